"""From a mission's messages to a score: how well each source and the fused tracks followed the truth.

* All is scored by position, (x, y), and z if the scoring space has it, in the frame of the centre's tracks, at the
  steps of the centre or at every multiple of `every` seconds (UTC), from the first truth to the last.
* Truth is interpolated linearly. An object exists from its first message to its last, but not inside a gap longer
  than `gap` seconds and than three of its median intervals. Times in such a gap of all of truth's messages are not
  scored: who was where then is not known.
* A source shows the newest version of each track of its newest epoch, unless a later complete scan left the track
  out or it is older than three declared periods; predicted to the time with its declared motion. All it publishes
  counts, whatever the existence probability.
* The centre shows the confirmed and the coasting tracks of its newest picture, not the tentative ones, no older
  than two steps. Where it is not of the very time it is predicted, by constant velocity with the largest q that
  its sources declare.
* RMSE, NEES and identity switches are over the pairs that GOSPA (p = 2, alpha = 2) assigns: errors below c. The
  bounds of the ANEES suppose independent errors; those along one track are not, so the true bounds are wider.
* Time to confirm: from when a target exists where a source says it covers (by its newest info), or has a local track,
  to the first fused track assigned to it, between scored times.
* Where there is no truth, what needs none is told (`consistency`, `logbook`), at the times of the centres' pictures.

Messages are read in blocks of times: what is held is what was last said, and the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from fusion_service.review.evaluation.consistency import Consistency, SourceAgreement
from fusion_service.review.evaluation.gathering import BLOCK, Evaluation, Gathering
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.reference import (
    NothingToScoreError,
    Reference,
    ScoredTruth,
    all_times,
    reference_for,
    scored_truth,
)
from fusion_service.review.snapshots import ShownTracks, Times, TrackMessage
from schemas import Frame, LocalTracks, Message, Motion, Truth

__all__ = ["Assessment", "Evaluation", "NothingToScoreError", "assess", "evaluate"]


SPREADS = 10.0
"""Without a given cut-off: so many standard deviations of the fused position, rounded up to 1, 2 or 5 times 10^n."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Assessment:
    """A mission as it is told: its logbook; evaluations by centre, none without truth (why: `unscored`); agreements
    of sources by centre; the cut-off, m, and whether it was chosen here; a thinned mission, for a map."""

    kept: bool = False
    """Whether the cut-off is that which the recording keeps."""
    book: Logbook
    evaluations: dict[str, Evaluation]
    agreements: dict[str, SourceAgreement]
    unscored: str | None
    c: float
    chosen: bool
    sample: list[Message]


def evaluate(
    messages: Iterable[Message],
    *,
    c: float,
    every: float | None,
    frame: Frame | None = None,
    space: tuple[str, ...] | None = None,
    centre: str | None = None,
    gap: float = 5.0,
    motion: Motion | None = None,
) -> Evaluation:
    """Score a mission by the rules at the head of this module; the order of the messages does not matter.

    c: GOSPA's cut-off, m. every: seconds between scored times, None for the times of the centre's pictures.
    frame, space: to score in, by default those of the centre's first picture. centre: which one, if several.
    motion: of sources that never published a SensorInfo (default: cv, q = 1 m2/s3); their period is their median
    interval. A source whose frame has no relation to the scoring one, or that lacks z where it is scored, is left out,
    by name. Raises `NothingToScoreError`, a ValueError, where nothing can be scored.
    """
    if not c > 0 or not (every is None or every > 0):
        raise ValueError(f"c and every must be positive: {c}, {every}")
    book = Logbook(messages)
    if centre is None and len(book.centres) > 1:
        raise NothingToScoreError(f"tracks of several centres ({', '.join(book.centres)}): say which one to score")
    centres = [centre] if centre else book.centres
    reference = reference_for(book, centres, frame, space, motion, c)
    scored = scored_truth(book.truths, reference, book.times(centres) if centres else None, every, gap)
    found, _, _ = _walk(book, reference, scored, scored.times)
    return found[centres[0] if centres else ""]


