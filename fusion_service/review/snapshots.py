"""What was there and what was shown at given times: truth, a source's tracks, a centre's tracks, as positions.

Times are arrays (K,) of int ns, ascending; positions are in one given frame along d axes, (x, y) or (x, y, z).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.densities import moments
from fusion_service.geodesy import FrameError, transform
from fusion_service.motion import predict
from schemas import Frame, GlobalTracks, LocalTracks, Motion, Truth, check_numbers, merged
from schemas.messages import TENTATIVE

__all__ = [
    "STALE_PERIODS",
    "STALE_STEPS",
    "Block",
    "Indices",
    "Numbers",
    "ShownTracks",
    "Times",
    "TrackMessage",
    "in_frame",
    "order",
    "truth_path",
    "truth_positions",
]

Times = NDArray[np.int64]
Indices = NDArray[np.intp]
U64 = NDArray[np.uint64]
TrackMessage = LocalTracks | GlobalTracks

STALE_PERIODS = 3.0
STALE_STEPS = 2.0
TRUTH_GAPS = 3.0


def order(message: TrackMessage | Truth) -> tuple[int, int, int]:
    """Sorting key: time, epoch, sequence."""
    return message.time, message.epoch, message.seq


def truth_path(
    truths: Sequence[Truth], frame: Frame, axes: tuple[str, ...], more: tuple[str, ...] = ()
) -> dict[int, tuple[Times, Floats]]:
    """Object id -> its times (L,), ascending, and positions (L, d) in `frame`; the later message of equal times.

    more: further components, which are NaN where truth does not say them. Raises ValueError where truth lacks an axis,
    `FrameError` where its frame has no relation to `frame`.
    """
    truths = sorted((truth for truth in truths if len(truth.ids)), key=order)
    moved: list[Floats] = []
    for truth in truths:
        own = tuple(name for name in (*"xyz", *more) if name in truth.space)
        if not set(axes) <= set(own):
            raise ValueError(f"truth has no z, but is asked for {' '.join(axes)}")
        means = truth.means[:, [truth.space.index(name) for name in own]]
        if truth.frame != frame:
            own, means = _movable(own, means, truth.frame, frame)
        places = np.full((len(means), len(axes) + len(more)), np.nan)
        for column, name in enumerate((*axes, *more)):
            if name in own:
                places[:, column] = means[:, own.index(name)]
        moved.append(places)
    if not truths:
        return {}
    ids, places = np.concatenate([truth.ids for truth in truths]), np.concatenate(moved)
    when = np.repeat(np.array([truth.time for truth in truths]), [len(truth.ids) for truth in truths])
    last = np.argsort(ids, kind="stable")
    ids, when = ids[last], when[last]
    kept = np.append((ids[1:] != ids[:-1]) | (when[1:] != when[:-1]), True)
    ids, when, places = ids[kept], when[kept], places[last[kept]]
    begins = np.flatnonzero(np.append(True, ids[1:] != ids[:-1])).tolist()
    return {int(ids[begin]): (when[begin:end], places[begin:end]) for begin, end in pairwise([*begins, len(ids)])}


def _movable(own: tuple[str, ...], means: Floats, source: Frame, target: Frame) -> tuple[tuple[str, ...], Floats]:
    """States in another frame; without their derivatives where these cannot be moved."""
    try:
        return own, transform(means, np.zeros((*means.shape, len(own))), own, source, target)[0]
    except FrameError:
        at = [index for index, name in enumerate(own) if name in "xyz"]
        short = tuple(own[index] for index in at)
        still = np.zeros((len(means), len(at), len(at)))
        return short, transform(means[:, at], still, short, source, target)[0]


def truth_positions(known: Times, path: Floats, times: Times, gap: float) -> Floats:
    """Positions (K, d) of one object at `times`, linear between `known` (L,), `path` (L, d).

    NaN before the first and after the last, and inside a gap longer than `gap` seconds and than `TRUTH_GAPS`
    median intervals.
    """
    limit = 1e9 * max(gap, TRUTH_GAPS * _median_step(known))
    before = np.searchsorted(known, times, side="right") - 1
    after = np.minimum(before + (known[before] != times), len(known) - 1)
    width = known[after] - known[before]
    there = (before >= 0) & (known[after] >= times) & (width <= limit)
    share = ((times - known[before]) / np.where(width > 0, width, 1))[there, None]
    out = np.full((len(times), path.shape[1]), np.nan)
    out[there] = (1 - share) * path[before[there]] + share * path[after[there]]
    return out


class Block(NamedTuple):
    """The tracks shown at K times, R in all, time after time: rows ends[k]:ends[k + 1] at the time k.

    number (R,): of the track, small integers that stand for (epoch, id) as long as its `ShownTracks` live. states
    (R, m) in its components, NaN where the track's space lacks one; covariances (R, d, d) of the position.
    """

    ends: Indices
    number: Indices
    states: Floats
    covariances: Floats


class _Part(NamedTuple):
    """The sound tracks of one message: numbers (M,), and states (M, n), covariances (M, n, n) in the frame."""

    message: TrackMessage
    space: tuple[str, ...]
    number: Indices
    means: Floats
    covariances: Floats

    def select(self, kept: NDArray[np.bool_]) -> _Part:
        return self._replace(number=self.number[kept], means=self.means[kept], covariances=self.covariances[kept])


class Numbers:
    """A small integer for each (epoch, id)."""

    def __init__(self) -> None:
        self.keys: list[tuple[int, int]] = []
        self._known: dict[int, tuple[U64, Indices]] = {}
        self._last: tuple[int, U64, Indices] | None = None

    def give(self, epoch: int, ids: U64) -> Indices:
        """The numbers (M,) of `ids` (M,), new ones for new ids."""
        if self._last is not None and self._last[0] == epoch and np.array_equal(self._last[1], ids):
            return self._last[2]
        found = self.find(epoch, ids)
        if (found < 0).any():
            new = np.unique(ids[found < 0])
            begin = len(self.keys)
            self.keys += [(epoch, id_) for id_ in new.tolist()]
            known, numbers = self._known.get(epoch, (new[:0], found[:0]))
            known, numbers = np.append(known, new), np.append(numbers, np.arange(begin, len(self.keys)))
            by = np.argsort(known)
            self._known[epoch] = known[by], numbers[by]
            found = self.find(epoch, ids)
        self._last = epoch, ids, found
        return found

    def find(self, epoch: int, ids: U64) -> Indices:
        """The numbers (M,) of `ids` (M,), -1 for one that is not known."""
        known, numbers = self._known.get(epoch, (ids[:0], np.zeros(0, dtype=np.intp)))
        if not len(known):
            return np.full(len(ids), -1)
        at = np.minimum(np.searchsorted(known, ids), len(known) - 1)
        return np.where(known[at] == ids, numbers[at], -1)


class ShownTracks:
    """What one source, or one centre, shows as time goes on.

    A source shows of its newest epoch the newest version of each track, unless a later complete scan left it out or it
    is older than `limit` seconds; a centre the confirmed and coasting tracks of its newest picture, no older than
    `limit`; where that is a delta, those of the ones before it, too. Both predicted with `motion`. Tracks that fail
    `schemas.check_numbers` are not shown.

    axes: the position's components, more: further components of the states. Messages are taken in the order of
    `order`; times, too, only ever grow.
    """

    def __init__(
        self, limit: float, motion: Motion, frame: Frame, axes: tuple[str, ...], more: tuple[str, ...] = ()
    ) -> None:
        self.numbers = Numbers()
        self.picture: GlobalTracks | None = None
        self._limit, self._motion = limit * 1e9, motion
        self._frame, self._axes, self._more = frame, axes, more
        self._coming: deque[_Part] = deque()
        self._parts: list[_Part] = []
        self._epoch = 0

    def add(self, messages: Sequence[TrackMessage]) -> None:
        """Messages to be shown from their time on. Raises `FrameError` where a frame has no relation to the frame."""
        parts: list[_Part | None] = [None] * len(messages)
        sound = [codes == 0 for codes in check_numbers(messages)]
        for space, indices, means, covariances in in_frame(messages, self._frame):
            finite, begin = np.isfinite(means[:, [space.index(name) for name in self._axes]].sum(axis=1)), 0
            for index in indices:
                message = messages[index]
                rows = slice(begin, begin := begin + len(message.ids))
                number = self.numbers.give(message.epoch if isinstance(message, LocalTracks) else 0, message.ids)
                part = _Part(message, space, number, means[rows], covariances[rows])
                good = sound[index] & finite[rows]
                if isinstance(message, GlobalTracks):
                    good = good & (message.status != TENTATIVE)
                parts[index] = part if good.all() else part.select(good)
        self._coming.extend(part for part in parts if part is not None)

    def show(self, times: Times) -> tuple[Block, list[GlobalTracks | None]]:
        """What is shown at each of `times` (K,), and of a centre the picture it is from."""
        entries: list[tuple[int, _Part]] = []
        pictures: list[GlobalTracks | None] = []
        for k, time in enumerate(times.tolist()):
            self._advance(time)
            entries += [(k, part) for part in self._parts if len(part.number)]
            pictures.append(self.picture)
        return self._block(entries, times), pictures

    def _advance(self, time: int) -> None:
        while self._coming and self._coming[0].message.time <= time:
            part = self._coming.popleft()
            message = part.message
            if isinstance(message, GlobalTracks):
                self._show(part, message)
            elif message.epoch >= self._epoch:
                if message.epoch > self._epoch or message.complete:
                    self._parts, self._epoch = [], message.epoch
                elif self._parts and len(part.number):
                    left = [old.select(~np.isin(old.number, part.number)) for old in self._parts]
                    self._parts = [old for old in left if len(old.number)]
                self._parts.append(part)
        self._parts = [part for part in self._parts if time - part.message.time <= self._limit]
        if not self._parts:
            self.picture = None

    def _show(self, part: _Part, message: GlobalTracks) -> None:
        """A picture: all there is, or what has changed in what is shown."""
        picture = merged(self.picture, message)
        if picture is None:
            return
        if message.delta:
            gone = np.array([track for track, _, _ in message.ended], dtype=np.uint64)
            there = self.numbers.find(0, np.concatenate([message.ids, gone]))
            left = [old.select(~np.isin(old.number, there)) for old in self._parts]
            part_of = [old for old in left if len(old.number)]
        else:
            part_of = []
        self._parts, self.picture = [*part_of, part], picture

    def _block(self, entries: list[tuple[int, _Part]], times: Times) -> Block:
        d, names = len(self._axes), (*self._axes, *self._more)
        sizes = np.array([len(part.number) for _, part in entries], dtype=np.intp)
        at = np.array([k for k, _ in entries], dtype=np.intp)
        ends = np.concatenate([[0], np.cumsum(np.bincount(at, weights=sizes, minlength=len(times)))]).astype(np.intp)
        states = np.full((ends[-1], len(names)), np.nan)
        spreads = np.empty((ends[-1], d, d))
        begins = np.cumsum(sizes) - sizes
        for space in dict.fromkeys(part.space for _, part in entries):
            chosen = [index for index, (_, part) in enumerate(entries) if part.space == space]
            parts = [entries[index][1] for index in chosen]
            age = np.array([int(times[entries[index][0]]) - entries[index][1].message.time for index in chosen]) / 1e9
            means = np.concatenate([part.means for part in parts])
            covariances = np.concatenate([part.covariances for part in parts])
            dt = np.repeat(age, sizes[chosen])
            x, P = predict(self._motion, space, means.T, np.moveaxis(covariances, 0, -1), dt, self._frame)
            rows = np.repeat(begins[chosen] - (np.cumsum(sizes[chosen]) - sizes[chosen]), sizes[chosen])
            rows += np.arange(len(rows))
            for column, name in enumerate(names):
                if name in space:
                    states[rows, column] = x[space.index(name)]
            places = [space.index(name) for name in self._axes]
            spreads[rows] = np.moveaxis(P[np.ix_(places, places)], -1, 0)
        number = np.concatenate([part.number for _, part in entries] or [np.zeros(0, dtype=np.intp)])
        return Block(ends, number, states, spreads)


def in_frame(
    messages: Sequence[TrackMessage], frame: Frame
) -> Iterator[tuple[tuple[str, ...], list[int], Floats, Floats]]:
    """All tracks in `frame`, mixtures as their mean and covariance, for each state space that occurs:
    the space, the indices of its messages, and their tracks one after another, means (R, n), covariances (R, n, n).

    Raises `FrameError` where a message's frame has no relation to `frame`.
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for index, message in enumerate(messages):
        key = (message.space, message.frame, getattr(message, "height", None))
        alike.setdefault(key, []).append(index)
    for indices in alike.values():
        one = messages[indices[0]]
        parts = [moments(m.means, m.covariances, m.weights, m.counts) for m in (messages[index] for index in indices)]
        means, covariances = (np.concatenate(column) for column in zip(*parts, strict=True))
        height = one.height if isinstance(one, LocalTracks) else None
        if not len(means):  # what says nothing needs no frame
            yield one.space, indices, means, covariances
            continue
        yield one.space, indices, *transform(means, covariances, one.space, one.frame, frame, height)


def _median_step(times: Times) -> float:
    return float(np.median(np.diff(times))) / 1e9 if len(times) > 1 else 0.0
