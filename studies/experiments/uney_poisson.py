"""Expected numbers fused. The exponential mixture (EMD) of two Poisson sets, PHD filters' output, has the rate
lambda_i^(1-omega) lambda_j^omega z: (30) as printed lacks the z, without which Proposition 3.4 would be about nothing.
"Consistent" is P4, (52) and (53), in the form that holds for either order of the rates: the logarithmic mean
(lambda_j - lambda_i) / ln(lambda_j / lambda_i). The paper gives no numbers for Poisson sets, only the claims below.

* **The example's Gaussians** (3.3, variances 1 and 1/kappa) as localisation, rates 10 and 10, equal weights.
* **Random pairs**: rates log-uniform in 0.5 ... 50; Gaussians with variances from 1 to 10, turned at random, means up
  to 2 sigma apart; omega = 1/2.
* **N sensors** with rate 10 each, kappa = 20, aspects spread over 180 degrees, independent errors.
* **End to end** (ours): 12 sites far apart. At site s a target appears at step 2 + 2 s; the odd sites' targets go at
  step 34. Each site has the target, the birth, the detection probability 0.7 and the 2 false reports a scan of
  `uney-bernoulli`; each sensor (noise variances 1 and 1/20) runs a PHD filter with one Gaussian a site (all hypotheses
  of a site are merged after every scan). Fused at every step without feedback, by intensities site by site: for the EMD
  that is exact, the sites being far apart. "Consistent" fuses the total, as P4 says; "consistent, by site" each site's
  mass. "Centralised" is one PHD filter with all reports, one sensor after the other. It takes a fifth of the runs.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy.stats import poisson

from fusion_service.existence import fuse_cardinality, fuse_poisson, loses_rate
from studies import uney
from studies.pictures import colour
from studies.statistics import armse, mean
from studies.study import Floats, Result, Row, Run, Study
from studies.uney import percent

KAPPAS = np.linspace(1.0, 40.0, 79)
RATE = 10.0
SENSORS = (2, 3, 4, 6, 8)
SITES, STEPS, GOING, KAPPA, TEAMS, PIECE = 12, 48, 34, 20.0, (2, 4), 50
METHODS = ("one sensor", "EMD", "EMD with z = 1", "average", "consistent", "consistent, by site", "centralised")
COLOURS = {
    "one sensor": "#888888",
    "EMD": colour("ci"),
    "EMD with z = 1": colour("bci"),
    "average": colour("aa"),
    "consistent": colour("hmd-ga"),
    "consistent, by site": colour("hmd-s"),
    "centralised": colour("ici"),
}


def printed(low: Floats, high: Floats) -> Floats:
    """lambda* (B,) of (52) and (53) as printed, low the first source's rate."""
    with np.errstate(all="ignore"):
        ratio = np.log(high / low)
        omega = (-np.log(ratio) + np.log(high / low - 1.0)) / ratio
        return np.asarray(low ** (1.0 - omega) * high**omega)


def presence() -> Any:
    """Where (STEPS, SITES) a target is."""
    k, s = np.arange(STEPS)[:, None], np.arange(SITES)
    return (k >= 2 + 2 * s) & ~((k >= GOING) & (s % 2 == 1))


def phd(seed: int, item: tuple[int, int, int]) -> Floats:
    """Estimated number of targets (METHODS, STEPS, M) of piece `item` = (number of sensors, piece, runs)."""
    N, piece, runs = item
    rng = np.random.default_rng([seed, N, piece])
    P = uney.aspects(np.full(SITES * runs, KAPPA), N)
    there = np.repeat(presence(), runs, axis=1)
    out = np.empty((len(METHODS), STEPS, runs))

    def total(a: Floats) -> Floats:
        return np.asarray(a.reshape(*a.shape[:-1], SITES, runs).sum(axis=-2))

    for k, (masses, z, centre) in enumerate(uney.network(rng, P, there, "phd")):
        site, whole = masses.T, total(masses)
        out[:, k] = (
            whole[0],
            total(fuse_poisson(site, "geometric", overlap=z)),
            total(fuse_poisson(site, "geometric", overlap=np.ones(len(z)))),
            fuse_poisson(whole.T, "average"),
            fuse_poisson(whole.T),
            total(fuse_poisson(site)),
            total(centre),
        )
    return out


