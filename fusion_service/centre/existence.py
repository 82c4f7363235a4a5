"""Does a global track exist: a Bernoulli filter over what its sources report, see and do not see.

In log-odds, existence is an opinion, the evidence for it and what was missed: logit r = opinion + evidence + misses,
each and their sum bounded by `MOST`.

* Birth: the opinion is that of `birth_existence`.
* A source that reports existence gives an opinion, not evidence: whenever one brings new data, the opinion becomes the
  value fused from all linked sources that report one (`fusion_service.existence`, by the configured method;
  "geometric" multiplies by the overlap of the densities and loses existence, which is kept to show it). Its repeated
  word changes nothing more.
* A new datum of a source that reports none is evidence: log(p / f), p its detection probability and f its
  `false_track`, the chance that a report of a track of it is of nothing.
* A complete scan of a source that covers the place and has no new datum of the track is evidence, log(1 - p), once per
  scan received (the Bernoulli filter's r' = r (1 - p) / (1 - r p)), after the track has been in its coverage for its
  initiation delay, and but for a track that another row of it stands for as well (`blobs`); what a source has missed
  is made good first by its own new data, and at once by its opinion. Where coverage or detection probability is not
  declared, nothing is lowered.
* Without any new datum the target may be gone: r' = r s^dt, s the `survival` of a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, among
from fusion_service.centre.association import by_size
from fusion_service.centre.blobs import Shared
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import Rows
from fusion_service.coverage import covers
from fusion_service.densities import Mixtures, power_product
from fusion_service.existence import fuse_existence
from fusion_service.records import altered

__all__ = ["Entries", "update_existence"]


MOST = float(np.log(0.9999 / 0.0001))
"""Log-odds beyond which nothing is believed or denied: from there a few data lead back."""
MOST_CERTAIN = 0.999
"""No sensor is believed to see more surely than this."""
USUAL_DETECTION = 0.9
"""Of a source that does not declare it."""
MOST_OVERLAPPING = 32
"""Beyond so many sources the overlap is not worked out, and existence is fused by the consistent rule."""


class Misses(NamedTuple):
    """What one source has not seen of K global tracks: ids, sorted; since i64 ns when each came into its coverage, -1
    where it is not in it; total f64, the log-odds that its scans without the track have added."""

    ids: NDArray[np.uint64]
    since: NDArray[np.int64]
    total: Floats


@dataclass(slots=True)
class Entries:
    """The `Misses` of every source, by name."""

    by_source: dict[str, Misses] = field(default_factory=dict)

    def of(self, name: str, picture: Picture) -> tuple[NDArray[np.int64], Floats]:
        """since and total (G,) of the tracks of the picture."""
        since, total = np.full(len(picture.id), -1, dtype=np.int64), np.zeros(len(picture.id))
        known = self.by_source.get(name)
        if known is not None and len(known.ids):
            at = np.minimum(np.searchsorted(known.ids, picture.id), len(known.ids) - 1)
            there = known.ids[at] == picture.id
            since[there], total[there] = known.since[at[there]], known.total[at[there]]
        return since, total

    def keep(self, name: str, picture: Picture, since: NDArray[np.int64], total: Floats) -> None:
        """Remember these of the tracks of the picture."""
        some = (since >= 0) | (total < 0)
        self.by_source[name] = Misses(picture.id[some], since[some], total[some])

    def forget_others(self, names: set[str]) -> None:
        """Forget all sources but these."""
        self.by_source = {name: kept for name, kept in self.by_source.items() if name in names}

    def packed(self) -> list[Any]:
        """As plain values, in order."""
        return [
            [name, *(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes() for part in misses)]
            for name, misses in sorted(self.by_source.items())
        ]

    @classmethod
    def unpacked(cls, packed: list[Any]) -> Entries:
        """From what `packed` gave."""
        made = cls()
        for name, ids, since, total in packed:
            made.by_source[str(name)] = Misses(
                np.frombuffer(ids, "<u8").astype(np.uint64),
                np.frombuffer(since, "<i8").astype(np.int64),
                np.frombuffer(total, "<f8").astype(np.float64),
            )
        return made


def update_existence(
    rows: Rows, picture: Picture, intake: Intake, entries: Entries, time: int, before: int, shared: Shared
) -> Picture:
    """The picture with existence at the step at `time`, ns, the last one having been at `before` (-1: none). shared:
    which rows stand for a second track."""
    config, count = intake.config, len(picture.id)
    inside = rows.inside()
    at = picture.find(rows.tracks.link[inside])
    fresh = rows.fresh[inside]
    says = np.isfinite(rows.tracks.existence[inside])
    hit = np.bincount(at[fresh], minlength=count) > 0
    opinion = np.where(np.isnan(picture.opinion), _begun(config.birth_existence), picture.opinion)
    evidence = picture.evidence.copy()
    opinion = _opinions(rows, picture, inside[says], opinion, config.existence, Unknown.of(config.space))
    said = (intake.declared(source) for _, source in sorted(intake.sources.items()))
    gain = np.array([_gain(one.detection_probability, one.false_track) for one in said])
    counted = fresh & ~says
    np.add.at(evidence, at[counted], gain[rows.source[inside[counted]]])
    missed, spent = _missed(rows, picture, intake, entries, gain, time, shared)
    evidence = evidence - spent
    evidence = _within(opinion + evidence, MOST) - opinion
    quiet = ~hit & (picture.time >= 0)
    if before >= 0 and quiet.any():
        r = _sigmoid(opinion + evidence) * config.survival ** (max(time - before, 0) / 1e9)
        evidence = np.where(quiet, _within(_logit(r), MOST) - opinion, evidence)
    total = _within(opinion + evidence + missed, MOST)
    return altered(picture, opinion=opinion, evidence=evidence, existence=_sigmoid(total))


def _opinions(
    rows: Rows, picture: Picture, saying: NDArray[np.intp], opinion: Floats, method: str, unknown: Unknown
) -> Floats:
    """The opinion of all sources that report existence, made anew where one has new data."""
    opinion = opinion.copy()
    if not len(saying):
        return opinion
    new = np.zeros(len(picture.id), dtype=np.bool_)
    new[picture.find(rows.tracks.link[saying[rows.fresh[saying]]])] = True
    for ids, members in by_size(rows.tracks.link[saying]):
        at = picture.find(ids)
        some = new[at]
        if some.any():
            opinion[at[some]] = _logit(_fused(rows, saying[members[some]], method, unknown))
    return opinion


def _fused(rows: Rows, members: NDArray[np.intp], method: str, unknown: Unknown) -> Floats:
    r = rows.tracks.existence[members]
    k = members.shape[1]
    if method != "geometric" or k > MOST_OVERLAPPING:
        return np.asarray(fuse_existence(r, "consistent" if method == "geometric" else method))
    means, covariances = unknown.shared(rows.tracks.mean[:, members], rows.tracks.covariance[:, :, members])
    flat = np.zeros((1, len(members)))
    sources = [Mixtures(flat, means[:, None, :, j], covariances[:, :, None, :, j]) for j in range(k)]
    overlap = np.exp(power_product(sources, np.full((k, len(members)), 1.0 / k)).log_mass)
    inside = np.clip(r, 1e-12, 1 - 1e-12)
    return np.asarray(fuse_existence(inside, "geometric", overlap=np.clip(np.nan_to_num(overlap), 0.0, 1.0)))


@lru_cache(maxsize=4096)
def _gain(detection_probability: float | None, false_track: float) -> float:
    """log(p / f) of a new datum of a source that declares them, never below 0."""
    p = USUAL_DETECTION if detection_probability is None else detection_probability
    return float(np.log(max(p, false_track) / false_track))


def _within(x: Floats, most: float) -> Floats:
    """`np.clip(x, -most, most)` without what that does beside it."""
    return np.minimum(np.maximum(x, -most), most)


def _missed(
    rows: Rows, picture: Picture, intake: Intake, entries: Entries, gain: Floats, time: int, shared: Shared
) -> tuple[Floats, Floats]:
    """What all scans that show nothing new of a track, so far, take from its log-odds (G,); and how much of the gain
    (N,) of new data only made good what their own sources had missed. An opinion of a source makes good all of it."""
    whole, spent = np.zeros(len(picture.id)), np.zeros(len(picture.id))
    frame = intake.frame
    sensors = {name: intake.sensor(source) for name, source in sorted(intake.sources.items()) if not source.muted}
    looking = {
        name: said
        for name, said in sensors.items()
        if said is not None and said.coverage is not None and said.detection_probability
    }
    entries.forget_others(set(looking))
    if frame is None or not len(picture.id):
        return whole, spent
    places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]
    index = {name: number for number, name in enumerate(intake.names())}
    for name, said in looking.items():
        since, total = entries.of(name, picture)
        covered = (picture.time >= 0) & covers(said, picture.mean[places], frame)
        since = np.where(covered, np.where(since >= 0, np.minimum(since, time), time), -1)
        mine = rows.source == index[name]
        new = mine & rows.fresh & ~rows.tracks.outside
        seen = among(picture.id, rows.tracks.link[new])
        says = among(picture.id, rows.tracks.link[new & np.isfinite(rows.tracks.existence)])
        unsure = among(picture.id, rows.tracks.link[mine & rows.tracks.outside])
        missed = covered & ~seen & ~unsure & (time - since >= said.initiation_delay * 1e9)
        missed = shared.still_missed(index[name], missed)
        p = min(float(said.detection_probability or 0.0), MOST_CERTAIN)
        more = intake.sources[name].scans * np.log1p(-p)
        again = seen & ~says & (total < 0)
        spent = spent + np.where(again, np.minimum(gain[index[name]], -total), 0.0)
        total = np.where(again, np.minimum(total + gain[index[name]], 0.0), np.where(says, 0.0, total))
        total = np.maximum(np.where(missed, total + more, total), -MOST)
        entries.keep(name, picture, since, total)
        whole = whole + total
    return whole, spent


@lru_cache(maxsize=64)
def _begun(r: float) -> float:
    """The log-odds of what a track begins with."""
    return float(_logit(r))


def _logit(r: Any) -> Any:
    r = np.minimum(np.maximum(r, 1e-12), 1 - 1e-12)
    return np.log(r) - np.log1p(-r)


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-x)))
