"""What takes the time where components of mixtures are merged, as loops: the additions, multiplications and divisions
of `densities.reduction` in the same order, so the same bits (see `kernels`). Logarithms are NumPy's on either road.
"""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats, Places
from fusion_service.compiled.kernels import LANES

__all__ = ["merged_pivots", "settled"]


def merged_pivots(P: Floats, x: Floats, w: Floats, places: Places, d: Floats) -> None:
    """The pivots d (n, J, T) of what becomes of component places[0] of the element places[1] (2, T) when it is merged
    with each of the last J: of weights w (C, B), means x (n, C, B) and covariances P (n, n, C, B)."""
    n, size, first = len(x), places.shape[1], len(w) - d.shape[1]
    W, mine = np.empty((n, n, LANES)), np.empty((n, n, LANES))
    D, mean = np.empty((n, LANES)), np.empty((n, LANES))
    own, share, rest, both, f = (
        np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    )  # fmt: skip
    for s in range(0, size, LANES):
        m = min(LANES, size - s)
        i, at = places[0, s : s + m], places[1, s : s + m]
        for b in range(m):
            own[b] = w[i[b], at[b]]
        for k in range(n):
            for b in range(m):
                mean[k, b] = x[k, i[b], at[b]]
            for c in range(k + 1):
                for b in range(m):
                    mine[k, c, b] = P[k, c, i[b], at[b]]
        for j in range(first, len(w)):
            others = w[j]
            for b in range(m):
                other = others[at[b]]
                share[b] = other / (own[b] + other)
                rest[b] = 1.0 - share[b]
                both[b] = share[b] * rest[b]
            for k in range(n):
                to, here, row = D[k], mean[k], x[k, j]
                for b in range(m):
                    to[b] = row[at[b]] - here[b]
            for k in range(n):
                for c in range(k + 1):
                    to, here, p, q, row = W[k, c], mine[k, c], D[k], D[c], P[k, c, j]
                    for b in range(m):
                        to[b] = share[b] * row[at[b]] + rest[b] * here[b] + both[b] * p[b] * q[b]
            for k in range(n):
                pivot = W[k, k]
                d[k, j - first, s : s + m] = pivot[:m]
                for r in range(k + 1, n):
                    row = W[r, k]
                    for b in range(m):
                        f[b] = row[b] * (-1.0 / pivot[b])
                    for c in range(k + 1, r + 1):
                        to, here = W[r, c], W[c, k]
                        for b in range(m):
                            to[b] += here[b] * f[b]


def settled(new: Floats, places: Places, cost: Floats, low: Floats, partner: Places) -> None:
    """Write the costs `new` (C, T) of the components places[0], into which places[1] were merged, of the elements
    places[2] (3, T) into `cost` (B, C, C), and which partner (B, C) is the cheapest for each, and its cost `low`."""
    for t in range(places.shape[1]):
        i, j, b = places[0, t], places[1, t], places[2, t]
        for r in range(len(new)):
            cost[b, i, r] = cost[b, r, i] = np.inf if r == i else new[r, t]
        partner[b, i] = _least(cost[b, i])
        low[b, i] = cost[b, i, partner[b, i]]
        for r in range(len(new)):
            if r == i:
                continue
            before, best = partner[b, r], low[b, r]
            if cost[b, i, r] < best:
                partner[b, r], low[b, r] = i, cost[b, i, r]
            if before in (i, j) and best < np.inf:
                partner[b, r] = _least(cost[b, r])
                low[b, r] = cost[b, r, partner[b, r]]


def _least(row: Floats) -> int:
    """The first place of what is no number, else of the least one."""
    found = 0
    for k in range(len(row)):
        if row[k] != row[k]:
            return k
        if row[k] < row[found]:
            found = k
    return found
