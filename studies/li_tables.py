"""The rows of Li-AA's Tables I and II: six ways to use two sensors, each with a Gaussian and with a SIR filter, then
the other readings of the text; and the picture of them over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.rules import fuse_last
from fusion_service.rules.face import Fused
from studies.feedback import Fuse, Model, Record, Scene, alone, gaussian, join, simulate, sir, sir_fused
from studies.pictures import colour
from studies.rules import fuser
from studies.statistics import armse, mean
from studies.study import Floats, Row, Run

__all__ = ["draw", "records", "rows", "weight_row"]

CHUNK = 50
"""Runs of particles at a time: what fits the cache."""
Weigh = Callable[[Floats, Floats], Floats]


def _shares(measure: Callable[[Floats], Floats], means: Floats, covariances: Floats) -> Floats:
    """Weights (2, B) inversely proportional to a measure of the covariances."""
    inverse = np.stack([1.0 / measure(P) for P in covariances])
    return np.asarray(inverse / inverse.sum(axis=0))


def _diversity(means: Floats, covariances: Floats) -> Floats:
    return fuse_last("aa", means, covariances, criterion="diversity").weights


def _weights(weights: float | Weigh, means: Floats, covariances: Floats) -> Floats:
    """(2, B): that of sensor 1 given, or a function."""
    if callable(weights):
        return weights(means, covariances)
    return np.repeat([[weights], [1.0 - weights]], means.shape[-1], axis=1)


def _ci(weights: float | Weigh) -> Fuse:
    """CI with weights that it would not choose itself."""
    return lambda means, covariances: fuse_last("ci", means, covariances, _weights(weights, means, covariances))


def _largest(weights: float | Weigh = 0.5) -> Fuse:
    """CU as (8) and its footnote have it: that one of the P_i + (x - x_i)(x - x_i)' whose trace is the larger."""

    def fuse(means: Floats, covariances: Floats) -> Fused:
        w = _weights(weights, means, covariances)
        x = w[0] * means[0] + w[1] * means[1]
        d = means - x
        U = covariances + d[:, :, None] * d[:, None]
        return Fused(x, np.where(linalg.trace(U[0]) >= linalg.trace(U[1]), U[0], U[1]), w, None)

    return fuse


DIVERSITY = fuser("aa:criterion=diversity")
FUSED: Mapping[str, Fuse] = {
    "nf": fuser("naive"),
    "aa": DIVERSITY,
    "ci": fuser("ci:criterion=trace"),
    "cu": _largest(),
}
FUSION: Mapping[str, Fuse | None] = {"noncoop": alone, "ic": None, **FUSED}
INVERSE_TRACE: Weigh = partial(_shares, linalg.trace)
INVERSE_DET: Weigh = partial(_shares, linalg.det)
OTHERS: Mapping[str, Fuse] = {
    "aa bound (45)": fuser("aa:criterion=bound"),
    "aa uniform": fuser("aa"),
    "ci det": fuser("ci:criterion=det"),
    "ci 1/det": _ci(INVERSE_DET),
    "ci 1/trace": _ci(INVERSE_TRACE),
    "ci w1 = 1/2": _ci(0.5),
    "cu least trace (7)": fuser("cu:criterion=trace"),
    "cu least det (7)": fuser("cu:criterion=det"),
    "cu min (9)": fuser("cu:criterion=trace,bound=min"),
    "cu weights (40)": _largest(_diversity),
    "cu w1 = 1/4": _largest(0.25),
    "cu w1 = 1": _largest(1.0),
}
CLOUDS: Mapping[str, Callable[..., Record]] = {
    "noncoop": partial(sir, joint=False),
    "ic": partial(sir, joint=True),
    **{name: partial(sir_fused, rule=rule, union=name == "aa") for name, rule in FUSED.items()},
    "noncoop multinomial": partial(sir, joint=False, systematic=False),
    "aa from a Gaussian": partial(sir_fused, rule=DIVERSITY),
    "ci 1/det": partial(sir_fused, rule=OTHERS["ci 1/det"]),
    "cu w1 = 1/4": partial(sir_fused, rule=OTHERS["cu w1 = 1/4"]),
    "ic multinomial": partial(sir, joint=True, systematic=False),
}


