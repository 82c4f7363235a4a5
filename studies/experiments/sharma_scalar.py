"""A scalar random walk x_k = x_(k-1) + w with measurements z_k = x_k + v, w and v correlated with rho, which no rule
knows. At each instant the prior, N(estimate, P + Q), is fused with the measurement's density, N(z, R), and the result
is the estimate from which the next prior comes: each rule runs a filter of its own. The paper's Fig. 3 shows the weight
over time: CI 0, ICI 1 (either is the measurement alone), HMD-GA about 0.2.

The weight is that of the prior in each rule's own formula, as printed: CI (78) weighs inverse variances, ICI (79)
variances, HMD-GA (77) with G = (1-w)(P+Q) + w R + w(1-w) d^2, d the difference of the means. The paper gives neither
Q, R nor rho. R = 1 here (only Q/R matters), the first estimate is drawn with variance R, so that the prior is always
the worse of the two for CI and ICI; 60 instants, of which the first 10 are not counted. Q/R = 1 stands for the paper's
curve. The printed 0.2 is put beside every choice, to see which give it.

"MSE / reported": the mean squared error of the result over the mean of what HMD-GA reports, over the same instants;
above 1 it is too sure of itself.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from studies.pictures import colour
from studies.rules import Fuser, fuser
from studies.statistics import Estimate, mean
from studies.study import Floats, Result, Row, Run, Study

RATIOS = (0.1, 0.3, 1.0, 3.0, 10.0)
CORRELATIONS = (-0.9, -0.5, 0.0, 0.5, 0.9)
MAIN = 1.0
STEPS, WARM = 60, 10
PUBLISHED = {"ci": 0.0, "ici": 1.0, "hmd-ga": 0.2}


class Walk(NamedTuple):
    """Of cases c: weight of the prior over time (STEPS, C); means over the counted instants (C, M) of weight, squared
    error and reported variance; the largest difference of a weight from the maximum of (77)."""

    over_time: Floats
    weight: Floats
    squared: Floats
    reported: Floats
    off: float


def walk(rule: Fuser, ratio: Floats, rho: Floats, rng: np.random.Generator, runs: int) -> Walk:
    """Filters by `rule` with Q = ratio (C,), R = 1 and rho (C,), on the same draws; errors only, since the truth is a
    common shift."""
    cases = len(ratio)
    Q, rho = ratio[:, None], rho[:, None]
    e, P, R = np.broadcast_to(rng.standard_normal(runs), (cases, runs)), np.ones((cases, runs)), np.ones((cases, runs))
    over_time, sums, off = np.empty((STEPS, cases)), np.zeros((3, cases, runs)), 0.0
    for k in range(STEPS):
        v, rest = rng.standard_normal((2, runs))
        w = np.sqrt(Q) * (rho * v + np.sqrt(1 - rho**2) * rest)
        means = np.stack([e - w, np.broadcast_to(v, (cases, runs))]).reshape(2, 1, -1)
        variances = np.stack([P + Q, R]).reshape(2, 1, 1, -1)
        fused = rule(means, variances)
        off = max(off, float(np.abs(fused.weights[0] - best(variances[:, 0, 0], means[1, 0] - means[0, 0])).max()))
        weight, e, P = (a.reshape(cases, runs) for a in (fused.weights[0], fused.mean, fused.covariance))
        over_time[k] = weight.mean(axis=1)
        if k >= WARM:
            sums += np.stack([weight, e**2, P])
    weight, squared, reported = sums / (STEPS - WARM)
    return Walk(over_time, weight, squared, reported, off)


def best(variances: Floats, d: Floats) -> Floats:
    """Where G of (77) is largest: it is a parabola in w. variances (2, M), d (M,)."""
    with np.errstate(divide="ignore"):
        w: Floats = np.clip(0.5 - 0.5 * (variances[0] - variances[1]) / d**2, 0.0, 1.0)
    return w


def honesty(squared: Floats, reported: Floats) -> Estimate:
    """MSE over mean reported variance, of (M,) each; error by the delta method."""
    ratio = float(squared.mean() / reported.mean())
    return Estimate(ratio, mean(squared - ratio * reported).stderr / float(reported.mean()))


def run(run: Run) -> Result:
    rows: list[Row] = []
    honest: list[Row] = []
    over_time: dict[str, Floats] = {}
    table: dict[tuple[float, float], Estimate] = {}
    for number, rule in enumerate(map(fuser, PUBLISHED), 1):
        ratios = RATIOS if rule.label == "hmd-ga" else (MAIN,)
        cases = [(ratio, rho) for ratio in ratios for rho in CORRELATIONS]
        ratio_of, rho_of = np.array(cases).T
        walked = walk(rule, ratio_of, rho_of, run.rng(), run.runs)
        over_time[rule.label] = walked.over_time[:, cases.index((MAIN, 0.5))]
        for (ratio, rho), weight, squared, reported in zip(cases, *walked[1:4], strict=True):
            one, where = mean(weight), f"rho = {rho:g}"
            name, stderr = f"{rule.label}: weight at Q/R = {ratio:g}", one.stderr if one.stderr > 1e-12 else None
            rows.append(Row(name, where, PUBLISHED[rule.label], one.value, stderr, int(rule.label == "hmd-ga")))
            if rule.label == "hmd-ga":
                table[ratio, rho] = one
                honest.append(
                    Row(f"hmd-ga: MSE / reported at Q/R = {ratio:g}", where, None, *honesty(squared, reported))
                )
        run.progress(number / len(PUBLISHED), rule.label)
    near = [f"{q:g} with {rho:g}" for (q, rho), one in table.items() if abs(one.value - 0.2) < 0.05]
    sure = [row for row in honest if row.ours > 1 + 3 * (row.stderr or 0.0)]
    worst = 100 * max(row.ours - 1 for row in honest)
    notes = (
        "CI always 0 and ICI always 1, so that the measurement alone is left: comes out for every rho, since the "
        f"prior's variance R + Q is above R. HMD-GA about 0.2: comes out at Q/R = {MAIN:g} with rho = 0.5 "
        f"({table[MAIN, 0.5].value:.3f}). Of the choices tried, Q/R with rho, a mean weight between 0.15 and 0.25 is "
        f"given by {', '.join(near)}; smaller Q/R gives more, larger Q/R and negative rho less.",
        "The weight that HMD-GA chose is where (77) is best, for scalars w = (1 - (P + Q - R) / d^2) / 2 kept within "
        f"0 and 1: the largest difference was {walked.off:.0e}. It is 0, the measurement alone, whenever "
        "d^2 < P + Q - R: an average of 0.2 is one of many zeros and some values up to 1/2.",
        f"HMD-GA reported less than its mean squared error, beyond three standard errors, at {len(sure)} of "
        f"{len(honest)} choices, by up to {worst:.0f} %: with negative rho, and Q not small. The measurement alone, "
        "which CI and ICI leave, is honest at all of them.",
    )
    return Result(tuple(rows + honest), notes, partial(picture, over_time, table), (11.0, 4.5))


def picture(over_time: dict[str, Floats], table: dict[tuple[float, float], Estimate], figure: Any) -> None:
    left, right = figure.subplots(1, 2)
    for label, weight in over_time.items():
        left.plot(np.arange(1, STEPS + 1), weight, color=colour(label), label=label)
    left.set(xlabel="instant", ylabel="mean weight of the prior", ylim=(-0.03, 1.03))
    left.set_title(f"Fusion weights as in Fig. 3: Q/R = {MAIN:g}, rho = 0.5", fontsize=10)
    left.legend(loc="center right", frameon=False)
    for shade, rho in zip(("#c7e9c0", "#a1d99b", "#74c476", "#31a354", "#006d2c"), CORRELATIONS, strict=True):
        right.semilogx(
            RATIOS, [table[q, rho].value for q in RATIOS], "o-", color=shade, markersize=4, label=f"rho = {rho:g}"
        )
    right.axhline(PUBLISHED["hmd-ga"], color="#000000", linewidth=0.9, linestyle=(0, (4, 2)))
    right.annotate("published", (RATIOS[-1], 0.2), xytext=(0, 4), textcoords="offset points", ha="right", fontsize=9)
    right.set(xlabel="Q / R", ylabel="mean weight of the prior", ylim=(0.0, None))
    right.set_title("HMD-GA: the weight depends on what the paper does not give", fontsize=10)
    right.legend(frameon=False, fontsize=9)


STUDIES = (
    Study(
        name="sharma-scalar-weights",
        title="Fusion weights of scalar estimates",
        source="Sharma 6.1, Fig. 3",
        about=__doc__ or "",
        run=run,
        runs=10_000,
        quick=500,
        seconds=10.0,
        published_runs=500,
    ),
)
