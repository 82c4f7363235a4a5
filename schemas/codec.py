"""MessagePack codec of wire format version 1 (WIRE.md), with structural checks.

`encode` writes the same bytes for the same message (keys in the order of the tables below, optional fields
left out when None), so that `encode(decode(data)) == data` for what `encode` wrote, and `digest` names a
message whatever wrote it. `decode` checks structure: types, lengths, names, ranges of integers; numbers are
checked for many messages at once by `schemas.check_numbers`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple, cast

import msgpack
import numpy as np

from schemas.keys import check_name
from schemas.messages import (
    DECISIONS,
    ORIGINS,
    STATUSES,
    Decisions,
    Entry,
    Floats,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    SensorInfo,
    Status,
    StepLog,
    Truth,
)
from schemas.spaces import (
    Coverage,
    Disk,
    Ecef,
    Enu,
    Frame,
    Height,
    Local,
    Motion,
    Polygon,
    Sector,
    check_space,
)

__all__ = ["MAX_BYTES", "VERSION", "MessageError", "decode", "digest", "encode", "pack_lower", "unpack_lower"]

VERSION = 1
MAX_BYTES = 16 * 2**20
"""A payload above this size is refused before it is read."""


class MessageError(ValueError):
    """A message that cannot be read or written. `reason` is one short stable word for counting."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class Field(NamedTuple):
    """One wire key: its attribute, how it is written and read, and whether it may be absent."""

    key: str
    attribute: str
    pack: Callable[[Any], Any]
    unpack: Callable[[Any], Any]
    optional: bool = False


def pack_lower(matrices: Floats) -> Floats:
    """Lower triangles of (..., n, n), row by row: (..., n(n+1)/2)."""
    rows, columns = np.tril_indices(matrices.shape[-1])
    return np.ascontiguousarray(matrices[..., rows, columns])


def unpack_lower(packed: Floats, n: int) -> Floats:
    """The symmetric (..., n, n) of packed lower triangles (..., n(n+1)/2)."""
    rows, columns = np.tril_indices(n)
    index = np.empty((n, n), dtype=np.intp)
    index[rows, columns] = index[columns, rows] = np.arange(len(rows))
    return packed[..., index]


def _same(value: Any) -> Any:
    return value


def _is(kind: type, name: str) -> Callable[[Any], Any]:
    def unpack(value: Any) -> Any:
        if type(value) is not kind:
            raise ValueError(f"not {name}")
        return value

    return unpack


def _float(value: Any) -> float:
    if type(value) is int:
        return float(value)
    if type(value) is not float:
        raise ValueError("not a number")
    return value


def _whole(low: int, high: int) -> Callable[[Any], int]:
    def unpack(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"not a whole number from {low} to {high}")
        return value

    return unpack


_U64 = _whole(0, 2**64 - 1)
_TIME = _whole(0, 2**63 - 1)
_TEXT = _is(str, "a text")


