"""From a mission's messages to a score: how well each source and the fused tracks followed the truth.

* All is scored by position, (x, y), and z if the scoring space has it, in the frame of the centre's tracks, at the
  steps of the centre or at every multiple of `every` seconds (UTC), from the first truth to the last.
* Truth is interpolated linearly. An object exists from its first message to its last, but not inside a gap longer
  than `gap` seconds and than three of its median intervals.
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

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service.arrays import Floats
from fusion_service.coverage import covers
from fusion_service.metrics import DENSE
from fusion_service.review.evaluation.consistency import Consistency, SourceAgreement
from fusion_service.review.evaluation.fusion_gain import fusion_gain
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.reference import (
    NothingToScoreError,
    Reference,
    ScoredTruth,
    all_times,
    reference_for,
    scored_truth,
)
from fusion_service.review.evaluation.scoring import Scores, Tally, plain
from fusion_service.review.snapshots import Block, ShownTracks, Times, TrackMessage
from schemas import Frame, GlobalTracks, LocalTracks, Message, Motion, Truth

__all__ = ["Assessment", "Evaluation", "NothingToScoreError", "assess", "evaluate"]


BLOCK = 32
"""Times scored at once."""
SPREADS = 10.0
"""Without a given cut-off: so many standard deviations of the fused position, rounded up to 1, 2 or 5 times 10^n."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """The scores of each source and of the centre.

    times (K,) ns; targets: T truth ids; exists (K, T); seen (K, T): how many sources had a track assigned to the
    target; left_out: source -> why it could not be scored. begins, confirm (T,): when each target could first be
    known, an index into times, -1 for never, and the seconds from there to its first fused track, NaN without one.

    shared: "seen_by_2", ..., "seen_by_2_or_more" -> over the pairs (target, time) on which so many sources had an
    assigned track: pairs, fused_missed (those without a fused track, which are in none of the other numbers), RMSE
    and ANEES, fused and best single source on the same pairs. The best single source is the one with the smallest
    RMSE, found with the truth for each target and set of sources that saw it: an advantage no operator has.
    """

    c: float
    dimension: int
    times: NDArray[np.int64]
    targets: tuple[int, ...]
    exists: NDArray[np.bool_]
    centre: str | None
    sources: dict[str, Scores]
    fused: Scores
    seen: NDArray[np.int64]
    shared: dict[str, dict[str, Any]]
    left_out: dict[str, str]
    begins: NDArray[np.int64]
    confirm: Floats

    def as_json(self, scenario: str, rule: str, recording: str) -> dict[str, Any]:
        """The summary as plain values, ready for `json.dumps`."""
        return {
            "scenario": scenario,
            "rule": rule,
            "recording": recording,
            "sources": {name: scores.as_json() for name, scores in self.sources.items()},
            "fused": self.fused.as_json(),
            "shared": {name: {key: plain(value) for key, value in row.items()} for name, row in self.shared.items()},
            "nees_bounds": {
                "sources": {name: plain(scores.bounds) for name, scores in self.sources.items()},
                "fused": plain(self.fused.bounds),
            },
            "scored": {
                "c": self.c,
                "p": 2,
                "alpha": 2,
                "dimension": self.dimension,
                "times": len(self.times),
                "targets": len(self.targets),
                "left_out": self.left_out,
            },
        }

    def more_json(self) -> dict[str, Any]:
        """All other numbers, and the series over time."""
        confirm = [plain(one) for one in self.confirm.tolist()]
        return {
            "centre": self.centre,
            "times_ns": self.times.tolist(),
            "true": self.exists.sum(axis=1).tolist(),
            "time_to_confirm": dict(zip(map(str, self.targets), confirm, strict=True)),
            "sources": {name: scores.more_json() for name, scores in self.sources.items()},
            "fused": self.fused.more_json(),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Assessment:
    """A mission as it is told: its logbook; evaluations by centre, none without truth (why: `unscored`); agreements
    of sources by centre; the cut-off, m, and whether it was chosen here; a thinned mission, for a map."""

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
) -> Assessment:
    """Everything that can be said of a mission. centres: which ones, all by default, each scored at the times of the
    pictures of all. truths: in place of the mission's own. progress: called with the share that is done. rows: about
    how many tracks of each source `sample` is to hold. Without a centre: in the frame of the first source, each
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
    found, agreements, sample = _walk(book, reference, scored, times, progress, rows)
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
) -> tuple[dict[str, Evaluation], dict[str, SourceAgreement], list[Message]]:
    """Once through the tracks, block by block of `times`: evaluations and agreements by centre, a thinned mission."""
    shown_tracks = {
        key: ShownTracks(
            reference.limits[key], reference.motions[key], reference.frame, reference.axes, reference.speeds
        )
        for key in reference.motions
    }
    agreements = {name: Consistency(reference.sources, len(reference.axes)) for name in reference.centres}
    score = _Score(book, reference, scored) if scored else None
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


