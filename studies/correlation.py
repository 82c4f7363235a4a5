"""What a fusion rule does to errors of a known joint distribution: true MSE, mean reported covariance, worst case.

Errors e = (e_1 ... e_N) of N sources have the joint covariance J. A rule gives x_1 + g(d) with d = (x_2 - x_1, ...
x_N - x_1), so its error is e_1 + g(d); with E[e_1 | d] = B d,

    MSE = P_1 - B E[d d'] B' + E[(B d + g)(B d + g)']

and only d is drawn. The draws are whitened (mean square exactly I), so that the MSE of a rule whose gain does not
depend on d is exact, and so is the mean covariance of one that is quadratic in d. A rule's excess is the largest
eigenvalue of its MSE relative to its mean reported covariance: above 1 it is not conservative.

A bound rho on the correlation, ||P_i^-1/2 P_ij P_j^-T/2|| <= rho, leaves for error combinations a_i = L_i' G_i' u of a
rule with gains G_i the worst case u' MSE u = sum |a_i|^2 + rho sum_(i != j) |a_i||a_j|, reached by P_ij = rho L_i
(a_i/|a_i|) (a_j/|a_j|)' L_j'. For two sources, with M_i = G_i P_i G_i',

    max_u u' MSE u / u' P u = min_(s > 0) lambda_max((1 + rho s) M_1 + (1 + rho / s) M_2 relative to P)

(2 |a_1||a_2| <= s |a_1|^2 + |a_2|^2 / s; equality since pairs of quadratic forms have a convex range, or in two
dimensions an ellipse, whose hull has the same upper boundary). The right side is convex in log s: the worst case is
exact, certified from above.

Shapes: batch first here, pairs (B,), draws (M,); P (B, N, n, n), J (B, N n, N n).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.rules import Fuser
from studies.study import Floats

__all__ = [
    "Outcome",
    "draws",
    "excess",
    "expected",
    "independent",
    "joint_of",
    "largest_correlation",
    "mse",
    "optimal",
    "rank_one",
    "top",
    "whitened",
    "worst",
    "worst_in_plane",
]

PIECE = 20_000
"""Fusions at a time."""


class Outcome(NamedTuple):
    """mse (B, n, n); reported (B, n, n), mean over the draws; gains (B, N, n, n), least squares of what the rule does;
    constant: neither gain nor covariance depends on d."""

    mse: Floats
    reported: Floats
    gains: Floats
    constant: bool


def transpose(A: Floats) -> Floats:
    """A' of the last two axes."""
    return A.swapaxes(-1, -2)


def excess(mse: Floats, reported: Floats) -> Floats:
    """Largest eigenvalue (...,) of mse relative to reported (..., n, n)."""
    W = np.linalg.inv(np.linalg.cholesky(reported))
    return np.asarray(np.linalg.eigvalsh(W @ mse @ transpose(W))[..., -1])


def top(mse: Floats, reported: Floats) -> tuple[Floats, Floats]:
    """The excess (B,) and the u (B, n) in whose direction u' mse u / u' reported u is so large."""
    W = np.linalg.inv(np.linalg.cholesky(reported))
    values, V = np.linalg.eigh(W @ mse @ transpose(W))
    return values[:, -1], np.einsum("bji,bj->bi", W, V[..., -1])


def joint_of(P: Floats, K: Floats) -> Floats:
    """J (B, N n, N n) of covariances P and the correlations K (B, N n, N n), identity blocks on its diagonal, of the
    errors whitened by Cholesky factors."""
    B, N, n, _ = P.shape
    L = np.asarray(np.linalg.cholesky(P))
    blocks = np.matmul(L[:, :, None], K.reshape(B, N, n, N, n).swapaxes(2, 3)) @ L.swapaxes(-1, -2)[:, None]
    return np.asarray(blocks.swapaxes(2, 3).reshape(B, N * n, N * n))


def independent(P: Floats) -> Floats:
    """J (B, N n, N n) of independent errors."""
    B, N, n, _ = P.shape
    return joint_of(P, np.broadcast_to(np.eye(N * n), (B, N * n, N * n)))


def whitened(J: Floats, P: Floats) -> Floats:
    """L_i^-1 J_ij L_j^-T as blocks (B, N, N, n, n), L_i the Cholesky factors of P (B, N, n, n)."""
    B, N, n, _ = P.shape
    W = np.linalg.inv(np.linalg.cholesky(P))
    return np.asarray(W[:, :, None] @ J.reshape(B, N, n, N, n).swapaxes(2, 3) @ transpose(W)[:, None])