def _tuple_of(unpack: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    def read(value: Any) -> tuple[Any, ...]:
        if type(value) is not list:
            raise ValueError("not a list")
        return tuple(unpack(item) for item in value)

    return read


def _maybe(unpack: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else unpack(value)


def _map_of(unpack: Callable[[Any], Any]) -> Callable[[Any], dict[str, Any]]:
    def read(value: Any) -> dict[str, Any]:
        if type(value) is not dict:
            raise ValueError("not a map")
        return {key: unpack(item) for key, item in value.items()}

    return read


def _pack_floats(value: dict[str, float]) -> dict[str, float]:
    return {key: float(item) for key, item in value.items()}


def _row(*parts: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    def read(value: Any) -> tuple[Any, ...]:
        if type(value) is not list or len(value) != len(parts):
            raise ValueError(f"not a list of {len(parts)}")
        return tuple(part(item) for part, item in zip(parts, value, strict=True))

    return read


def _name(value: Any) -> str:
    return check_name(_TEXT(value))


def _origin(value: Any) -> str:
    if value not in ORIGINS:
        raise ValueError(f"not one of {' '.join(ORIGINS)}")
    return cast(str, value)


def _space(value: Any) -> tuple[str, ...]:
    return check_space(_tuple_of(_TEXT)(value))


def _pack_kind(value: Any) -> dict[str, Any]:
    return {"kind": value.kind, **_pack_plain(value)}


def _pack_plain(value: Any) -> dict[str, Any]:
    parts = {field.name: getattr(value, field.name) for field in fields(value)}
    return {name: part if isinstance(part, str) else float(part) for name, part in parts.items()}


def _map(value: Any, *needed: str) -> dict[str, Any]:
    if type(value) is not dict or any(key not in value for key in needed):
        raise ValueError(f"not a map with {' '.join(needed)}")
    return value


def _frame(value: Any) -> Frame:
    kind = _map(value, "kind")["kind"]
    if kind == "enu":
        _map(value, "lat", "lon")
        return Enu(_float(value["lat"]), _float(value["lon"]), _float(value.get("alt", 0.0)))
    if kind == "ecef":
        return Ecef()
    if kind == "local":
        return Local(_TEXT(_map(value, "name")["name"]))
    raise ValueError("not a frame (kind enu, ecef or local)")


def _height(value: Any) -> Height:
    _map(value, "value", "sigma")
    return Height(_float(value["value"]), _float(value["sigma"]))


def _motion(value: Any) -> Motion:
    _map(value, "kind", "q")
    return Motion(_TEXT(value["kind"]), _float(value["q"]), _float(value.get("q_turn", 0.0)))


def _coverage(value: Any) -> Coverage:
    kind = _map(value, "kind")["kind"]
    if kind == "disk":
        return Disk(_float(_map(value, "radius")["radius"]), _float(value.get("inner", 0.0)))
    if kind == "sector":
        _map(value, "radius", "azimuth", "width")
        radius, azimuth, width = (_float(value[key]) for key in ("radius", "azimuth", "width"))
        return Sector(radius, azimuth, width, _float(value.get("inner", 0.0)))
    if kind == "polygon":
        return Polygon(_tuple_of(_row(_float, _float))(_map(value, "points")["points"]))
    raise ValueError("not a coverage (kind disk, sector or polygon)")


def _pack_coverage(value: Coverage) -> dict[str, Any]:
    if isinstance(value, Polygon):
        return {"kind": value.kind, "points": [[float(x), float(y)] for x, y in value.points]}
    return _pack_kind(value)


def _plain(key: str, unpack: Callable[[Any], Any], optional: bool = False, pack: Callable[[Any], Any] = _same) -> Field:
    return Field(key, key, pack, unpack, optional)


def _column(key: str, dtype: str, optional: bool = False, attribute: str = "") -> Field:
    kind = np.dtype(dtype)

    def pack(value: Any) -> bytes:
        return np.ascontiguousarray(value, dtype=kind).tobytes()

    def unpack(value: Any) -> Any:
        if type(value) is not bytes or len(value) % kind.itemsize:
            raise ValueError(f"not a bin of {dtype} numbers")
        return np.frombuffer(value, dtype=kind)

    return Field(key, attribute or key, pack, unpack, optional)


def _covariances(optional: bool = False, key: str = "covs", attribute: str = "covariances") -> Field:
    column = _column(key, "<f8")
    return Field(key, attribute, lambda value: column.pack(pack_lower(np.asarray(value))), column.unpack, optional)


def _entries(key: str) -> Field:
    row = _row(_TEXT, _U64, _U64, _U64, _TEXT, _U64)
    read = _tuple_of(lambda value: Entry(*row(value)))
    return _plain(key, read, pack=lambda value: [[e.source, e.epoch, e.seq, e.hash, e.reason, e.count] for e in value])


_NAMES = _tuple_of(_name)
_ANY_MAP = _map_of(_same)
_TEXTS = _tuple_of(_maybe(_TEXT))
_INTS = _map_of(_U64)
_FLOATS = _map_of(_float)

_HEADER = (
    _plain("source", _name),
    _plain("epoch", _U64),
    _plain("seq", _U64),
    _plain("sent", _TIME),
    _plain("origin", _origin),
    _plain("lineage", _NAMES, optional=True, pack=list),
)
_WHERE = (_plain("space", _space, pack=list), _plain("frame", _frame, pack=_pack_kind))
_HEIGHT = _plain("height", _height, optional=True, pack=_pack_plain)
_DENSITIES = (_column("means", "<f8"), _covariances())
_MIXED = (_column("counts", "<u2", optional=True), _column("weights", "<f8", optional=True))
_DECISION_COLUMNS = {
    "kind": "u1",
    "track": "<u8",
    "source": "<u2",
    "epoch": "<u8",
    "id": "<u8",
    "other": "<u8",
    "value": "<f8",
}

_FIELDS: dict[type[Message], tuple[Field, ...]] = {
    LocalTracks: (
        *_HEADER,
        _plain("time", _TIME),
        _plain("complete", _is(bool, "true or false")),
        *_WHERE,
        _HEIGHT,
        _column("ids", "<u8"),
        _column("existence", "<f8", optional=True),
        _column("updated", "<i8", optional=True),
        *_MIXED,
        *_DENSITIES,
        _plain("identity", _TEXTS, optional=True, pack=list),
        _plain("kind", _TEXTS, optional=True, pack=list),
        _column("kind_p", "<f8", optional=True),
    ),
    LocalIntensity: (
        *_HEADER,
        _plain("time", _TIME),
        *_WHERE,
        _HEIGHT,
        _column("weights", "<f8"),
        *_DENSITIES,
    ),
    SensorInfo: (
        *_HEADER,
        _plain("frame", _frame, pack=_pack_kind),
        _plain("position", _row(_float, _float, _float), pack=lambda xyz: [float(part) for part in xyz]),
        _covariances(optional=True, key="position_covariance", attribute="position_covariance"),
        _plain("period", _float, pack=float),
        _plain("motion", _motion, pack=_pack_plain),
        _plain("coverage", _coverage, optional=True, pack=_pack_coverage),
        _plain("detection_probability", _float, optional=True, pack=float),
        _plain("initiation_delay", _float, pack=float),
        _plain("may_start", _is(bool, "true or false")),
        _plain("correlation_group", _TEXT, optional=True),
    ),
    GlobalTracks: (
        *_HEADER,
        _plain("time", _TIME),
        _plain("step", _U64),
        _plain("rule", _TEXT),
        *_WHERE,
        _column("ids", "<u8"),
        _column("status", "u1"),
        _column("existence", "<f8"),
        *_MIXED,
        *_DENSITIES,
        _column("updated", "<i8"),
        _plain("sources", _NAMES, pack=list),
        _column("contributor_counts", "<u2"),
        _column("contributor_source", "<u2"),
        _column("contributor_epoch", "<u8"),
        _column("contributor_id", "<u8"),
        _column("contributor_influence", "<f8"),
        _plain("ended", _tuple_of(_row(_U64, _TEXT, _maybe(_U64))), pack=lambda rows: [list(row) for row in rows]),
        _plain("split_from", _tuple_of(_row(_U64, _U64)), pack=lambda rows: [list(row) for row in rows]),
    ),
    StepLog: (
        *_HEADER,
        _plain("step", _U64),
        _plain("time", _TIME),
        _plain("config_hash", _TEXT),
        _plain("version", _TEXT),
        _entries("taken"),
        _entries("refused"),
        _entries("dropped"),
        _plain("events", _tuple_of(_ANY_MAP), pack=list),
        _plain("sources", _NAMES, pack=list),
        *(_column(f"decision_{name}", dtype, attribute=name) for name, dtype in _DECISION_COLUMNS.items()),
    ),
    Status: (
        *_HEADER,
        _plain("time", _TIME),
        _plain("step", _U64),
        _plain("uptime", _float, pack=float),
        _plain("rates", _FLOATS, pack=_pack_floats),
        _plain("queue", _INTS),
        _plain("refused", _INTS),
        _plain("dropped", _INTS),
        _plain("sources", _map_of(_ANY_MAP)),
        _plain("tracks", _INTS),
        _plain("step_time", _FLOATS, pack=_pack_floats),
        _plain("memory", _U64, optional=True),
    ),
    Truth: (*_HEADER, _plain("time", _TIME), *_WHERE, _column("ids", "<u8"), _column("means", "<f8")),
}
_CLASSES: dict[str, type[Message]] = {kind.type: kind for kind in _FIELDS}


def encode(message: Message) -> bytes:
    """The MessagePack bytes of a message. `MessageError` if its parts do not fit together."""
    data = _pack(message)
    decode(data)
    return data


def digest(message: Message) -> int:
    """A 64-bit hash of the encoded message: the same for an exact repeat, whatever wrote it."""
    return int.from_bytes(hashlib.blake2b(_pack(message), digest_size=8).digest(), "little")


def _pack(message: Message) -> bytes:
    kind = type(message)
    if kind not in _FIELDS:
        raise MessageError("type", f"{kind.__name__} is not a message")
    out: dict[str, Any] = {"v": VERSION, "type": message.type}
    space = getattr(message, "space", None)
    for field in _FIELDS[kind]:
        holder = message.decisions if isinstance(message, StepLog) and field.key.startswith("decision_") else message
        value = getattr(holder, field.attribute)
        if value is None and field.optional:
            continue
        if space is not None and field.key in ("means", "covs") and np.shape(value)[-1:] != (len(space),):
            raise MessageError("length", f"{kind.type}.{field.attribute} does not end in {len(space)} components")
        try:
            out[field.key] = field.pack(value)
        except (ValueError, TypeError, AttributeError, OverflowError, IndexError) as error:
            raise MessageError("bad-field", f"{kind.type}.{field.attribute}: {error}") from None
    try:
        return cast(bytes, msgpack.packb(out))
    except (ValueError, TypeError, OverflowError) as error:
        raise MessageError("bad-field", f"{kind.type}: {error}") from None


def decode(data: bytes) -> Message:
    """The message in `data`. `MessageError` with a reason: too-large, not-msgpack, version, type, missing,
    bad-field, length. Arrays are read-only; keys that this version does not know are ignored."""
    if len(data) > MAX_BYTES:
        raise MessageError("too-large", f"{len(data)} bytes, more than {MAX_BYTES}")
    try:
        raw = msgpack.unpackb(data)
    except (ValueError, TypeError, RecursionError) as error:
        raise MessageError("not-msgpack", str(error) or type(error).__name__) from None
    if type(raw) is not dict:
        raise MessageError("not-msgpack", "not a map")
    if type(raw.get("v")) is not int or raw["v"] != VERSION:
        raise MessageError("version", f"version {raw.get('v')!r}, this is {VERSION}")
    name = raw.get("type")
    kind = _CLASSES.get(name) if isinstance(name, str) else None
    if kind is None:
        raise MessageError("type", f"unknown type {name!r}")
    values: dict[str, Any] = {}
    for field in _FIELDS[kind]:
        value = raw.get(field.key)
        slot = field.key if field.key.startswith("decision_") else field.attribute
        if value is None:
            if not field.optional:
                raise MessageError("missing", f"{name} without {field.key}")
            values[slot] = None
            continue
        try:
            values[slot] = field.unpack(value)
        except (ValueError, TypeError) as error:
            raise MessageError("bad-field", f"{name}.{field.key}: {error}") from None
    _SHAPE[kind](values)
    return kind(**values)


def _length(values: dict[str, Any], length: int, *names: str) -> None:
    for name in names:
        if values[name] is not None and len(values[name]) != length:
            raise MessageError("length", f"{name} has {len(values[name])} numbers where {length} belong")


def _shape_densities(values: dict[str, Any], components: int) -> None:
    n = len(values["space"])
    _length(values, components * n, "means")
    _length(values, components * n * (n + 1) // 2, "covariances")
    values["means"] = values["means"].reshape(components, n)
    values["covariances"] = unpack_lower(values["covariances"].reshape(components, n * (n + 1) // 2), n)


def _components(values: dict[str, Any], tracks: int) -> int:
    _length(values, tracks, "counts")
    counts, weights = values["counts"], values["weights"]
    if counts is None:
        _length(values, tracks, "weights")
        return tracks
    if weights is None:
        raise MessageError("missing", "counts without weights")
    if tracks and counts.min() == 0:
        raise MessageError("length", "a track without components")
    total = int(counts.sum(dtype=np.int64))
    _length(values, total, "weights")
    return total


def _shape_local(values: dict[str, Any]) -> None:
    tracks = len(values["ids"])
    if len(np.unique(values["ids"])) != tracks:
        raise MessageError("bad-field", "an id stands twice")
    _length(values, tracks, "existence", "updated", "identity", "kind", "kind_p")
    _shape_densities(values, _components(values, tracks))


def _shape_intensity(values: dict[str, Any]) -> None:
    _shape_densities(values, len(values["weights"]))


def _shape_info(values: dict[str, Any]) -> None:
    if values["position_covariance"] is not None:
        _length(values, 6, "position_covariance")
        values["position_covariance"] = unpack_lower(values["position_covariance"], 3)


def _shape_global(values: dict[str, Any]) -> None:
    tracks = len(values["ids"])
    _length(values, tracks, "status", "existence", "updated", "contributor_counts")
    contributions = int(values["contributor_counts"].sum(dtype=np.int64))
    parts = ("source", "epoch", "id", "influence")
    _length(values, contributions, *(f"contributor_{part}" for part in parts))
    if contributions and values["contributor_source"].max() >= len(values["sources"]):
        raise MessageError("bad-field", "contributor_source beyond sources")
    if tracks and values["status"].max() >= len(STATUSES):
        raise MessageError("bad-field", f"status beyond {len(STATUSES) - 1}")
    _shape_densities(values, _components(values, tracks))


def _shape_log(values: dict[str, Any]) -> None:
    columns = {name: values.pop(f"decision_{name}") for name in _DECISION_COLUMNS}
    _length(columns, len(columns["kind"]), *columns)
    if len(columns["kind"]) and columns["kind"].max() >= len(DECISIONS):
        raise MessageError("bad-field", f"decision_kind beyond {len(DECISIONS) - 1}")
    values["decisions"] = Decisions(**columns)


def _shape_truth(values: dict[str, Any]) -> None:
    tracks, n = len(values["ids"]), len(values["space"])
    _length(values, tracks * n, "means")
    values["means"] = values["means"].reshape(tracks, n)


_SHAPE: dict[type[Message], Callable[[dict[str, Any]], None]] = {
    LocalTracks: _shape_local,
    LocalIntensity: _shape_intensity,
    SensorInfo: _shape_info,
    GlobalTracks: _shape_global,
    StepLog: _shape_log,
    Status: lambda values: None,
    Truth: _shape_truth,
}
