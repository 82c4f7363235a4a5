"""Does a global track exist: a Bernoulli filter over what its sources report, see and do not see.

In log-odds, existence is an opinion and the evidence since: logit r = opinion + evidence, bounded by `MOST`.

* Birth: the opinion is that of `birth_existence`.
* A source that reports existence gives an opinion, not evidence: whenever one brings new data, the opinion becomes the
  value fused from all linked sources that report one (`fusion_service.existence`, by the configured method;
  "geometric" multiplies by the overlap of the densities and loses existence, which is kept to show it). Its repeated
  word changes nothing more.
* A new datum of a source that reports none is evidence: log(p / f), p its detection probability and f its
  `false_track`, the chance that a report of a track of it is of nothing.
* A complete scan of a source that covers the place and has no new datum of the track is evidence, log(1 - p), once per
  scan received (the Bernoulli filter's r' = r (1 - p) / (1 - r p)), after the track has been in its coverage for its
  initiation delay. Where coverage or detection probability is not declared, nothing is lowered.
* Without any new datum the target may be gone: r' = r s^dt, s the `survival` of a second.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.association import by_size
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.config import SourceConfig
from fusion_service.coverage import covers
from fusion_service.densities import Mixtures, power_product
from fusion_service.existence import fuse_existence

__all__ = ["Entries", "update_existence"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MOST = float(np.log(0.9999 / 0.0001))
"""Log-odds beyond which nothing is believed or denied: from there a few data lead back."""
MOST_CERTAIN = 0.999
"""No sensor is believed to see more surely than this."""
USUAL_DETECTION = 0.9
"""Of a source that does not declare it."""
MOST_OVERLAPPING = 32
"""Beyond so many sources the overlap is not worked out, and existence is fused by the consistent rule."""


@dataclass(slots=True)
class Entries:
    """When each global track came into the coverage of each source: by name the ids (K,), sorted, and times (K,) ns."""

    by_source: dict[str, tuple[NDArray[np.uint64], NDArray[np.int64]]] = field(default_factory=dict)

    def note(self, name: str, picture: Picture, covered: Bools, time: int) -> NDArray[np.int64]:
        """The time (G,) since when each track is covered, `time` for one that was not before and for others."""
        ids, since = self.by_source.get(name, (picture.id[:0], picture.time[:0]))
        entered = np.full(len(picture.id), time, dtype=np.int64)
        if len(ids):
            at = np.minimum(np.searchsorted(ids, picture.id), len(ids) - 1)
            known = covered & (ids[at] == picture.id)
            entered[known] = np.minimum(since[at[known]], time)
        self.by_source[name] = (picture.id[covered], entered[covered])
        return entered

    def keep(self, names: set[str]) -> None:
        """Forget all other sources."""
        self.by_source = {name: kept for name, kept in self.by_source.items() if name in names}

    def packed(self) -> list[Any]:
        """As plain values, in order."""
        return [
            [name, ids.astype("<u8").tobytes(), since.astype("<i8").tobytes()]
            for name, (ids, since) in sorted(self.by_source.items())
        ]

    @classmethod
    def unpacked(cls, packed: list[Any]) -> Entries:
        """From what `packed` gave."""
        made = cls()
        for name, ids, since in packed:
            made.by_source[str(name)] = (
                np.frombuffer(ids, "<u8").astype(np.uint64),
                np.frombuffer(since, "<i8").astype(np.int64),
            )
        return made


def update_existence(rows: Rows, picture: Picture, intake: Intake, entries: Entries, time: int, before: int) -> Picture:
    """The picture with existence at the step at `time`, ns, the last one having been at `before` (-1: none)."""
    config, count = intake.config, len(picture.id)
    inside = rows.inside()
    at = picture.find(rows.tracks.link[inside])
    fresh = rows.fresh[inside]
    says = np.isfinite(rows.tracks.existence[inside])
    hit = np.bincount(at[fresh], minlength=count) > 0
    opinion = np.where(picture.time < 0, _logit(config.birth_existence), picture.opinion)
    evidence = picture.evidence.copy()
    opinion, told = _opinions(rows, picture, inside[says], hit, opinion, config.existence)
    gain = np.array([_gain(intake.declared(intake.sources[name])) for name in intake.names()])
    counted = fresh & ~says
    np.add.at(evidence, at[counted], gain[rows.source[inside[counted]]])
    evidence = np.where(told, 0.0, evidence) + _missed(rows, picture, intake, entries, time)
    if before >= 0:
        quiet = ~hit & (picture.time >= 0)
        r = _sigmoid(np.clip(opinion + evidence, -MOST, MOST)) * config.survival ** (max(time - before, 0) / 1e9)
        evidence = np.where(quiet, _logit(r) - opinion, evidence)
    total = np.clip(opinion + evidence, -MOST, MOST)
    return replace(picture, opinion=opinion, evidence=total - opinion, existence=_sigmoid(total))


def _opinions(
    rows: Rows, picture: Picture, saying: NDArray[np.intp], hit: Bools, opinion: Floats, method: str
) -> tuple[Floats, Bools]:
    """The opinion of all sources that report existence, where one has new data; and where that is."""
    opinion, told = opinion.copy(), np.zeros(len(picture.id), dtype=np.bool_)
    new = np.zeros(len(picture.id), dtype=np.bool_)
    new[picture.find(rows.tracks.link[saying[rows.fresh[saying]]])] = True
    for ids, members in by_size(rows.tracks.link[saying]):
        at = picture.find(ids)
        some = new[at]
        if some.any():
            opinion[at[some]] = _logit(_fused(rows, saying[members[some]], method))
            told[at[some]] = True
    return opinion, told


def _fused(rows: Rows, members: NDArray[np.intp], method: str) -> Floats:
    r = rows.tracks.existence[members]
    k = members.shape[1]
    if method != "geometric" or k > MOST_OVERLAPPING:
        return np.asarray(fuse_existence(r, "consistent" if method == "geometric" else method))
    sources = [
        Mixtures(
            np.zeros((1, len(members))),
            rows.tracks.mean[:, None, members[:, j]],
            rows.tracks.covariance[:, :, None, members[:, j]],
        )
        for j in range(k)
    ]
    overlap = np.exp(power_product(sources, np.full((k, len(members)), 1.0 / k)).log_mass)
    inside = np.clip(r, 1e-12, 1 - 1e-12)
    return np.asarray(fuse_existence(inside, "geometric", overlap=np.clip(np.nan_to_num(overlap), 0.0, 1.0)))


def _gain(declared: SourceConfig) -> float:
    """log(p / f) of a new datum of a source, never below 0."""
    p = USUAL_DETECTION if declared.detection_probability is None else declared.detection_probability
    return float(np.log(max(p, declared.false_track) / declared.false_track))


def _missed(rows: Rows, picture: Picture, intake: Intake, entries: Entries, time: int) -> Floats:
    """What the scans of the step that show nothing new of a track add to its log-odds (G,)."""
    total = np.zeros(len(picture.id))
    frame = intake.frame
    sensors = {name: intake.sensor(source) for name, source in sorted(intake.sources.items()) if not source.muted}
    looking = {
        name: said
        for name, said in sensors.items()
        if said is not None and said.coverage is not None and said.detection_probability
    }
    entries.keep(set(looking))
    if frame is None or not len(picture.id):
        return total
    places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]
    index = {name: number for number, name in enumerate(intake.names())}
    new = rows.fresh | rows.tracks.outside
    for name, said in looking.items():
        covered = (picture.time >= 0) & covers(said, picture.mean[places], frame)
        entered = entries.note(name, picture, covered, time)
        scans = intake.sources[name].scans
        if not scans:
            continue
        told = rows.tracks.link[(rows.source == index[name]) & new]
        missed = covered & (time - entered >= said.initiation_delay * 1e9) & ~np.isin(picture.id, told)
        p = min(float(said.detection_probability or 0.0), MOST_CERTAIN)
        total[missed] += scans * np.log1p(-p)
    return total


def _logit(r: Any) -> Any:
    r = np.clip(r, 1e-12, 1 - 1e-12)
    return np.log(r) - np.log1p(-r)


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-x)))