def records(run: Run, model: Model, kind: str, exact: bool) -> dict[str, Record]:
    """Every filter by its name, the twelve of the paper first; `kind`: the Gaussian filter's name; `exact`: where the
    truth starts (`simulate`). The rows named after the other start have the other."""
    sizes = [min(CHUNK, run.runs - start) for start in range(0, run.runs, CHUNK)]
    scenes = [simulate(model, run.rng(chunk), size, exact) for chunk, size in enumerate(sizes)]
    elsewhere = [simulate(model, run.rng(chunk, 1), size, not exact) for chunk, size in enumerate(sizes)]
    extra = {rule.label: rule for rule in run.rules}
    found: dict[str, list[Record]] = {}
    for number in range(0, len(scenes), 5):
        scene, other = (Scene(*join(some[number : number + 5])) for some in (scenes, elsewhere))
        start = "truth from P0" if exact else "truth at mu0"
        parts = (
            ("", gaussian(model, scene, {**FUSION, **OTHERS, **extra})),
            (" without feedback", gaussian(model, scene, FUSED, feedback=False)),
            (f" {start}", gaussian(model, other, FUSION)),
        )
        for suffix, part in parts:
            for name, record in part.items():
                found.setdefault(f"{kind}-{name}{suffix}", []).append(record)
        run.progress(min(1.0, (number + 5) / len(scenes)), kind)
    work = partial(_clouds, model, run.seed)
    for answer in run.map(work, enumerate(scenes), "SIR"):
        for name, record in answer.items():
            found.setdefault(f"sir-{name}", []).append(record)
    names = [f"{one}-{name}" for one in (kind, "sir") for name in FUSION]
    names += [f"{kind}-{label}" for label in extra]
    return {name: Record(*join(found[name])) for name in [*names, *(name for name in found if name not in names)]}


def _clouds(model: Model, seed: int, item: tuple[int, Scene]) -> dict[str, Record]:
    chunk, scene = item
    return {
        name: cloud(model, scene, np.random.default_rng([seed, chunk, 2, number]))
        for number, (name, cloud) in enumerate(CLOUDS.items())
    }


def rows(model: Model, found: Mapping[str, Record], published: Mapping[str, tuple[float, ...]]) -> list[Row]:
    """The ARMSE of each filter."""
    out = []
    for name, record in found.items():
        for number, (quantity, _, _) in enumerate(model.errors):
            printed = published[name][number] if name in published else None
            out.append(Row(name, quantity, printed, *armse(record.squared[number]), decimals=2))
    return out


def weight_row(found: Mapping[str, Record], quantity: str, published: Mapping[str, float], steps: slice) -> list[Row]:
    """The mean weight of sensor 1 over some steps, of the filters whose weight the data decide."""
    return [
        Row(name, quantity, published.get(name), *mean(record.weight[steps].mean(axis=0)), decimals=3)
        for name, record in found.items()
        if record.weight[steps].std(axis=1).max() > 1e-9
    ]


LABELS = {"noncoop": "sensor 1 alone", "ic": "IC", "nf": "NF", "aa": "AA", "ci": "CI", "cu": "CU"}
STYLES: Mapping[str, dict[str, Any]] = {
    "noncoop": {"color": "#555555", "ls": "--", "zorder": 3},
    "ic": {"color": "#000000"},
    "nf": {"color": colour("naive")},
}


def draw(figure: Any, model: Model, found: Mapping[str, Record], kind: str) -> None:
    """RMSE over time, a row an error, a column a kind of filter; then the weight of sensor 1 under AA."""
    from matplotlib.ticker import LogLocator

    axes = figure.subplots(len(model.errors) + 1, 2, sharex=True, sharey="row")
    time = np.arange(1, model.steps + 1)
    for column, one in enumerate((kind, "sir")):
        axes[0, column].set_title(f"{one.upper()} filters with feedback, RMSE over {_count(found):,} runs")
        for ax, (number, (quantity, _, _)) in zip(axes[:, column], enumerate(model.errors), strict=False):
            for name, label in LABELS.items():
                rmse = np.sqrt(found[f"{one}-{name}"].squared[number].mean(axis=1))
                ax.plot(time, rmse, label=label, lw=1.3, **STYLES.get(name, {"color": colour(name)}))
            ax.set_ylabel(quantity)
        weight = found[f"{one}-aa"].weight
        middle, sd = weight.mean(axis=1), weight.std(axis=1)
        ax = axes[-1, column]
        ax.fill_between(time, middle - sd, middle + sd, color=colour("aa"), alpha=0.25, lw=0)
        ax.plot(time, middle, color=colour("aa"))
        ax.set_ylabel("AA: weight of sensor 1,\nmean and ± std. dev. over the runs")
        ax.set_xlabel("step k (s)")
    for ax in axes[:-1].flat:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
        low, high = ax.get_ylim()
        if high < 6 * low:
            ax.yaxis.set_minor_formatter("{x:g}")
        else:
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_minor_formatter("")
    for ax in axes.flat:
        ax.grid(alpha=0.3, which="both", lw=0.5)
        ax.tick_params(labelleft=True)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=6, frameon=False)


def _count(found: Mapping[str, Record]) -> int:
    return int(next(iter(found.values())).weight.shape[1])
