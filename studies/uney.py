"""What the studies of Uney share: the sensors of example 3.3, Newton's iteration of Algorithms 1 and 2, and local
filters of one target (Bernoulli) or of one site of many (PHD) with one Gaussian each, batch last.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.densities import Mixtures, kl_gaussians, log_gaussian, overlap_gaussians
from studies.statistics import mean
from studies.study import Floats, Row

__all__ = [
    "FIRST_MEAN",
    "SECOND_MEAN",
    "Indices",
    "Local",
    "Reports",
    "Search",
    "Slopes",
    "aspects",
    "bisect",
    "equal_divergence",
    "example",
    "gaussian_slopes",
    "network",
    "newton",
    "overlap",
    "percent",
    "prior",
    "random_gaussians",
    "report",
    "search_rows",
    "update",
]

Indices = NDArray[np.intp]
Slopes = Callable[[Floats, Indices], tuple[Floats, Floats]]
"""Weights w (b,) of the second source, for the problems at an index (b,): d log z / dw and d2 log z / dw2, (b,)."""

SURVIVAL, BIRTH, DETECTION, CLUTTER, HALF, WALK, ORIGIN = 0.98, 0.02, 0.7, 2.0, 20.0, 0.05, 8.0
"""Of the filters: probabilities of survival, birth and detection, false reports a scan, half the side of the square
they lie in, variance of the walk a step, sigma of the birth density."""
FIRST_MEAN, SECOND_MEAN = np.array([0.25, 0.25]), np.array([-0.75, -0.25])
"""m_i and m_j of Uney's example 3.3."""


def aspects(kappa: Floats | float, N: int = 2) -> Floats:
    """Covariances (N, 2, 2, ...) of N sensors with variance 1 along and 1/kappa (...) across their line of sight.

    Their lines of sight are pi/4, pi/4 - pi/N, ... : for two +-pi/4 as in example 3.3, for more spread evenly.
    """
    angle = (np.pi / 4 - np.arange(N) * np.pi / N).reshape(N, *([1] * np.ndim(kappa)))
    c, s, small = np.cos(angle), np.sin(angle), 1.0 / np.asarray(kappa)
    P = [[c * c + small * s * s, c * s * (1 - small)], [c * s * (1 - small), s * s + small * c * c]]
    return np.moveaxis(np.array([[np.broadcast_to(p, (N, *np.shape(kappa))) for p in row] for row in P]), 2, 0)


