"""How many are there? Two IID cluster sets whose cardinality distributions agree, and a fused one that does not.
Example 3.6: binomial numbers of 5 (P = 0.95 and 0.92) and of 35 (P = 0.98 and 0.975). The exponential mixture (EMD)
multiplies the fused probability of n by z^n, (15) and (28); z = 0.1 ... 0.9 and omega = 0 ... 1 are swept as in the
paper. "Consistent" is P4, solved by Algorithm 2; the arithmetic average stands beside them.

* **Algorithm 2** as printed starts at infinity, takes N from (16), which holds the z of the localisation, instead of
  (38), writes z_k for N_k in step 8, and does not stay in [0, 1]. Tried one by one on random pairs with z = 0.5.
  Failure: not settled (moved by at most 1e-4) within 50 updates, or settled more than 1e-3 from the omega of equal
  divergence by bisection. "Alike": 0 to 10 targets, probabilities uniform on the simplex; "unlike": 0 to 40 targets,
  Gaussian shapes, means uniform in 0 ... 40, standard deviations in 1.5 ... 6.
* **N sensors**: binomial numbers of 10 (P = 0.95) from each, the EMD's z as N sensors with kappa = 20, aspects spread
  over 180 degrees and independent errors give it.
* **End to end** (ours): n targets far apart, N sensors, 4 scans each. A scan gives a target's position with
  probability 0.8 (noise variances 1 and 1/20 along the sensor's aspect) and a Poisson number (mean 1) of false
  reports. From its counts a sensor has the exact distribution of n (uniform prior on 0 ... 40), from its positions
  the exact Gaussian of each target (prior variance 25); which reports are false is known to the latter. Its IID
  cluster set has those Gaussians with equal weights, so that z is the mean of the targets' overlaps. Fused once,
  equal weights for the EMD; "centralised" is the exact distribution of n given all counts. The estimate is the most
  probable number.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy.stats import binom, poisson

from fusion_service import linalg
from fusion_service.existence import (
    cardinality_map,
    cardinality_mean,
    fuse_cardinality,
    loses_cardinality,
    loss_threshold,
)
from studies import uney
from studies.pictures import colour
from studies.statistics import mean, rmse
from studies.study import Floats, Result, Row, Run, Study

SMALL = np.stack([binom.pmf(np.arange(6), 5, P) for P in (0.95, 0.92)])
LARGE = np.stack([binom.pmf(np.arange(36), 35, P) for P in (0.98, 0.975)])
Z, OMEGA = np.linspace(0.1, 0.9, 81), np.linspace(0.0, 1.0, 101)
INNER = slice(1, -1)
SENSORS = (2, 3, 4, 6, 8)
SCANS, DETECTION, FALSE, MOST, SPREAD, KAPPA = 4, 0.8, 1.0, 40, 25.0, 20.0
NUMBERS, TEAMS = (1, 5, 10, 20, 30), (2, 4)
METHODS = ("one sensor", "EMD", "average", "consistent", "centralised")
COLOURS = {"one sensor": "#888888", "EMD": colour("ci"), "average": colour("aa"), "consistent": colour("hmd-ga")}


def slopes(logs: Floats, scale: Floats | float = 0.0, numerator: float | None = None) -> uney.Slopes:
    """Of two pmfs, logs (2, K, B): Algorithm 2's N', N'' over N. scale (K,): log z(n) in N, as (16) has and (38) has
    not; numerator: the z_k of step 8, N_k if None. The quotient of what is given back is the printed step."""

    def of(w: Floats, at: uney.Indices) -> tuple[Floats, Floats]:
        a, b = logs[:, :, at]
        terms = np.exp((1.0 - w) * a + w * b)
        N = linalg.total((terms.T * np.exp(scale)).T)
        ratio = b - a
        first, second = linalg.total(terms * ratio), linalg.total(terms * ratio * ratio)
        return first * (N if numerator is None else numerator), second * N - first * first

    return of


def equal_divergence(logs: Floats) -> Floats:
    """The weight (B,) of the second pmf by bisection of KL(p_w || p_i) - KL(p_w || p_j)."""

    def lower(w: Floats) -> Any:
        mixed = (1.0 - w) * logs[0] + w * logs[1]
        p = np.exp(mixed - mixed.max(axis=0))
        return (p * (logs[1] - logs[0])).sum(axis=0) < 0.0

    return uney.bisect(lower, logs.shape[-1])


def random_pmfs(rng: np.random.Generator, B: int, family: str) -> Floats:
    """Pairs (2, K, B), positive."""
    if family == "alike":
        return np.asarray(rng.dirichlet(np.ones(11), (2, B)).swapaxes(1, 2))
    n = np.arange(MOST + 1)[:, None]
    p = np.exp(-0.5 * ((n - rng.uniform(0, MOST, (2, 1, B))) / rng.uniform(1.5, 6.0, (2, 1, B))) ** 2)
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def algorithm(rng: np.random.Generator, B: int, family: str) -> dict[str, tuple[Floats, Floats]]:
    """Updates (B,), NaN where a variant fails, and the error (B,) against bisection, for each variant."""
    p = random_pmfs(rng, B, family)
    logs = np.log(p)
    half, best, series = np.full(B, 0.5), equal_divergence(logs), np.arange(p.shape[1]) * np.log(0.5)
    searches = {
        "as printed, from infinity": uney.newton(slopes(logs, series, 0.5), np.full(B, np.inf), clamp=False),
        "from 1/2, N of (16)": uney.newton(slopes(logs, series), half, clamp=False),
        "from 1/2, z for N in step 8": uney.newton(slopes(logs, numerator=0.5), half, clamp=False),
        "from 1/2": uney.newton(slopes(logs), half, clamp=False),
        "from 1/2, clamped": uney.newton(slopes(logs), half),
    }
    found = {name: (s.weight, np.where(s.settled, s.updates, np.nan)) for name, s in searches.items()}
    found["this product, bracketed"] = fuse_cardinality(p.transpose(2, 0, 1))[1][:, 1], np.zeros(B)
    errors = {name: np.abs(w - best) for name, (w, _) in found.items()}
    return {name: (np.where(errors[name] <= 1e-3, found[name][1], np.nan), errors[name]) for name in found}


def emd(pmfs: Floats) -> Floats:
    """p (Z, OMEGA, K) of the EMD of two pmfs (2, K)."""
    weights = np.stack(np.broadcast_arrays(1 - OMEGA, OMEGA), axis=-1)
    shape = (len(Z), len(OMEGA))
    pmf = np.broadcast_to(pmfs, (*shape, *pmfs.shape))
    return fuse_cardinality(pmf, "geometric", weights=weights, overlap=np.broadcast_to(Z[:, None], shape))[0]


def counts(rng: np.random.Generator, n: int, N: int, runs: int) -> tuple[Floats, Floats]:
    """pmfs (M, N, K) of the number of targets, of which there are n, and the overlap z (M,) of N sensors' sets."""
    seen = rng.random((SCANS, n, N, runs)) < DETECTION
    reports = seen.sum(axis=1) + rng.poisson(FALSE, (SCANS, N, runs))
    total = np.arange(int(reports.max()) + 1)
    table = np.empty((len(total), MOST + 1))
    for targets in range(MOST + 1):
        detected = binom.pmf(total, targets, DETECTION)
        table[:, targets] = np.convolve(detected, poisson.pmf(total, FALSE))[: len(total)]
    with np.errstate(divide="ignore"):
        logs = np.log(table)[reports].sum(axis=0)  # (N, M, K)
    p = np.exp(logs - logs.max(axis=-1, keepdims=True))
    p /= p.sum(axis=-1, keepdims=True)
    hits = seen.sum(axis=0).transpose(1, 0, 2).reshape(N, -1)  # (N, n M)
    A = np.linalg.inv(uney.aspects(KAPPA, N))[..., None]
    P = linalg.inverse(np.eye(2)[..., None, None] / SPREAD + hits * A.transpose(1, 2, 0, 3))
    truth = np.sqrt(SPREAD) * rng.standard_normal((2, 1, hits.shape[1]))
    noise = np.linalg.cholesky(A[..., 0]) @ rng.standard_normal((N, 2, hits.shape[1]))
    means = [
        linalg.matvec(P[:, :, s], hits[s] * linalg.matvec(A[s], truth[:, 0]) + np.sqrt(hits[s]) * noise[s])
        for s in range(N)
    ]
    z = uney.overlap(np.stack(means), np.ascontiguousarray(P.transpose(2, 0, 1, 3)))
    return p.swapaxes(0, 1), z.reshape(n, runs).mean(axis=0)


