"""Whether the columns of a message fit together, and their shapes.

Each function gets the values read by the tables, gives columns their shape in place, and raises `MessageError`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from schemas.errors import MessageError
from schemas.messages import (
    DECISIONS,
    NO_SOURCE,
    ORIGINS,
    STATUSES,
    U64,
    Decisions,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    SensorInfo,
    Status,
    StepLog,
    Truth,
)
from schemas.spaces import Ecef, Polygon
from schemas.tables import DECISION_COLUMNS
from schemas.values import unpack_lower

__all__ = ["SHAPE"]

Values = dict[str, Any]


def _lengths(values: Values, length: int, *names: str) -> None:
    for name in names:
        column = values[name]
        if column is not None and len(column) != length:
            raise MessageError("length", f"{name} has {len(column)} numbers where {length} belong")


def _unique(ids: U64) -> None:
    if (ids[1:] > ids[:-1]).all():
        return
    if len(ids) <= 64:
        twice = len(set(ids.tolist())) != len(ids)
    else:
        ordered = np.sort(ids)
        twice = bool((ordered[1:] == ordered[:-1]).any())
    if twice:
        raise MessageError("bad-field", "ids: one stands twice")


def _placed(values: Values) -> int:
    """n, where the state space has a place in the frame."""
    space = values["space"]
    if type(values["frame"]) is Ecef and "z" not in space:
        raise MessageError("bad-field", "space: states in an ecef frame need z")
    return len(space)


def _densities(values: Values, components: int) -> None:
    n = _placed(values)
    triangle = n * (n + 1) // 2
    means, packed = values["means"], values["covariances"]
    if len(means) != components * n or len(packed) != components * triangle:
        _lengths(values, components * n, "means")
        _lengths(values, components * triangle, "covariances")
    values["means"] = means.reshape(components, n)
    values["covariances"] = covariances = unpack_lower(packed.reshape(components, triangle), n)
    covariances.flags.writeable = False


def _components(values: Values, tracks: int) -> int:
    counts, weights = values["counts"], values["weights"]
    if counts is None:
        _lengths(values, tracks, "weights")
        return tracks
    _lengths(values, tracks, "counts")
    if weights is None:
        raise MessageError("missing", "counts without weights")
    if tracks and counts.min() == 0:
        raise MessageError("bad-field", "counts: a track without components")
    total = int(counts.sum(dtype=np.int64))
    _lengths(values, total, "weights")
    return total


def _lineages(values: Values, tracks: int) -> None:
    """Which names of the lineage each track has, a row of bits for each."""
    bits, lineage = values["track_lineage"], values["lineage"]
    if bits is None:
        return
    if lineage is None:
        raise MessageError("missing", "track_lineage without lineage")
    width = -(-len(lineage) // 8)
    _lengths(values, tracks * width, "track_lineage")
    values["track_lineage"] = bits.reshape(tracks, width)


def _rows_of(values: Values, tracks: int, width: int, *names: str) -> None:
    """Columns of so many numbers a track, where they are there."""
    _lengths(values, tracks * width, *names)
    for name in names:
        if values[name] is not None:
            values[name] = values[name].reshape(tracks, width)


def _references(values: Values, tracks: int) -> None:
    packed = values["reference_covariances"]
    if packed is None:
        return
    _lengths(values, 3 * tracks, "reference_covariances")
    values["reference_covariances"] = covariances = unpack_lower(packed.reshape(tracks, 3), 2)
    covariances.flags.writeable = False


def _local(values: Values) -> None:
    ids = values["ids"]
    _unique(ids)
    _lengths(values, len(ids), "existence", "updated", "identity", "kind", "kind_p")
    _lineages(values, len(ids))
    _rows_of(values, len(ids), 3, "extent", "extent_sigma")
    _references(values, len(ids))
    _densities(values, _components(values, len(ids)))


def _intensity(values: Values) -> None:
    _densities(values, len(values["weights"]))


def _info(values: Values) -> None:
    if isinstance(values["coverage"], Polygon) and isinstance(values["frame"], Ecef):
        raise MessageError("bad-field", "coverage: a polygon needs a frame with a horizontal plane, not ecef")
    packed = values["position_covariance"]
    if packed is None:
        return
    _lengths(values, 6, "position_covariance")
    covariance = unpack_lower(packed, 3)
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] < -1e-9 * np.abs(covariance).max():
        raise MessageError("bad-field", "position_covariance: not finite and positive semidefinite")
    covariance.flags.writeable = False
    values["position_covariance"] = covariance


def _global(values: Values) -> None:
    ids = values["ids"]
    tracks = len(ids)
    _unique(ids)
    _lengths(values, tracks, "status", "existence", "updated", "contributor_counts")
    _lengths(values, tracks, "identity", "identity_p", "kind", "kind_p", "track_origin", "marks", "number", "callsign")
    _lengths(values, tracks, "track_rule")
    if values["track_rule"] is not None and tracks and values["track_rule"].max() >= len(values["rules"] or ()):
        raise MessageError("bad-field", "track_rule: beyond rules")
    contributions = int(values["contributor_counts"].sum(dtype=np.int64))
    parts = ("source", "epoch", "id", "influence")
    _lengths(values, contributions, *(f"contributor_{part}" for part in parts))
    if contributions and values["contributor_source"].max() >= len(values["sources"]):
        raise MessageError("bad-field", "contributor_source: beyond sources")
    if tracks and values["status"].max() >= len(STATUSES):
        raise MessageError("bad-field", f"status: beyond {len(STATUSES) - 1}")
    if values["track_origin"] is not None and tracks and values["track_origin"].max() >= len(ORIGINS):
        raise MessageError("bad-field", f"track_origin: beyond {len(ORIGINS) - 1}")
    _lineages(values, tracks)
    _rows_of(values, tracks, 3, "extent", "extent_sigma")
    _densities(values, _components(values, tracks))


def _log(values: Values) -> None:
    columns = {name: values.pop(f"decision_{name}") for name in DECISION_COLUMNS}
    _lengths(columns, len(columns["kind"]), *columns)
    if len(columns["kind"]) and columns["kind"].max() >= len(DECISIONS):
        raise MessageError("bad-field", f"decision_kind: beyond {len(DECISIONS) - 1}")
    if ((columns["source"] >= len(values["sources"])) & (columns["source"] != NO_SOURCE)).any():
        raise MessageError("bad-field", f"decision_source: beyond sources (none is {NO_SOURCE})")
    values["decisions"] = Decisions(**columns)


def _truth(values: Values) -> None:
    ids, n = values["ids"], _placed(values)
    _unique(ids)
    _lengths(values, len(ids) * n, "means")
    values["means"] = values["means"].reshape(len(ids), n)
    _rows_of(values, len(ids), 3, "extent")
    _rows_of(values, len(ids), 2, "extent_offset")


def _nothing(values: Values) -> None:
    """A status has no columns."""


SHAPE: dict[type[Message], Callable[[Values], None]] = {
    LocalTracks: _local,
    LocalIntensity: _intensity,
    SensorInfo: _info,
    GlobalTracks: _global,
    StepLog: _log,
    Status: _nothing,
    Truth: _truth,
}
