"""The local tracks of all sources as one step sees them: predicted to its time, in one state space, in one order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.densities import Mixtures
from fusion_service.intake import Intake
from fusion_service.journal import Journal
from fusion_service.motion import predict
from fusion_service.sources import Columns, Tracks, join_tracks, no_parts
from schemas import Entry, Motion

__all__ = ["NO_TRACK", "Rows", "predict_tracks", "usable_rows", "write_back"]

NO_TRACK = np.uint64(0)
"""The link of a track that belongs to no global track."""
PARTS = ("log_weight", "part_mean", "part_covariance")
LINK_COLUMNS = ("link", "since", "fails", "used")


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """M usable local tracks in canonical order (source, epoch, id).

    source (M,): index into the sorted names. epoch (M,) u64. tracks: their columns, mean (n, M) and covariance
    (n, n, M) predicted and marginalised to the centre's space; the columns of links may be written. may_start
    (M,). kept: how many of them each source has, in order.
    """

    source: NDArray[np.intp]
    epoch: NDArray[np.uint64]
    tracks: Tracks
    may_start: NDArray[np.bool_]
    kept: dict[str, int]

    def linked(self) -> NDArray[np.intp]:
        """Rows that belong to a global track."""
        return np.flatnonzero(self.tracks.link != NO_TRACK)


def usable_rows(intake: Intake, time: int, journal: Journal) -> Rows:
    """Every source's newest tracks at `time`, ns, by its declared motion. What is stale leaves its table, and
    so does what has no sound density there (refused: ill-conditioned)."""
    config = intake.config
    parts: list[Tracks] = []
    index: list[NDArray[np.intp]] = []
    epochs: list[NDArray[np.uint64]] = []
    starts: list[NDArray[np.bool_]] = []
    kept: dict[str, int] = {}
    for number, (name, source) in enumerate(sorted(intake.sources.items())):
        said = intake.declared(source)
        oldest = time - round(config.stale_periods * said.period * 1e9)
        source.tracks = table = source.tracks.take(source.tracks.time >= oldest)
        if source.muted or not intake.ready(source):
            continue
        predicted = predict_tracks(table, said.motion, source.space, config.space, (time - table.time) / 1e9)
        sound = linalg.is_positive_definite(predicted.covariance) & np.isfinite(predicted.mean).all(axis=0)
        count = int(sound.sum())
        if count < len(sound):
            journal.refuse(Entry(name, source.epoch, 0, 0, "ill-conditioned", len(sound) - count))
            source.tracks = table.take(sound)
        kept[name] = count
        parts.append(predicted.take(sound))
        index.append(np.full(count, number, dtype=np.intp))
        epochs.append(np.full(count, source.epoch, dtype=np.uint64))
        starts.append(np.full(count, said.may_start, dtype=np.bool_))
    if not parts:
        nothing = intake.nothing()
        return Rows(np.zeros(0, dtype=np.intp), nothing.id, nothing, np.zeros(0, dtype=np.bool_), kept)
    return Rows(np.concatenate(index), np.concatenate(epochs), join_tracks(parts), np.concatenate(starts), kept)


def predict_tracks(
    tracks: Columns, motion: Motion, space: tuple[str, ...], wanted: tuple[str, ...], dt: NDArray[np.float64]
) -> Columns:
    """Densities `dt` (T,) seconds later, marginalised from `space` to the components `wanted`."""
    at = [space.index(component) for component in wanted]
    some = np.ix_(at, at)
    components = len(tracks.log_weight)
    if not components:
        mean, covariance = predict(motion, space, tracks.mean, tracks.covariance, dt)
        parts = no_parts(len(at), len(dt))
        return replace(tracks, mean=mean[at], covariance=covariance[some], **dict(zip(PARTS, parts, strict=True)))
    n, count = tracks.mean.shape
    means, covariances = predict(
        motion,
        space,
        tracks.part_mean.reshape(n, -1),
        tracks.part_covariance.reshape(n, n, -1),
        np.tile(dt, components),
    )
    means = means.reshape(n, components, count)[at]
    covariances = covariances.reshape(n, n, components, count)[some]
    mean, covariance = Mixtures(tracks.log_weight, means, covariances).moments()
    return replace(tracks, mean=mean, covariance=covariance, part_mean=means, part_covariance=covariances)


def write_back(rows: Rows, intake: Intake) -> None:
    """Put the columns of links back into the sources' own tables."""
    start = 0
    for name, count in rows.kept.items():
        source, part = intake.sources[name], slice(start, start + count)
        source.tracks = replace(source.tracks, **{name: getattr(rows.tracks, name)[part] for name in LINK_COLUMNS})
        start += count
