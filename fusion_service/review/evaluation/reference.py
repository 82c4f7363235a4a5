"""On what all of a mission are scored: frame, times, true positions, and how long each source's tracks are shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.errors import ReviewError
from fusion_service.review.evaluation.hulls import TrueHulls, true_hulls
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.times_apart import apart_in_time
from fusion_service.review.snapshots import STALE_PERIODS, STALE_STEPS, Times, truth_path, truth_positions
from schemas import Frame, Motion, Truth

__all__ = ["NothingToScoreError", "Reference", "ScoredTruth", "all_times", "reference_for", "scored_truth"]


MOST_TIMES = 5_000_000


class NothingToScoreError(ReviewError):
    """There is nothing to score, or not what was asked for."""


class Reference(NamedTuple):
    """What all are scored on. sources: those that can be; motions, limits (s): of each of them and of each centre."""

    frame: Frame
    axes: tuple[str, ...]
    speeds: tuple[str, ...]
    sources: list[str]
    centres: list[str]
    left_out: dict[str, str]
    motions: dict[tuple[str, str], Motion]
    limits: dict[tuple[str, str], float]
    c: float


class ScoredTruth(NamedTuple):
    """times (K,), ids of T targets, their states (K, T, m), and their hulls, None where truth tells none."""

    times: Times
    targets: tuple[int, ...]
    states: Floats
    hulls: TrueHulls | None = None


def reference_for(
    book: Logbook,
    centres: Sequence[str],
    frame: Frame | None,
    space: tuple[str, ...] | None,
    motion: Motion | None,
    c: float,
) -> Reference:
    """The reference of a mission; frame and space: by default those of the first picture of the first of `centres`,
    but on the plane where one of these has a track of unknown height.

    motion: of sources without an info. c: the cut-off, m. Raises `NothingToScoreError` for a centre without tracks, and
    where nothing says a frame and a space.
    """
    for name in centres:
        if name not in book.centres:
            there = ", ".join(book.centres) or "none"
            raise NothingToScoreError(f"no tracks of a centre {name!r} (there are: {there})")
    if centres:
        first = book.first_pictures[centres[0]]
        whole = tuple(name for name in first.space if name != "z" or not book.flat & set(centres))
        frame, space = frame or first.frame, space or whole
    if frame is None or space is None:
        raise NothingToScoreError("no global tracks: without a centre, frame, space and every must be given")
    axes = tuple(name for name in "xyz" if name in space)
    left_out = {name: reason for name in book.sources if (reason := book.unreachable(name, frame, axes))}
    sources = [name for name in book.sources if name not in left_out]
    motions: dict[tuple[str, str], Motion] = {}
    limits: dict[tuple[str, str], float] = {}
    for name in sources:
        info = book.infos.get(name)
        period = info.period if info else book.traffic["local", name].interval
        motions["local", name] = info.motion if info else motion or Motion("cv", 1.0)
        limits["local", name] = STALE_PERIODS * period
    drift = Motion("cv", max((_jolt(book.infos[name].motion) for name in sources if name in book.infos), default=1.0))
    for name in centres:
        motions["global", name] = drift
        limits["global", name] = STALE_STEPS * book.traffic["global", name].interval
    speeds = tuple(f"v{name}" for name in axes)
    return Reference(frame, axes, speeds, sources, list(centres), left_out, motions, limits, c)


def _jolt(motion: Motion) -> float:
    """Intensity of the white acceleration noise, m2/s3, that covers a motion between two steps; of ca and still 0."""
    if motion.kind == "singer":
        return 2 * motion.sigma**2 * motion.tau
    if motion.kind == "ou":
        return 2 * motion.sigma**2 / motion.tau
    return motion.q if motion.kind in ("cv", "ct") else 0.0


def scored_truth(
    truths: Sequence[Truth], reference: Reference, pictures: Times | None, every: float | None, gap: float
) -> ScoredTruth:
    """The states of all targets at the scored times: `pictures` (K,) ns, or every so many seconds; gap: s.

    Raises `NothingToScoreError`, and `ValueError` as of `truth_path`, where there is none.
    """
    if every is None and pictures is None:
        raise NothingToScoreError("no global tracks: without a centre, frame, space and every must be given")
    paths = truth_path(truths, reference.frame, reference.axes, reference.speeds)
    if not truths:
        raise NothingToScoreError("no truth to score against")
    ends = [known for known, _ in paths.values()] or [np.sort(np.array([truth.time for truth in truths]))]
    first, last = min(int(known[0]) for known in ends), max(int(known[-1]) for known in ends)
    if every is None:
        assert pictures is not None
        times = pictures[(pictures >= first) & (pictures <= last)]
    else:
        times = _multiples(first, last, every)
    if not len(times):
        seen = pictures if pictures is not None and len(pictures) else None
        if seen is not None and not (first <= int(seen[-1]) and int(seen[0]) <= last):
            when = apart_in_time((first, last), (int(seen[0]), int(seen[-1])))
            raise NothingToScoreError(f"no time to score, no picture of the centre while there is truth: {when}")
        raise NothingToScoreError(
            "no time to score: no picture of the centre, or no multiple of every, while there is truth"
        )
    times = times[_told(truths, times, gap)]
    nobody = [np.zeros((len(times), 0, len(reference.axes) + len(reference.speeds)))]
    found = [truth_positions(*path, times, gap)[:, None] for path in paths.values()]
    states = np.concatenate(nobody + found, axis=1)
    states[~np.isfinite(states[:, :, : len(reference.axes)]).all(axis=2)] = np.nan
    return ScoredTruth(times, tuple(paths), states, true_hulls(truths, reference.frame, times, tuple(paths)))


def _told(truths: Sequence[Truth], times: Times, gap: float) -> NDArray[np.bool_]:
    """At which times (K,) truth speaks at all: not inside a gap, by the rule for one object, of all its messages, those
    of no object among them: who was where then nobody knows. All of them, where it never does."""
    heard = np.unique(np.array([truth.time for truth in truths], dtype=np.int64))
    speaks = np.isfinite(truth_positions(heard, np.zeros((len(heard), 1)), times, gap)[:, 0])
    return speaks if speaks.any() else np.ones(len(times), dtype=np.bool_)


def all_times(book: Logbook, pictures: Times | None, every: float | None) -> Times:
    """The times (K,), ns, at which a mission without truth is looked at."""
    if every is None:
        return pictures if pictures is not None else np.zeros(0, dtype=np.int64)
    return _multiples(*book.span, every) if book.span else np.zeros(0, dtype=np.int64)


def _multiples(first: int, last: int, every: float) -> Times:
    step = max(round(every * 1e9), 1)
    if (count := (last - first) // step) > MOST_TIMES:
        raise NothingToScoreError(
            f"{count} times every {every:g} s: a clock is wrong, or every (--every) is too short, for a mission of "
            f"{(last - first) / 1e9:.4g} s"
        )
    return np.arange(-(-first // step), last // step + 1, dtype=np.int64) * step
