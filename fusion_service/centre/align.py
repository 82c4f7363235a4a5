"""Brings every source's newest tracks, and the global ones, to the time and state space of a step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.centre import kinship
from fusion_service.centre.evidence import chi2_by_size
from fusion_service.centre.extents import with_reference
from fusion_service.centre.intake import MAX_TOTAL, Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.partial import Unknown, predict_known
from fusion_service.centre.retiring import leave_out, retire
from fusion_service.centre.rows import Rows
from fusion_service.centre.sources import Source
from fusion_service.centre.standing import turned
from fusion_service.centre.stated_registration import shift_of
from fusion_service.centre.tracks import LINKS, Columns, Tracks, join_tracks, no_parts
from fusion_service.centre.treatment import treated
from fusion_service.densities import Mixtures
from schemas import Entry, Frame, Motion

__all__ = ["predict_tracks", "usable_rows", "write_back"]

PARTS = ("log_weight", "part_mean", "part_covariance")


def usable_rows(intake: Intake, time: int, journal: Journal) -> Rows:
    """Every source's newest tracks at `time`, ns, by its declared motion. What is stale leaves its table, and
    so does what has no sound density there (refused: ill-conditioned); what is not used, and why, is told."""
    config = intake.config
    parts: list[Tracks] = []
    index: list[NDArray[np.intp]] = []
    epochs: list[NDArray[np.uint64]] = []
    starts: list[NDArray[np.bool_]] = []
    interval: list[NDArray[np.int64]] = []
    lost: list[NDArray[np.bool_]] = []
    gates: list[NDArray[np.float64]] = []
    kept: dict[str, int] = {}
    room = MAX_TOTAL // max(len(intake.sources), 1)
    for number, (name, source) in enumerate(sorted(intake.sources.items())):
        said = intake.declared(source)
        table = retire(source, said, time, room, config)
        if source.muted or not intake.ready(source):
            leave_out(source)
            continue
        treatment = intake.treatment(name)
        predicted = _brought(intake, source, table, time)
        sound = linalg.is_positive_definite(predicted.covariance) & np.isfinite(predicted.mean).all(axis=0)
        count = int(sound.sum())
        if count < len(sound):
            journal.refuse(Entry(name, source.epoch, 0, 0, "ill-conditioned", len(sound) - count))
            source.tracks = table.take(sound)
        kept[name] = count
        parts.append(predicted.take(sound))
        index.append(np.full(count, number, dtype=np.intp))
        epochs.append(np.full(count, max(source.epoch, 0), dtype=np.uint64))  # -1: nothing was heard of it yet
        starts.append(np.full(count, said.may_start and not treatment.out, dtype=np.bool_))
        interval.append(table.interval[sound])
        lost.append(np.full(count, source.alive is False, dtype=np.bool_))
        gate = config.gate if said.gate is None else said.gate
        gates.append(np.tile(chi2_by_size(gate, len(config.space))[:, None], count))
    if not parts:
        parts.append(intake.nothing())
    tracks = join_tracks(parts)
    whose = _joined(index, np.intp)
    treatments = [intake.treatment(name) for name in intake.names()]
    kin = kinship.of_rows(intake, tracks, whose)
    return Rows(
        source=whose,
        epoch=_joined(epochs, np.uint64),
        tracks=tracks,
        may_start=_joined(starts, np.bool_) & ~kinship.stale_echo(tracks, kin.echo, time, config),
        interval=_joined(interval, np.int64),
        lost=_joined(lost, np.bool_),
        gate=np.concatenate([np.zeros((len(config.space) + 1, 0)), *gates], axis=1),
        fresh=tracks.updated > tracks.judged,
        kept=kept,
        kin=kin,
        out=np.array([one.out for one in treatments], dtype=np.bool_)[whose],
        union=np.array([one.union for one in treatments], dtype=np.bool_)[whose],
    )


def _brought(intake: Intake, source: Source, table: Tracks, time: int) -> Tracks:
    """The tracks of a source at `time`, ns, in the picture's space, after its treatment, with the errors that all of
    them have in common."""
    config, treatment = intake.config, intake.treatment(source.name)
    age = np.maximum(time - table.time + treatment.clock, 0) / 1e9
    motion = intake.declared(source).motion
    tracks = predict_tracks(table, motion, source.space, config.space, age, intake.frame, config.unknown_speed)
    if config.kind != "tracks":
        return tracks
    tracks = treated(tracks, config.space, treatment)
    if treatment.correction is None:  # else what remains of these errors is in it already
        tracks = turned(_shifted(tracks, shift_of(intake, source)), source, config.space, intake.frame)
    return with_reference(tracks, config.space, intake.frame)


def _shifted(tracks: Tracks, shift: Floats | None) -> Tracks:
    """Tracks that may all be off by one shift of this covariance (n, n), besides their own errors."""
    if shift is None:
        return tracks
    more = shift[:, :, None]
    parts = tracks.part_covariance + more[..., None]
    return replace(tracks, covariance=tracks.covariance + more, part_covariance=parts)


def _joined(parts: list[NDArray[Any]], kind: type[np.generic]) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, kind), *parts])


def predict_tracks(
    tracks: Columns,
    motion: Motion,
    space: tuple[str, ...],
    wanted: tuple[str, ...],
    dt: NDArray[np.float64],
    frame: Frame | None,
    speed: float = 100.0,
    age: NDArray[np.float64] | float = 0.0,
) -> Columns:
    """Densities in `space` and `frame`, `dt` (T,) seconds later in the space `wanted`: marginalised to it, and padded
    where they do not know of a component (see `partial`). speed: one sigma of that of targets, where it is not known;
    age (T,): seconds for which it was not already."""
    unknown = Unknown.of(wanted)
    known = Unknown.of(space).known(tracks.covariance)
    how = dt, unknown, speed, age, frame
    if not len(tracks.log_weight):
        one, spread = tracks.mean[:, None], tracks.covariance[:, :, None]
        one, spread = predict_known(motion, space, one, spread, known, *how)
        parts = no_parts(len(wanted), len(dt))
        return replace(tracks, mean=one[:, 0], covariance=spread[:, :, 0], **dict(zip(PARTS, parts, strict=True)))
    means, covariances = predict_known(motion, space, tracks.part_mean, tracks.part_covariance, known, *how)
    mean, covariance = Mixtures(tracks.log_weight, means, covariances).moments()
    return replace(tracks, mean=mean, covariance=covariance, part_mean=means, part_covariance=covariances)


def write_back(rows: Rows, intake: Intake) -> None:
    """Put the columns of links back into the sources' own tables."""
    start = 0
    for name, count in rows.kept.items():
        source, part = intake.sources[name], slice(start, start + count)
        source.tracks = replace(source.tracks, **{name: getattr(rows.tracks, name)[part] for name in LINKS})
        start += count
