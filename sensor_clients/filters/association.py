"""Which return belongs to which track, as probabilities, and the update that follows from them.

A track is a Bernoulli: it exists with probability r and then has a Gaussian state. A return of track i is
detected with probability p_i, has the density l_ij at return j; clutter and the first returns of unknown
targets together have the intensity lambda_j (per unit of measurement space). The joint weights
psi_ij = r_i p_i l_ij / ((1 - r_i p_i) lambda_j) have marginals under "a return has one source, a track one
return" that loopy belief propagation finds (Williams and Lau 2014); they are exact for one track, or one
return, or when the gated pairs form a tree. For one track they are the weights of PDA (r = 1) and of IPDA:

    P(j) = psi_j / (1 + sum psi),   r' = sum_j P(j) + P(0) r (1-p) / (1 - r p)

The updated density is moment-matched with the spread of the innovations (Bar-Shalom):

    x' = x + K nu,  nu = sum_j b_j nu_j,   P' = P - (1 - b_0) K S K' + K [sum_j b_j nu_j nu_j' - nu nu'] K'
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusion_service import linalg
from sensor_clients.filters.measurement import Floats, Prediction

__all__ = ["Association", "associate", "gate_probability", "likelihood", "update"]


class Association(NamedTuple):
    """existence (T,) after the scan; weights (T, M) of the returns given existence, missed (T,) of none of
    them (each row sums to 1 with it); unused (M,): the probability that a return is of no track."""

    existence: Floats
    weights: Floats
    missed: Floats
    unused: Floats


def gate_probability(gate: float, d: int) -> float:
    """That a return of `d` components, 1 or 2, lies within the squared Mahalanobis distance `gate`."""
    return 1 - math.exp(-gate / 2) if d == 2 else math.erf(math.sqrt(gate / 2))


def likelihood(prediction: Prediction, gate: float) -> Floats:
    """Density l_ij (T, M) of return j under track i, 0 beyond `gate` (squared Mahalanobis distance).

    Divided by the probability of the gate, so that it integrates to 1.
    """
    nu, S = prediction.innovations, linalg.inverse(prediction.covariance)
    distance = S[0, 0, :, None] * nu[0] ** 2
    if len(nu) == 2:
        distance = distance + 2 * S[0, 1, :, None] * nu[0] * nu[1] + S[1, 1, :, None] * nu[1] ** 2
    scale = np.sqrt((2 * math.pi) ** len(nu) * linalg.det(prediction.covariance)) * gate_probability(gate, len(nu))
    density, near = np.zeros_like(distance), distance < gate
    density[near] = np.exp(-0.5 * distance[near])
    return np.asarray(density / scale[:, None])


def associate(
    densities: Floats, existence: Floats, detection: Floats, intensity: Floats, tolerance: float = 1e-6
) -> Association:
    """Marginal association probabilities by loopy belief propagation.

    densities l (T, M), existence r (T,), detection p (T,) including the gate's probability, intensity of
    what is not a track (M,). Iterates until no message changes by more than `tolerance` (relative). Tracks
    without a gated return send nothing and receive the same: one stands for all of them.
    """
    T, M = densities.shape
    if not T:
        return Association(existence, np.zeros((0, M)), np.zeros(0), np.ones(M))
    hit = np.minimum(existence * detection, 1 - 1e-12)
    psi = (hit / (1 - hit))[:, None] * densities / intensity
    sending = psi.any(axis=1)
    sending[np.argmin(sending)] = True
    psi = psi[sending]
    nu = np.ones_like(psi)
    for _ in range(200):
        towards = psi * nu
        mu = psi / (1 + towards.sum(axis=1, keepdims=True) - towards)
        new = 1 / (1 + mu.sum(axis=0) - mu)
        change = np.max(np.abs(new - nu), initial=0.0)
        nu = new
        if change < tolerance:
            break
    towards = psi * nu
    total, taken = np.ones(T), np.zeros((T, M))
    total[sending] = 1 + towards.sum(axis=1)
    taken[sending] = towards / total[sending, None]
    # What misses may still exist: only that part of P(0) is the existing track's own.
    missed = existence * (1 - detection) / (1 - hit) / total
    after = np.minimum(taken.sum(axis=1) + missed, 1.0)
    safe = np.maximum(after, 1e-300)
    return Association(after, taken / safe[:, None], missed / safe, 1 / (1 + mu.sum(axis=0)))


def update(
    means: Floats, covariances: Floats, prediction: Prediction, weights: Floats, missed: Floats
) -> tuple[Floats, Floats]:
    """The moment-matched PDA update of means (n, T) and covariances (n, n, T) by weights (T, M), missed (T,)."""
    nu = np.einsum("atm,tm->at", prediction.innovations, weights)
    second = np.einsum("atm,btm,tm->abt", prediction.innovations, prediction.innovations, weights, optimize=True)
    spread = second - linalg.outer(nu, nu) - (1 - missed) * prediction.covariance
    K = prediction.gain
    return means + linalg.matvec(K, nu), linalg.symmetrise(covariances + linalg.congruence(K, spread))
