"""How far densities are apart, and the weights that put their geometric mean in the middle.

Kullback-Leibler divergence of Gaussians, its bounds for mixtures, and Chernoff weights: with
z(w) = int prod_i f_i^w_i, the w on the simplex with the least z(w). For two densities that is the w with
KL(f_w || f_1) = KL(f_w || f_2), f_w = prod f_i^w_i / z (Uney (7), (8)); for more, the sources that keep a weight are
equally far from f_w and the others nearer. log z is convex, with

    d log z / dw_i = E_w[log f_i],    d2 log z / dw_i dw_j = Cov_w[log f_i, log f_j]

in closed form for Gaussians and for finite distributions, so that Newton's method needs no sampling (Uney Algorithms
1 and 2; as printed they start at infinity, do not stay in [0, 1], and mix up z and N).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints
from fusion_service.densities.mixture import LOG_2PI, Mixture, Mixtures, log_gaussian, log_sum
from fusion_service.densities.sampling import draws, halved_sum
from fusion_service.linalg import total

__all__ = [
    "chernoff_discrete",
    "chernoff_gaussians",
    "chernoff_mixtures",
    "kl_bounds",
    "kl_gaussians",
    "overlap_gaussians",
]

ROUNDS = 60
DECREMENT = 1e-22
"""Squared Newton decrement below which a weight is found: about 1e-11 of a weight on a curvature of 1."""
SWEEPS = 20
GAP = 1e-10
"""What log z may be above its least value, relative to its slopes, with more than two sources."""

Oracle = Callable[[Floats, Ints], tuple[Floats, Floats]]
"""Weights (N, b) of the elements at an index (b,): gradient (N, b) and Hessian (N, N, b) of log z."""


def kl_gaussians(means: Floats, covariances: Floats, others: Floats, spreads: Floats) -> Floats:
    """KL(N(m, P) || N(o, S)) (...), batch-last: m, o (n, ...), P, S (n, n, ...) (Uney (55), corrected)."""
    with np.errstate(all="ignore"):
        A, det, _ = linalg.sweep(spreads)
        d = means - others
        square = total(d * linalg.matvec(A, d)) + linalg.inner(A, covariances) - len(d)
        out: Floats = 0.5 * (square + np.log(det) - linalg.logdet(covariances))
    return out


def kl_bounds(f: Mixture, g: Mixture) -> tuple[float, float]:
    """Lower and upper bound of KL(f || g) of the normalised densities, in closed form.

    Of E_fa[log h], h = sum_b w_b h_b: at least log sum_b w_b exp(-KL(fa || hb)) minus the entropy of fa, at
    most log sum_b w_b int fa hb (Jensen). One bound for each of the two terms (Durrieu, Thiran, Kelly 2012).
    """
    weights = f.weights / f.mass
    x, P = linalg.to_last(f.means, 1), linalg.to_last(f.covariances, 2)
    n = len(x)
    entropy = 0.5 * (linalg.logdet(P) + n * (1.0 + LOG_2PI))
    low, high = [], []
    for h in (f, g):
        with np.errstate(divide="ignore"):
            logs = np.log(h.weights / h.mass)
        y, S = linalg.to_last(h.means, 1), linalg.to_last(h.covariances, 2)
        a = x[..., None], P[..., None]
        b = y[:, None], S[:, :, None]
        size = (len(f.weights), len(h.weights))
        a = np.broadcast_to(a[0], (n, *size)), np.broadcast_to(a[1], (n, n, *size))
        b = np.broadcast_to(b[0], (n, *size)), np.broadcast_to(b[1], (n, n, *size))
        low.append(log_sum((logs - kl_gaussians(*a, *b)).T) - entropy)
        overlap = log_gaussian(a[0] - b[0], *linalg.ldl(a[1] + b[1]))
        high.append(log_sum((logs + overlap).T))
    return max(0.0, float(weights @ (low[0] - high[1]))), float(weights @ (high[0] - low[1]))


def chernoff_gaussians(means: Floats, covariances: Floats) -> Floats:
    """Chernoff weights (N, B) of Gaussians, means (N, n, B), covariances (N, n, n, B); equal if all are alike."""
    A, det, _ = linalg.sweep(covariances.transpose(1, 2, 0, 3))
    x = (means - means[:1]).transpose(1, 0, 2)
    logdet = np.log(det)

    def oracle(w: Floats, at: Ints) -> tuple[Floats, Floats]:
        C = linalg.inverse(total(np.moveaxis(w * A[..., at], 2, 0)))
        return _slopes(w, x[..., at], A[..., at], logdet[:, at], C)[1:]

    return _minimise(oracle, *det.shape)


def overlap_gaussians(means: Floats, covariances: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """log z (B,) of the weighted geometric mean of Gaussians (Uney (25), corrected), its gradient (N, B) and Hessian
    (N, N, B) in the weights (N, B), which sum to 1: of the gradient only differences mean something.

    Of two, with A = C1^-1 - C0^-1 and w = w_1: d log z / dw = g_1 - g_0 = KL(f_w || f_0) - KL(f_w || f_1) (Uney (54)),
    d2 log z / dw2 = H_00 + H_11 - 2 H_01 = tr((A C)^2) / 2 + d'C d, d = C1^-1 (m - m_1) - C0^-1 (m - m_0).
    """
    A, det, _ = linalg.sweep(covariances.transpose(1, 2, 0, 3))
    C, precision, _ = linalg.sweep(total(np.moveaxis(weights * A, 2, 0)))
    with np.errstate(all="ignore"):
        x, logdet = (means - means[:1]).transpose(1, 0, 2), np.log(det)
        square, gradient, hessian = _slopes(weights, x, A, logdet, C)
        return -0.5 * (total(weights * logdet) + np.log(precision) + square), gradient, hessian


def _slopes(w: Floats, x: Floats, A: Floats, logdet: Floats, C: Floats) -> tuple[Floats, Floats, Floats]:
    """sum_i w_i |x_i - m|^2 in A_i (B,), with the gradient and the Hessian of log z, of precisions A (n, n, N, B)."""
    m = linalg.matvec(C, total((w * linalg.matvec(A, x)).swapaxes(0, 1)))
    d = x - m[:, None]
    u = linalg.matvec(A, d)
    far = total(d * u)
    gradient = -0.5 * (logdet + linalg.inner(A, C[:, :, None]) + far)
    X = linalg.product(A, C[:, :, None])
    hessian = total(u[:, :, None] * linalg.matvec(C[:, :, None], u)[:, None])
    for p in range(len(C)):
        for q in range(len(C)):
            hessian += 0.5 * X[p, q][:, None] * X[q, p][None]
    return total(w * far), gradient, hessian


def chernoff_discrete(logs: Floats, base: Floats) -> Floats:
    """Chernoff weights (N, B) for z(w) = sum_k exp(base_k + sum_i w_i logs_ik), logs (N, K, B), base (K, B).

    With base 0 and the logs of probabilities this is Uney's Algorithm 2. What no source allows has base -inf and
    finite logs.
    """

    def oracle(w: Floats, at: Ints) -> tuple[Floats, Floats]:
        l = logs[..., at]
        exponent = base[:, at] + total(w[:, None] * l)
        p = np.exp(exponent - exponent.max(axis=0))
        p /= halved_sum(p)
        gradient = np.stack([halved_sum(p * row) for row in l])
        d = l - gradient[:, None]
        return gradient, np.stack([np.stack([halved_sum(p * a * b) for b in d]) for a in d])

    return _minimise(oracle, len(logs), logs.shape[-1])


def chernoff_mixtures(sources: Sequence[Mixtures], samples: int, seed: int) -> Floats:
    """Chernoff weights (N, B) of N batches of mixtures, z(w) by importance sampling.

    The samples, stratified over the components and the same for every w, come in equal parts from each source and
    from the geometric mean of the Gaussians with the sources' moments, so the problem stays convex and smooth.
    """
    N, B = len(sources), len(sources[0])
    normal = [f.normalised() for f in sources]
    gauss = [f.moments() for f in normal]
    x = np.stack([g[0] for g in gauss])
    P = np.stack([g[1] for g in gauss])
    w = chernoff_gaussians(x, P)
    A = np.stack([linalg.inverse(p) for p in P])
    C = linalg.inverse(total(w[:, None, None] * A))
    y = total(w[:, None] * np.stack([linalg.matvec(a, d) for a, d in zip(A, x - x[0], strict=True)]))
    middle = Mixtures(np.zeros((1, B)), (x[0] + linalg.matvec(C, y))[:, None], C[:, :, None])
    z = draws(len(C), samples // (N + 1), seed)
    parts = [*normal, middle]
    points = np.concatenate([_stratified(f, z, seed + i) for i, f in enumerate(parts)], axis=1)
    densities = np.stack([f.log_pdf(points) for f in parts])
    return chernoff_discrete(densities[:-1], -log_sum(densities))


def _stratified(f: Mixtures, z: Floats, seed: int) -> Floats:
    """Points (n, S, B) of each mixture from the normal draws z (n, S), every component with its share of them."""
    S = z.shape[1]
    level = np.random.default_rng(seed).permutation((np.arange(S) + 0.5) / S)[:, None]
    which = np.zeros((S, len(f)), dtype=np.intp)
    sum_ = np.zeros(len(f))
    for w in f.weights[:-1]:
        sum_ = sum_ + w
        which += level > sum_
    b = np.arange(len(f))
    L, d = linalg.ldl(f.covariances)
    out = linalg.matvec(L[:, :, which, b], z[..., None] * np.sqrt(d[:, which, b]))
    out += f.means[:, which, b]
    return out


def _minimise(oracle: Oracle, N: int, B: int) -> Floats:
    """The w (N, B) on the simplex with the least log z: Newton steps, and lines where one would overshoot."""
    w = np.full((N, B), 1.0 / N)
    todo = np.arange(B)
    with np.errstate(all="ignore"):
        if N == 2:
            return _line(oracle, w, todo, 0, 1)
        g, H = oracle(w, todo) if N > 1 else (w, w)
        for _ in range(ROUNDS if N > 1 else 0):
            here = w[:, todo]
            go = total(here * g) - g.min(axis=0) > GAP * (1.0 + np.abs(g).max(axis=0))
            todo, here, g, H = todo[go], here[:, go], g[:, go], H[..., go]
            if not len(todo):
                break
            new = _quadratic(here, g, H)
            g_new, H = oracle(new, todo)
            far = total((new - here) * g_new) > -0.5 * total((new - here) * g)
            if far.any():
                some = here[:, far]
                for a in range(N):
                    for b in range(a + 1, N):
                        some = _line(oracle, some, todo[far], a, b)
                new[:, far] = some
                g_new[:, far], H[..., far] = oracle(some, todo[far])
            w[:, todo], g = new, g_new
    return w


def _quadratic(w: Floats, g: Floats, H: Floats) -> Floats:
    """The v (N, b) on the simplex with nearly the least g'(v - w) + (v - w)'H(v - w) / 2, by moves between two."""
    v, slope = w.copy(), g.copy()
    N = len(w)
    for _ in range(SWEEPS):
        for a in range(N):
            for b in range(a + 1, N):
                step = (slope[a] - slope[b]) / (H[a, a] + H[b, b] - 2.0 * H[a, b])
                step = np.where(np.isfinite(step), np.minimum(np.maximum(step, -v[b]), v[a]), 0.0)
                v[a] -= step
                v[b] += step
                slope += step * (H[b] - H[a])
    return v


def _line(oracle: Oracle, w: Floats, index: Ints, a: int, b: int) -> Floats:
    """Newton's method, bracketed, along e_b - e_a."""
    both = w[a] + w[b]
    lo, hi = np.zeros_like(both), both.copy()
    ends = np.zeros((2, len(both)), dtype=np.bool_)  # where the slope is known at 0 and at `both`
    busy = np.flatnonzero(both > 0.0)
    for _ in range(ROUNDS):
        if not len(busy):
            break
        g, H = oracle(w[:, busy], index[busy])
        slope, bend = g[b] - g[a], H[a, a] + H[b, b] - 2.0 * H[a, b]
        t, s = w[b, busy], both[busy]
        ends[0, busy] |= t == 0.0
        ends[1, busy] |= t == s
        lo[busy] = np.where(slope < 0.0, t, lo[busy])
        hi[busy] = np.where(slope > 0.0, t, hi[busy])
        done = (slope * slope <= DECREMENT * np.maximum(bend, DECREMENT)) | ~np.isfinite(slope)
        done |= ((t == 0.0) & (slope > 0.0)) | ((t == s) & (slope < 0.0))
        low, high = lo[busy], hi[busy]
        new = t - slope / bend
        middle = 0.5 * (low + high)
        new = np.where(new > low, new, np.where((low == 0.0) & ~ends[0, busy], 0.0, middle))
        new = np.where(new < high, new, np.where((high == s) & ~ends[1, busy], s, middle))
        new = np.where(np.isfinite(new), new, middle)
        new = np.where(done, t, new)
        done |= new == t
        w[b, busy], w[a, busy] = new, s - new
        busy = busy[~done]
    return w
