"""The functions of `fusion_service.linalg` by kernels: same arguments, same results, bit for bit.

None for what is not for a kernel: longdouble, an empty batch, batches that would have to be broadcast.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from fusion_service.compiled.either import Floats, Places

__all__ = ["SWEEPS", "functions"]

F8 = np.dtype(np.float64)
SWEEPS = 30
"""Of Jacobi's rotations, at most."""


def functions(kernels: SimpleNamespace) -> dict[str, Callable[..., Any]]:
    """By name, over these `kernels` (those of the module, compiled or as they are)."""
    return {
        **_inverses(kernels), **_factors(kernels), **_products(kernels), "intersect": _groups(kernels),
        "from_start_of_three": _three(kernels), "jacobi": _turns(kernels), "product_of_all": _whole(kernels),
        **_mergers(kernels),
    }  # fmt: skip


def _fits(a: Floats, *others: Floats) -> bool:
    for one in others:
        if one.dtype != F8:
            return False
    return a.dtype == F8 and a.size > 0


def _one(a: Floats, core: int) -> Floats:
    """With one batch axis."""
    return a if a.ndim == core + 1 else a.reshape(*a.shape[:core], -1)


def _flat(a: Floats, core: int) -> Floats:
    """Contiguous, with one batch axis."""
    return np.ascontiguousarray(_one(a, core))


def _inverses(kernels: SimpleNamespace) -> dict[str, Callable[..., Any]]:
    def inverted(P: Floats) -> tuple[Floats, Floats, Floats, Floats] | None:
        if not _fits(P):
            return None
        batch = P.shape[2:]
        p = _one(P, 2)
        out, rest = np.empty(p.shape), np.empty((3, p.shape[2]))
        kernels.invert(p, out, rest[0], rest[1], rest[2])
        return out.reshape(P.shape), rest[0].reshape(batch), rest[1].reshape(batch), rest[2].reshape(batch)

    def inverse(P: Floats) -> Floats | None:
        found = inverted(P)
        return None if found is None else found[0]

    def sweep(P: Floats) -> tuple[Floats, Floats, Floats] | None:
        found = inverted(P)
        return None if found is None else found[:3]

    def inverse_det(P: Floats) -> tuple[Floats, Floats, Floats] | None:
        found = inverted(P)
        return None if found is None else (found[0], found[1], found[3])

    return {"inverse": inverse, "sweep": sweep, "inverse_det": inverse_det}


def _factors(kernels: SimpleNamespace) -> dict[str, Callable[..., Any]]:
    def pivots(P: Floats) -> Floats | None:
        if not _fits(P):
            return None
        d = np.empty((len(P), P[0, 0].size))
        kernels.pivots(_one(P, 2), d)
        return d.reshape(P.shape[1:])

    def ldl(P: Floats) -> tuple[Floats, Floats] | None:
        if not _fits(P):
            return None
        p = _one(P, 2)
        L, d = np.empty(p.shape), np.empty(p.shape[1:])
        kernels.ldl(p, L, d)
        return L.reshape(P.shape), d.reshape(P.shape[1:])

    def solved(P: Floats, x: Floats, back: bool) -> Floats | None:
        if not _fits(P, x) or P.shape[1:] != x.shape:
            return None
        p, y = _one(P, 2), _one(x, 1)
        solution, square = np.empty(y.shape if back else (1, 1)), np.empty(1 if back else y.shape[1])
        kernels.solve(p, y, solution, square, back)
        return solution.reshape(x.shape) if back else square.reshape(x.shape[1:])

    return {
        "_pivots": pivots,
        "ldl": ldl,
        "solve": lambda P, x: solved(P, x, True),
        "quadratic": lambda P, x: solved(P, x, False),
    }


