"""The scores of a mission while they are gathered, block by block of times, and what they come to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service.arrays import Floats
from fusion_service.coverage import covers
from fusion_service.metrics import DENSE
from fusion_service.review.evaluation.account import Account
from fusion_service.review.evaluation.fusion_gain import fusion_gain
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.misses import Coverages, Misses, Sighting
from fusion_service.review.evaluation.reference import Reference, ScoredTruth
from fusion_service.review.evaluation.scoring import Scores, Tally, plain
from fusion_service.review.evaluation.targets import TargetRecord, target_records
from fusion_service.review.snapshots import STALE_PERIODS, Block, Numbers
from schemas import Frame, GlobalTracks

__all__ = ["BLOCK", "Evaluation", "Gathering"]

BLOCK = 32
"""Times scored at once."""
NOBODY = Sighting(np.full((0, 0), -1, dtype=np.int32), Numbers(), 1.0)
"""Where there is no centre."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """The scores of each source and of the centre.

    times (K,) ns; targets: T truth ids; exists (K, T); seen (K, T): how many sources had a track assigned to the
    target; left_out: source -> why it could not be scored. begins, confirm (T,): when each target could first be
    known, an index into times, -1 for never, and the seconds from there to its first fused track, NaN without one.
    records: each target by itself, the worst first; sightings: what of each source, and of the centre (fused, None
    without one), was assigned to the targets. places (K, T, d): the true ones, m, in `frame`, NaN where there is none.

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
    records: tuple[TargetRecord, ...]
    sightings: dict[str, Sighting]
    fused_sighting: Sighting | None
    frame: Frame
    places: Floats

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
            "targets": [one.as_json() for one in self.records],
            "sources": {name: scores.more_json() for name, scores in self.sources.items()},
            "fused": self.fused.more_json(),
        }


class Gathering:
    """The scores of all, gathered block by block."""

    def __init__(
        self,
        book: Logbook,
        reference: Reference,
        truth: ScoredTruth,
        numbers: Mapping[tuple[str, str], Numbers],
        names: Mapping[int, str],
    ) -> None:
        self._names = names
        self._reference, self._truth, self._infos = reference, truth, book.infos
        self._exists = np.isfinite(truth.states[:, :, 0])
        count, targets = self._exists.shape
        what = truth.times, truth.states, len(reference.axes), reference.c, truth.hulls
        self._tallies = {key: Tally(*what) for key in reference.motions}
        self._alone = None if reference.centres else Tally(*what)
        self._seen = np.zeros((count, targets), dtype=np.int16)
        self._begins = np.full(targets, -1)
        self._confirmed = {name: np.full(targets, -1) for name in reference.centres}
        self._sightings = {
            key: Sighting(tally.held, numbers[key], reference.limits[key] / STALE_PERIODS)
            for key, tally in self._tallies.items()
        }
        self._coverages = Coverages(reference.sources, book.infos, book.platforms)
        accounts = [book.accounts[name] for name in reference.centres]
        self._misses = {
            name: Misses(count, targets, account.turned_away)
            for name, account in zip(reference.centres or [""], accounts or [Account()], strict=True)
        }

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
            self._note_missed(k, there, {name: shown[row] for (_, name), shown in pictures.items()})

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

    def _note_missed(self, k: int, there: NDArray[np.intp], pictures: Mapping[str, GlobalTracks | None]) -> None:
        """Why targets that are `there` have no fused track."""
        time, d = int(self._truth.times[k]), len(self._reference.axes)
        sources = {name: self._sightings["local", name] for name in self._reference.sources}
        for name, misses in self._misses.items():
            fused = self._sightings["global", name] if name else NOBODY
            missed = there[fused.held[k, there] < 0] if name else there
            if not len(missed):
                continue
            covered = np.ones(len(missed), dtype=np.bool_)
            if self._coverages.told:
                places = self._truth.states[k, missed, :d].T
                covered = self._coverages.hold(time, places, self._reference.frame)
            misses.add(k, time, missed, covered, pictures.get(name), fused, sources)

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
            confirm = np.where((confirmed >= 0) & (self._begins >= 0), after, np.nan)
            local = {one: self._sightings["local", one] for one in sources}
            mine, misses = self._sightings.get(("global", name)), self._misses[name]
            records = target_records(
                times,
                self._truth.targets,
                self._exists,
                fused.errors,
                confirm,
                (misses.codes, misses.others),
                mine,
                local,
                self._names,
            )
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
                confirm=confirm,
                records=records,
                sightings=local,
                fused_sighting=mine,
                frame=self._reference.frame,
                places=self._truth.states[:, :, : len(self._reference.axes)],
            )
        return found


def _nothing(m: int, d: int) -> Block:
    return Block(np.zeros(2, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((0, m)), np.zeros((0, d, d)))
