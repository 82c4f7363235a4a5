"""MessagePack codec of wire format version 1 (WIRE.md).

`encode` writes the same bytes for the same message (keys in the order of the tables, optional fields left out
when None), so that `encode(decode(data)) == data` for what `encode` wrote, and `digest` names a message
whatever wrote it. `decode` checks structure: types, lengths, names, ranges; the numbers of densities are
checked for many messages at once by `schemas.check_numbers`.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields
from typing import Any, cast

import msgpack

from schemas.errors import MessageError
from schemas.messages import Message
from schemas.structure import SHAPE
from schemas.tables import CLASSES, FIELDS
from schemas.values import check_symmetric

__all__ = ["MAX_BYTES", "MAX_ITEMS", "MAX_KEYS", "MAX_NAMES", "VERSION", "decode", "digest", "encode"]

VERSION = 1
MAX_BYTES = 16 * 2**20
"""A payload above this size is refused before it is read."""
MAX_ITEMS = 2**16
"""A list with more items is refused: lists in lists that each announce millions cost far more than their bytes."""
MAX_KEYS = 256
"""A map with more keys is refused, but for those of a status or a log, which may name more sources:"""
MAX_NAMES = 8192
NAMING = ("status", "step_log")

_SLOTS = {kind: [(field.name, getattr(kind, field.name).__set__) for field in fields(kind)] for kind in FIELDS}
"""The attributes of each message, set one by one in `decode`: half the time of a frozen dataclass's own `__init__`."""


def encode(message: Message, *, sound: bool = False) -> bytes:
    """The MessagePack bytes of a message. `MessageError` if its parts do not fit together, a number does not
    fit its column, or a covariance is not symmetric. sound: its parts were made to fit together, so that this is
    checked only of a message so large that no reader may take it."""
    data = _pack(message)
    if sound and (len(data) < MAX_ITEMS or _is_readable(message, len(data))):
        return data
    for name in ("covariances", "position_covariance", "reference_covariances"):
        matrices = getattr(message, name, None)
        if matrices is not None:
            try:
                check_symmetric(matrices)
            except ValueError as error:
                raise MessageError("bad-field", f"{message.type}.{name}: {error}") from None
    decode(data)
    return data


def _is_readable(message: Message, size: int) -> bool:
    """Whether a message of so many bytes, whose parts fit together, is within what `decode` takes: surely, for that is
    looked at from outside. What a log tells of events holds lists of its own."""
    values = [getattr(message, slot) for slot, _ in _SLOTS[type(message)]]
    listed = [value for value in values if isinstance(value, (tuple, list, dict))]
    told = getattr(message, "events", ()) or any(isinstance(value, dict) for value in listed)
    return size <= MAX_BYTES and not told and all(len(value) <= MAX_ITEMS for value in listed)


def digest(message: Message) -> int:
    """A 64-bit hash of the message (the first 8 bytes of SHA-256 over what `encode` writes, little-endian): the
    same for an exact repeat, whatever wrote it."""
    return int.from_bytes(hashlib.sha256(_pack(message)).digest()[:8], "little")


def _pack(message: Message) -> bytes:
    kind = type(message)
    table = FIELDS.get(kind)
    if table is None:
        raise MessageError("type", f"{kind.__name__} is not a message")
    out: dict[str, Any] = {"v": VERSION, "type": kind.type}
    key = ""
    try:
        for key, _, get, pack, _, optional in table:
            value = get(message)
            if value is not None or not optional:
                out[key] = value if pack is None else pack(value)
                if key == "means" and value.shape[1] != len(out["space"]):
                    raise ValueError(f"not {len(out['space'])} components each")
        try:
            return cast(bytes, msgpack.packb(out))
        except (ValueError, TypeError, OverflowError):
            for key in out:
                msgpack.packb(out[key])
            raise
    except (ValueError, TypeError, AttributeError, OverflowError, IndexError) as error:
        raise MessageError("bad-field", f"{kind.type}.{key}: {error}") from None


def _unpacked(data: bytes, keys: int) -> Any:
    """What MessagePack makes of `data`, where no map in it has more than so many keys: those of a message that may name
    many sources, `MAX_NAMES`."""
    try:
        return msgpack.unpackb(data, max_array_len=min(len(data), MAX_ITEMS), max_map_len=min(len(data), keys))
    except ValueError:
        if keys >= MAX_NAMES or _type_of(data) not in NAMING:
            raise
        return _unpacked(data, MAX_NAMES)


def _type_of(data: bytes) -> Any:
    """The `type` that a message says, of the first `MAX_KEYS` keys; the values are passed over."""
    unpacker = msgpack.Unpacker(max_buffer_size=max(len(data), 1))
    unpacker.feed(data)
    try:
        for _ in range(min(unpacker.read_map_header(), MAX_KEYS)):
            if unpacker.unpack() == "type":
                return unpacker.unpack()
            unpacker.skip()
    except (ValueError, TypeError, msgpack.exceptions.UnpackException, RecursionError):
        pass
    return None


def decode(data: bytes) -> Message:
    """The message in `data`. `MessageError` with one of `schemas.REASONS`. Arrays are read-only; keys that
    this version does not know are ignored."""
    if len(data) > MAX_BYTES:
        raise MessageError("too-large", f"{len(data)} bytes, more than {MAX_BYTES}")
    try:
        raw = _unpacked(data, MAX_KEYS)
    except (ValueError, TypeError, RecursionError, MemoryError) as error:
        raise MessageError("not-msgpack", str(error) or type(error).__name__) from None
    if type(raw) is not dict:
        raise MessageError("not-msgpack", "not a map")
    version = raw.get("v")
    if type(version) is not int or version != VERSION:
        raise MessageError("version", f"version {version if type(version) is int else '?'}, this is {VERSION}")
    name = raw.get("type")
    kind = CLASSES.get(name) if type(name) is str else None
    if kind is None:
        raise MessageError("type", f"unknown type {name if type(name) is str else '?'}")
    values: dict[str, Any] = {}
    read = raw.get
    key = ""
    try:
        for key, slot, _, _, unpack, optional in FIELDS[kind]:
            value = read(key)
            if value is not None:
                values[slot] = unpack(value)
            elif optional:
                values[slot] = None
            else:
                raise MessageError("missing", f"{name} without {key}")
    except MessageError:
        raise
    except (ValueError, TypeError) as error:
        raise MessageError("bad-field", f"{name}.{key}: {error}") from None
    SHAPE[kind](values)
    message = object.__new__(kind)
    for slot, put in _SLOTS[kind]:
        put(message, values[slot])
    return message