def assess(
    book: Logbook,
    *,
    c: float | None = None,
    every: float | None = None,
    centres: Sequence[str] = (),
    truths: Sequence[Truth] = (),
    gap: float = 5.0,
    motion: Motion | None = None,
    progress: Callable[[float], None] = lambda _: None,
    rows: int = 0,
    called: Mapping[int, str] | None = None,
) -> Assessment:
    """Everything that can be said of a mission. centres: which ones, all by default, each scored at the times of the
    pictures of all. truths: in place of the mission's own. progress: called with the share that is done. rows: about
    how many tracks of each source `sample` is to hold. called: names of true objects, by
    id. Without a centre: in the frame of the first source, each
    interval of the fastest. Raises `NothingToScoreError` where there are no tracks."""
    chosen = c is None
    names = list(centres) or book.centres
    frame, space = (book.default_space() if not names else None) or (None, None)
    if not names:
        intervals = [book.traffic["local", name].interval for name in book.sources]
        every = every or min((interval for interval in intervals if interval > 0), default=1.0)
    reference = reference_for(book, names, frame, space, motion, c or book.cutoff(SPREADS))
    at = book.times(names) if names else None
    try:
        scored, unscored = scored_truth(truths or book.truths, reference, at, every, gap), None
    except ValueError as error:
        scored, unscored = None, str(error)
    if truths and not scored:
        raise NothingToScoreError(f"the given truth does not go with this mission: {unscored}")
    times = scored.times if scored else all_times(book, at, every)
    found, agreements, sample = _walk(book, reference, scored, times, progress, rows, called or {})
    if rows and scored:
        told = sorted(truths or book.truths, key=lambda truth: truth.time)
        sample += told[:: max(1, sum(len(truth.ids) for truth in told) // rows)]
    return Assessment(
        book=book,
        evaluations=found,
        agreements=agreements,
        unscored=unscored,
        c=reference.c,
        chosen=chosen,
        sample=sample,
    )


def _walk(
    book: Logbook,
    reference: Reference,
    scored: ScoredTruth | None,
    times: Times,
    progress: Callable[[float], None] = lambda _: None,
    rows: int = 0,
    names: Mapping[int, str] = MappingProxyType({}),
) -> tuple[dict[str, Evaluation], dict[str, SourceAgreement], list[Message]]:
    """Once through the tracks, block by block of `times`: evaluations and agreements by centre, a thinned mission."""
    shown_tracks = {
        key: ShownTracks(
            reference.limits[key], reference.motions[key], reference.frame, reference.axes, reference.speeds
        )
        for key in reference.motions
    }
    agreements = {name: Consistency(reference.sources, len(reference.axes)) for name in reference.centres}
    numbers = {key: one.numbers for key, one in shown_tracks.items()}
    score = Gathering(book, reference, scored, numbers, names) if scored else None
    thin = _Thin(book, reference, rows)
    stream = book.tracks(lambda kind, name: (kind, name) in shown_tracks)
    ahead = next(stream, None)
    for begin in range(0, len(times), BLOCK):
        block = times[begin : begin + BLOCK]
        came: dict[tuple[str, str], list[TrackMessage]] = {key: [] for key in shown_tracks}
        while ahead is not None and ahead.time <= block[-1]:
            key = ("local" if isinstance(ahead, LocalTracks) else "global", ahead.source)
            came[key].append(ahead)
            thin.add(key, ahead)
            ahead = next(stream, None)
        for key, messages in came.items():
            shown_tracks[key].add(messages)
        shown = {key: one.show(block) for key, one in shown_tracks.items()}
        if score:
            score.add(
                begin,
                {key: one for key, (one, _) in shown.items()},
                {key: pictures for key, (_, pictures) in shown.items() if key[0] == "global"},
            )
        local = {name: (shown_tracks["local", name].numbers, shown["local", name][0]) for name in reference.sources}
        for name, agreement in agreements.items():
            agreement.add(shown["global", name][1], local)
        progress(min(1.0, (begin + BLOCK) / len(times)))
    told = {name: agreement.result() for name, agreement in agreements.items()}
    return score.evaluations() if score else {}, told, thin.sample


class _Thin:
    """Keeps every so many messages of each source and of the first centre, about `rows` tracks of each."""

    def __init__(self, book: Logbook, reference: Reference, rows: int) -> None:
        self.sample: list[Message] = list(book.infos.values()) if rows else []
        wanted = [("local", name) for name in reference.sources] + [("global", name) for name in reference.centres[:1]]
        self._every = {key: max(1, -(-book.traffic[key].tracks // rows)) for key in wanted} if rows else {}
        self._count = dict.fromkeys(wanted, 0)

    def add(self, key: tuple[str, str], message: TrackMessage) -> None:
        if key in self._every:
            if self._count[key] % self._every[key] == 0:
                self.sample.append(message)
            self._count[key] += 1
