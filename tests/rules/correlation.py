"""The worst that correlation can do to a linear rule, found by optimisation over directions."""

import numpy as np
from scipy.linalg import sqrtm
from scipy.optimize import minimize

from fusion_service.arrays import Floats

SEED = 4711


def worst_ratio(P: Floats, fused: Floats, gains: Floats, R: Floats) -> float:
    """Largest u'Eu / u'Fu over directions u and joint covariances within the bounds R, by optimisation over u.

    For one u the worst joint covariance correlates the sources along a_i = P_i^1/2 K_i' u, with exactly
    R_ij: it is positive semidefinite when R is.
    """
    roots = [np.real(sqrtm(p)) @ k.T for p, k in zip(P, gains, strict=True)]

    def ratio(u: Floats) -> float:
        a = np.array([np.linalg.norm(r @ u) for r in roots])
        return float(a @ R @ a / (u @ fused @ u))

    rng = np.random.default_rng(SEED)
    starts = rng.normal(size=(12, len(fused)))
    return float(max(-minimize(lambda u: -ratio(u / np.linalg.norm(u)), u, method="BFGS").fun for u in starts))


def gains_of(P: Floats, c: Floats, fused: Floats) -> Floats:
    """Gains (N, n, n) of a fusion whose information is sum c_i P_i^-1."""
    return np.stack([c[i] * fused @ np.linalg.inv(P[i]) for i in range(len(P))])
