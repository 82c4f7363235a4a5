"""What a checkpoint holds, brought into the space and frame that the config states: the config wins.

Tracks are moved with mean and covariance. Of the components that only the new space has, nothing is known: they are
padded (see `partial`), and a global track keeps its id. What cannot be moved is left out: local tracks come
again with their next report, the ids of global tracks are not used again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.centre.extents import turned
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.partial import Unknown, brought, transformed
from fusion_service.centre.rows import NO_TRACK
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks, empty_tracks
from fusion_service.config import CentreConfig
from fusion_service.geodesy import FrameError
from schemas import Frame, Height

__all__ = ["fit_config"]

Columns = TypeVar("Columns", Tracks, Picture)


def fit_config(
    sources: Mapping[str, Source], picture: Picture, space: tuple[str, ...], frame: Frame | None, config: CentreConfig
) -> Picture:
    """Change the tables of `sources` to the config, and return the picture, that was in `space` and `frame`, so."""
    for name, source in sources.items():
        if config.kind == "intensity" and not set(config.space) <= set(source.space):
            source.space, source.tracks = config.space, empty_tracks(len(config.space))
        source.tracks = _moved(source.tracks, source.space, frame, config.frame, config.source(name).height)
    picture = _moved(picture, space, frame, config.frame, config.source_defaults.height)
    for source in sources.values():
        there = np.isin(source.tracks.link, picture.id)
        source.tracks = replace(source.tracks, link=np.where(there, source.tracks.link, NO_TRACK))
    return picture if space == config.space else _in_space(picture, space, config.space)


def _moved(
    tracks: Columns, space: tuple[str, ...], frame: Frame | None, wanted: Frame | None, height: Height
) -> Columns:
    """Tracks in `space` brought from one frame into the other, without those that cannot be."""
    if frame is None or wanted is None or frame == wanted or not tracks.mean.shape[-1]:
        return tracks
    try:
        mean, covariance = _transformed(tracks.mean, tracks.covariance, space, frame, wanted, height)
        parts = _transformed(tracks.part_mean, tracks.part_covariance, space, frame, wanted, height)
    except FrameError:
        return _taken(tracks, np.zeros(tracks.mean.shape[-1], dtype=np.bool_))
    tracks = replace(tracks, mean=mean, covariance=covariance, part_mean=parts[0], part_covariance=parts[1])
    tracks = turned(tracks, space, frame, wanted)
    columns = mean, covariance, parts[0]
    sound = [np.isfinite(column.reshape(-1, column.shape[-1])).all(axis=0) for column in columns]
    return _taken(tracks, np.logical_and.reduce(sound))


def _transformed(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    space: tuple[str, ...],
    frame: Frame,
    wanted: Frame,
    height: Height,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    batch = mean.shape[1:]
    n, flat = len(mean), (int(np.prod(batch)),)
    means, covariances = transformed(
        linalg.to_first(mean.reshape(n, -1), flat, 1), linalg.to_first(covariance.reshape(n, n, -1), flat, 2),
        space, frame, wanted, height,
    )  # fmt: skip
    return (
        linalg.to_last(means, 1).reshape(mean.shape),
        linalg.symmetrise(linalg.to_last(covariances, 2)).reshape(covariance.shape),
    )


def _taken(tracks: Columns, rows: NDArray[np.bool_]) -> Columns:
    return replace(tracks, **{one.name: getattr(tracks, one.name)[..., rows] for one in fields(tracks)})


def _in_space(picture: Picture, space: tuple[str, ...], wanted: tuple[str, ...]) -> Picture:
    """Marginalised to the components that both have; the rest unknown."""
    unknown = Unknown.of(wanted)
    mean, covariance = brought(picture.mean, picture.covariance, space, unknown)
    part_mean, part_covariance = brought(picture.part_mean, picture.part_covariance, space, unknown)
    return replace(picture, mean=mean, covariance=covariance, part_mean=part_mean, part_covariance=part_covariance)
