"""Which fields each message has on the wire, in the order in which they are written."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from schemas import values
from schemas.extents import REFERENCES, SHAPES
from schemas.messages import (
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    SensorInfo,
    Status,
    StepLog,
    Truth,
)
from schemas.platform import pack_platform, read_platform
from schemas.values import Convert

__all__ = ["CLASSES", "DECISION_COLUMNS", "FIELDS", "Field"]


class Field(NamedTuple):
    """One wire key: the value's name when read, how it is got from a message, written (None: as it is) and read."""

    key: str
    slot: str
    get: Callable[[Any], Any]
    pack: Convert | None
    unpack: Convert
    optional: bool = False


def _plain(key: str, unpack: Convert, pack: Convert | None = None, optional: bool = False) -> Field:
    return Field(key, key, attrgetter(key), pack, unpack, optional)


def _column(key: str, dtype: str, optional: bool = False, ndim: int = 1, path: str = "") -> Field:
    kind = np.dtype(dtype)
    read = partial(np.frombuffer, dtype=kind)
    return Field(key, key, attrgetter(path or key), partial(values.pack_column, kind, ndim), read, optional)


def _covariances(key: str, slot: str, ndim: int, optional: bool = False) -> Field:
    pack = partial(values.pack_covariances, ndim)
    return _column(key, "<f8", optional)._replace(slot=slot, get=attrgetter(slot), pack=pack)


_NAMES = values.list_of(values.name)
_SOURCES = values.list_of(values.source)
_TEXTS = values.list_of(values.maybe(values.text))
_COUNTERS = values.map_of(values.u64)
_FLOATS = values.map_of(values.number)
_ENTRIES = values.list_of(values.entry)
_ENDED = values.list_of(values.row(values.u64, values.text, values.maybe(values.u64)))
_PAIRS = values.list_of(values.row(values.u64, values.u64))
_POSITION = values.row(*[values.within(-1e12, 1e12)] * 3)
_SECONDS = values.within(0.0, 1e9)

_HEADER = (
    _plain("source", values.name),
    _plain("epoch", values.u64),
    _plain("seq", values.u64),
    _plain("sent", values.nanoseconds),
    _plain("origin", values.origin),
    _plain("lineage", _NAMES, list, optional=True),
)
_TIME = _plain("time", values.nanoseconds)
_STEP = _plain("step", values.u64)
_FRAME = _plain("frame", values.frame, values.pack_kind)
_WHERE = (_plain("space", values.space, list), _FRAME)
_HEIGHT = _plain("height", values.height, values.pack_parts, optional=True)
_IDS = _column("ids", "<u8")
_MEANS = _column("means", "<f8", ndim=2)
_DENSITIES = (_MEANS, _covariances("covs", "covariances", 3))
_MIXED = (_column("counts", "<u2", optional=True), _column("weights", "<f8", optional=True))
_LINEAGES = _column("track_lineage", "u1", optional=True, ndim=2)
_EXTENT = _column("extent", "<f8", optional=True, ndim=2)
_SIGMA = _column("extent_sigma", "<f8", optional=True, ndim=2)
_SHAPE = _plain("shape", values.one_of(SHAPES), optional=True)

DECISION_COLUMNS = {
    "kind": "u1",
    "track": "<u8",
    "source": "<u2",
    "epoch": "<u8",
    "id": "<u8",
    "other": "<u8",
    "value": "<f8",
}