def group(seed: int, runs: int, item: tuple[int, int]) -> Floats:
    """Most probable number less the true one (METHODS, M), and z (M,)."""
    n, N = item
    p, z = counts(np.random.default_rng([seed, n, N]), n, N, runs)
    with np.errstate(divide="ignore"):
        logs = np.log(p).sum(axis=1)
    every = np.exp(logs - logs.max(axis=1, keepdims=True))
    fused = (
        p[:, 0],
        fuse_cardinality(p, "geometric", overlap=z)[0],
        fuse_cardinality(p, "average")[0],
        fuse_cardinality(p)[0],
        every / every.sum(axis=1, keepdims=True),
    )
    return np.stack([*(cardinality_map(q) - float(n) for q in fused), z])


def run(run: Run) -> Result:
    M = run.runs
    rows: list[Row] = []
    fused: dict[str, Floats] = {}
    shares: dict[str, float] = {}
    claims: dict[str, bool] = {}
    omegas: dict[str, float] = {}
    for label, pmfs, number, omega in (("of 5", SMALL, 5, 0.5182), ("of 35", LARGE, 35, 0.5090)):
        for source, pmf in zip("ij", pmfs, strict=True):
            rows.append(
                Row(f"binomials {label}", f"MAP of p_{source}", number, float(cardinality_map(pmf)), decimals=0)
            )
        p, _ = fuse_cardinality(pmfs)
        logs = np.log(pmfs)[..., None]
        search = uney.newton(slopes(logs), np.array([0.5]))
        omegas[label] = float(equal_divergence(logs)[0])
        name = f"binomials {label}, consistent"
        rows.append(Row(name, "omega_c* of algorithm 2", omega, float(search.weight[0]), decimals=4))
        rows.append(Row(name, "updates of algorithm 2", 2.0, float(search.updates[0]), decimals=0))
        rows.append(Row(name, "MAP", number, float(cardinality_map(p)), decimals=0))
        rows.append(Row(name, "mean", None, float(cardinality_mean(p))))
        fused[label] = emd(pmfs)
        best = cardinality_map(fused[label])
        shares[label] = float((best == number).mean())
        rows.append(Row(f"binomials {label}, EMD", "MAP right, % of z and omega", None, 100 * shares[label]))
        for z in (0.9, 0.5, 0.1):
            at = fused[label][int(np.argmin(np.abs(Z - z))), 50]
            rows.append(Row(f"binomials {label}, EMD, z = {z}", "MAP", None, float(cardinality_map(at))))
            rows.append(Row(f"binomials {label}, EMD, z = {z}", "mean", None, float(cardinality_mean(at))))
        bound, threshold = losses(pmfs)
        every = np.arange(len(pmfs[0]))
        lost = loses_cardinality(np.broadcast_to(pmfs, (len(Z), *pmfs.shape)), Z, np.full((len(Z), 2), 0.5))
        claims |= {
            f"{label}: the peak moves with z": len(np.unique(best[:, 50])) > 1,
            f"{label}: (33) grows with n at omega = 1/2": bool((np.diff(bound, axis=1) > 0).all()),
            f"{label}: every n above (34) is lost, omega = 1/2": bool(lost[every > threshold[:, 50, None]].all()),
            f"{label}: the consistent p is nowhere below both": bool((p >= pmfs.min(axis=0) * (1 - 1e-12)).all()),
        }
        if number == 5:
            right = 100 * float((best[:, INNER][threshold[:, INNER] > 5] == 5).mean())
            above = float((threshold[:, INNER] > 5).mean())
            rows.append(Row(f"binomials {label}, EMD", "(34) above 5, % of z and omega", None, 100 * above))
            rows.append(Row(f"binomials {label}, EMD", "MAP right where (34) is above 5, %", None, right))
            claims["of 5: (34) above 5 at most z and omega"] = above > 0.5
            claims["of 5: some MAP estimates below 5"] = shares[label] < 1
    claims["of 35: MAP wrong at more z and omega than of 5"] = shares["of 35"] < shares["of 5"]
    rows += [Row(claim, "claim holds (1: yes)", 1.0, float(held), decimals=0) for claim, held in claims.items()]
    run.progress(0.1, "example")

    lost_targets: dict[int, Floats] = {}
    for N in SENSORS:
        P = uney.aspects(KAPPA, N)
        means = np.linalg.cholesky(P) @ run.rng(1, N).standard_normal((N, 2, M))
        overlap = uney.overlap(means, np.ascontiguousarray(np.broadcast_to(P[..., None], (N, 2, 2, M))))
        pmf = np.broadcast_to(binom.pmf(np.arange(11), 10, 0.95), (M, N, 11))
        lost_targets[N] = np.float64(10) - cardinality_map(fuse_cardinality(pmf, "geometric", overlap=overlap)[0])
        rows.append(Row(f"{N} sensors that see 10, EMD", "targets lost (MAP)", None, *mean(lost_targets[N])))
    for family in ("alike", "unlike"):
        for variant, (updates, error) in algorithm(run.rng(2), M, family).items():
            rows += uney.search_rows(f"{family}: {variant}", updates, error)
    run.progress(0.3, "algorithm 2")

    items = [(n, N) for N in TEAMS for n in NUMBERS]
    outcomes = dict(zip(items, run.map(partial(group, run.seed, M), items, "groups"), strict=True))
    for (n, N), out in outcomes.items():
        for method, wrong in zip(METHODS, out, strict=False):
            label = f"n = {n}, N = {N}: {method}"
            rows.append(Row(label, "mean error of the number", None, *mean(wrong)))
            rows.append(Row(label, "RMS error of the number", None, *(rmse(wrong**2) if wrong.any() else (0.0, 0.0))))
    overlaps = [float(outcomes[10, N][-1].mean()) for N in TEAMS]
    once = float(uney.newton(slopes(np.log(LARGE)[..., None]), np.array([0.5]), most=1).weight[0])
    notes = (
        f"By bisection omega_c* is {omegas['of 5']:.5f} and {omegas['of 35']:.5f}: the published 0.5090 is cut "
        "off, not rounded. Algorithm 2 is started at 1/2, the paper does not say where; the first of its two updates "
        f"gives {once:.5f} for the latter.",
        "The N of (16) is too small by about z^n. Of unlike pairs the second derivative then mostly comes out "
        "negative, and the steps either lead away or are so short that the iteration settles where no root is.",
        "The threshold (34) says that every number above it is lost, not that what lies below it is kept: it does not "
        "tell where the most probable number is right.",
        f"End to end the overlap is {overlaps[0]:.2f} for two sensors and {overlaps[1]:.2f} for four on average at "
        "n = 10, and the EMD counts too few, the more the more targets there are. The consistent estimate is nearly as "
        "good as that of all counts together, and better than the average at every n here.",
    )
    return Result(tuple(rows), notes, partial(draw, fused, lost_targets, outcomes), (17, 8.5))