def example(kappa: Floats, distance: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Means (2, 2, B) and covariances (2, 2, 2, B) of example 3.3; `distance` stretches m_i - m_j about its middle."""
    middle, half = (FIRST_MEAN + SECOND_MEAN) / 2, (FIRST_MEAN - SECOND_MEAN) / 2
    step = np.broadcast_to(distance, kappa.shape)
    means = np.stack([middle[:, None] + half[:, None] * step, middle[:, None] - half[:, None] * step])
    return means, np.ascontiguousarray(aspects(kappa))


def overlap(means: Floats, covariances: Floats, weight: Floats | float | None = None) -> Floats:
    """z (B,) of N Gaussians (N, n, B), (N, n, n, B): of two at `weight` of the second, or at equal weights."""
    N, _, B = means.shape
    w = np.full((N, B), 1.0 / N) if weight is None else np.stack([1.0 - np.broadcast_to(weight, B), np.full(B, weight)])
    return np.asarray(np.exp(np.minimum(overlap_gaussians(means, covariances, w)[0], 0.0)))


def random_gaussians(rng: np.random.Generator, B: int, n: int, aspect: float, far: float) -> tuple[Floats, Floats]:
    """Pairs of Gaussians (2, n, B), (2, n, n, B): variances log-uniform in 1 ... aspect, turned at random, one source
    up to 3 times as large as the other; means uniform up to `far` apart, in sigmas of their difference."""
    spread = np.exp(np.log(aspect) * rng.random((2, B, n)) + np.log(3.0) * rng.uniform(-1, 1, (2, B, 1)))
    turn = np.linalg.qr(rng.standard_normal((2, B, n, n)))[0]
    P = np.einsum("sbij,sbj,sbkj->sbik", turn, spread, turn)
    ray = rng.standard_normal((B, n))
    ray *= (far * rng.random(B) / np.linalg.norm(ray, axis=1))[:, None]
    gap = np.einsum("bij,bj->bi", np.linalg.cholesky(P.sum(axis=0)), ray)
    means = np.stack([np.zeros((n, B)), gap.T])
    return means, np.ascontiguousarray(P.transpose(0, 2, 3, 1))


def gaussian_slopes(means: Floats, covariances: Floats) -> Slopes:
    """Of two Gaussians, in closed form: outside [0, 1] as long as there is a density."""

    def slopes(w: Floats, at: Indices) -> tuple[Floats, Floats]:
        _, g, H = overlap_gaussians(means[..., at], covariances[..., at], np.stack([1.0 - w, w]))
        return g[1] - g[0], H[0, 0] + H[1, 1] - 2.0 * H[0, 1]

    return slopes


class Search(NamedTuple):
    """weight (B,); updates (B,) made, the last one included; settled (B,): whether the last was small enough."""

    weight: Floats
    updates: NDArray[np.intp]
    settled: NDArray[np.bool_]


def newton(slopes: Slopes, start: Floats, tolerance: float = 1e-4, clamp: bool = True, most: int = 50) -> Search:
    """Uney's Algorithms 1 and 2 from `start` (B,): w <- w - (log z)' / (log z)'' until it moves by at most
    `tolerance`. `clamp`: kept in [0, 1], which the algorithms as printed do not do."""
    w = start.copy()
    updates, settled = np.zeros(len(w), dtype=np.intp), np.zeros(len(w), dtype=np.bool_)
    busy = np.arange(len(w))
    with np.errstate(all="ignore"):
        for _ in range(most):
            if not len(busy):
                break
            first, second = slopes(w[busy], busy)
            new = w[busy] - first / second
            if clamp:
                new = np.clip(new, 0.0, 1.0)
            step = np.abs(new - w[busy])
            w[busy] = new
            updates[busy] += 1
            settled[busy] = step <= tolerance
            busy = busy[(step > tolerance) & np.isfinite(new)]
    return Search(w, updates, settled)


def search_rows(name: str, updates: Floats, error: Floats) -> list[Row]:
    """How a search fares: updates (B,), NaN where it fails, and error (B,) of the weight."""
    good = np.isfinite(updates)
    rows = [Row(name, "failures, %", None, *percent(~good))]
    if good.sum() > 1:
        if updates[good].any():
            rows.append(Row(name, "updates where it works", None, *mean(updates[good])))
        rows.append(Row(name, "largest error where it works", None, float(error[good].max())))
    return rows


def bisect(lower: Callable[[Floats], NDArray[np.bool_]], size: int) -> Floats:
    """The weight (B,) in [0, 1], by 50 halvings; lower(w) says where (B,) w is still too small."""
    low, high = np.zeros(size), np.ones(size)
    for _ in range(50):
        w = 0.5 * (low + high)
        small = lower(w)
        low, high = np.where(small, w, low), np.where(small, high, w)
    return 0.5 * (low + high)


def equal_divergence(means: Floats, covariances: Floats) -> Floats:
    """The weight (B,) of the second Gaussian at which KL(f_w || f_i) = KL(f_w || f_j), by bisection (Uney (7))."""
    A = linalg.inverse(covariances.transpose(1, 2, 0, 3))
    x = means - means[:1]
    y = linalg.matvec(A, x.swapaxes(0, 1))

    def lower(w: Floats) -> NDArray[np.bool_]:
        C = linalg.inverse((1.0 - w) * A[:, :, 0] + w * A[:, :, 1])
        m = linalg.matvec(C, (1.0 - w) * y[:, 0] + w * y[:, 1])
        return np.asarray(kl_gaussians(m, C, x[0], covariances[0]) < kl_gaussians(m, C, x[1], covariances[1]))

    return bisect(lower, means.shape[-1])


class Local(NamedTuple):
    """mass (B,): existence, or expected number; mean (2, B); covariance (2, 2, B)."""

    mass: Floats
    mean: Floats
    covariance: Floats


class Reports(NamedTuple):
    """Positions (2, S, B) in S slots, of which `valid` (S, B) are filled."""

    position: Floats
    valid: NDArray[np.bool_]


def report(
    rng: np.random.Generator,
    truth: Floats,
    there: NDArray[np.bool_],
    R: Floats,
    detection: float,
    clutter: float,
    half: float,
) -> Reports:
    """One scan of position sensors: the target at truth (2, B), where `there` (B,), with noise R (2, 2, B); and a
    Poisson number (mean `clutter`) of false reports, uniform in the square of +-half about the origin."""
    B = truth.shape[-1]
    count = np.asarray(rng.poisson(clutter, B))
    S = 1 + int(count.max(initial=0))
    position = rng.uniform(-half, half, (2, S, B))
    L, d = linalg.ldl(R)
    position[:, 0] = truth + linalg.matvec(L, np.sqrt(d) * rng.standard_normal((2, B)))
    valid = np.arange(S)[:, None] <= count
    valid[0] = (rng.random(B) < detection) & there
    return Reports(position, valid)


def update(parts: tuple[Local, ...], reports: Reports, R: Floats, detection: float, density: float, kind: str) -> Local:
    """Update of a prior that is a sum of Gaussians of given masses (survivor, birth), merged into one Gaussian.

    R (2, 2, B); density: expected false reports per area. kind "bernoulli": with L the sum of mass (1 - pD), no
    report being the target's, and of mass pD N(z; ...) / density over reports and Gaussians, and r the prior existence,
    r' = L / (1 - r + L). kind "phd": the latter terms of each report are divided by 1 + their sum; the mass is L.
    """
    log_weights, means, covariances = [], [], []
    for part in parts:
        S = part.covariance + R
        K = linalg.product(part.covariance, linalg.inverse(S))
        v = reports.position - part.mean[:, None]
        L, d = linalg.ldl(S)
        hit = np.where(reports.valid, log_gaussian(v, L[:, :, None], d[:, None]) + np.log(detection / density), -np.inf)
        missed = np.full((1, hit.shape[-1]), np.log1p(-detection))
        with np.errstate(divide="ignore"):
            log_weights.append(np.log(part.mass) + np.concatenate([missed, hit]))
        means += [part.mean[:, None], part.mean[:, None] + linalg.matvec(K[:, :, None], v)]
        after = (part.covariance - linalg.congruence(K, S))[:, :, None]
        covariances += [part.covariance[:, :, None], np.broadcast_to(after, (2, *v.shape))]
    logs = np.stack(log_weights)
    if kind == "phd":
        logs[:, 1:] -= np.log1p(linalg.total(np.exp(logs[:, 1:])))
    logs = logs.reshape(-1, logs.shape[-1])
    mass = linalg.total(np.exp(logs))
    joined = Mixtures(logs, np.concatenate(means, axis=1), np.concatenate(covariances, axis=2))
    if kind == "bernoulli":
        mass = mass / (1.0 - linalg.total(np.stack([part.mass for part in parts])) + mass)
    return Local(mass, *joined.moments())


def prior(local: Local, survival: float, walk: float, birth: Local) -> tuple[Local, ...]:
    """One step of a target that walks at random, variance `walk` a step: what survives, and what is born."""
    moved = local.covariance + walk * np.eye(2)[..., None]
    return Local(survival * local.mass, local.mean, moved), birth


def network(
    rng: np.random.Generator, P: Floats, there: NDArray[np.bool_], kind: str
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Filters of N sensors with noise P (N, 2, 2, B) and one fed with all reports, step by step.

    The target is there (K, B) or not, and starts about the origin. Yields the sensors' masses (N, B), the overlap
    (B,) of their Gaussians at equal weights, and the mass (B,) of the filter fed with all.
    """
    N, B = len(P), P.shape[-1]
    R = P.transpose(1, 2, 0, 3).reshape(2, 2, -1)
    density = CLUTTER / (2 * HALF) ** 2

    def step(local: Local) -> tuple[Local, ...]:
        birth = BIRTH * (1.0 - local.mass) if kind == "bernoulli" else np.full(len(local.mass), BIRTH)
        start = np.zeros((2, len(birth))), np.tile(ORIGIN**2 * np.eye(2)[..., None], (1, 1, len(birth)))
        return prior(local, SURVIVAL, WALK, Local(birth, *start))

    local = Local(np.zeros(N * B), np.zeros((2, N * B)), R)
    centre = Local(np.zeros(B), np.zeros((2, B)), R[..., :B])
    x, before = np.zeros((2, B)), np.zeros(B, dtype=np.bool_)
    for now in there:
        x = x + np.sqrt(WALK) * rng.standard_normal((2, B))
        x = np.where(now & ~before, ORIGIN * rng.standard_normal((2, B)), x)
        before = now
        reports = report(rng, np.tile(x, N), np.tile(now, N), R, DETECTION, CLUTTER, HALF)
        local = update(step(local), reports, R, DETECTION, density, kind)
        for s in range(N):
            at = slice(s * B, (s + 1) * B)
            own = Reports(reports.position[..., at], reports.valid[:, at])
            centre = update((centre,) if s else step(centre), own, R[..., at], DETECTION, density, kind)
        z = overlap(
            local.mean.reshape(2, N, B).swapaxes(0, 1), local.covariance.reshape(2, 2, N, B).transpose(2, 0, 1, 3)
        )
        yield local.mass.reshape(N, B), z, centre.mass


def percent(hit: NDArray[Any]) -> tuple[float, float]:
    """Share (per cent) and standard error of independent outcomes or shares (M,)."""
    value = mean(100.0 * hit.astype(np.float64))
    return value.value, value.stderr
