"""100 sonobuoys in 10 x 10 km hear the bearing of one underwater target; four trackers, each with the 25 of its own
5 x 5 km, filter it and fuse their tracks at every node (Dubey IV). T = 15 s, 144 steps (36 min), R = (2 deg)^2, sensors
selected anew every 2 min. Target at 10 knots: from (9, 9) km on course -130 deg, nearly constant velocity; or from
(8.5, 8) km on course -165 deg turning by -1.84 deg/min. Courses and bearings are clockwise from north, turns
counterclockwise; then the target meets trackers 4, (2,) 1 as the paper says.

**Chosen, where the paper is silent or wrong.**

* Sensors: 25 uniform in each square, 20 layouts; the paper shows one, unknown. Every number is the mean of 20 layouts,
  its standard error that of this mean; "agrees" takes the published number for that of one layout drawn at random.
* Selection: least trace of the *inverse* of the Fisher information at the tracker's own estimate (as printed, of
  itself, it takes the farthest), the best pair of all 300, further sensors one at a time. At the first step about
  the true place.
* First estimate: place and covariance by triangulation, (30), (33). Velocity: the true one with an error of variance
  v_m^2 / 3 a component, v_m = 0.5 knot. The paper gives no v_m; the axis of its Fig. 10 ends at 0.5 knot, and with
  v_m = 10 knots the velocity errors of the first minutes alone exceed its table. (31) as printed, the difference
  of two triangulations, has an error of tens of knots, and (32) does not know it. Turn rate: the true one +- 0.1
  deg/min.
* Process noise q1 = 1.944 m^2/min^3 in the truth as in the filters (else NEES would be far below n); (5) with its two
  signs exchanged; q2 = 0.01 deg^2/min^3, not rad^2.
* Local filter: the shifted Rayleigh filter, bearings one after another; in the turning scenario it predicts as the
  CKF does.
* Table III sets "individual tracks without fusion" beside HMD: the tracks run alone, and what is fused goes nowhere.
  "Fed back": all four trackers go on from the fused density. Both are run.
* Weights "(23)": least dispersion of the symmetrised divergences, found from equal weights. As they cost
  milliseconds, they are evaluated once in 3 min (at 1.5, 4.5, ... 34.5 min); "GMD (23)" and "AMD (23)" take the same
  weights. GMD of Gaussians has a closed form: it is covariance intersection.
* A run has diverged if its error at the end exceeds 1 km; it is left out of the averages of that track. The number of
  runs is not in the text (percentages such as 0.64 and 0.59 want 10,000).
* ANEES is not divided by n: consistent is 4, or 5 with the turn rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fusion_service.rules import fuse_last
from studies import sonobuoys
from studies.pictures import colour
from studies.rules import Fuser, fuser
from studies.sonobuoy_scores import Stats, averages, bounds, curve, distances, errors, gathered, lost, over
from studies.sonobuoys import CT, CV, FILTERS, KNOT, STEPS, Readings, Scenario
from studies.study import Floats, Result, Row, Run, Study

NAMES = ("Track-1", "Track-2", "Track-3", "Track-4")
RULES = {
    "AMD equal": "aa:weights=uniform",
    "GMD equal": "ci:weights=uniform",
    "GMD det": "ci",
    "HMD equal": "hmd-ga:weights=uniform",
    "HMD det": "hmd-ga",
}
KINDS = ("HMD", "GMD", "AMD")
DISPERSION = "hmd-ga:criterion=kl"
LAYOUTS, CHUNK = 20, 5
FEW = 100
"""Below so many runs (in CI) what is slow for few runs as well is left out."""
SPREAD = "n = 2: position, sd between layouts, m"
SPARSE = 12
"""Weights (23) are found at one step in so many."""
STYLE: dict[str, dict[str, Any]] = {
    "Track-1": {"color": "#1f77b4", "lw": 1.2},
    "Track-2": {"color": "#ff7f0e", "lw": 1.2},
    "Track-3": {"color": "#9467bd", "lw": 1.2},
    "Track-4": {"color": "#d62728", "lw": 1.2},
    "HMD equal": {"color": colour("hmd-ga"), "lw": 1.6, "ls": ":"},
    "HMD det": {"color": colour("hmd-ga"), "lw": 1.8},
    "HMD (23)": {"color": colour("hmd-ga"), "lw": 1.2, "ls": "--", "marker": "x", "ms": 4},
}
POSITION = {
    1: {2: (67.81, 55.23, 47.19, 39.71, 22.29), 3: (63.42, 53.94, 55.13, 37.14, 20.64),
        4: (61.98, 52.37, 44.56, 36.54, 19.36)},
    2: {2: (58.60, 39.80, 76.10, 43.40, 22.70), 3: (55.40, 37.20, 71.50, 40.20, 21.10),
        4: (53.80, 36.40, 68.40, 38.70, 20.80)},
}  # fmt: skip
VELOCITY = {
    1: {2: (0.2786, 0.2660, 0.2506, 0.2228, 0.2191), 3: (0.2684, 0.2516, 0.2408, 0.2178, 0.2118),
        4: (0.2648, 0.2438, 0.2364, 0.2142, 0.2084)},
    2: {2: (0.2786, 0.2527, 0.3402, 0.2495, 0.2333), 3: (0.2696, 0.2484, 0.3312, 0.2378, 0.2218),
        4: (0.2658, 0.2446, 0.3272, 0.2342, 0.2164)},
}  # fmt: skip
DIVERGED = {
    1: {2: (0.0, 0.65, 0.70, 1.90, 0.0), 3: (0.0, 0.60, 0.64, 1.15, 0.0), 4: (0.0, 0.59, 0.60, 1.10, 0.0)},
    2: {2: (0.05, 0.25, 1.15, 2.30, 0.0), 3: (0.0, 0.20, 1.05, 1.95, 0.0), 4: (0.0, 0.20, 1.00, 1.90, 0.0)},
}
"""Tables II and III, by scenario and number of sensors: tracks 1 to 4, HMD."""
PRINTED, ITSELF = "(31) as printed, v_m = 10 knots", "trace of the Fisher information itself"
VARIANTS = {
    "as chosen": Readings(),
    "v_m = 1 knot": Readings(top_speed=KNOT),
    "v_m = 10 knots": Readings(top_speed=10 * KNOT),
    "v_m = 10 knots, velocity 0": Readings("zero", 10 * KNOT, turn_spread=np.radians(2.0) / 60),
    PRINTED: Readings("triangulated", 10 * KNOT, turn_spread=np.radians(2.0) / 60),
    "no process noise in the truth": Readings(driven=False),
    ITSELF: Readings(inverse=False),
    "q2 in rad^2/min^3": Readings(q2=0.01 / 60**3),
}


@dataclass(frozen=True, slots=True)
class Job:
    """Missions of one kind in `CHUNK` layouts, `runs` in each. fusions: by label, made of tracks that run alone,
    at all steps or at one of `every`; consensus: the label of the rule of RULES that is fed back."""

    scenario: Scenario
    seed: int
    layouts: tuple[int, ...]
    runs: int
    count: int = 2
    filter: str = "SRF"
    consensus: str = ""
    fusions: tuple[str, ...] = ()
    own: tuple[Fuser, ...] = ()
    every: int = 1
    readings: Readings = Readings()


def fly(job: Job) -> Stats:
    L, R = len(job.layouts), job.runs
    rng = np.random.default_rng([job.seed, 1, job.layouts[0]])
    fields = [sonobuoys.field(np.random.default_rng([job.seed, 0, one]), 1) for one in job.layouts]
    sensors = np.repeat(np.concatenate(fields, axis=-1), R, axis=-1)
    consensus = fuser(RULES[job.consensus]) if job.consensus else None
    true, tracks = sonobuoys.fly(job.scenario, rng, sensors, job.count, job.filter, consensus, job.readings)
    at = slice(job.every // 2, None, job.every)
    true, means, covariances = true[at], tracks.means[at], tracks.covariances[at]
    out = Stats()

    def keep(label: str, mean: Floats, covariance: Floats) -> None:
        out[label] = errors(true, mean, covariance).reshape(3, -1, L, R)

    if job.consensus:
        keep(f"{job.consensus}, fed back", means[:, 0], covariances[:, 0])
        return out
    for j, name in enumerate(NAMES):
        keep(name, means[:, j], covariances[:, j])
    K, N, n, M = means.shape
    x, P = means.transpose(1, 2, 0, 3).reshape(N, n, -1), covariances.transpose(1, 2, 3, 0, 4).reshape(N, n, n, -1)

    def keep_fused(label: str, mean: Floats, covariance: Floats, weights: Floats) -> None:
        keep(label, mean.reshape(n, K, M).swapaxes(0, 1), covariance.reshape(n, n, K, M).transpose(2, 0, 1, 3))
        out[f"weights {label}"] = weights.reshape(N, K, L, R).swapaxes(0, 1)

    for label in job.fusions:
        if label == "(23)":
            w = fuser(DISPERSION)(x, P).weights
            for kind, rule in zip(KINDS, ("hmd-ga", "ci", "aa"), strict=True):
                fused = fuse_last(rule, x, P, w)
                keep_fused(f"{kind} (23)", fused.mean, fused.covariance, w)
        else:
            fused = fuser(RULES[label])(x, P)
            keep_fused(label, fused.mean, fused.covariance, fused.weights)
    for own in job.own:
        fused = own(x, P)
        keep_fused(own.label, fused.mean, fused.covariance, fused.weights)
    return out


def jobs(scenario: Scenario, run: Run) -> dict[str, Job]:
    """One job of each kind, by its key in the results; its layouts and runs are the most any of the kind has."""
    few = run.runs < FEW
    each = max(run.runs // LAYOUTS, 1) if not few else run.runs // 2
    layouts = tuple(range(LAYOUTS if not few else 2))
    base = Job(scenario, run.seed, layouts, each)
    out = {"n2": replace(base, fusions=tuple(RULES))}
    for n in (3, 4):
        out[f"n{n}"] = replace(base, count=n, fusions=("HMD equal", "HMD det"))
    for n in (2,) if few else (2, 3, 4):
        out[f"(23) n{n}"] = replace(base, count=n, every=6 * SPARSE if few else SPARSE, fusions=("(23)",))
    for label in ("GMD equal", "HMD equal") if few else RULES:
        out[f"{label}, fed back"] = replace(base, consensus=label)
    for name in ("CKF", "UKF") if few else FILTERS:
        out[name] = replace(base, filter=name, fusions=("HMD equal",))
    for name, readings in VARIANTS.items() if not few else ():
        if scenario.n == 5 or "q2" not in name:
            out[name] = replace(base, readings=readings, fusions=("HMD equal",), runs=max(each // 2, 1))
    return out


def results(scenario: Scenario, run: Run) -> dict[str, Stats]:
    """What came of every kind of job."""
    kinds = jobs(scenario, run)
    work = {
        (key, start): replace(job, layouts=job.layouts[start : start + CHUNK])
        for key, job in kinds.items()
        for start in range(0, len(job.layouts), CHUNK)
    }
    answers = dict(zip(work, run.map(fly, work.values(), "missions"), strict=True))
    out = {key: gathered([answers[at] for at in work if at[0] == key]) for key in kinds}
    if run.rules:
        own = [fly(replace(work[at], fusions=(), own=run.rules)) for at in work if at[0] == "n2"]
        out["own"] = gathered(own)
    return out


def table_rows(scenario: Scenario, out: dict[str, Stats]) -> list[Row]:
    """Tables III and II."""
    rows, number = [], scenario.number
    for n in (2, 3, 4):
        tracks = {name: out[f"n{n}"][name] for name in (*NAMES, "HMD equal", "HMD det")}
        if f"(23) n{n}" in out:
            tracks["HMD (23)"] = out[f"(23) n{n}"]["HMD (23)"]
        if n == 2:
            tracks |= out["HMD equal, fed back"]
        for k, (what, table, places) in enumerate((("position, m", POSITION, 2), ("velocity, knots", VELOCITY, 4))):
            for at, (name, stats) in enumerate(tracks.items()):
                values = averages(stats)[k]
                rows.append(Row(name, f"n = {n}: {what}", table[number][n][min(at, 4)], *over(values), places))
        for at, name in enumerate((*NAMES, "HMD equal")):
            share = 100 * lost(tracks[name]).mean(axis=1)
            rows.append(Row(name, f"n = {n}: diverged, %", DIVERGED[number][n][at], *over(share), 2))
    for name in (*NAMES, "HMD equal", "HMD det"):
        stats = out["n2"][name]
        rows.append(Row(name, "n = 2: ever beyond 1 km, %", None, *over(100 * lost(stats, False).mean(axis=1))))
        spread = float(averages(stats)[0].std(ddof=1))
        rows.append(Row(name, SPREAD, None, spread))
    return rows


def more_rows(scenario: Scenario, out: dict[str, Stats], own: Sequence[str]) -> list[Row]:
    """Fusions, filters, consistency, weights and segments, at n = 2; then the readings."""
    rows = []
    fused = {key: out["n2"][key] for key in RULES} | {f"{kind} (23)": out["(23) n2"][f"{kind} (23)"] for kind in KINDS}
    fused |= {key: out[key][key] for key in out if "fed back" in key}
    fused |= {label: out["own"][label] for label in own}
    for k, what in enumerate(("position, m", "velocity, knots", "ANEES")):
        rows += [Row(key, f"fusions: {what}", None, *over(averages(stats)[k])) for key, stats in fused.items()]
    for k, what in enumerate(("position, m", "velocity, knots")):
        few = out["(23) n2"]["HMD (23)"]
        every = (STEPS + 1) // few.shape[1]
        for name, stats in (("HMD (23)", few), ("HMD equal", fused["HMD equal"][:, every // 2 :: every])):
            rows.append(Row(name, f"at the steps of (23): {what}", None, *over(averages(stats)[k])))
        for name in filter(out.__contains__, FILTERS):
            rows.append(Row(name, f"filters, HMD equal: {what}", None, *over(averages(out[name]["HMD equal"])[k])))
    shown = {name: out["n2"][name] for name in (*NAMES, "GMD det", "HMD equal", "HMD det")}
    for name in NAMES:
        rows.append(Row(name, "ANEES", None, *over(averages(shown[name])[2])))
    for name, stats in shown.items():
        anees, (low, high) = curve(stats)[2], bounds(scenario.n, stats[0, 0].size)
        inside = float(100 * np.mean((anees > low) & (anees < high)))
        rows.append(Row(name, "steps inside the bounds (34), (35), %", None, inside))
    for key, label in (("(23) n2", "HMD (23)"), ("n2", "HMD det"), ("n2", "GMD det")):
        w = out[key][f"weights {label}"]
        order = np.argsort(distances(scenario, (STEPS + 1) // len(w)), axis=1)
        for what, column in (("nearest", order[:, 0]), ("farthest", order[:, -1])):
            values = w[np.arange(len(w)), column].mean(axis=(0, 2))
            rows.append(Row(label, f"mean weight of the {what} tracker", None, *over(values)))
    for part in range(3):
        steps = slice(48 * part, 48 * (part + 1) + 1)
        for name in (*NAMES, "HMD equal", "HMD det"):
            values = averages(out["n2"][name], steps)[0]
            rows.append(Row(name, f"minutes {12 * part}-{12 * part + 12}: position, m", None, *over(values)))
    for name in filter(out.__contains__, VARIANTS):
        by_track = out[name]
        if name != ITSELF:
            for one in ("Track-1", "Track-4", "HMD equal"):
                position, velocity, _ = averages(by_track[one])
                rows.append(Row(f"{name}: {one}", "readings: position, m", None, *over(position)))
                rows.append(Row(f"{name}: {one}", "readings: velocity, knots", None, *over(velocity)))
        if name in (PRINTED, ITSELF):
            for one in (*NAMES, "HMD equal"):
                rows.append(
                    Row(f"{name}: {one}", "readings: diverged, %", None, *over(100 * lost(by_track[one]).mean(1)))
                )
    return rows


def notes(scenario: Scenario, rows: Sequence[Row], run: Run) -> tuple[str, ...]:
    value = {(row.name, row.quantity): row.ours for row in rows}

    def told(quantity: str, *names: str, digits: int = 1) -> list[str]:
        return [f"{value[name, quantity]:.{digits}f}" for name in names]

    means = told("at the steps of (23): position, m", "HMD (23)", "HMD equal")
    means += told("n = 2: position, m", "HMD equal", "HMD det")
    near = told("mean weight of the nearest tracker", "HMD (23)", "HMD det", digits=2)
    far = told("mean weight of the farthest tracker", "HMD (23)", "HMD det", digits=2)
    anees = told("fusions: ANEES", "HMD equal", "HMD (23)", "HMD det", "AMD equal", "GMD equal", digits=2)
    text = [
        "The paper's layout is unknown. Between layouts the position ARMSE at n = 2 has a standard deviation of "
        f"{', '.join(told(SPREAD, *NAMES, 'HMD equal'))} m (tracks 1 to 4, HMD with equal weights).",
        f"Weights: (23), which the paper optimises, gives {means[0]} m, equal weights at the same steps {means[1]} m "
        f"(at all steps {means[2]} m), det weights {means[3]} m. That (23) is superior to equal weights, and gives the "
        f"nearest tracker the most (Figs. 3, 4), does not come out: the nearest gets {near[0]}, the farthest {far[0]} "
        f"on average. By det it is {near[1]} and {far[1]}, as the paper describes it. HMD follows the best local "
        "track, and is better than it, with det weights only.",
        "ANEES: the local tracks are consistent. HMD inside the bounds throughout does not come out at equal weights "
        f"({anees[0]}) or by (23) ({anees[1]}), where it is too wide; by det ({anees[2]}) it is inside while one "
        f"tracker has nearly all the weight. AMD ({anees[3]}) is far too wide, as the paper says; so is GMD at equal "
        f"weights ({anees[4]}).",
        f"Divergence: 0 of {run.runs} runs excludes more than {300 / run.runs:.2g} %. Far tracks begin beyond 1 km "
        "in some runs, since two bearings from 5 to 10 km away place a target no better. The printed percentages grow "
        "with the distance at the end, so they are taken to be counted there; neither (31) as printed nor the Fisher "
        "information as printed gives them (last rows).",
    ]
    if scenario.number == 1:
        text.append("Table III, n = 3, Track-3: 55.13 exceeds the 47.19 of n = 2: a misprint, probably.")
    if run.runs >= FEW:
        text += [
            "Fed back, HMD by det is too sure of itself: what four posteriors of one prior share is counted "
            "more than once. (23) is not run fed back: it would be 145 searches one after another.",
            "That all filters do the same comes out. Readings: half of the runs, and without lost runs, whose share is "
            "given where there are any.",
        ]
    return tuple(text)


def draw(figure: Any, scenario: Scenario, seed: int, out: dict[str, Stats]) -> None:
    axes = figure.subplots(2, 3)
    _draw_field(axes[0, 0], scenario, seed)
    minutes = np.arange(STEPS + 1) / 4
    sparse = out["(23) n2"]
    curves = {name: (minutes, curve(out["n2"][name])) for name in (*NAMES, "HMD equal", "HMD det")}
    few = curve(sparse["HMD (23)"])
    every = (STEPS + 1) // few.shape[1]
    rare = minutes[every // 2 :: every]
    curves["HMD (23)"] = (rare, few)
    titles = ("RMSE of position, m", "RMSE of velocity, knots", "ANEES")
    for k, (ax, title) in enumerate(zip((axes[0, 1], axes[0, 2], axes[1, 0]), titles, strict=True)):
        for name, (time, values) in curves.items():
            ax.plot(time, values[k], label=name, **STYLE[name])
        ax.set(title=title, xlabel="minutes", xlim=(0, 36))
    axes[0, 1].set_yscale("log")
    for ax in (axes[0, 1], axes[0, 2]):
        ax.set_ylim(top=2.2 * ax.get_ylim()[1] if ax is axes[0, 1] else 1.3 * ax.get_ylim()[1])
    axes[0, 1].legend(ncols=2, fontsize="x-small", loc="upper center")
    low, high = bounds(scenario.n, out["n2"]["Track-1"][0, 0].size)
    axes[1, 0].axhspan(low, high, color="0.8", zorder=0)
    axes[1, 0].set_ylim(0, 1.5 * scenario.n)
    axes[1, 0].text(35.5, 1.42 * scenario.n, "grey: 95 % of a consistent filter", ha="right", fontsize="small")
    weights = (("HMD (23)", rare, sparse), ("HMD det", minutes, out["n2"]))
    for ax, (label, time, stats) in zip(axes[1, 1:], weights, strict=True):
        for j, name in enumerate(NAMES):
            ax.plot(time, stats[f"weights {label}"][:, j].mean(axis=(1, 2)), label=name, **STYLE[name])
        what = "by dispersion (23)" if "23" in label else "by det"
        ax.set(title=f"mean weight in HMD, {what}", xlabel="minutes", xlim=(0, 36), ylim=(-0.02, 1.02))
    axes[1, 2].legend(fontsize="x-small")


def _draw_field(ax: Any, scenario: Scenario, seed: int) -> None:
    sensors = sonobuoys.field(np.random.default_rng([seed, 0, 0]), 1)
    true, tracks = sonobuoys.fly(scenario, np.random.default_rng([seed, 1, 0]), sensors)
    fused = fuser(RULES["HMD det"])(
        tracks.means[..., 0].transpose(1, 2, 0), np.moveaxis(tracks.covariances[..., 0], 0, -1)
    )
    ax.plot(*sensors.reshape(2, -1) / 1000, ".", color="0.6", ms=3)
    ax.plot(*sonobuoys.centres() / 1000, "^", color="0.3", ms=6)
    for j, name in enumerate(NAMES):
        ax.plot(*tracks.means[:, j, :2, 0].T / 1000, **STYLE[name] | {"lw": 0.8})
    ax.plot(*fused.mean[:2] / 1000, **STYLE["HMD det"] | {"lw": 2.5})
    ax.plot(*true[:, :2, 0].T / 1000, color=colour("truth"), lw=1)
    for j, (x, y) in enumerate(sonobuoys.centres().T / 1000):
        ax.annotate(str(j + 1), (x, y), (5, 4), textcoords="offset points", color=STYLE[NAMES[j]]["color"])
    ax.axhline(5, color="0.7", lw=0.6)
    ax.axvline(5, color="0.7", lw=0.6)
    ax.set(
        xlim=(0, 10), ylim=(0, 10), aspect="equal", xlabel="east, km", ylabel="north, km", title="one run: tracks, HMD"
    )


def run(scenario: Scenario, run: Run) -> Result:
    out = results(scenario, run)
    rows = table_rows(scenario, out) + more_rows(scenario, out, [rule.label for rule in run.rules])
    return Result(
        tuple(rows),
        notes(scenario, rows, run),
        partial(draw, scenario=scenario, seed=run.seed, out=out),
        (14.0, 8.4),
    )


STUDIES = tuple(
    Study(
        name=f"dubey-sonobuoys-{what}",
        title=f"Sonobuoys and four trackers, {words}: tracks, HMD, GMD and AMD",
        source=f"Dubey IV.{section}",
        about=__doc__ or "",
        run=partial(run, scenario),
        runs=1000,
        quick=6,
        seconds=seconds,
        published_runs=50,
        takes_rules=True,
    )
    for what, words, section, scenario, seconds in (
        ("cv", "constant velocity", "B", CV, 140.0),
        ("ct", "constant turn rate", "C", CT, 260.0),
    )
)