def losses(pmfs: Floats) -> tuple[Floats, Floats]:
    """The bound (33) (Z, n = 1 ...) at omega = 1/2 and the threshold (34) (Z, OMEGA)."""
    n = np.arange(pmfs.shape[1])
    product = np.sqrt(pmfs[0] * pmfs[1])
    N = (product * Z[:, None] ** n).sum(axis=1)
    bound = (N[:, None] * (pmfs.min(axis=0) / product)[1:]) ** (1.0 / n[1:])
    weights = np.stack([1 - OMEGA, OMEGA], axis=-1)
    shape = (len(Z), len(OMEGA))
    return bound, loss_threshold(
        np.broadcast_to(pmfs, (*shape, *pmfs.shape)), np.broadcast_to(Z[:, None], shape), weights
    )


def draw(
    fused: dict[str, Floats], lost: dict[int, Floats], outcomes: dict[tuple[int, int], Floats], figure: Any
) -> None:
    axes = figure.subplots(2, 4)
    shades = {0.9: "#08306b", 0.7: "#2171b5", 0.5: "#6baed6", 0.3: "#fd8d3c", 0.1: "#d94801"}
    for ax, label, pmfs, first, fig in (
        (axes[0, 0], "of 5", SMALL, 0, "3b, 7a"),
        (axes[1, 0], "of 35", LARGE, 12, "3g, 7b"),
    ):
        n = np.arange(len(pmfs[0]))
        ax.plot(n, pmfs[0], "k-", lw=1, label="$p_i$")
        ax.plot(n, pmfs[1], "k--", lw=1, label="$p_j$")
        for z, shade in shades.items():
            ax.plot(n, fused[label][int(np.argmin(np.abs(Z - z))), 50], "-", color=shade, lw=1.2, label=f"EMD, z = {z}")
        ax.plot(n, fuse_cardinality(pmfs)[0], "o", color=COLOURS["consistent"], ms=4, label="consistent")
        ax.set(
            title=f"Binomials {label}, fused (Figs. {fig})",
            xlabel="number of targets",
            ylabel="probability",
            xlim=(first, n[-1] + 0.5),
        )
    axes[0, 0].legend(frameon=False, fontsize=8)
    bound, threshold = losses(SMALL)
    for z, shade in shades.items():
        axes[0, 1].plot(
            np.arange(1, 6), bound[int(np.argmin(np.abs(Z - z)))], "o-", color=shade, label=f"z = {z}", ms=3
        )
    axes[0, 1].set(
        title="Lost where z is below this\n(33), $\\omega$ = 1/2 (Fig. 3c)",
        xlabel="number of targets",
        ylabel="bound on z",
    )
    axes[0, 1].legend(frameon=False, fontsize=8)
    image = axes[0, 2].contourf(OMEGA[INNER], Z, np.minimum(threshold[:, INNER], 12), np.arange(0, 13), cmap="viridis")
    axes[0, 2].contour(OMEGA[INNER], Z, threshold[:, INNER], [5.0], colors="red")
    figure.colorbar(image, ax=axes[0, 2])
    axes[0, 2].set(
        title="Of 5: every number above this is lost\n(34) (Fig. 3d; red: 5)", xlabel="$\\omega$", ylabel="z"
    )
    for ax, label, most, fig in ((axes[0, 3], "of 5", 5, "3e"), (axes[1, 1], "of 35", 35, "3h")):
        image = ax.pcolormesh(OMEGA, Z, cardinality_map(fused[label]), cmap="viridis", vmax=most)
        figure.colorbar(image, ax=ax)
        ax.set(
            title=f"Most probable number, EMD {label}\n(Fig. {fig}); both sources say {most}",
            xlabel="$\\omega$",
            ylabel="z",
        )
    average = [float(lost[N].mean()) for N in lost]
    axes[1, 2].plot(list(lost), average, "o-", color=COLOURS["EMD"], label="EMD")
    axes[1, 2].plot(list(lost), [0] * len(lost), "o-", color=COLOURS["consistent"], label="consistent")
    axes[1, 2].legend(frameon=False)
    axes[1, 2].set(
        title="Targets of 10 lost, all sensors alike,\naspects differing with $\\kappa$ = 20",
        xlabel="sensors N",
        ylabel="targets lost, mean",
    )
    for N, style in zip(TEAMS, ("-", "--"), strict=True):
        for i, method in enumerate(METHODS):
            bias = [float(outcomes[n, N][i].mean()) for n in NUMBERS]
            axes[1, 3].plot(
                NUMBERS,
                bias,
                style,
                marker="o",
                ms=3,
                color=COLOURS.get(method, "black"),
                label=method if N == 2 else None,
            )
    axes[1, 3].set(
        title="Counts and positions of n targets,\n2 sensors (solid) and 4 (dashed)",
        xlabel="n",
        ylabel="mean error of the number",
    )
    axes[1, 3].legend(frameon=False, fontsize=8, loc="lower left")


STUDIES = (
    Study(
        name="uney-iid-cluster",
        title="Numbers fused: the exponential mixture counts too few, the more targets the worse",
        source="Uney examples 3.6, 4.3, Algorithm 2",
        about=__doc__ or "",
        run=run,
        runs=2_000,
        quick=50,
        seconds=10.0,
    ),
)