def largest_correlation(J: Floats, P: Floats) -> Floats:
    """The least bound (B,) that holds for J: the largest singular value of any whitened P_ij, i != j."""
    blocks = whitened(J, P)
    first, second = np.triu_indices(P.shape[1], 1)
    return np.asarray(np.linalg.norm(blocks[:, first, second], 2, axis=(-2, -1)).max(axis=1))


def draws(rng: np.random.Generator, size: int, M: int) -> Floats:
    """Standard normal (size, M) whose mean square is exactly I."""
    z = rng.standard_normal((size, max(M, 2 * size)))
    return np.asarray(np.sqrt(z.shape[1]) * np.linalg.solve(np.linalg.cholesky(z @ z.T), z))


def _fused(rule: Fuser, d: Floats, P: Floats) -> tuple[Floats, Floats]:
    """g (B, n, M) and covariances (B, n, n, M) for differences d (B, N - 1, n, M)."""
    B, N, n, _ = P.shape
    M = d.shape[-1]
    g, reported = np.empty((B, n, M)), np.empty((B, n, n, M))
    step = max(1, PIECE // M)
    for b in range(0, B, step):
        part = slice(b, b + step)
        count = len(d[part])
        means = np.zeros((N, n, count, M))
        means[1:] = d[part].transpose(1, 2, 0, 3)
        covariances = np.empty((N, n, n, count, M))
        covariances[:] = P[part].transpose(1, 2, 3, 0)[..., None]
        fused = rule(means.reshape(N, n, -1), covariances.reshape(N, n, n, -1))
        g[part] = fused.mean.reshape(n, count, M).swapaxes(0, 1)
        reported[part] = fused.covariance.reshape(n, n, count, M).transpose(2, 0, 1, 3)
    return g, reported


def expected(rule: Fuser, P: Floats, J: Floats, z: Floats) -> Outcome:
    """`rule` told P (B, N, n, n), on errors of joint covariance J, by the draws z ((N - 1) n, M).

    Fusions that the rule refuses (sampled ones of means far apart) are left out; ValueError if they are over 5 %.
    """
    B, N, n, _ = P.shape
    H = _differences(N, n)
    D, cross = H @ J @ H.T, J[:, :n] @ H.T  # E[d d'], E[e_1 d']
    values, V = np.linalg.eigh(D)
    root = np.sqrt(np.maximum(values, 0.0))
    scale = np.where(values > 1e-10 * values[:, -1:], 1.0 / np.maximum(root, 1e-150), 0.0)
    inverse_root = V * scale[:, None]  # R^-T of D = R R', R = V root
    d = (V * root[:, None]) @ z
    g, reported = _fused(rule, d.reshape(B, N - 1, n, -1), P)
    good = np.asarray(np.isfinite(g).all(axis=1))  # (B, M)
    if good.mean() < 0.95:
        raise ValueError(f"rule {rule.label!r} refuses {100 * (1 - good.mean()):.0f} % of these fusions")
    g = np.where(good[:, None], g, 0.0)
    reported = np.where(good[:, None, None], reported, 0.0)
    count = good.sum(axis=1)[:, None, None]
    S = g @ z.T / count
    gain = S @ transpose(inverse_root)
    constant = bool(
        np.allclose(g, gain @ d, rtol=1e-6, atol=1e-6 * np.abs(d).max())
        and np.allclose(reported, reported[..., :1], rtol=1e-7, atol=0.0)
    )
    others = gain.reshape(B, n, N - 1, n).swapaxes(1, 2)
    gains = np.concatenate([np.eye(n) - others.sum(axis=1, keepdims=True), others], axis=1)
    known = cross @ inverse_root  # E[e_1 | z] = known z
    seen = np.where(good[:, None], known @ z + g, 0.0)
    true = J[:, :n, :n] - known @ transpose(known) + seen @ transpose(seen) / count
    return Outcome(0.5 * (true + transpose(true)), reported.sum(axis=-1) / count, gains, constant)


def mse(gains: Floats, J: Floats) -> Floats:
    """True MSE (B, n, n) of constant gains (B, N, n, n)."""
    B, N, n, _ = gains.shape
    G = gains.swapaxes(1, 2).reshape(B, n, N * n)
    return np.asarray(G @ J @ transpose(G))


def _differences(N: int, n: int) -> Floats:
    """H ((N - 1) n, N n) of d = H e."""
    return np.kron(np.concatenate([-np.ones((N - 1, 1)), np.eye(N - 1)], axis=1), np.eye(n))


def optimal(J: Floats, n: int) -> Floats:
    """Covariance (B, n, n) of the best linear fusion of sources with joint covariance J, which may be singular."""
    N = J.shape[1] // n
    s = np.sqrt(np.diagonal(J, axis1=1, axis2=2)[:, :n])  # units of the components
    units, H = np.tile(s, (1, N)), _differences(N, n)
    U = J / (units[:, :, None] * units[:, None])
    cross = H @ U[:, :, :n]
    P = U[:, :n, :n] - transpose(cross) @ np.linalg.pinv(H @ U @ H.T, 1e-11, hermitian=True) @ cross
    return np.asarray(P * s[:, :, None] * s[:, None])


def rank_one(gains: Floats, P: Floats, u: Floats, rho: float | Floats) -> Floats:
    """The correlations (B, N n, N n) within rho, a number or (B,), that are worst for the error along u (B, n)."""
    B, N, n, _ = P.shape
    a = np.einsum("bkji,bkmj,bm->bki", np.linalg.cholesky(P), gains, u)
    a = a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-150)
    K = np.einsum("bip,bjq->bipjq", a, a) * np.broadcast_to(rho, B)[:, None, None, None, None]
    K[:, range(N), :, range(N)] = np.eye(n)
    return np.asarray(K.reshape(B, N * n, N * n))


