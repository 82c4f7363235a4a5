"""Inverse covariance intersection by det: the slope of log det P in elementary symmetric functions.

e_k and E_k are those of r and of r^2, where P_1 = T T' and P_2 = T diag(r) T' (see `ici`):

    prod g_k = sum e_k (1-t)^k t^(n-k),    g_k = t + (1-t) r_k

e_1 and e_{n-1} are traces, n - 3 determinants give the rest, and E follows from e (Graeffe). So nothing need be
diagonalised; for n <= `pairs.LIMIT`, since rounding spoils it above.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import inner
from fusion_service.rules.base.block import Sources

__all__ = ["symmetric_functions", "symmetric_slope"]


def symmetric_slope(t: Floats, u: Floats, data: Floats) -> tuple[Floats, Floats]:
    """As `_det_slope`, from `symmetric_functions`."""
    n, power = len(data) - 1, [np.ones_like(t), t]
    for _ in range(2, n + 1):
        power.append(power[-1] * t)
    (g, h), (dg, dh), (ddg, ddh) = (_form(data[: max(n + 1 - order, 1), order], power, u) for order in range(3))
    u, v = dg / g, dh / h
    return u - v, ddg / g - u * u - ddh / h + v * v


def _form(c: Floats, power: list[Floats], b: Floats) -> Floats:
    """sum c_k b^k t^(n-k), (2, B), from the powers of t."""
    n = len(c) - 1
    out = np.array(c[n])
    for k in range(n - 1, -1, -1):
        out *= b
        out += c[k] * power[n - k]
    return out


def symmetric_functions(two: Sources) -> Floats:
    """Coefficients (n+1, 3, 2, B) of sum e_k (1-t)^k t^(n-k), of the same with E_k, and of their derivatives.

    e_k and E_k are the elementary symmetric functions of r and of r^2.
    """
    P, A = two.covariances, two.information
    n = len(P)
    e = np.empty((n + 1, P.shape[-1]))
    e[0], e[n] = 1.0, two.dets[1] / two.dets[0]
    if n > 1:
        e[1], e[n - 1] = inner(A[:, :, 0], P[:, :, 1]), e[n] * inner(A[:, :, 1], P[:, :, 0])
    unknown = n - 3
    if unknown > 0:
        # det(P_1 + s P_2) = det P_1 sum e_k s^k, at values of s where the unknown terms are the large ones
        centre = (e[1] / e[n - 1]) ** (1.0 / (n - 2))
        s = centre * 3.0 ** (np.arange(unknown) - 0.5 * (unknown - 1))[:, None]
        rest = linalg.det(P[:, :, :1] + s * P[:, :, 1:]) / two.dets[0]
        rest = (rest - 1.0 - s * e[1] - s ** (n - 1) * (e[n - 1] + s * e[n])) / (s * s)
        e[2 : n - 1] = _interpolated(s, rest)
    E = e * e
    for k in range(1, n):
        for j in range(1, min(k, n - k) + 1):
            E[k] += (2.0 if j % 2 == 0 else -2.0) * e[k - j] * e[k + j]
    out = np.zeros((n + 1, 3, 2, P.shape[-1]))
    out[:, 0, 0], out[:, 0, 1] = e, E
    for order in (0, 1):
        m = n - order
        index = np.arange(m, dtype=np.float64)[:, None, None]
        out[:m, order + 1] = (m - index) * out[:m, order] - (index + 1.0) * out[1 : m + 1, order]
    return out


def _interpolated(s: Floats, values: Floats) -> Floats:
    """Coefficients (m, B) of the polynomials with these values at s, by divided differences."""
    m = len(s)
    d = np.array(values)
    for j in range(1, m):
        d[j:] = (d[j:] - d[j - 1 : -1]) / (s[j:] - s[:-j])
    out = np.zeros_like(d)
    for j in range(m - 1, -1, -1):
        out[1:] = out[:-1] - s[j] * out[1:]
        out[0] = d[j] - s[j] * out[0]
    return out