def run(run: Run) -> Result:
    M = run.runs
    means, covariances = uney.example(KAPPAS)
    z = uney.overlap(means, covariances)
    equal = fuse_poisson(np.full((len(z), 2), RATE), "geometric", overlap=z)
    rows = [Row("10 and 10", "consistent rate", None, float(fuse_poisson([RATE, RATE])))]
    for kappa in (1.0, 10.0, 20.0, 40.0):
        rate = float(equal[int(np.argmin(np.abs(KAPPAS - kappa)))])
        rows.append(Row(f"10 and 10, kappa = {kappa:.0f}", "EMD rate", None, rate))
    for stretch in (0.0, 2.0, 4.0):
        overlap = uney.overlap(*uney.example(np.array([20.0]), stretch))[0]
        rate = float(fuse_poisson([RATE, RATE], "geometric", overlap=overlap))
        rows.append(Row(f"10 and 10, kappa = 20, means {stretch:g} times as far", "EMD rate", None, rate))
    many = {}
    for N in SENSORS:
        P = uney.aspects(KAPPA, N)
        x = np.linalg.cholesky(P) @ run.rng(1, N).standard_normal((N, 2, M))
        overlaps = uney.overlap(x, np.ascontiguousarray(np.broadcast_to(P[..., None], (N, 2, 2, M))))
        many[N] = fuse_poisson(np.full((M, N), RATE), "geometric", overlap=overlaps)
        rows.append(Row(f"{N} sensors of 10, EMD", "rate, mean", None, *mean(many[N])))

    rng = run.rng(2)
    rates = 0.5 * 100.0 ** rng.random((M, 2))
    overlap = uney.overlap(*uney.random_gaussians(rng, M, 2, 10.0, 2.0))
    lost = loses_rate(rates, overlap)
    enough = overlap < rates.min(axis=1) / rates.max(axis=1)
    unscaled = np.sqrt(rates[:, 0] * rates[:, 1]) < rates.min(axis=1) * (1 - 1e-12)
    star = fuse_poisson(rates)
    old = printed(rates[:, 0], rates[:, 1])
    rising = rates[:, 0] < rates[:, 1]
    n = np.arange(160)
    some = rates[: min(M, 200)]
    pmf = fuse_cardinality(poisson.pmf(n, some[..., None]) / poisson.cdf(n[-1], some)[..., None])[0]
    logs = np.log(rates.T)

    def lower(w: Floats) -> Any:
        rate = np.exp((1.0 - w) * logs[0] + w * logs[1])
        far = [rate * (np.log(rate) - one) - rate + np.exp(one) for one in logs]  # KL of Poissons
        return far[0] < far[1]

    w = uney.bisect(lower, M)
    claims = {
        "equal rates: the EMD expects fewer at every kappa": (equal < RATE).all(),
        "wherever (32) holds, so does (31)": lost[enough].all(),
        "consistent rate between the two": ((star >= rates.min(axis=1)) & (star <= rates.max(axis=1))).all(),
    }
    rows += [Row(claim, "claim holds (1: yes)", 1.0, float(held), decimals=0) for claim, held in claims.items()]
    rows += [
        Row("random pairs, EMD", "fewer than both: (31), %", None, *percent(lost)),
        Row("random pairs, EMD", "by the sufficient condition (32), %", None, *percent(enough)),
        Row("random pairs, EMD by (30) as printed", "fewer than both: (31), %", None, *percent(unscaled)),
        Row("random pairs, consistent", "fewer than both: (31), %", None, *percent(star < rates.min(axis=1))),
        Row("(52) as printed, lambda_i < lambda_j", "no number, %", None, *percent(~np.isfinite(old[rising]))),
        Row("(52) as printed, lambda_i > lambda_j", "no number, %", None, *percent(~np.isfinite(old[~rising]))),
        Row("closed form against (52), (53)", "largest relative difference", None, _off(star, old, rising)),
        Row("closed form against bisection", "largest relative difference", None, _off(star, np.exp(_mix(logs, w)))),
        Row("closed form against algorithm 2", "largest relative difference", None, _off(star[: len(some)], pmf @ n)),
    ]
    run.progress(0.1, "pairs")

    small = max(10, M // 5)
    items = [(N, i, min(PIECE, small - i)) for N in TEAMS for i in range(0, small, PIECE)]
    pieces = run.map(partial(phd, run.seed), items, "filters")
    truth = presence().sum(axis=1)
    numbers = {}
    for N in TEAMS:
        chosen = [piece for piece, item in zip(pieces, items, strict=True) if item[0] == N]
        numbers[N] = np.concatenate(chosen, axis=-1)
        for method, number in zip(METHODS, numbers[N], strict=True):
            error = number - truth[:, None]
            settled = mean(error[28:GOING].mean(axis=0))
            rows.append(Row(f"N = {N}: {method}", "mean error, 12 targets, steps 28 to 33", None, *settled))
            rows.append(Row(f"N = {N}: {method}", "RMS error, all steps", None, *armse(error**2)))
    notes = (
        "(32) is sufficient, not necessary: the EMD expects fewer than both sources more often than (32) says.",
        "(52) as printed takes the logarithm of a negative number if the first rate is the larger. The comparison with "
        f"algorithm 2 is of {len(some)} pairs, whose distributions are cut at {n[-1]}.",
        "End to end the sum of consistent site masses differs from the consistent total: a site that one sensor doubts "
        "is one of many in the total, and the whole of its own. The total is the paper's P4, it says nothing of where.",
    )
    return Result(tuple(rows), notes, partial(draw, equal, many, (rates, overlap), truth, numbers), (14, 8.5))


def _mix(logs: Floats, w: Floats) -> Floats:
    return np.asarray((1.0 - w) * logs[0] + w * logs[1])


def _off(a: Floats, b: Floats, where: Any = slice(None)) -> float:
    return float(np.max(np.abs(b[where] / a[where] - 1.0)))


def draw(
    equal: Floats, many: dict[int, Floats], pairs: tuple[Floats, Floats], truth: Any, numbers: Any, figure: Any
) -> None:
    axes = figure.subplots(2, 3)
    axes[0, 0].plot(KAPPAS, np.full(len(KAPPAS), RATE), color=COLOURS["consistent"], label="consistent")
    axes[0, 0].plot(KAPPAS, equal, color=COLOURS["EMD"], label="EMD, $\\omega$ = 1/2")
    axes[0, 0].set(title="Rate fused from 10 and 10", xlabel="$\\kappa$", ylabel="expected number", ylim=(0, 11))
    axes[0, 0].legend(frameon=False, loc="lower left")
    ratio = np.geomspace(1.0, 20.0, 100)
    two = np.stack([np.ones(100), ratio], axis=1)
    for z, style in ((1.0, "--"), (0.7, "-"), (0.4, "-."), (0.1, ":")):
        rate = fuse_poisson(two, "geometric", overlap=np.full(100, z))
        axes[0, 1].plot(ratio, rate, style, color=COLOURS["EMD"], label=f"EMD, z = {z}")
    axes[0, 1].plot(ratio, fuse_poisson(two), color=COLOURS["consistent"], label="consistent")
    axes[0, 1].plot(ratio, fuse_poisson(two, "average"), color=COLOURS["average"], label="average")
    axes[0, 1].fill_between(ratio, 0.05, 1.0, color="#eeeeee")
    axes[0, 1].set(title="Rate fused from 1 and r\n(grey: below both)", xscale="log", yscale="log")
    axes[0, 1].set(xlabel="r", ylabel="expected number", ylim=(0.08, 12), xlim=(1, 20))
    axes[0, 1].legend(frameon=False, fontsize=8, loc="upper left")
    rates, overlap = pairs
    r, lost = rates.max(axis=1) / rates.min(axis=1), loses_rate(rates, overlap)
    axes[0, 2].plot(r[~lost], overlap[~lost], ".", color="#bbbbbb", ms=3, label="not below both")
    axes[0, 2].plot(r[lost], overlap[lost], ".", color="#d55e00", ms=3, label="below both (31)")
    axes[0, 2].plot(ratio, 1 / ratio, "k-", lw=1.2, label="(32): z = 1/ratio")
    axes[0, 2].plot(ratio, ratio**-0.5, "k--", lw=1.2, label="exact at $\\omega$ = 1/2")
    axes[0, 2].set(
        title="Random pairs, EMD", xlabel="ratio of the rates", ylabel="overlap z", xscale="log", ylim=(0, 1.2)
    )
    axes[0, 2].set(xlim=(1, 20))
    axes[0, 2].legend(frameon=False, fontsize=8, loc="upper right", ncol=2, markerscale=3)
    axes[1, 0].boxplot(list(many.values()), positions=list(many), whis=(5, 95), showfliers=False, widths=0.6)
    axes[1, 0].axhline(RATE, color=COLOURS["consistent"])
    axes[1, 0].set(title="N sensors of 10, $\\kappa$ = 20: EMD\n(5 to 95 %); consistent: green", xlabel="N")
    axes[1, 0].set(ylabel="expected number", ylim=(0, 11))
    for ax, N in zip(axes[1, 1:], TEAMS, strict=True):
        ax.step(np.arange(STEPS), truth, "k-", where="mid", lw=1, label="truth")
        for method, number in zip(METHODS, numbers[N], strict=True):
            ax.plot(number.mean(axis=1), color=COLOURS[method], label=method, lw=1.4)
        ax.set(
            title=f"PHD filters of {N} sensors, $\\kappa$ = 20: mean number", xlabel="step", ylabel="number of targets"
        )
    axes[1, 1].legend(frameon=False, fontsize=8, loc="lower right", ncol=2)


STUDIES = (
    Study(
        name="uney-poisson",
        title="Expected numbers fused: the exponential mixture always expects too few of what all agree on",
        source="Uney 3.B and 4.B",
        about=__doc__ or "",
        run=run,
        runs=2_000,
        quick=50,
        seconds=15.0,
    ),
)