FIELDS: dict[type[Message], tuple[Field, ...]] = {
    LocalTracks: (
        *_HEADER,
        _TIME,
        _plain("complete", values.boolean),
        *_WHERE,
        _HEIGHT,
        _plain("platform", read_platform, pack_platform, optional=True),
        _IDS,
        _column("existence", "<f8", optional=True),
        _column("updated", "<i8", optional=True),
        *_MIXED,
        *_DENSITIES,
        _plain("identity", _TEXTS, list, optional=True),
        _plain("kind", _TEXTS, list, optional=True),
        _column("kind_p", "<f8", optional=True),
        _LINEAGES,
        _EXTENT,
        _SIGMA,
        _SHAPE,
        _plain("reference", values.one_of(REFERENCES), optional=True),
        _covariances("reference_covs", "reference_covariances", 3, optional=True),
    ),
    LocalIntensity: (*_HEADER, _TIME, *_WHERE, _HEIGHT, _column("weights", "<f8"), *_DENSITIES),
    SensorInfo: (
        *_HEADER,
        _FRAME,
        _plain("position", _POSITION, lambda xyz: [float(part) for part in xyz]),
        _covariances("position_covariance", "position_covariance", 2, optional=True),
        _plain("heading_sigma", values.within(0.0, math.pi), float, optional=True),
        _plain("period", values.within(1e-6, 1e9), float),
        _plain("motion", values.motion, values.pack_motion),
        _plain("coverage", values.coverage, values.pack_kind, optional=True),
        _plain("detection_probability", values.within(0.0, 1.0), float, optional=True),
        _plain("initiation_delay", _SECONDS, float),
        _plain("may_start", values.boolean),
        _plain("correlation_group", values.text, optional=True),
        _plain("feedback", values.boolean, optional=True),
        _plain("polar", values.boolean, optional=True),
    ),
    GlobalTracks: (
        *_HEADER,
        _TIME,
        _STEP,
        _plain("rule", values.text),
        *_WHERE,
        _IDS,
        _column("status", "u1"),
        _column("existence", "<f8"),
        *_MIXED,
        *_DENSITIES,
        _column("updated", "<i8"),
        _plain("sources", _SOURCES, list),
        _column("contributor_counts", "<u2"),
        _column("contributor_source", "<u2"),
        _column("contributor_epoch", "<u8"),
        _column("contributor_id", "<u8"),
        _column("contributor_influence", "<f8"),
        _plain("rules", values.list_of(values.text), list, optional=True),
        _column("track_rule", "u1", optional=True),
        _plain("ended", _ENDED, values.pack_rows),
        _plain("split_from", _PAIRS, values.pack_rows),
        _plain("identity", _TEXTS, list, optional=True),
        _column("identity_p", "<f8", optional=True),
        _plain("kind", _TEXTS, list, optional=True),
        _column("kind_p", "<f8", optional=True),
        _column("track_origin", "u1", optional=True),
        _column("marks", "u1", optional=True),
        _column("number", "<u4", optional=True),
        _plain("callsign", _TEXTS, list, optional=True),
        _LINEAGES,
        _EXTENT,
        _SIGMA,
        _SHAPE,
        _plain("delta", values.boolean, optional=True),
        _plain("revised", values.nanoseconds, optional=True),
    ),
    StepLog: (
        *_HEADER,
        _STEP,
        _TIME,
        _plain("config_hash", values.text),
        _plain("version", values.text),
        _plain("taken", _ENTRIES, values.pack_entries),
        _plain("refused", _ENTRIES, values.pack_entries),
        _plain("dropped", _ENTRIES, values.pack_entries),
        _plain("events", values.list_of(values.free_map), list),
        _plain("sources", _SOURCES, list),
        *(_column(f"decision_{key}", dtype, path=f"decisions.{key}") for key, dtype in DECISION_COLUMNS.items()),
    ),
    Status: (
        *_HEADER,
        _TIME,
        _STEP,
        _plain("uptime", values.within(0.0, math.inf), float),
        _plain("rates", _FLOATS, values.pack_floats),
        _plain("queue", _COUNTERS),
        _plain("refused", _COUNTERS),
        _plain("dropped", _COUNTERS),
        _plain("sources", values.map_of(values.free_map)),
        _plain("tracks", _COUNTERS),
        _plain("step_time", _FLOATS, values.pack_floats),
        _plain("memory", values.u64, optional=True),
        _plain("notes", values.list_of(values.text), list, optional=True),
        _plain("road", values.text, optional=True),
        _plain("term", values.u64, optional=True),
        _plain("standby", _COUNTERS, optional=True),
    ),
    Truth: (
        *_HEADER,
        _TIME,
        *_WHERE,
        _IDS,
        _MEANS,
        _EXTENT,
        _column("extent_offset", "<f8", optional=True, ndim=2),
        _SHAPE,
    ),
}
"""Message class -> its fields, after `v` and `type`."""

CLASSES: dict[str, type[Message]] = {kind.type: kind for kind in FIELDS}
