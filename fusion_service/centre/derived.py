"""Cross-covariances of local tracks, derived from their successive covariances: nobody has to send a gain.

A linear tracker's update is e <- B e + (its own measurement error) with B = I - K H = P_new P_pred^-1, which stands in
the covariances that it reports; between updates errors of one target go by e <- F e + w, with the same w for all
trackers of it. So for two of them (Bar-Shalom's recursion for cross-covariances)

    C <- F C F' + Q,    C <- B_i C  (an update of i),    C <- C B_j'  (one of j),

in the order of time. What C was when the two were first known together is not known; it was L_i Z L_j' with P = L L'
then and ||Z|| <= 1. With D_i <- B_i F D_i from D_i = L_i, what is left of it is D_i Z D_j', and of the correlation

    ||L_i^-1 D_i Z D_j' L_j^-T|| <= |L_i^-1 D_i|_F |L_j^-1 D_j|_F = sqrt(tr(D_i' P_i^-1 D_i) tr(D_j' P_j^-1 D_j))

which goes to 0 as updates come in (`unknown`). So the correlation of the two is at most sigma_max(L_i^-1 C L_j^-T) +
unknown, of which the first is bounded by its Schatten norm (tr (M'M)^64)^(1/128), at most n^(1/128) too much.

Exact for linear trackers that are heard at every update, whose declared motion is what they use and what targets do.
What it cannot see: errors common to measurements (navigation), messages that were lost, a tracker that says B and does
otherwise.

A pair begins anew where the chain is broken: an update older than what was already applied to the pair, one whose
predecessor is older than the last that was applied, or more than `MOST_WAVES` in one step.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, to_bytes
from fusion_service.centre.association import by_size
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.shared_noise import SharedNoise

__all__ = ["MOST_MEMBERS", "Derived", "Followed", "Successive", "rows_of"]

MOST_PAIRS = 200_000
"""Pairs that are followed at most."""
MOST_MEMBERS = 32
"""Rows of one global track whose pairs are followed."""
MOST_WAVES = 64
"""Updates of a pair in one step."""
FORGOTTEN = 1e-9
"""What is left of the unknown start, below which it counts as nothing."""
SQUARINGS = 6


class Successive(Protocol):
    """K new versions of rows in order of (time, row): `row` (K,), `time` and `before` (K,) ns of the new and the old,
    the old one predicted to `time`, `predicted_covariance` (n, n, K), and the new one, `covariance` (n, n, K)."""

    @property
    def row(self) -> Ints: ...
    @property
    def time(self) -> NDArray[np.int64]: ...
    @property
    def before(self) -> NDArray[np.int64]: ...
    @property
    def predicted_covariance(self) -> Floats: ...
    @property
    def covariance(self) -> Floats: ...


@dataclass(slots=True)
class _Pairs:
    """K pairs of rows: source (2, K) by number, epoch and id (2, K) u64; version (2, K) ns of the last update of each
    that is in it; time (K,) ns at which cross (n, n, K), C, and left (n, n, 2, K), D, hold."""

    source: Ints
    epoch: NDArray[np.uint64]
    id: NDArray[np.uint64]
    version: NDArray[np.int64]
    time: NDArray[np.int64]
    cross: Floats
    left: Floats

    @classmethod
    def none(cls, n: int) -> _Pairs:
        two = np.zeros((2, 0), dtype=np.int64)
        ids = two.astype(np.uint64)
        return cls(two.astype(np.intp), ids, ids, two, two[0], np.zeros((n, n, 0)), np.zeros((n, n, 2, 0)))


@dataclass(frozen=True, slots=True)
class Followed:
    """What is known of pairs of rows at a step: key (K,), first row * count + second, sorted; cross (n, n, K); bound
    (K,) on their correlation; unknown (K,), the part of it that comes of the start; count: of the rows."""

    key: Ints
    cross: Floats
    bound: Floats
    unknown: Floats
    count: int

    def of(self, members: Ints) -> tuple[Floats, Floats, Floats]:
        """Of rows `members` (B, N): bounds (N, N, B), cross-covariances (N, N, n, n, B), and the largest part (B,) of
        any bound that comes of the start. A pair that is not followed has 1, 0 and 1."""
        size, N = members.shape
        n = len(self.cross)
        R, C, unknown = np.ones((N, N, size)), np.zeros((N, N, n, n, size)), np.zeros(size)
        for i in range(N):
            for j in range(i + 1, N):
                a, b = members[:, i], members[:, j]
                asked = np.minimum(a, b) * self.count + np.maximum(a, b)
                at = np.minimum(np.searchsorted(self.key, asked), max(len(self.key) - 1, 0))
                there = self.key[at] == asked if len(self.key) else np.zeros(size, dtype=np.bool_)
                one, swapped = at[there], (a > b)[there]
                R[i, j, there] = R[j, i, there] = self.bound[one]
                cross = np.where(swapped, self.cross[:, :, one].swapaxes(0, 1), self.cross[:, :, one])
                C[i, j][:, :, there], C[j, i][:, :, there] = cross, cross.swapaxes(0, 1)
                mine = np.ones(size)
                mine[there] = self.unknown[one]
                unknown = np.maximum(unknown, mine)
        return R, C, unknown


@dataclass(slots=True)
class Derived:
    """The pairs of rows that were linked to one global track in the last step. beyond: how many there was no room for.
    names: of the sources, by number."""

    n: int
    names: tuple[str, ...] = ()
    beyond: int = 0
    _pairs: _Pairs = field(init=False)

    def __post_init__(self) -> None:
        self._pairs = _Pairs.none(self.n)

    def __len__(self) -> int:
        return len(self._pairs.time)

    def follow(
        self, rows: Rows, names: tuple[str, ...], versions: Successive, noise: SharedNoise, sound: Bools, time: int
    ) -> Followed:
        """Go on to the step at `time`, ns, with its links and the versions since the last. noise: of sources `names`;
        sound (M,): rows that are what a linear tracker reports, one Gaussian in the centre's whole space."""
        count = len(rows.source)
        pair = self._wanted(rows, noise, sound)
        shared = noise.of(*rows.source[pair])
        pairs, known = self._carried(rows, names, pair)
        broken = self._apply(pairs, pair, versions, noise, shared, np.flatnonzero(known)) | ~known
        W = _whitening(rows.tracks.covariance) if pair.size else rows.tracks.covariance
        at = np.flatnonzero(broken)
        pairs.time[at], pairs.version[:, at], pairs.cross[:, :, at] = time, rows.tracks.time[pair[:, at]], 0.0
        for side in (0, 1):
            pairs.left[:, :, side, at] = _root(rows.tracks.covariance[:, :, pair[side, at]])
        self._pairs, self.names = pairs, names
        return self._now(pairs, pair, noise, shared, W, count, time)

    def _wanted(self, rows: Rows, noise: SharedNoise, sound: Bools) -> Ints:
        """The pairs (2, K) to be followed, in order."""
        linked = np.flatnonzero((rows.tracks.link != NO_TRACK) & sound & (noise.kind[rows.source] >= 0))
        parts = [np.zeros((2, 0), dtype=np.intp)]
        self.beyond = 0
        for _, groups in by_size(rows.tracks.link[linked]):
            k = groups.shape[1]
            most = min(k, MOST_MEMBERS)
            self.beyond += len(groups) * (k * (k - 1) - most * (most - 1)) // 2
            first, second = np.triu_indices(most, 1)
            parts.append(linked[np.stack([groups[:, first].ravel(), groups[:, second].ravel()])])
        pair = np.concatenate(parts, axis=1)
        pair = pair[:, noise.of(*rows.source[pair]) >= 0]
        pair = pair[:, np.lexsort(pair[::-1])]
        self.beyond += max(0, pair.shape[1] - MOST_PAIRS)
        return pair[:, :MOST_PAIRS]

    def _carried(self, rows: Rows, names: tuple[str, ...], pair: Ints) -> tuple[_Pairs, Bools]:
        """State of the wanted pairs, as it was where they were followed before (K,)."""
        old, count, n, K = self._pairs, len(rows.source), self.n, pair.shape[1]
        place = {name: i for i, name in enumerate(names)}
        number = np.array([*(place.get(name, -1) for name in self.names), -1], dtype=np.intp)
        row = np.stack([rows_of(rows, number[old.source[side]], old.epoch[side], old.id[side]) for side in (0, 1)])
        key = np.where((row >= 0).all(axis=0), row[0] * count + row[1], -1)
        order = np.argsort(key, kind="stable")
        asked = pair[0] * count + pair[1]
        at = np.minimum(np.searchsorted(key[order], asked), max(len(key) - 1, 0))
        known = key[order][at] == asked if len(key) else np.zeros(K, dtype=np.bool_)
        of, to = order[at[known]] if len(key) else np.zeros(0, dtype=np.intp), np.flatnonzero(known)
        new = _Pairs(
            rows.source[pair],
            rows.epoch[pair],
            rows.tracks.id[pair],
            np.zeros((2, K), dtype=np.int64),
            np.zeros(K, dtype=np.int64),
            np.zeros((n, n, K)),
            np.zeros((n, n, 2, K)),
        )
        new.version[:, to], new.time[to] = old.version[:, of], old.time[of]
        new.cross[:, :, to], new.left[:, :, :, to] = old.cross[:, :, of], old.left[:, :, :, of]
        return new, known

    def _apply(
        self, pairs: _Pairs, pair: Ints, versions: Successive, noise: SharedNoise, shared: Ints, known: Ints
    ) -> Bools:
        """Take the versions into the `known` pairs, in order of time; which pairs (K,) could not take one."""
        broken = np.zeros(pair.shape[1], dtype=np.bool_)
        if not len(versions.row) or not len(known):
            return broken
        B = linalg.product(versions.covariance, linalg.inverse(versions.predicted_covariance))
        sound = np.isfinite(B).all(axis=(0, 1))
        sound &= linalg.is_positive_definite(versions.predicted_covariance)
        held = np.asarray(pairs.left.any(axis=(0, 1, 2)))
        at, side, event, wave = _schedule(pair[:, known], versions.row)
        at = known[at]
        broken[at[wave >= MOST_WAVES]] = True
        for w in range(min(int(wave.max(initial=-1)) + 1, MOST_WAVES)):
            some = np.flatnonzero((wave == w) & ~broken[at])
            p, s, e = at[some], side[some], event[some]
            new = versions.time[e]
            good = sound[e] & (new >= pairs.time[p]) & (versions.before[e] >= pairs.version[s, p])
            broken[p[~good]] = True
            p, s, e, new = p[good], s[good], e[good], new[good]
            F, Q = noise.between(shared[p], (new - pairs.time[p]) / 1e9)
            C = linalg.product(linalg.product(F, pairs.cross[:, :, p]), F.swapaxes(0, 1)) + Q
            gain = B[:, :, e]
            ahead = s == 0
            C[:, :, ahead] = linalg.product(gain[:, :, ahead], C[:, :, ahead])
            C[:, :, ~ahead] = linalg.product(C[:, :, ~ahead], gain[:, :, ~ahead].swapaxes(0, 1))
            pairs.cross[:, :, p] = C
            some = np.flatnonzero(held[p])
            D = linalg.product(F[:, :, None, some], pairs.left[:, :, :, p[some]])
            which = np.arange(len(some)), s[some]
            D[:, :, which[1], which[0]] = linalg.product(gain[:, :, some], D[:, :, which[1], which[0]])
            pairs.left[:, :, :, p[some]] = D
            pairs.time[p], pairs.version[s, p] = new, new
        return broken

    def _now(
        self, pairs: _Pairs, pair: Ints, noise: SharedNoise, shared: Ints, W: Floats, count: int, time: int
    ) -> Followed:
        """What holds at `time`; forgets what is left of a start that is none any more."""
        F, Q = noise.between(shared, (time - pairs.time) / 1e9)
        C = linalg.product(linalg.product(F, pairs.cross), F.swapaxes(0, 1)) + Q
        held = np.flatnonzero(pairs.left.any(axis=(0, 1, 2)))
        left = np.ones(len(held))
        for side in (0, 1):
            D = linalg.product(W[:, :, pair[side, held]], linalg.product(F[:, :, held], pairs.left[:, :, side, held]))
            left = left * np.sqrt(linalg.total(linalg.total(D * D)))
        gone = left < FORGOTTEN
        pairs.left[:, :, :, held[gone]] = 0.0
        unknown = np.zeros(pair.shape[1])
        unknown[held] = np.where(gone, 0.0, np.minimum(np.nan_to_num(left, nan=1.0), 1.0))
        M = linalg.product(linalg.product(W[:, :, pair[0]], C), W[:, :, pair[1]].swapaxes(0, 1))
        bound = np.minimum(np.nan_to_num(_largest(M) + unknown, nan=1.0), 1.0)
        return Followed(pair[0] * count + pair[1], C, bound, unknown, count)

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        pairs = self._pairs
        held = np.flatnonzero(pairs.left.any(axis=(0, 1, 2)))
        columns = [pairs.source.astype(np.int64), pairs.epoch, pairs.id, pairs.version, pairs.time, pairs.cross]
        return {
            "n": self.n,
            "names": list(self.names),
            "columns": [to_bytes(column) for column in (*columns, held.astype(np.int64), pairs.left[..., held])],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with what `packed` gave; with nothing, if that was in another space."""
        if state["n"] != self.n:
            return
        n, kinds = self.n, ("<i8", "<u8", "<u8", "<i8", "<i8", "<f8", "<i8", "<f8")
        source, epoch, ids, version, time, cross, held, left = (
            np.frombuffer(one, kind) for one, kind in zip(state["columns"], kinds, strict=True)
        )
        K = len(time)
        whole = np.zeros((n, n, 2, K))
        whole[..., held.astype(np.intp)] = left.reshape(n, n, 2, len(held))
        self.names = tuple(state["names"])
        self._pairs = _Pairs(
            source.reshape(2, K).astype(np.intp),
            epoch.reshape(2, K).astype(np.uint64),
            ids.reshape(2, K).astype(np.uint64),
            version.reshape(2, K).astype(np.int64),
            time.astype(np.int64),
            cross.reshape(n, n, K).astype(np.float64),
            whole,
        )


def rows_of(rows: Rows, source: Ints, epoch: NDArray[np.uint64], ids: NDArray[np.uint64]) -> Ints:
    """The rows (K,) of these tracks, -1 where there is none."""
    if not len(rows.source) or not len(ids):
        return np.full(len(ids), -1, dtype=np.intp)
    every = np.unique(rows.tracks.id)
    code = np.minimum(np.searchsorted(every, ids), len(every) - 1)
    there = rows.source * len(every) + np.searchsorted(every, rows.tracks.id)
    asked = source * len(every) + code
    at = np.minimum(np.searchsorted(there, asked), len(there) - 1)
    same = (source >= 0) & (every[code] == ids) & (there[at] == asked) & (rows.epoch[at] == epoch)
    return np.where(same, at, -1)


def _schedule(pair: Ints, row: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """Which pair (2, K) takes which version, of `row` (E,), on which side, and as its how-manieth: four of (J,)."""
    order = np.argsort(row, kind="stable")
    low, high = (np.searchsorted(row[order], pair.ravel(), where) for where in ("left", "right"))
    many = high - low
    which = np.repeat(np.arange(pair.size), many)
    event = order[np.repeat(low - (np.cumsum(many) - many), many) + np.arange(len(which))]
    side, at = np.divmod(which, pair.shape[1])
    sorting = np.lexsort((event, at))
    at, side, event = at[sorting], side[sorting], event[sorting]
    begins = np.searchsorted(at, at, "left")
    return at, side, event, np.arange(len(at)) - begins


def _root(P: Floats) -> Floats:
    """L (n, n, B) with P = L L'."""
    L, d = linalg.ldl(P)
    with np.errstate(all="ignore"):
        return np.asarray(L * np.sqrt(d)[None])


def _whitening(P: Floats) -> Floats:
    """L^-1 (n, n, B) of P = L L'."""
    L, d = linalg.ldl(P)
    W = np.zeros_like(P)
    with np.errstate(all="ignore"):
        for i in range(len(P)):
            W[i, i] = 1.0
            for k in range(i):
                W[i, : k + 1] -= L[i, k] * W[k, : k + 1]
        return np.asarray(W / np.sqrt(d)[:, None])


def _largest(M: Floats) -> Floats:
    """The largest singular value (B,) of M (n, n, B), or up to a factor n^(1/128) more, never less."""
    with np.errstate(all="ignore"):
        G = linalg.product(M.swapaxes(0, 1), M)
        size = linalg.trace(G)
        none, log, power = size == 0.0, np.log(size), 1.0
        for _ in range(SQUARINGS):
            G = G / size
            G = linalg.product(G, G)
            size = linalg.trace(G)
            power *= 0.5
            log = log + power * np.log(size)
        return np.where(none, 0.0, np.exp(0.5 * log) * (1.0 + 1e-9))
