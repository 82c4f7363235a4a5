"""Does a global track exist: fused from the sources that say so, lowered by those that look and see nothing.

Whenever a source with an opinion brings new data, the existence of its global track is fused anew from all
linked sources that report one, by the configured method (`fusion_service.existence`; "geometric" multiplies by the
overlap of the densities and loses existence, which is why it is kept: to show it). A source whose coverage holds the
place, that has no track there, lowers it once per complete scan received, r' = r (1 - p) / (1 - r p), p its declared
detection probability, once its declared initiation delay has passed for the track.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.association import by_size
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.coverage import covers
from fusion_service.densities import Mixtures, power_product
from fusion_service.existence import fuse_existence, lower_existence

__all__ = ["existence_now"]

Floats = NDArray[np.float64]

MOST_CERTAIN = 0.999
"""No sensor is believed to see more surely than this."""

MOST_OVERLAPPING = 32
"""Beyond so many sources the overlap is not worked out, and existence is fused by the consistent rule."""


def existence_now(rows: Rows, picture: Picture, fresh: NDArray[np.bool_], intake: Intake, time: int) -> Floats:
    """Existence (G,) of the picture's tracks at `time`, ns. fresh (G,): tracks with new data in this step."""
    existence = picture.existence.copy()
    linked = rows.linked()
    saying = linked[np.isfinite(rows.tracks.existence[linked])]
    for ids, members in by_size(rows.tracks.link[saying]):
        at = picture.find(ids)
        new = fresh[at]
        existence[at[new]] = _fused(rows, saying[members[new]], intake.config.existence)
    if intake.frame is None:
        return existence
    return _lowered(existence, rows, picture, intake, time)


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


def _lowered(existence: Floats, rows: Rows, picture: Picture, intake: Intake, time: int) -> Floats:
    places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]
    frame = intake.frame
    assert frame is not None
    age = (time - picture.born) / 1e9
    for index, (_, source) in enumerate(sorted(intake.sources.items())):
        info = source.info
        if not source.scans or source.muted or info is None or not info.detection_probability:
            continue
        own = rows.tracks.link[rows.source == index]
        missed = (picture.time >= 0) & (age >= info.initiation_delay) & ~np.isin(picture.id, own)
        missed &= covers(info, picture.mean[places], frame)
        chance = 1 - (1 - min(info.detection_probability, MOST_CERTAIN)) ** source.scans
        existence[missed] = lower_existence(existence[missed], min(chance, MOST_CERTAIN))
    return existence