def _products(kernels: SimpleNamespace) -> dict[str, Callable[..., Any]]:
    def matvec(A: Floats, x: Floats) -> Floats | None:
        if not _fits(A, x) or A.shape[1:] != x.shape:
            return None
        out = np.empty((len(A), x[0].size))
        kernels.matvec(_flat(A, 2), _flat(x, 1), out)
        return out.reshape(len(A), *x.shape[1:])

    def product(A: Floats, B: Floats) -> Floats | None:
        if not _fits(A, B) or A.shape[1] != B.shape[0] or A.shape[2:] != B.shape[2:] or A.ndim < 3:
            return None
        shape = len(A), *B.shape[1:]
        out = np.empty((*shape[:2], B[0, 0].size))
        kernels.product(_flat(A, 2), _flat(B, 2), out)
        return out.reshape(shape)

    def inner(A: Floats, B: Floats) -> Floats | None:
        if not _fits(A, B) or A.shape != B.shape or A.ndim < 3:
            return None
        out = np.empty(A[0, 0].size)
        kernels.inner(_flat(A, 2), _flat(B, 2), out)
        return out.reshape(A.shape[2:])

    def congruence(F: Floats, P: Floats) -> Floats | None:
        shared = F.ndim == 2
        if not _fits(P, F) or F.shape[1] != len(P) or P.ndim < 3:
            return None
        if not (shared or F.shape[2:] == P.shape[2:]):
            return None
        m, p = len(F), _flat(P, 2)
        out = np.empty((m, m, p.shape[2]))
        if shared:
            kernels.congruence(np.ascontiguousarray(F), p, out)
        else:
            kernels.congruence_each(_flat(F, 2), p, out)
        return out.reshape(m, m, *P.shape[2:])

    return {"matvec": matvec, "product": product, "inner": inner, "congruence": congruence}


def _groups(kernels: SimpleNamespace) -> Callable[..., Any]:
    def intersect(x: Floats, P: Floats, rows: Places, others: tuple[Floats, Floats]) -> tuple[Floats, ...] | None:
        """Of rows (n, M), (n, n, M) in groups (G, k), see `groups.intersect`: mean, covariance and margin of each
        group, and the margins (M,) of the others of each row, which are written into `others`."""
        if x.dtype != F8 or P.dtype != F8 or rows.shape[1] < 2:
            return None
        n, size = len(x), len(rows)
        mean, covariance, margin = np.empty((n, size)), np.empty((n, n, size)), np.empty(size)
        beside = np.empty(x.shape[1])
        at = np.ascontiguousarray(rows, dtype=np.int64)
        kernels.intersect(_flat(x, 1), _flat(P, 2), at, mean, covariance, margin, *others, beside)
        return mean, covariance, margin, beside

    return intersect


def _three(kernels: SimpleNamespace) -> Callable[..., Any]:
    def from_start_of_three(
        A: Floats, x: Floats, bound: Floats, start: Floats, limits: tuple[float, ...]
    ) -> tuple[Floats, ...] | None:
        """See `three.from_start_of_three`: what it writes."""
        if not _fits(A, x, bound, start) or A.shape[2] != 3:
            return None
        n, size = len(x), x.shape[2]
        shapes = (n, size), (n, n, size), (3, size), (3, size), (size,), (size,), (size,)
        made = tuple(np.empty(shape) for shape in shapes)
        kernels.from_start_of_three(A, x, bound, start, np.array(limits), *made)
        return made

    return from_start_of_three


def _turns(kernels: SimpleNamespace) -> Callable[..., Any]:
    def jacobi(X: Floats, floor: Floats, small: float) -> Floats | None:
        """X, turned in place where it is contiguous."""
        if not _fits(X, floor) or X.shape[2:] != floor.shape:
            return None
        turned = _flat(X, 2)
        kernels.jacobi(np.ascontiguousarray(floor).reshape(-1), np.array([small, SWEEPS]), turned)
        return turned.reshape(X.shape)

    return jacobi


def _whole(kernels: SimpleNamespace) -> Callable[..., Any]:
    def product_of_all(x: Floats, P: Floats) -> tuple[Floats, ...] | None:
        """See `products.product_of_all`: what it writes."""
        if not _fits(x, P):
            return None
        size, _, n = x.shape
        made = np.empty((size, n)), np.empty((size, n, n)), np.empty(size)
        kernels.product_of_all(np.ascontiguousarray(x), np.ascontiguousarray(P), *made)
        return made

    return product_of_all


def _mergers(kernels: SimpleNamespace) -> dict[str, Callable[..., Any]]:
    def merged_logdet(P: Floats, x: Floats, w: Floats, i: Any, at: Places, first: int) -> Floats | None:
        """Logarithms are NumPy's, as on the plain road."""
        if not _fits(P, x, w) or not len(at):
            return None
        d = np.empty((len(x), len(w) - first, len(at)))
        kernels.merged_pivots(P, x, w, np.array([np.broadcast_to(i, at.shape), at]), d)
        logs: Floats = np.log(d, out=d)
        total: Floats = logs[0]
        for row in logs[1:]:
            total += row
        return total

    def settled(new: Floats, i: Places, j: Places, at: Places, cost: Floats, low: Floats, partner: Places) -> bool:
        kernels.settled(np.ascontiguousarray(new), np.array([i, j, at]), cost, low, partner)
        return True

    return {"merged_logdet": merged_logdet, "settled": settled}
