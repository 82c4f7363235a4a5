"""Tracks of a message as rows of a table, whose columns `schemas.flat` describes. A mixture goes by its moments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import moments
from fusion_service.geodesy import ecef_to_geodetic, enu_to_geodetic
from schemas import STATUSES, Ecef, Enu, GlobalTracks, Height, LocalTracks, Truth, pack_lower
from schemas.flat import frame_text, lower, track_columns

__all__ = ["AS", "Exportable", "TableRow", "rows_of"]

Exportable = GlobalTracks | LocalTracks | Truth
TableRow = dict[str, Any]
AS = {GlobalTracks: "global", LocalTracks: "local", Truth: "truth"}
TEXTS = (("callsign", "callsign"), ("identity", "identity"), ("class", "kind"))
"""Columns of the table, and of messages."""
SETTLED = 8
"""Steps after which a place at a given altitude, up to 1,000 km from the origin, is known to a millimetre."""


def rows_of(message: Exportable, label: Callable[[int], str] = str) -> Iterator[TableRow]:
    """A row for each track, in the order of the message; None for what is not said. label: of global ids."""
    n = len(message.space)
    if isinstance(message, Truth):
        means, covariances = message.means, np.full((len(message.means), n, n), np.nan)
    else:
        means, covariances = moments(message.means, message.covariances, message.weights, message.counts)
    packed, places = pack_lower(covariances), _places(message, means)
    names = track_columns(message.space)
    common = {
        "time": datetime.fromtimestamp(message.time // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        + f".{message.time % 10**9 // 1000:06d}Z",
        "time_ns": message.time,
        "source": message.source,
        "kind": AS[type(message)],
        "epoch": message.epoch,
        "lineage": " ".join(message.lineage or ()),
        "frame": frame_text(message.frame),
    }
    said = {name: getattr(message, column, None) for name, column in TEXTS}
    numbers, extent = getattr(message, "number", None), message.extent
    axes = [message.space.index(name) for name in "xyz" if name in message.space]
    sigma = np.sqrt(covariances[:, axes, axes].mean(axis=1))
    existence = getattr(message, "existence", None)
    updated = getattr(message, "updated", None)
    behind = _contributors(message)
    covariance_names = [f"cov_{message.space[i]}_{message.space[j]}" for i, j in lower(message.space)]
    for k, track in enumerate(message.ids.tolist()):
        row = dict.fromkeys(names) | common | {"track_id": track, "sources": behind[k] if behind else ""}
        row |= dict(zip(message.space, means[k].tolist(), strict=True))
        row |= {"track_hex": f"0x{track:016x}", "label": _label(message, track, label)}
        row |= {name: column[k] for name, column in said.items() if column is not None}
        if numbers is not None and numbers[k]:
            row["number"] = int(numbers[k])
        if extent is not None and np.isfinite(extent[k]).all():
            length, width, heading = extent[k].tolist()
            turned = (90.0 - math.degrees(heading)) % 360.0
            row |= {"extent_length": length, "extent_width": width, "extent_heading": turned}
        if not isinstance(message, Truth):
            row |= dict(zip(covariance_names, packed[k].tolist(), strict=True))
            row["sigma"] = float(sigma[k])
        if isinstance(message, GlobalTracks):
            row["status"] = STATUSES[message.status[k]]
        if existence is not None:
            row["existence"] = float(existence[k])
        if updated is not None:
            row["updated_ns"] = int(updated[k])
        if places is not None:
            row |= dict(zip(("latitude", "longitude", "altitude"), places[:, k].tolist(), strict=True))
        yield row


def _label(message: Exportable, track: int, label: Callable[[int], str]) -> str:
    if isinstance(message, GlobalTracks):
        return f"track {label(track)}"
    return f"target {track}" if isinstance(message, Truth) else f"{message.source} {track}"


def _contributors(message: Exportable) -> list[str]:
    if not isinstance(message, GlobalTracks):
        return []
    ends = np.cumsum(message.contributor_counts.astype(int)).tolist()
    names = [message.sources[index] for index in message.contributor_source.tolist()]
    return [" ".join(sorted(set(names[begin:end]))) for begin, end in pairwise([0, *ends])]


def _places(message: Exportable, means: Floats) -> Floats | None:
    """Latitude, longitude (degrees) and altitude (m), (3, T); None in a frame without a place on Earth. A state without
    z lies `height` (0 unless the source says one) above the ellipsoid."""
    xyz = [means[:, message.space.index(name)] if name in message.space else None for name in "xyz"]
    x, y, z = xyz
    assert x is not None
    assert y is not None
    if isinstance(message.frame, Ecef) and z is not None:
        return np.stack(ecef_to_geodetic(x, y, z))
    if not isinstance(message.frame, Enu):
        return None
    if z is not None:
        return np.stack(enu_to_geodetic(x, y, z, message.frame))
    height = getattr(message, "height", None) or Height()
    z = np.zeros_like(x)
    for _ in range(SETTLED):
        z = z - (enu_to_geodetic(x, y, z, message.frame)[2] - height.value)
    return np.stack(enu_to_geodetic(x, y, z, message.frame))
