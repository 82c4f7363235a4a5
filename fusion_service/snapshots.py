"""What was there and what was shown at given times: truth, a source's tracks, a centre's tracks, as positions.

Times are arrays (K,) of int ns, ascending; positions are in one given frame along d axes, (x, y) or (x, y, z).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.densities import moments
from fusion_service.geodesy import FrameError, transform
from fusion_service.motion import predict
from schemas import Frame, GlobalTracks, LocalTracks, Motion, Truth, check_numbers
from schemas.messages import TENTATIVE

__all__ = [
    "STALE_PERIODS",
    "STALE_STEPS",
    "Snapshot",
    "centre_snapshots",
    "in_frame",
    "interval",
    "order",
    "source_snapshots",
    "truth_path",
    "truth_positions",
]

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Tracks = LocalTracks | GlobalTracks
Shown = list[list[tuple[int, int]]]
"""For each time the tracks shown, as (index of the message, row in it)."""

STALE_PERIODS = 3.0
STALE_STEPS = 2.0
TRUTH_GAPS = 3.0


class Snapshot(NamedTuple):
    """The M tracks shown at one time: keys (epoch, id), epoch 0 for a centre's; positions (M, d);
    covariances (M, d, d)."""

    keys: list[tuple[int, int]]
    positions: Floats
    covariances: Floats


def order(message: Tracks | Truth) -> tuple[int, int, int]:
    """Sorting key: time, epoch, sequence."""
    return message.time, message.epoch, message.seq


def interval(messages: Sequence[Tracks | Truth]) -> float:
    """Median interval between the times of messages, s; 0 for a single one."""
    return _median_step(np.unique([message.time for message in messages]))


def truth_path(truths: Sequence[Truth], frame: Frame, axes: tuple[str, ...]) -> dict[int, tuple[Times, Floats]]:
    """Object id -> its times (L,), ascending, and positions (L, d) in `frame`; the later message of equal times.

    Raises ValueError where truth lacks an axis, `FrameError` where its frame has no relation to `frame`.
    """
    truths = sorted((truth for truth in truths if len(truth.ids)), key=order)
    moved: list[Floats] = []
    for truth in truths:
        own = tuple(name for name in "xyz" if name in truth.space)
        if not set(axes) <= set(own):
            raise ValueError(f"truth has no z, but is asked for {' '.join(axes)}")
        means = truth.means[:, [truth.space.index(name) for name in own]]
        moved.append(transform(means, np.zeros((*means.shape, len(own))), own, truth.frame, frame)[0][:, : len(axes)])
    if not truths:
        return {}
    ids, places = np.concatenate([truth.ids for truth in truths]), np.concatenate(moved)
    when = np.repeat(np.array([truth.time for truth in truths]), [len(truth.ids) for truth in truths])
    paths: dict[int, tuple[Times, Floats]] = {}
    for target in np.unique(ids):
        rows = np.flatnonzero(ids == target)[::-1]
        known, last = np.unique(when[rows], return_index=True)
        paths[int(target)] = known, places[rows[last]]
    return paths


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


def source_snapshots(
    scans: list[LocalTracks], times: Times, period: float, motion: Motion, frame: Frame, axes: tuple[str, ...]
) -> list[Snapshot]:
    """What one source shows at each time: of its newest epoch the newest version of each track, unless a later
    complete scan left it out or it is older than `STALE_PERIODS` periods; predicted with `motion`.

    Tracks that fail `schemas.check_numbers` are not shown. Raises `FrameError` where they cannot be brought into
    `frame`, or lack an axis.
    """
    scans = sorted(scans, key=order)
    sound = [codes == 0 for codes in check_numbers(scans)]
    shown: Shown = []
    newest: dict[int, tuple[int, int]] = {}
    epoch, following = 0, 0
    for time in times.tolist():
        while following < len(scans) and scans[following].time <= time:
            scan = scans[following]
            if scan.epoch >= epoch:
                if scan.epoch > epoch or scan.complete:
                    newest, epoch = {}, scan.epoch
                rows = enumerate(scan.ids.tolist())
                newest |= {id_: (following, row) for row, id_ in rows if sound[following][row]}
            following += 1
        shown.append([one for one in newest.values() if time - scans[one[0]].time <= STALE_PERIODS * period * 1e9])
    return _snapshots(scans, shown, times, motion, frame, axes)


def centre_snapshots(
    pictures: list[GlobalTracks], times: Times, motion: Motion, frame: Frame, axes: tuple[str, ...]
) -> list[Snapshot]:
    """What a centre shows at each time: the confirmed and coasting tracks of its newest picture, no older than
    `STALE_STEPS` median steps; predicted with `motion`."""
    pictures = sorted(pictures, key=order)
    faults = check_numbers(pictures)
    visible = [
        np.flatnonzero((codes == 0) & (picture.status != TENTATIVE)).tolist()
        for codes, picture in zip(faults, pictures, strict=True)
    ]
    limit = STALE_STEPS * interval(pictures) * 1e9
    at = np.searchsorted(np.array([picture.time for picture in pictures]), times, side="right") - 1
    shown: Shown = [
        [(k, row) for row in visible[k]] if k >= 0 and time - pictures[k].time <= limit else []
        for k, time in zip(at.tolist(), times.tolist(), strict=True)
    ]
    return _snapshots(pictures, shown, times, motion, frame, axes)


def in_frame(messages: Sequence[Tracks], frame: Frame) -> Iterator[tuple[tuple[str, ...], list[int], Floats, Floats]]:
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
        yield one.space, indices, *transform(means, covariances, one.space, one.frame, frame, height)


def _snapshots(
    messages: Sequence[Tracks], shown: Shown, times: Times, motion: Motion, frame: Frame, axes: tuple[str, ...]
) -> list[Snapshot]:
    d = len(axes)
    found: list[Snapshot] = [Snapshot([], np.empty((0, d)), np.empty((0, d, d)))] * len(times)
    for space, indices, means, covariances in in_frame(messages, frame):
        if not set(axes) <= set(space):
            raise FrameError(f"its tracks have no z (their space: {' '.join(space)})")
        sizes = [len(messages[index].ids) for index in indices]
        first = dict(zip(indices, (np.cumsum(sizes) - sizes).tolist(), strict=True))
        chosen = [(k, index, row) for k, tracks in enumerate(shown) for index, row in tracks if index in first]
        if not chosen:
            continue
        rows = np.array([first[index] + row for _, index, row in chosen])
        dt = np.array([int(times[k]) - messages[index].time for k, index, _ in chosen]) / 1e9
        x, P = predict(motion, space, means[rows].T, np.moveaxis(covariances[rows], 0, -1), dt)
        at = [space.index(name) for name in axes]
        places, spreads = x[at].T, np.moveaxis(P[np.ix_(at, at)], -1, 0)
        keys = [_key(messages[index], row) for _, index, row in chosen]
        here = np.isfinite(places.sum(axis=1))
        ends = np.searchsorted([k for k, _, _ in chosen], np.arange(len(times) + 1))
        for k, old in enumerate(found):
            mine = np.arange(ends[k], ends[k + 1])
            mine = mine[here[mine]]
            if len(mine):
                found[k] = Snapshot(
                    old.keys + [keys[i] for i in mine],
                    np.concatenate([old.positions, places[mine]]),
                    np.concatenate([old.covariances, spreads[mine]]),
                )
    return found


def _key(message: Tracks, row: int) -> tuple[int, int]:
    return message.epoch if isinstance(message, LocalTracks) else 0, int(message.ids[row])


def _median_step(times: Times) -> float:
    return float(np.median(np.diff(times))) / 1e9 if len(times) > 1 else 0.0
