"""What holds for a source: what it says of itself, what the config says of it, and what follows for its tracks."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fusion_service.centre.intervals import Pace
from fusion_service.centre.places import Place
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.coverage import at_platform
from fusion_service.densities import Mixtures
from schemas import Motion, SensorInfo

__all__ = ["declared_by", "loosened", "motion_declared", "pace_of", "sensor_of"]

PLACES = ("x", "y", "z")
UNHEARD = 10.0
"""Seconds between the scans of a source of which neither it nor the config says anything, until they are measured."""


def declared_by(said: SourceConfig, info: SensorInfo | None) -> SourceConfig:
    """The source's own word, else the config's (`said`); with `override` the other way round."""
    if info is None:
        return said
    own, other = (said, info) if said.override else (info, said)
    said = replace(
        said,
        coverage=other.coverage if own.coverage is None else own.coverage,
        detection_probability=(
            other.detection_probability if own.detection_probability is None else own.detection_probability
        ),
        initiation_delay=own.initiation_delay or other.initiation_delay or 0.0,
        feedback=said.feedback or bool(info.feedback),
        correlation_group=own.correlation_group or other.correlation_group,
    )
    return said if said.override else replace(said, period=info.period, motion=info.motion, may_start=info.may_start)


def motion_declared(said: SourceConfig, source: Source, config: CentreConfig) -> Motion | None:
    """How tracks of the source move, if it or the config says so; `said`: what holds for it."""
    usual = SourceConfig().motion
    known = source.info is not None or (source.name in config.sources and config.sources[source.name].override)
    return said.motion if known or said.motion != usual else None


def sensor_of(said: SourceConfig, info: SensorInfo | None, place: Place | None = None) -> SensorInfo | None:
    """The source's info with what is declared of it, where its platform is; None while it has none, and so no place."""
    if info is None:
        return None
    declared = replace(
        info,
        coverage=said.coverage,
        detection_probability=said.detection_probability,
        initiation_delay=said.initiation_delay or 0.0,
    )
    return declared if place is None else at_platform(declared, place.platform, place.frame)


def pace_of(said: SourceConfig, silent: bool, measured: int, config: CentreConfig) -> Pace:
    """Bounds of the intervals of a source's tracks. silent: nobody says anything of it; measured: the interval of its
    complete scans, ns, or -1."""
    return _pace(said.period, silent, measured, config.remember, config.period)


@lru_cache(maxsize=4096)
def _pace(declared: float, silent: bool, measured: int, remember: float, step: float) -> Pace:
    period = round(declared * 1e9)
    first = measured if measured > 0 else max(period, round(UNHEARD * 1e9)) if silent else period
    cap = max(round(remember * 1e9), period)
    floor = min(period, round(step * 1e9))
    return Pace(min(max(first, floor), cap), floor, cap)


def loosened(tracks: Tracks, space: tuple[str, ...], said: SourceConfig) -> Tracks:
    """Tracks whose covariances are multiplied by `inflation`, with `covariance_floor` added on each axis of place."""
    if said.inflation == 1.0 and said.covariance_floor == 0.0:
        return tracks
    more = np.zeros((len(space), len(space), 1))
    for name in PLACES:
        if name in space:
            more[space.index(name), space.index(name)] = said.covariance_floor**2
    if not len(tracks.log_weight):
        return replace(tracks, covariance=said.inflation * tracks.covariance + more)
    parts = said.inflation * tracks.part_covariance + more[..., None]
    mean, covariance = Mixtures(tracks.log_weight, tracks.part_mean, parts).moments()
    return replace(tracks, mean=mean, covariance=covariance, part_covariance=parts)
