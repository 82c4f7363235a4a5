"""The SIR particle filter (Gordon, Salmond and Smith 1993), batch last: particles (n, Np, B), weights (Np, B).

    predict    x_s ~ p(x | x_s)             the caller's own: any motion, any noise
    weigh      W_s ~ p(y | x_s), sum 1
    resample   Np of the particles with probability W_s each, all of weight 1 / Np from then on

The density may leave the particles for a Gaussian of the same moments (`moments`) and come back (`draw`): the Gaussian
particle filter's step (Kotecha and Djuric 2003), which is what rules for Gaussians need. An arithmetic average of
densities needs none of it: the particles of all, each with its weight times its source's share (`union`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.measurement import Floats

__all__ = ["draw", "effective", "moments", "resample", "union", "weigh"]


def draw(rng: np.random.Generator, state: Estimate, count: int) -> Floats:
    """`count` particles (n, count, B) of Gaussians."""
    L, d = linalg.ldl(state.covariance)
    noise = rng.standard_normal((len(state.mean), count, state.mean.shape[-1]))
    return state.mean[:, None] + linalg.matvec((L * np.sqrt(d))[:, :, None], noise)


def weigh(log_likelihood: Floats) -> Floats:
    """Weights (Np, B) of particles that had equal ones, by the logarithm of p(y | x_s), to a constant, (Np, B)."""
    weights = np.exp(log_likelihood - log_likelihood.max(axis=0))
    return np.asarray(weights / weights.sum(axis=0))


def effective(weights: Floats) -> Floats:
    """The effective number of particles 1 / sum W_s^2 (B,)."""
    return np.asarray(1.0 / np.einsum("sb,sb->b", weights, weights))


def moments(particles: Floats, weights: Floats) -> Estimate:
    """Mean and covariance sum W_s (x_s - x)(x_s - x)' of weighted particles."""
    mean = np.einsum("isb,sb->ib", particles, weights)
    away = particles - mean[:, None]
    n, P = len(away), np.empty((len(away), len(away), mean.shape[1]))
    for i in range(n):
        weighted = away[i] * weights
        for j in range(i + 1):
            P[i, j] = P[j, i] = np.einsum("sb,sb->b", weighted, away[j])
    return Estimate(mean, P)


def union(particles: Sequence[Floats], weights: Sequence[Floats], shares: Floats) -> tuple[Floats, Floats]:
    """The arithmetic average of N weighted sets, which is a set: their particles (n, N Np, B) with their weights times
    the shares (N, B), sum 1, of their sources."""
    return (
        np.concatenate(particles, axis=1),
        np.concatenate([W * share for W, share in zip(weights, shares, strict=True)]),
    )


def resample(
    rng: np.random.Generator, particles: Floats, weights: Floats, count: int | None = None, systematic: bool = True
) -> Floats:
    """`count` (or as many as there are) particles of equal weight. Systematic: one random number for each element of
    the batch, a particle comes floor or ceil of count W_s times (Kitagawa 1996); else multinomial, independently."""
    Np, B = weights.shape
    number = Np if count is None else count
    if systematic:
        reached = np.cumsum(weights, axis=0)
        ends = np.ceil(reached * (number / reached[-1]) - rng.random(B)).astype(np.intp)
        ends[-1] = number
        copies = np.diff(ends, axis=0, prepend=0).T
    else:
        copies = rng.multinomial(number, (weights / weights.sum(axis=0)).T)
    chosen: NDArray[np.intp] = np.repeat(np.tile(np.arange(Np), B), copies.ravel()).reshape(B, number)
    return np.take_along_axis(particles, chosen.T[None], axis=1)
