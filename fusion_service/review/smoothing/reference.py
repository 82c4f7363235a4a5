"""The reference: one trajectory for each object, at the times of a centre's pictures, as truth messages.

What it cannot see: an error that all sources share (of a clock, a survey, the propagation), an object that no source
tracked or the centre never confirmed, a false track that it did confirm, and two objects that were linked as one or one
as two: for objects and links it takes the centre's word. Whatever takes part in it is judged too well by it: a source
by its own data, the fused tracks by all. `left_out` leaves a source's data out, so that it is judged by the
others alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion_service.arrays import Ints
from fusion_service.errors import ReviewError
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.reference import Reference, reference_for
from fusion_service.review.smoothing.gained import Gain, Gained
from fusion_service.review.smoothing.linked import Links
from fusion_service.review.smoothing.smoother import smooth
from fusion_service.review.snapshots import Times
from schemas import GlobalTracks, Truth

__all__ = ["smoothed_truth"]

TOGETHER = 32
"""Objects smoothed at once: what is held grows with it."""
SILENT = 5.0
"""Seconds without any measurement, and `PERIODS` median intervals, after which an object is not told."""
PERIODS = 3.0


def smoothed_truth(book: Logbook, centre: str | None = None, left_out: str | None = None) -> list[Truth]:
    """Of a mission, by the links of one centre, the first by default. left_out: a source whose data do not count.

    Raises `ReviewError` where there is no centre, no such source, or no object left.
    """
    if not book.centres:
        raise ReviewError("no centre in this recording: a smoothed reference takes its links")
    name = centre or book.centres[0]
    if left_out is not None and left_out not in book.sources:
        there = ", ".join(book.sources) or "none"
        raise ReviewError(f"no source {left_out!r} in this recording; there are: {there}")
    reference = reference_for(book, [name], None, None, None, 1.0)
    space = tuple(part for axis in reference.axes for part in (axis, f"v{axis}"))
    links, gains = _gathered(book, reference, name, space, left_out)
    by_object: dict[int, list[Gain]] = {one: [] for one in links.objects()}
    for gain in gains:
        found = by_object.get(links.object_of(gain.key, gain.time))
        if found is not None:
            found.append(gain)
    told = {one: some for one, some in by_object.items() if len(some) > 1}
    if not told:
        what = f" without {left_out}" if left_out else ""
        raise ReviewError(f"no object of {name} was told of often enough{what} to be smoothed")
    rows: dict[int, list[tuple[int, np.ndarray[tuple[int], np.dtype[np.float64]]]]] = {}
    names = list(told)
    for begin in range(0, len(names), TOGETHER):
        some = {one: told[one] for one in names[begin : begin + TOGETHER]}
        for time, one, state in _trajectories(some, links.picture_times(), reference, name, space):
            rows.setdefault(time, []).append((one, state))
    return [
        Truth(
            source="smoothed",
            epoch=1,
            seq=seq,
            sent=time,
            time=time,
            space=space,
            frame=reference.frame,
            ids=np.array([one for one, _ in rows[time]], dtype=np.uint64),
            means=np.stack([state for _, state in rows[time]]),
        )
        for seq, time in enumerate(sorted(rows))
    ]


def _gathered(
    book: Logbook, reference: Reference, centre: str, space: tuple[str, ...], left_out: str | None
) -> tuple[Links, list[Gain]]:
    links, gains = Links(), []
    sources = {
        name: Gained(name, reference.motions["local", name], reference.frame, space)
        for name in reference.sources
        if name != left_out
    }
    for message in book.tracks(lambda kind, name: name in sources if kind == "local" else name == centre):
        if isinstance(message, GlobalTracks):
            links.add(message)
        else:
            gains += sources[message.source].add(message)
    return links, gains


def _trajectories(
    told: dict[int, list[Gain]], pictures: Times, reference: Reference, centre: str, space: tuple[str, ...]
) -> Iterator[tuple[int, int, np.ndarray[tuple[int], np.dtype[np.float64]]]]:
    """(time, object, state (n,)) at the times of the pictures."""
    first = min(gain.time for some in told.values() for gain in some)
    last = max(gain.time for some in told.values() for gain in some)
    wanted = pictures[(pictures >= first) & (pictures <= last)]
    heard = np.array([gain.time for some in told.values() for gain in some], dtype=np.int64)
    times = np.unique(np.concatenate([wanted, heard]))
    n, count = len(space), len(times)
    y, L = np.zeros((count, len(told), n)), np.zeros((count, len(told), n, n))
    begin = np.zeros(len(told), dtype=np.intp)
    for column, some in enumerate(told.values()):
        begin[column] = np.searchsorted(times, min(gain.time for gain in some))
        for gain in some:
            k = int(np.searchsorted(times, gain.time))
            at = np.array([space.index(name) for name in gain.space], dtype=np.intp)
            y[k, column, at] += gain.y
            L[k, column][np.ix_(at, at)] += gain.L
    means, _ = smooth(times, y, L, begin, reference.motions["global", centre], space)
    rows = np.searchsorted(times, wanted)
    for column, (one, some) in enumerate(told.items()):
        for k in _covered(wanted, np.unique([gain.time for gain in some])).tolist():
            yield int(wanted[k]), one, means[rows[k], column]


def _covered(times: Times, heard: Times) -> Ints:
    """Indices of the times that lie between two measurements that are not too far apart."""
    after = np.searchsorted(heard, times)
    inside = (times >= heard[0]) & (times <= heard[-1])
    low, high = heard[np.maximum(after - 1, 0)], heard[np.minimum(after, len(heard) - 1)]
    limit = 1e9 * max(SILENT, PERIODS * float(np.median(np.diff(heard))) / 1e9 if len(heard) > 1 else 0.0)
    return np.flatnonzero(inside & ((high - low <= limit) | (times == high) | (times == low)))
