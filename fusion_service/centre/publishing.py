"""From the picture after a step to what is published of it: the same for every kind of centre."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import all_of
from fusion_service.centre.extent_fusion import extent_columns
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.labels import Labels
from fusion_service.centre.lifecycle import WAYS, Picture, Support, advance
from fusion_service.centre.partial import Unknown
from fusion_service.centre.pictures import is_picture_of
from fusion_service.config import CentreConfig
from fusion_service.coverage import region_holds
from fusion_service.densities import Mixtures
from fusion_service.layout import to_first
from schemas import ORIGINS, STATUSES, GlobalTracks, Local, messages

__all__ = ["Contributions", "live_on", "picture_message"]

MOST_BITS = 2**21
"""Bytes of lineages of tracks that a message carries at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """Who fed the tracks: counts (G,) per track, and of each of the K contributions source (index into the sorted
    names), epoch, local id and influence, (K,), track by track."""

    counts: NDArray[np.integer[Any]]
    source: NDArray[np.intp]
    epoch: NDArray[np.uint64]
    id: NDArray[np.uint64]
    influence: NDArray[np.float64]


def live_on(
    picture: Picture, time: int, support: Support, config: CentreConfig, journal: Journal,
    held: Callable[[NDArray[np.uint64]], NDArray[np.bool_]] | None = None,
) -> tuple[Picture, NDArray[np.bool_], NDArray[np.bool_]]:  # fmt: skip
    """One step of every life, told to the journal: the picture, which of its tracks (G,) leave it now, and which of
    those are suspended; held: which of the tracks of these ids, that end by silence alone, are."""
    before = picture.status
    picture, ended = advance(picture, time, support, config)
    waits = np.zeros(len(ended), dtype=np.bool_)
    if held is not None and ended.any():
        silent = np.flatnonzero(ended & (before != messages.TENTATIVE) & ~support.dropped)
        silent = silent[picture.existence[silent] >= config.min_existence]
        waits[silent] = held(picture.id[silent])
    for track in picture.id[ended & ~waits].tolist():
        journal.end(track, "lost", None)
    for status, decision in ((messages.CONFIRMED, messages.CONFIRMED_NOW), (messages.COASTING, messages.COASTING_NOW)):
        journal.tracks(decision, picture.id[(picture.status == status) & (before != status) & ~ended])
    return picture, ended, waits


def picture_message(
    picture: Picture,
    intake: Intake,
    journal: Journal,
    contributions: Contributions,
    labels: Labels,
    *,
    epoch: int,
    seq: int,
    step: int,
    time: int,
    rule: str,
    revised: int | None = None,
) -> GlobalTracks:
    """The message that publishes a picture; its lineage is every source known, what is in the tracks, and the centre
    itself. revised: as in `GlobalTracks`."""
    config, names = intake.config, intake.names()
    picture, contributions = _published(picture, contributions, intake)
    origins = {source.origin for source in intake.sources.values() if source.messages}
    origins.update(one.origin for one in intake.resting.values() if one.messages)
    origin = max(origins, key=ORIGINS.index, default="live")
    return GlobalTracks(
        source=config.name,
        epoch=epoch,
        seq=seq,
        sent=time,
        origin=origin,
        **_lineage(picture, intake),
        time=time,
        step=step,
        rule=rule,
        space=config.space,
        frame=intake.frame or Local("none"),
        ids=picture.id,
        status=picture.status,
        existence=picture.existence,
        **_densities(picture, config.space, config.publish),
        updated=picture.updated,
        sources=names,
        contributor_counts=contributions.counts.astype(np.uint16),
        contributor_source=contributions.source.astype(np.uint16),
        contributor_epoch=contributions.epoch,
        contributor_id=contributions.id,
        contributor_influence=contributions.influence,
        ended=journal.ended(),
        split_from=journal.splits(),
        **_ways(picture, rule),
        **extent_columns(picture),
        **labels.columns(picture.id, origin),
        revised=revised,
    )


def _published(picture: Picture, contributions: Contributions, intake: Intake) -> tuple[Picture, Contributions]:
    """What of the picture goes out, by its status and its place."""
    config = intake.config
    shown = np.array([name in config.publish_status for name in STATUSES], dtype=np.bool_)[picture.status]
    if config.publish_region is not None and intake.frame is not None:
        places = [config.space.index(axis) for axis in ("x", "y", "z") if axis in config.space]
        shown &= region_holds(config.publish_region, picture.mean[places])
    if all_of(shown):
        return picture, contributions
    whose = np.repeat(shown, contributions.counts)
    kept = Contributions(
        counts=contributions.counts[shown],
        source=contributions.source[whose],
        epoch=contributions.epoch[whose],
        id=contributions.id[whose],
        influence=contributions.influence[whose],
    )
    return picture.take(shown), kept


def _lineage(picture: Picture, intake: Intake) -> dict[str, Any]:
    """The lineage of a message and, of a centre that links tracks, that of each of them; too many bits are left out."""
    own, names = intake.config.name, [name for name in intake.names() if not is_picture_of(name)]
    if intake.config.kind != "tracks":
        return {"lineage": (*(name for name in names if name != own), own)}
    lineage, bits = intake.lineages.told(picture.lineage, names, own)
    return {"lineage": lineage, "track_lineage": bits if bits.size <= MOST_BITS else None}


def _ways(picture: Picture, rule: str) -> dict[str, Any]:
    """What each track was fused by, where that is not the rule for all."""
    if not picture.way.any():
        return {}
    used, which = np.unique(picture.way, return_inverse=True)
    return {"rules": tuple(WAYS[way] or rule for way in used.tolist()), "track_rule": which.astype(np.uint8)}


def _densities(picture: Picture, space: tuple[str, ...], publish: str) -> dict[str, Any]:
    """The columns of a message: mixtures as they are, as their moments, or by their heaviest component."""
    unknown = Unknown.of(space)
    mean, covariance = picture.mean, unknown.told(picture.covariance)
    if len(picture.log_weight) and publish == "mixture":
        parts = Mixtures(picture.log_weight, picture.part_mean, unknown.told(picture.part_covariance))
        weights, means, covariances, counts = parts.rows()
        return {"means": means, "covariances": covariances, "weights": weights, "counts": counts}
    if len(picture.log_weight) and publish == "mode":
        heaviest, each = picture.log_weight.argmax(axis=0), np.arange(len(picture.id))
        mean = picture.part_mean[:, heaviest, each]
        covariance = unknown.told(picture.part_covariance[:, :, heaviest, each])
    return {
        "means": to_first(mean, mean.shape[-1:], 1),
        "covariances": to_first(covariance, mean.shape[-1:], 2),
    }
