"""Covariance union (CU): one covariance that holds whichever source is right (Uhlmann; Li-AA section II-B).

    x = sum w_i x_i,    U_i = P_i + (x - x_i)(x - x_i)'                             (Li-AA (5), (11))

max: the smallest P, by det or trace, with P >= U_i for every i (7). Li-AA's (8), the largest of the U_i by
trace or det, is not above the others as a matrix; this is. min: the smallest of the U_i, as in (9). The
weights only place the mean; uniform unless given.

Two sources have a closed form. With U_1 = T T', U_2 = T diag(r) T' the least det is that of
T diag(max(r, 1)) T'; the least trace is that of U_1 + (U_2 - U_1)_+, the positive part. For more, the
problem is convex (det: in P^-1) and a barrier method finds P to a duality gap of `GAP`, from within; where rounding
does not let it, in longdouble either, P is what joining them two by two gives: above all, if not the smallest.

Promise (max): conservative if one source is, that is, if for one i the truth given all estimates has mean
x_i and covariance at most P_i. Li-AA's Lemmas 1 and 2 need just this; a covariance P_i that holds on average
over the estimates is not enough, least of all for min.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import condition, inner, total, trace
from fusion_service.rules.base.block import Result, Sources, alone
from fusion_service.rules.base.matrices import lower_inverse, spectral
from fusion_service.rules.base.options import CRITERION, Option, one_of
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.weights.pencil import eigen, pencil

__all__ = ["RULE", "cu"]

GAP = 2e-10
FACTOR = 8.0
"""By how much the barrier is lowered each time."""
ROUNDS = 400


def cu(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, bound: str) -> Result:
    """Covariance union, `bound` "max" or "min"."""
    if sources.count == 1:
        return alone(sources, influence)
    w = sources.uniform if weights is None else weights
    x = total((sources.spread * w).swapaxes(0, 1))
    d = sources.spread - x[:, None]
    U = sources.covariances + linalg.outer(d, d)
    A, _, margin = linalg.sweep(U)
    worst, gap = condition(U, A).max(axis=0), np.zeros_like(sources.condition)
    worst = np.where(margin.min(axis=0) > 0.0, worst, np.inf)
    if bound == "min":
        size = linalg.logdet(U) if criterion == "det" else trace(U)
        P = np.take_along_axis(U, size.argmin(axis=0)[None, None, None], axis=2)[:, :, 0]
    else:
        P, worst = U[:, :, 0], np.zeros_like(worst)
        for i in range(1, sources.count):
            P, more = _join(criterion, P, U[:, :, i])
            worst = np.maximum(worst, 10.0 * more)
        worst = np.where(margin.min(axis=0) > 0.0, worst, np.inf)
        if sources.count > 2:
            P, gap = _smallest(criterion, P, U)
    return Result(sources.means[:, 0] + x, P, w, w if influence else None, worst, gap)


RULE = Rule(
    name="cu",
    order=13,
    title="covariance union, `max` and `min`",
    promise="conservative if one source is (max)",
    source="covariance union (Uhlmann; Li-AA (7)-(9))",
    fuse=in_scales(cu),
    takes={"criterion": CRITERION, "scales": SCALES, "bound": Option("max", one_of("max", "min"))},
)


def _join(criterion: str, U: Floats, W: Floats) -> tuple[Floats, Floats]:
    """The smallest matrix above both, and what rounding grows by.

    The result is above both, so it is the condition of the larger that counts: how flat the smaller one is does not.
    """
    swap = linalg.logdet(W) > linalg.logdet(U)
    U, W = np.where(swap, W, U), np.where(swap, U, W)
    base = condition(U, linalg.inverse(U))
    if criterion == "det":
        T, _, r, _ = pencil(U, W)
        return spectral(T, np.maximum(r, 1.0)), base * np.maximum(np.abs(r).max(axis=0), 1.0)
    size, Q = eigen(W - U)
    P = U + spectral(Q, np.maximum(size, 0.0))
    return P, base * np.abs(size).max(axis=0) / np.stack([P[k, k] for k in range(len(P))]).min(axis=0)


def _smallest(criterion: str, start: Floats, U: Floats) -> tuple[Floats, Floats]:
    """The smallest P (n, n, B) above every U (n, n, N, B), and the gap (B,); `start` is one above them."""
    n, _, N, size = U.shape
    L, d = linalg.ldl(start)
    F = L * np.sqrt(d)
    identity = np.zeros_like(start)
    identity[range(n), range(n)] = 1.0
    K, pivots = linalg.ldl(U)
    G = linalg.product(lower_inverse(F)[:, :, None] + np.zeros_like(U), K * np.sqrt(pivots))  # G G' is at most I
    if criterion == "det":
        ends, X, C = G, 0.5 * identity, None
    else:
        ends, X = linalg.product(G, G.swapaxes(0, 1)), 2.0 * identity
        C = linalg.product(F.swapaxes(0, 1), F)
        C /= trace(C)
    best, gap = np.array(X), np.full_like(start[0, 0], np.inf)
    todo, t, stopped = np.arange(size), np.ones_like(gap), np.ones(size, dtype=np.bool_)
    last = U.dtype != np.float64
    for _ in range(ROUNDS):
        X, done, stuck = _newton(X, ends, C, t)
        final = t >= N * n / GAP
        finished = (done & final) | stuck
        best[..., todo[finished]] = X[..., finished]
        gap[todo[finished]] = np.where(stuck, np.inf, N * n / t)[finished]
        stopped[todo[finished]] = stuck[finished]
        t = np.where(done & ~final, t * FACTOR, t)
        keep = ~finished
        if not keep.any():
            break
        todo, t, X, ends = todo[keep], t[keep], X[..., keep], ends[..., keep]
        C = None if C is None else C[..., keep]
    P = linalg.congruence(F, linalg.inverse(best) if criterion == "det" else best)
    size_of = linalg.logdet if criterion == "det" else trace
    new, old = size_of(P), size_of(start)
    no_worse = ~(old > new + 2.0 * GAP * (np.abs(new) if criterion == "trace" else 1.0))
    no_worse |= stopped & last  # longdouble does not find it either: what is above all, if not the smallest
    return np.where(no_worse, start, P), np.where(no_worse, 0.0, gap)


def _slack(X: Floats, ends: Floats, C: Floats | None) -> Floats:
    """S_i(X) (n, n, N, B) of `_newton`."""
    if C is not None:
        return X[:, :, None] - ends
    inside = linalg.product(linalg.product(ends.swapaxes(0, 1), X[:, :, None]), ends)
    return np.eye(len(X), dtype=X.dtype)[:, :, None, None] - 0.5 * (inside + inside.swapaxes(0, 1))


def _newton(X: Floats, ends: Floats, C: Floats | None, t: Floats) -> tuple[Floats, Bools, Bools]:
    """One damped Newton step of t c(X) - sum log det S_i(X); whether it was a small one, or none.

    c is trace C X and S_i = X - ends_i, or, where C is None, c is -log det X and S_i = I - G_i' X G_i, G_i = ends_i:
    X <= (G_i G_i')^-1 without the inverse, whose large elements would cost the digits of the small ones.
    """
    slack = _slack(X, ends, C)
    V = linalg.inverse(slack)
    if C is None:
        V = linalg.product(linalg.product(ends, V), ends.swapaxes(0, 1))
    slope = total(np.moveaxis(V, 2, 0)) * (1.0 if C is None else -1.0)
    curved = [(V, np.ones_like(t))]
    if C is None:
        Y = linalg.inverse(X)
        slope = slope - t * Y
        curved.append((Y[:, :, None], t))
    else:
        slope = slope + t * C
    n = len(X)
    pairs = [(a, b) for a in range(n) for b in range(a + 1)]
    twice = np.array([1.0 if a == b else 2.0 for a, b in pairs])
    g = np.stack([slope[a, b] for a, b in pairs]) * twice[:, None]
    first, second = np.array(pairs).T
    both = 0.5 * twice[:, None] * twice
    H = np.zeros((len(pairs), len(pairs), *t.shape), X.dtype)
    for M, s in curved:
        for i in range(M.shape[2]):
            A = M[:, :, i]
            square = A[first[:, None], first] * A[second[:, None], second]
            square += A[first[:, None], second] * A[second[:, None], first]
            square *= s
            H += square
    H *= both[..., None]
    step = -linalg.solve(H, g)
    decrement = np.sqrt(np.maximum(-total(g * step), 0.0))
    D = np.empty_like(X)
    for value, (a, b) in zip(step, pairs, strict=True):
        D[a, b] = D[b, a] = value

    def height(X: Floats) -> Floats:
        room = total(linalg.logdet(_slack(X, ends, C)))
        out: Floats = (t * inner(C, X) if C is not None else -t * linalg.logdet(X)) - room
        return out

    here, length = height(X), np.ones_like(t)
    low = decrement < 0.25  # inside, a whole step is safe: the function is self-concordant
    for _ in range(40):
        good = height(X + length * D) <= here - 0.1 * length * decrement**2
        if (good | low).all():
            break
        length = np.where(good | low, length, 0.5 * length)
    return np.where(good | low, X + length * D, X), decrement < 0.05, ~(good | low)