class _Score:
    """The scores of all, gathered block by block."""

    def __init__(self, book: Logbook, reference: Reference, truth: ScoredTruth) -> None:
        self._reference, self._truth, self._infos = reference, truth, book.infos
        self._exists = np.isfinite(truth.states[:, :, 0])
        count, targets = self._exists.shape
        what = truth.times, truth.states, len(reference.axes), reference.c, truth.hulls
        self._tallies = {key: Tally(*what) for key in reference.motions}
        self._alone = None if reference.centres else Tally(*what)
        self._seen = np.zeros((count, targets), dtype=np.int16)
        self._begins = np.full(targets, -1)
        self._confirmed = {name: np.full(targets, -1) for name in reference.centres}

    def add(
        self,
        begin: int,
        blocks: dict[tuple[str, str], Block],
        pictures: dict[tuple[str, str], list[GlobalTracks | None]],
    ) -> None:
        d = len(self._reference.axes)
        count = min(BLOCK, len(self._truth.times) - begin)
        for row in range(count):
            k = begin + row
            there = np.flatnonzero(self._exists[k])
            places = self._truth.states[k, there, :d]
            tree = cKDTree(places) if len(there) ** 2 > DENSE else None
            for key, tally in self._tallies.items():
                tally.add(k, there, tree, blocks[key], row)
                if key[0] == "local":
                    self._seen[k] += tally.assigned(k)
            if self._alone:
                self._alone.add(k, there, tree, _nothing(d + len(self._reference.speeds), d), 0)
            self._note_first(k, there, places)
            for key, shown in pictures.items():
                picture = shown[row]
                if picture is not None:
                    self._tallies[key].expect(k, float(picture.existence.sum()))

    def _note_first(self, k: int, there: NDArray[np.intp], places: Floats) -> None:
        known = self._seen[k] > 0
        unknown = there[(self._begins[there] < 0) & ~known[there]]
        if len(unknown):
            where = self._truth.states[k, unknown, : places.shape[1]].T
            for info in self._infos.values():
                known[unknown] |= covers(info, where, self._reference.frame)
        self._begins[(self._begins < 0) & known] = k
        for name, confirmed in self._confirmed.items():
            confirmed[(confirmed < 0) & self._tallies["global", name].assigned(k)] = k

    def evaluations(self) -> dict[str, Evaluation]:
        """By centre; without one, by an empty name."""
        scores = {key: tally.scores() for key, tally in self._tallies.items()}
        sources = {name: scores["local", name] for name in self._reference.sources}
        seen, times = self._seen.astype(np.int64), self._truth.times
        found: dict[str, Evaluation] = {}
        for name in self._reference.centres or [""]:
            confirmed = self._confirmed.get(name, np.full(len(self._begins), -1))
            after = np.maximum(times[confirmed] - times[self._begins], 0) / 1e9
            fused = scores["global", name] if name else self._alone.scores() if self._alone else None
            assert fused is not None
            found[name] = Evaluation(
                c=self._reference.c,
                dimension=len(self._reference.axes),
                times=times,
                targets=self._truth.targets,
                exists=self._exists,
                centre=name or None,
                sources=sources,
                fused=fused,
                seen=seen,
                shared=fusion_gain(list(sources.values()), fused, seen, len(self._reference.axes)),
                left_out=self._reference.left_out,
                begins=self._begins,
                confirm=np.where((confirmed >= 0) & (self._begins >= 0), after, np.nan),
            )
        return found


def _nothing(m: int, d: int) -> Block:
    return Block(np.zeros(2, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((0, m)), np.zeros((0, d, d)))


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
