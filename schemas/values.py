"""How one value of a message is written as MessagePack and read back.

Every reader takes what MessagePack gave and returns the value, or raises ValueError or TypeError. What comes
with every message of a source (names, space, frame) is remembered, so that it is checked once; only values
that passed are, and those are small.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from schemas.keys import check_name, check_source
from schemas.messages import ORIGINS, Entry, Floats
from schemas.spaces import (
    MOTIONS,
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

__all__ = [
    "Convert",
    "check_symmetric",
    "coverage",
    "free_map",
    "pack_column",
    "pack_covariances",
    "pack_lower",
    "unpack_lower",
]

Convert: TypeAlias = Callable[[Any], Any]

MAX_DEPTH = 4
"""How deep lists and maps may lie in each other inside a free value (`events`, the `sources` of a status)."""


@lru_cache(maxsize=64)
def _lower(n: int) -> NDArray[np.intp]:
    rows, columns = np.tril_indices(n)
    return rows * n + columns


@lru_cache(maxsize=64)
def _full(n: int) -> NDArray[np.intp]:
    index = np.empty((n, n), dtype=np.intp)
    rows, columns = np.tril_indices(n)
    index[rows, columns] = index[columns, rows] = np.arange(len(rows))
    return index


def pack_lower(matrices: Floats) -> Floats:
    """Lower triangles of (..., n, n), row by row: (..., n(n+1)/2)."""
    n = matrices.shape[-1]
    return matrices.reshape(*matrices.shape[:-2], n * n).take(_lower(n), axis=-1, mode="clip")


def unpack_lower(packed: Floats, n: int) -> Floats:
    """The symmetric (..., n, n) of packed lower triangles (..., n(n+1)/2)."""
    return packed.take(_full(n), axis=-1, mode="clip")


def exactly(kind: type, name: str) -> Convert:
    def read(value: Any) -> Any:
        if type(value) is not kind:
            raise ValueError(f"not {name}")
        return value

    return read


def whole(low: int, high: int) -> Convert:
    def read(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"not a whole number from {low} to {high}")
        return value

    return read


u64 = whole(0, 2**64 - 1)
nanoseconds = whole(0, 2**63 - 1)
text = exactly(str, "a text")
boolean = exactly(bool, "true or false")
name = lru_cache(maxsize=4096)(check_name)
source = lru_cache(maxsize=4096)(check_source)


def number(value: Any) -> float:
    if type(value) is int:
        return float(value)
    if type(value) is not float:
        raise ValueError("not a number")
    return value


def within(low: float, high: float) -> Convert:
    def read(value: Any) -> float:
        real = number(value)
        if not low <= real <= high:
            raise ValueError(f"{real} is not from {low:g} to {high:g}")
        return real

    return read


def maybe(read: Convert) -> Convert:
    return lambda value: None if value is None else read(value)


def list_of(read: Convert) -> Convert:
    def read_all(value: Any) -> tuple[Any, ...]:
        if type(value) is not list:
            raise ValueError("not a list")
        return tuple([read(item) for item in value])

    return read_all


def row(*reads: Convert) -> Convert:
    def read_row(value: Any) -> tuple[Any, ...]:
        if type(value) is not list or len(value) != len(reads):
            raise ValueError(f"not a list of {len(reads)}")
        return tuple([read(item) for read, item in zip(reads, value, strict=True)])

    return read_row


def map_of(read: Convert) -> Convert:
    def read_map(value: Any) -> dict[str, Any]:
        if type(value) is not dict:
            raise ValueError("not a map")
        return {text(key): read(item) for key, item in value.items()}

    return read_map


def free(value: Any, depth: int = 0) -> Any:
    """nil, true, false, an integer, a float, a text, bytes, or lists and maps of these up to `MAX_DEPTH`."""
    kind = type(value)
    if kind in (type(None), bool, int, float, str, bytes):
        return value
    if kind not in (list, dict) or depth == MAX_DEPTH:
        raise ValueError(f"not a plain value (numbers, texts, bytes, lists and maps, {MAX_DEPTH} deep)")
    read = partial(free, depth=depth + 1)
    return [read(item) for item in value] if kind is list else map_of(read)(value)


free_map = map_of(partial(free, depth=1))


def one_of(words: tuple[str, ...]) -> Convert:
    def read(value: Any) -> str:
        if value not in words:
            raise ValueError(f"not one of {' '.join(words)}")
        return cast(str, value)

    return read


origin = one_of(ORIGINS)


_check_space = lru_cache(maxsize=256)(check_space)


def space(value: Any) -> tuple[str, ...]:
    if type(value) is not list:
        raise ValueError("not a list")
    return _check_space(tuple(value))


def entry(value: Any) -> Entry:
    return Entry(*_ENTRY(value))


_ENTRY = row(text, u64, u64, u64, text, u64)


def pack_entries(value: tuple[Entry, ...]) -> list[list[Any]]:
    return [[e.source, e.epoch, e.seq, e.hash, e.reason, e.count] for e in value]


def pack_rows(value: Any) -> list[list[Any]]:
    return [list(item) for item in value]


def pack_floats(value: dict[str, float]) -> dict[str, float]:
    return {key: float(item) for key, item in value.items()}


def pack_parts(value: Any) -> dict[str, Any]:
    """The attributes of a `Height` or `Disk`, say, as a map."""
    parts = ((key, getattr(value, key)) for key in value.__slots__)
    return {key: part if isinstance(part, str) else float(part) for key, part in parts}


def pack_motion(value: Any) -> dict[str, Any]:
    """A motion as its kind and the numbers that it takes."""
    return {"kind": value.kind, **{name: float(getattr(value, name)) for name in MOTIONS[value.kind]}}


def pack_kind(value: Any) -> dict[str, Any]:
    """A frame or coverage as a map that begins with its kind."""
    if type(value) is Enu:
        return {"kind": "enu", "lat": float(value.lat), "lon": float(value.lon), "alt": float(value.alt)}
    if isinstance(value, Polygon):
        return {"kind": value.kind, "points": [[float(x), float(y)] for x, y in value.points]}
    return {"kind": value.kind, **pack_parts(value)}


def _parts(value: Any, *keys: str, **defaults: float) -> list[float]:
    """Numbers of the map `value`: those that must be there, then those with a default."""
    parts = [number(value.get(key)) for key in keys]
    given = ((value.get(key), default) for key, default in defaults.items())
    return parts + [default if part is None else number(part) for part, default in given]


def _map(value: Any) -> dict[str, Any]:
    if type(value) is not dict:
        raise ValueError("not a map")
    return value


_DOUBLES = struct.Struct("<3d")


@lru_cache(maxsize=1024)
def _enu(origin: bytes) -> Enu:
    return Enu(*_DOUBLES.unpack(origin))


def frame(value: Any) -> Frame:
    kind = _map(value).get("kind")
    if kind == "enu":
        lat, lon, alt = value.get("lat"), value.get("lon"), value.get("alt")
        return _enu(_DOUBLES.pack(number(lat), number(lon), 0.0 if alt is None else number(alt)))
    if kind == "ecef":
        return Ecef()
    if kind == "local":
        return Local(text(value.get("name")))
    raise ValueError("not a frame (kind enu, ecef or local)")


def height(value: Any) -> Height:
    return Height(*_parts(_map(value), "value", "sigma"))


def motion(value: Any) -> Motion:
    kind = text(_map(value).get("kind"))
    given = {name: value.get(name) for name in MOTIONS.get(kind, ())}
    return Motion(kind, **{name: number(one) for name, one in given.items() if one is not None})


def coverage(value: Any) -> Coverage:
    kind = _map(value).get("kind")
    if kind == "disk":
        return Disk(*_parts(value, "radius", inner=0.0))
    if kind == "sector":
        return Sector(*_parts(value, "radius", "azimuth", "width", inner=0.0))
    if kind == "polygon":
        return Polygon(_POINTS(value.get("points")))
    raise ValueError("not a coverage (kind disk, sector or polygon)")


_POINTS = list_of(row(number, number))


def pack_column(kind: np.dtype[Any], ndim: int, value: Any) -> bytes:
    """Little-endian numbers in C order; ValueError when a number does not fit the column's type."""
    given = np.asarray(value)
    if given.ndim != ndim:
        raise ValueError(f"an array of {given.ndim} dimensions where {ndim} belong")
    if given.dtype == kind:
        return given.tobytes()
    with np.errstate(all="ignore"):
        written = given.astype(kind)
    if not np.array_equal(written, given, equal_nan=kind.kind == "f"):
        raise ValueError(f"numbers that do not fit {kind.str}")
    return written.tobytes()


def pack_covariances(ndim: int, value: Any) -> bytes:
    matrices = np.asarray(value)
    if matrices.ndim != ndim or matrices.shape[-1] != matrices.shape[-2]:
        raise ValueError(f"shape {matrices.shape} is not that of square matrices")
    return pack_column(_DOUBLE, ndim - 1, pack_lower(matrices))


_DOUBLE = np.dtype("<f8")


def check_symmetric(value: Any) -> None:
    """ValueError when a matrix differs from its transpose by more than rounding (1e-9 of the deviations' product)."""
    matrices = np.asarray(value, dtype=np.float64)
    if np.array_equal(matrices, matrices.swapaxes(-1, -2), equal_nan=True):
        return
    transposed = matrices.swapaxes(-1, -2)
    with np.errstate(all="ignore"):
        deviations = np.sqrt(np.maximum(np.einsum("...ii->...i", matrices), 0.0))
        tolerance = 1e-9 * deviations[..., :, None] * deviations[..., None, :]
        same = (np.abs(matrices - transposed) <= tolerance) | (matrices == transposed)
    same |= np.isnan(matrices) & np.isnan(transposed)
    if not same.all():
        raise ValueError("not symmetric")