def _relative(gains: Floats, reported: Floats, P: Floats) -> tuple[Floats, Floats]:
    """M_i = G_i P_i G_i' (B, N, n, n) and the directions back, where the reported covariance is I."""
    W = np.linalg.inv(np.linalg.cholesky(reported))
    G = W[:, None] @ gains
    return G @ P @ transpose(G), W


def worst(gains: Floats, reported: Floats, P: Floats, rho: float | Floats) -> tuple[Floats, Floats]:
    """Largest excess (B,) over all correlations of two sources within rho, a number or (B,), from above, and the
    direction u (B, n) in which an admissible correlation, `rank_one`, reaches it."""
    M, W = _relative(gains, reported, P)
    rho = np.broadcast_to(rho, len(P))
    bound = rho[:, None, None]

    def top(t: Floats) -> tuple[Floats, Floats, Floats]:
        s = np.exp(t)[:, None, None]
        values, V = np.linalg.eigh((1.0 + bound * s) * M[:, 0] + (1.0 + bound / s) * M[:, 1])
        v = V[..., -1]
        pull = s[:, 0, 0] * _form(M[:, 0], v) - _form(M[:, 1], v) / s[:, 0, 0]
        return values[:, -1], v, pull

    low, high = np.full(len(P), -36.0), np.full(len(P), 36.0)
    for _ in range(36):
        middle = 0.5 * (low + high)
        rising = top(middle)[2] > 0.0
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    below, above = top(low), top(high)
    angle = np.linspace(0.0, np.pi, 361)[:, None, None]
    v = np.cos(angle) * below[1] + np.sin(angle) * above[1]
    v = v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
    best = np.argmax(_bounded(M, v, rho), axis=0)
    u = np.einsum("bji,bj->bi", W, v[best, range(len(P))])
    return np.minimum(below[0], above[0]), u


def worst_in_plane(
    gains: Floats, reported: Floats, P: Floats, rho: float | Floats, angles: int = 3600
) -> tuple[Floats, Floats]:
    """The same for any number of sources in two dimensions, by a dense search over directions: from
    below, short by about 1e-6."""
    M, W = _relative(gains, reported, P)
    angle = np.arange(angles) * np.pi / angles
    v = np.broadcast_to(np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None], (angles, len(P), 2))
    value = _bounded(M, v, rho)
    best = np.argmax(value, axis=0)
    return value.max(axis=0), np.einsum("bji,bj->bi", W, v[best, range(len(P))])


def _form(M: Floats, v: Floats) -> Floats:
    return np.asarray((v * (M @ v[..., None])[..., 0]).sum(axis=-1))


def _bounded(M: Floats, v: Floats, rho: float | Floats) -> Floats:
    """sum |a_i|^2 + rho sum_(i != j) |a_i||a_j| (A, B) for directions v (A, B, n)."""
    squares = np.maximum(np.stack([_form(M[:, i], v) for i in range(M.shape[1])]), 0.0)
    return np.asarray((1.0 - rho) * squares.sum(axis=0) + rho * np.sqrt(squares).sum(axis=0) ** 2)
