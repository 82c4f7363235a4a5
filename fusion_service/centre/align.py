"""Brings every source's newest tracks, and the global ones, to the time and state space of a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats, all_of
from fusion_service.centre import kinship
from fusion_service.centre.evidence import chi2_by_size
from fusion_service.centre.extents import with_reference
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.limits import MAX_TOTAL
from fusion_service.centre.partial import Unknown, predict_known
from fusion_service.centre.retiring import leave_out, retire
from fusion_service.centre.rows import Rows
from fusion_service.centre.sources import Source
from fusion_service.centre.standing import heading_sigma_of, turned
from fusion_service.centre.stated_registration import shift_of
from fusion_service.centre.tracks import LINKS, Columns, Tracks, join_tracks, no_parts
from fusion_service.centre.treatment import Treatment, treated
from fusion_service.config import SourceConfig
from fusion_service.densities import Mixtures
from fusion_service.records import altered
from schemas import Entry, Frame, Motion

__all__ = ["PARTS", "predict_tracks", "usable_rows", "write_back"]

KEPT = 4096
"""Rows up to which columns that say something of sources are kept."""
PARTS = ("log_weight", "part_mean", "part_covariance")


@dataclass(frozen=True, slots=True)
class _Used:
    """A source whose tracks are used: its place in the sorted names, what holds for it, its table."""

    number: int
    source: Source
    said: SourceConfig
    treatment: Treatment
    table: Tracks


def usable_rows(intake: Intake, time: int, journal: Journal) -> Rows:
    """Every source's newest tracks at `time`, ns, by its declared motion. What is stale leaves its table, and
    so does what has no sound density there (refused: ill-conditioned); what is not used, and why, is told."""
    config = intake.config
    used, counts, tracks = _sound_tracks(intake, _used(intake, time), time, journal)
    n = len(config.space)

    many = tuple(counts.tolist())

    def each(values: list[Any], kind: Any) -> NDArray[Any]:
        return _repeated(tuple(values), kind, many) if len(tracks.id) <= KEPT else _spread(values, kind, many)

    whose = each([one.number for one in used], np.intp)
    gates = [config.gate if one.said.gate is None else one.said.gate for one in used]
    kin = kinship.of_rows(intake, tracks, whose)
    may_start = each([one.said.may_start and not one.treatment.out for one in used], np.bool_)
    return Rows(
        source=whose,
        epoch=each([max(one.source.epoch, 0) for one in used], np.uint64),  # -1: nothing was heard of it yet
        tracks=tracks,
        may_start=may_start & ~kinship.stale_echo(tracks, kin.echo, time, config),
        interval=tracks.interval,
        lost=each([one.source.alive is False for one in used], np.bool_),
        gate=_gates(tuple(gates), n, many) if len(tracks.id) <= KEPT else _gates.__wrapped__(tuple(gates), n, many),
        fresh=tracks.updated > tracks.judged,
        kept={one.source.name: count for one, count in zip(used, counts.tolist(), strict=True)},
        kin=kin,
        out=each([one.treatment.out for one in used], np.bool_),
        union=each([one.treatment.union for one in used], np.bool_),
    )


def _spread(values: Sequence[Any], kind: Any, counts: tuple[int, ...]) -> NDArray[Any]:
    """A value for each row of each source."""
    return np.repeat(np.array(values, dtype=kind), counts)


@lru_cache(maxsize=256)
def _repeated(values: tuple[Any, ...], kind: Any, counts: tuple[int, ...]) -> NDArray[Any]:
    """The same, which is the same from step to step as long as sources bring the same number of tracks."""
    column = _spread(values, kind, counts)
    column.flags.writeable = False
    return column


@lru_cache(maxsize=256)
def _gates(shares: tuple[float, ...], n: int, counts: tuple[int, ...]) -> Floats:
    """(n + 1, M): the d2 within which rows meet others, by how many components are in common, of the share of right
    pairs that each source is to lose."""
    gates = np.array([chi2_by_size(one, n) for one in shares]).T.reshape(n + 1, -1)
    columns = np.repeat(gates, counts, axis=1)
    columns.flags.writeable = False
    return columns


def _used(intake: Intake, time: int) -> list[_Used]:
    """The sources whose tracks are used, by name; of all the stale ones leave their tables."""
    used: list[_Used] = []
    room = MAX_TOTAL // max(len(intake.sources), 1)
    for number, (name, source) in enumerate(sorted(intake.sources.items())):
        said = intake.declared(source)
        table = retire(source, said, time, room, intake.config, intake.spared.awake)
        if source.muted or not intake.ready(source):
            leave_out(source)
        else:
            used.append(_Used(number, source, said, intake.treatment(name), table))
    return used


def _sound_tracks(
    intake: Intake, used: list[_Used], time: int, journal: Journal
) -> tuple[list[_Used], NDArray[np.intp], Tracks]:
    """The sources, how many tracks of each there are, and these one after the other at `time`, ns. Sources whose
    tracks need nothing but the same motion are brought there together."""
    parts: list[Tracks] = []
    for _, run in groupby(used, key=lambda one: _alike(intake, one)):
        alike = [*run]
        joined = alike[0].table if len(alike) == 1 else join_tracks([one.table for one in alike])
        parts.append(_brought(intake, alike[0], joined, time))
    whole = len(parts) == 1 and len(used) > 1
    tracks = parts[0] if whole else join_tracks(parts or [intake.nothing()])
    counts = np.array([len(one.table.id) for one in used], dtype=np.intp)
    sound = linalg.is_positive_definite(tracks.covariance) & np.logical_and.reduce(np.isfinite(tracks.mean))
    if all_of(sound):
        return used, counts, tracks
    ends = np.cumsum(counts)
    for one, end, count in zip(used, ends.tolist(), counts.tolist(), strict=True):
        mine = sound[end - count : end]
        bad = count - int(mine.sum())
        if bad:
            journal.refuse(Entry(one.source.name, one.source.epoch, 0, 0, "ill-conditioned", bad))
            one.source.tracks = one.table.take(mine)
    return used, np.array([len(one.source.tracks.id) for one in used], dtype=np.intp), tracks.take(sound)


def _alike(intake: Intake, one: _Used) -> tuple[Any, ...]:
    """What sources whose tracks are brought to the step together have in common; those that need more than their
    motion stand alone."""
    source, table = one.source, one.table
    plain = one.treatment.plain and not len(table.log_weight) and not len(table.extent)
    if plain and intake.config.kind == "tracks":
        plain = not heading_sigma_of(source) and shift_of(intake, source) is None
    return one.said.motion, source.space, -1 if plain else one.number


def _brought(intake: Intake, one: _Used, table: Tracks, time: int) -> Tracks:
    """Tracks of a source, or of sources that are alike, at `time`, ns, in the picture's space, after its treatment,
    with the errors that all of them have in common."""
    config, treatment, source = intake.config, one.treatment, one.source
    age = np.maximum(time - table.time + treatment.clock, 0) / 1e9
    tracks = predict_tracks(table, one.said.motion, source.space, config.space, age, intake.frame, config.unknown_speed)
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
    return altered(tracks, covariance=tracks.covariance + more, part_covariance=parts)


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
        return altered(tracks, mean=one[:, 0], covariance=spread[:, :, 0], **dict(zip(PARTS, parts, strict=True)))
    means, covariances = predict_known(motion, space, tracks.part_mean, tracks.part_covariance, known, *how)
    mean, covariance = Mixtures(tracks.log_weight, means, covariances).moments()
    return altered(tracks, mean=mean, covariance=covariance, part_mean=means, part_covariance=covariances)


def write_back(rows: Rows, intake: Intake) -> None:
    """Put the columns of links back into the sources' own tables."""
    start, columns = 0, [getattr(rows.tracks, name) for name in LINKS]
    for name, count in rows.kept.items():
        source, part = intake.sources[name], slice(start, start + count)
        source.tracks = altered(source.tracks, **dict(zip(LINKS, [one[part] for one in columns], strict=True)))
        start += count
