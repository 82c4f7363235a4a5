"""The estimate of all errors of all sources at once, in information form.

Data are kept apart from what is supposed beforehand: (matrix, vector) hold only what shared targets have told, fading
with time, so that slow drift is followed. Of a target that k sources see, z_i = u + H_i theta_i + e_i with e_i of
covariance W_i^-1 and nothing known of u, eliminating u leaves exactly

    matrix += blockdiag(H_i' W_i H_i) - B' C B,    vector += [H_i' W_i z_i] - B' C sum W_i z_i,
    B = [W_1 H_1 ... W_k H_k],    C = (sum W_i)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints, from_bytes, to_bytes
from fusion_service.centre.supervision.bias import CLOCK, DRIFT, PARAMETERS

__all__ = ["Group", "Information", "Posterior", "inverse_2x2"]

P = len(PARAMETERS)
TIGHT = 1e-4
"""Of what is supposed beforehand: how exactly a gauge is kept."""
LOST = 1e-9
"""Information that is nothing, beside what is supposed beforehand."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """M rows of G shared targets, those of one target beside each other. source (M,): index into the names of the
    estimate; group (M,), start (G,); H (2, 7, M); z (2, M), m; weight (2, 2, M), 1/m2, the inverse of its error."""

    source: Ints
    group: Ints
    start: Ints
    H: Floats
    z: Floats
    weight: Floats

    def total(self, a: Floats) -> Floats:
        """Sums (..., G) over the rows of each target."""
        return np.add.reduceat(a, self.start, axis=-1) if len(self.start) else np.zeros((*a.shape[:-1], 0))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """mean (S, 7) and covariance (S, 7, S, 7)."""

    mean: Floats
    covariance: Floats

    def of(self, at: int) -> tuple[Floats, Floats]:
        """Mean (7,) and covariance (7, 7) of one source."""
        return self.mean[at], self.covariance[at, :, at]

    @property
    def variance(self) -> Floats:
        """(S, 7)."""
        s, p = self.mean.shape
        return np.diagonal(self.covariance.reshape(s * p, s * p)).reshape(s, p)

    @property
    def sound(self) -> bool:
        """Whether it is finite, and no variance is negative."""
        return bool(np.isfinite(self.covariance).all() and np.isfinite(self.mean).all() and (self.variance >= 0).all())


class Information:
    """What shared targets have told of the errors of the sources `names`. shared (S, S): how many targets two of them
    had in common, fading; on the diagonal those that one had with any. pending: what all that is known is to be
    multiplied by when it fades next: an estimate that was made before it is kept is made again to the bit."""

    def __init__(self, names: tuple[str, ...] = ()) -> None:
        self.names = names
        self.matrix = np.zeros((len(names), P, len(names), P))
        self.vector = np.zeros((len(names), P))
        self.shared = np.zeros((len(names), len(names)))
        self.pending = 1.0

    def fade(self, kept: float, dt: float) -> None:
        """Go on by `dt` seconds, in which clocks drift, and keep this share of all that is known."""
        share, self.pending = kept * self.pending, 1.0
        self.matrix, self.vector, self.shared = share * self.matrix, share * self.vector, kept * self.shared
        self.matrix[:, DRIFT] -= dt * self.matrix[:, CLOCK]
        self.matrix[..., DRIFT] -= dt * self.matrix[..., CLOCK]
        self.vector[:, DRIFT] -= dt * self.vector[:, CLOCK]

    def reweigh(self, before: Floats, now: Floats) -> None:
        """What the information of each source (S,) is divided by was `before`: it is `now`, on the mean of all of them
        by what they share, also for what was taken; from the next step on."""
        weight = np.diagonal(self.shared)
        if weight.any():
            self.pending *= float(np.exp((weight * (np.log(before) - np.log(now))).sum() / weight.sum()))

    def arrange(self, names: tuple[str, ...]) -> None:
        """Be about these sources: nothing is known of new ones, and those that are gone are eliminated."""
        if names == self.names:
            return
        for at, name in enumerate(self.names):
            if name not in names:
                self.forget(at, np.ones(P, dtype=np.bool_))
        old, new = Information(names), [name for name in names if name in self.names]
        to, of = ([every.index(name) for name in new] for every in (names, self.names))
        old.matrix[np.ix_(to, range(P), to, range(P))] = self.matrix[np.ix_(of, range(P), of, range(P))]
        old.vector[to], old.shared[np.ix_(to, to)] = self.vector[of], self.shared[np.ix_(of, of)]
        self.names, self.matrix, self.vector, self.shared = names, old.matrix, old.vector, old.shared

    def forget(self, at: int, which: Bools) -> None:
        """Know nothing more of errors `which` (7,) of the source `at`, and of all others what is known without them:
        they are integrated out."""
        flat = self.matrix.reshape(self.vector.size, -1)
        gone = np.zeros(self.vector.shape, dtype=np.bool_)
        gone[at] = which
        a, b = np.flatnonzero(~gone.ravel()), np.flatnonzero(gone.ravel())
        inner = flat[np.ix_(b, b)]
        size = np.where(np.diag(inner) > 0, np.sqrt(np.abs(np.diag(inner))), 1.0)
        scaled = inner / np.outer(size, size)
        inverse = np.linalg.pinv(0.5 * (scaled + scaled.T), rcond=LOST, hermitian=True) / np.outer(size, size)
        across = flat[np.ix_(a, b)] @ inverse
        matrix, vector = np.zeros_like(flat), np.zeros(self.vector.size)
        matrix[np.ix_(a, a)] = flat[np.ix_(a, a)] - across @ flat[np.ix_(b, a)]
        vector[a] = self.vector.ravel()[a] - across @ self.vector.ravel()[b]
        self.matrix = (0.5 * (matrix + matrix.T)).reshape(self.matrix.shape)
        self.vector = vector.reshape(self.vector.shape)

    def add(self, group: Group) -> None:
        """Take what one step says."""
        if not len(group.start):
            return
        s, count = len(self.names), len(group.start)
        B = sum(group.weight[:, k, None] * group.H[k][None] for k in (0, 1))
        own = sum(group.H[k][:, None] * B[k][None] for k in (0, 1))
        C = inverse_2x2(group.total(group.weight))
        weighed = sum(group.weight[:, k] * group.z[k] for k in (0, 1))
        told = sum(group.H[k] * weighed[k] for k in (0, 1))
        root = _root_2x2(C)
        wide = np.zeros((2, count, s, P))
        for k in (0, 1):
            part = root[0, k][group.group] * B[0] + root[1, k][group.group] * B[1]
            wide[k, group.group, group.source] = part.T
        flat = wide.reshape(2 * count, s * P)
        total = group.total(np.asarray(weighed))
        rest = np.stack([root[0, k] * total[0] + root[1, k] * total[1] for k in (0, 1)]).reshape(-1)
        matrix, vector = -(flat.T @ flat).reshape(s, P, s, P), -(flat.T @ rest).reshape(s, P)
        for at in np.unique(group.source).tolist():
            mine = group.source == at
            matrix[at, :, at] += np.asarray(own)[:, :, mine].sum(axis=-1)
            vector[at] += np.asarray(told)[:, mine].sum(axis=-1)
        self.matrix, self.vector = self.matrix + matrix, self.vector + vector
        there = np.zeros((count, s))
        there[group.group, group.source] = 1.0
        self.shared = self.shared + there.T @ there

    def posterior(self, sigma: Floats, gauge: Floats) -> Posterior:
        """The estimate with `sigma` (S, 7) supposed beforehand, 0 for what is known to be 0, and K sums gauge (K, S, 7)
        of errors, each in units of its sigma, kept at 0."""
        free = np.flatnonzero(sigma.ravel() > 0)
        scale = sigma.ravel()[free]
        flat, sums = self.matrix.reshape(sigma.size, sigma.size), gauge.reshape(len(gauge), sigma.size)[:, free] / TIGHT
        A = np.eye(len(free)) + flat[np.ix_(free, free)] * scale[:, None] * scale + sums.T @ sums
        inverse = _inverse(0.5 * (A + A.T))
        inverse = 0.5 * (inverse + inverse.T) * scale[:, None] * scale
        mean, covariance = np.zeros(sigma.size), np.zeros((sigma.size, sigma.size))
        mean[free] = inverse @ self.vector.ravel()[free]
        covariance[np.ix_(free, free)] = inverse
        return Posterior(mean.reshape(sigma.shape), covariance.reshape(*sigma.shape, *sigma.shape))

    def packed(self) -> list[object]:
        """As plain values."""
        return [list(self.names), self.pending, *(to_bytes(one) for one in (self.matrix, self.vector, self.shared))]

    @classmethod
    def unpacked(cls, packed: list[Any]) -> Information:
        """From what `packed` gave."""
        names, pending, *parts = packed
        made = cls(tuple(str(name) for name in names))
        made.pending = float(pending)
        like = (made.matrix, made.vector, made.shared)
        made.matrix, made.vector, made.shared = (
            from_bytes(part, one).reshape(one.shape) for part, one in zip(parts, like, strict=True)
        )
        return made


def _inverse(A: Floats) -> Floats:
    """A^-1, NaN where there is none."""
    try:
        return np.asarray(np.linalg.inv(A)) if len(A) else A
    except np.linalg.LinAlgError:
        return np.full_like(A, np.nan)


def inverse_2x2(A: Floats) -> Floats:
    """A^-1 (2, 2, M) of symmetric A."""
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return np.asarray(np.stack([np.stack([A[1, 1], -A[0, 1]]), np.stack([-A[1, 0], A[0, 0]])]) / det)


def _root_2x2(A: Floats) -> Floats:
    """L (2, 2, M) lower triangular, A = L L'."""
    L = np.zeros_like(A)
    L[0, 0] = np.sqrt(np.maximum(A[0, 0], 0.0))
    L[1, 0] = A[1, 0] / np.where(L[0, 0] > 0, L[0, 0], 1.0)
    L[1, 1] = np.sqrt(np.maximum(A[1, 1] - L[1, 0] ** 2, 0.0))
    return L
