"""Filters that propagate deterministic points: CKF, CQKF, UKF, GHF; batch last.

A rule is points xi_s (n, S) and weights w_s (S,) for which sum_s w_s f(xi_s) approximates E f(xi), xi ~ N(0, I):

    CKF    +-sqrt(n) e_i, weights 1 / 2n; exact to degree 3               (Arasaratnam and Haykin 2009)
    UKF    those scaled to sqrt(n + kappa), and the centre; degree 3      (Julier and Uhlmann 1997)
    GHF    the product of Gauss-Hermite rules of m points; degree 2m - 1  (Ito and Xiong 2000)
    CQKF   +-sqrt(2 lambda_j) e_i, lambda_j the roots of the Laguerre polynomial L_m^(n/2 - 1), of which the CKF
           is the case m = 1                                              (Bhaumik and Swati 2013)

With P = C C' the points of a state are x + C xi_s. They are drawn anew from the predicted covariance, process noise
included, before the update.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from math import gamma
from typing import NamedTuple

import numpy as np
from scipy.special import roots_genlaguerre, roots_hermitenorm

from fusion_service import linalg
from sensor_clients.filters.kalman import Estimate, correct
from sensor_clients.filters.measurement import Floats

__all__ = ["Rule", "cubature", "cubature_quadrature", "gauss_hermite", "predict", "unscented", "update"]


class Rule(NamedTuple):
    """points (n, S) and weights (S,), sum 1."""

    points: Floats
    weights: Floats


def cubature(n: int) -> Rule:
    """The 2n points of the CKF."""
    return Rule(np.sqrt(n) * _axes(n), np.full(2 * n, 1 / (2 * n)))


def unscented(n: int, kappa: float | None = None) -> Rule:
    """The 2n + 1 points of the UKF; kappa = 3 - n unless given (Julier and Uhlmann: fits the fourth moment)."""
    k = 3.0 - n if kappa is None else kappa
    points = np.concatenate([np.zeros((n, 1)), np.sqrt(n + k) * _axes(n)], axis=1)
    return Rule(points, np.concatenate([[k / (n + k)], np.full(2 * n, 1 / (2 * (n + k)))]))


def gauss_hermite(n: int, order: int = 3) -> Rule:
    """The order^n points of the GHF."""
    x, w = roots_hermitenorm(order)
    grid = np.array(list(itertools.product(range(order), repeat=n))).T
    return Rule(x[grid], np.prod(w[grid] / np.sqrt(2 * np.pi), axis=0))


def cubature_quadrature(n: int, order: int = 2) -> Rule:
    """The 2 n order points of the CQKF."""
    roots, w = roots_genlaguerre(order, n / 2 - 1)
    points = np.concatenate([np.sqrt(2 * root) * _axes(n) for root in roots], axis=1)
    return Rule(points, np.repeat(w / (2 * n * gamma(n / 2)), 2 * n))


def predict(rule: Rule, f: Callable[[Floats], Floats], state: Estimate, Q: Floats) -> Estimate:
    """One step of x' = f(x) + w, w ~ N(0, Q): f takes states (n, S, B); Q (n, n) or (n, n, B)."""
    moved = f(_points(rule, state))
    mean = _average(rule, moved)
    away = moved - mean[:, None]
    return Estimate(mean, _moment(rule, away, away) + (Q[..., None] if Q.ndim == 2 else Q))


def update(
    rule: Rule,
    h: Callable[[Floats], Floats],
    state: Estimate,
    R: Floats,
    z: Floats,
    difference: Callable[[Floats, Floats], Floats] = np.subtract,
) -> Estimate:
    """Take in measurements z (d, B) = h(x) + v, v ~ N(0, R): h takes states (n, S, B) to (d, S, B); R (d, d) or
    (d, d, B); `difference` of two measurements wraps angles. Means of angles are taken about h of the mean state."""
    points = _points(rule, state)
    centre = h(state.mean[:, None])
    seen = difference(h(points), centre)
    shift = _average(rule, seen)
    away = seen - shift[:, None]
    S = _moment(rule, away, away) + (R[..., None] if R.ndim == 2 else R)
    cross = _moment(rule, points - state.mean[:, None], away)
    return correct(state, difference(z, centre[:, 0] + shift), S, cross)


def _axes(n: int) -> Floats:
    return np.concatenate([np.eye(n), -np.eye(n)], axis=1)


def _points(rule: Rule, state: Estimate) -> Floats:
    """x + C xi_s (n, S, B)."""
    L, d = linalg.ldl(state.covariance)
    return np.asarray(state.mean[:, None] + np.einsum("ikb,ks->isb", L * np.sqrt(d), rule.points))


def _average(rule: Rule, values: Floats) -> Floats:
    return np.asarray(np.einsum("s,isb->ib", rule.weights, values))


def _moment(rule: Rule, a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("isb,jsb->ijb", rule.weights[:, None] * a, b))
