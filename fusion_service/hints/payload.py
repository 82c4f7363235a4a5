"""What is wrong with bytes that are no message: which field, which value, and how it is mended."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import msgpack

from fusion_service.hints.finding import Finding, cut
from fusion_service.hints.times import unit_of_time
from fusion_service.hints.words import component_hint, did_you_mean, near
from schemas import COMPONENTS, MOTIONS, ORIGINS, REFERENCES, SHAPES, MessageError
from schemas.codec import MAX_ITEMS, MAX_KEYS
from schemas.tables import CLASSES, FIELDS

__all__ = ["raw_map", "read_finding"]

FIELD = re.compile(r"(?:\w+\.)?(\w+): ")
TIMES = ("time", "sent", "epoch", "revised")
SIZES = {"ids": 8, "means": 8, "covs": 8, "weights": 8, "existence": 8, "updated": 8, "counts": 2}
WORDS: dict[str, tuple[str, ...]] = {"origin": ORIGINS, "shape": SHAPES, "reference": REFERENCES}
KINDS: dict[str, tuple[str, ...]] = {
    "frame": ("enu", "ecef", "local"),
    "coverage": ("disk", "sector", "polygon"),
    "motion": tuple(MOTIONS),
}
ANGLES = {"azimuth": 2 * math.pi, "width": 2 * math.pi, "heading": 2 * math.pi, "heading_sigma": math.pi}
"""Angle -> the largest that it may be, rad."""
LONGER = {
    "covariances": "covs",
    "position_covariances": "position_covariance",
    "reference_covariances": "reference_covs",
}


def raw_map(data: bytes) -> dict[Any, Any]:
    """The MessagePack map in `data`, whatever is in it; empty where there is none, or it is too large to be read."""
    if len(data) > 2**20:
        return {}
    try:
        raw = msgpack.unpackb(
            data, max_array_len=min(len(data), MAX_ITEMS), max_map_len=min(len(data), MAX_KEYS), strict_map_key=False
        )
    except (ValueError, TypeError, RecursionError, MemoryError):
        return {}
    return raw if type(raw) is dict else {}


def read_finding(data: bytes, error: ValueError, now: int) -> Finding:
    """Why `data`, that came at `now`, ns, cannot be read, where `decode` says `error`. Never raises."""
    reason = error.reason if isinstance(error, MessageError) else "bad-field"
    detail = str(error).removeprefix(f"{reason}: ")[:200]
    raw = raw_map(data)
    if reason == "too-large":
        return Finding(
            reason, "", f"{len(data)} bytes", f"it is too large: {detail}: send it in parts, complete = false"
        )
    if reason == "not-msgpack":
        return Finding(reason, "", cut(data), _not_msgpack(data, detail))
    if reason == "version":
        had = cut(raw.get("v", "nothing"))
        return Finding(reason, "v", had, f"its `v` is {had}: write the whole number 1")
    if reason == "type":
        had = cut(raw.get("type", "nothing"))
        meant = did_you_mean(raw.get("type"), CLASSES) or f": it is one of {', '.join(CLASSES)}"
        return Finding(reason, "type", had, f'its `type` is "{had}"{meant}')
    if reason == "missing":
        return _missing(raw, detail)
    if reason == "length":
        return _length(raw, detail)
    match = FIELD.match(detail)
    field = LONGER.get(match[1], match[1]) if match else ""
    value: Any = raw.get(field)
    said = _field(field, value, detail.removeprefix(match[0]) if match else detail, now)
    return Finding(reason, field, "" if value is None else cut(value), f"`{field}`: {said}" if field else said)


def _not_msgpack(data: bytes, detail: str) -> str:
    start = data[:64].lstrip()
    if not data:
        return "its payload is empty: send a MessagePack map"
    if start[:1] in (b"{", b"["):
        return "its payload is JSON: send MessagePack, with columns as bytes (WIRE.md, The bytes)"
    if start[:2] == b"\x1f\x8b":
        return "its payload is compressed by gzip: send MessagePack as it is"
    if start[:1] == b"<":
        return "its payload is XML: send MessagePack (WIRE.md, The bytes)"
    if data[0] & 0xF0 == 0x80 or data[0] in (0xDE, 0xDF):
        return f"its payload begins as a map and is not one whole ({detail}): is it cut, or is something behind it?"
    return f"its payload is no MessagePack map ({detail}): send one map of texts to values (WIRE.md, The bytes)"


def _missing(raw: Mapping[Any, Any], detail: str) -> Finding:
    field = detail.rpartition(" ")[2]
    kind = CLASSES.get(raw["type"]) if isinstance(raw.get("type"), str) else None
    known = {one.key for one in FIELDS[kind]} if kind else set()
    odd = [key for key in raw if isinstance(key, str) and key not in known and key not in ("v", "type")]
    other = near(field, odd) or next((key for key in odd if key in LONGER and LONGER[key] == field), "")
    said = f'it has no `{field}`: is it what it calls "{cut(other)}"?' if other else f"it has no `{field}`: add it"
    if field == "weights":
        said = "it has `counts` without `weights`: send the weight of each component"
    return Finding("missing", field, "", f"{said} (WIRE.md, {raw.get('type', 'Messages')})"[:300])


def _length(raw: Mapping[Any, Any], detail: str) -> Finding:
    """A column that is too long or too short: as of whole matrices, of variances alone, or of smaller numbers."""
    field = LONGER.get(detail.partition(" ")[0], detail.partition(" ")[0])
    found = re.search(r"has (\d+) numbers where (\d+) belong", detail)
    column, space = raw.get(field), raw.get("space")
    if not found or not isinstance(column, bytes) or not isinstance(space, list):
        return Finding("length", field, "", f"{detail}: see WIRE.md for how the lengths follow from each other")
    has, belong, n = int(found[1]), int(found[2]), max(len(space), 1)
    if field == "covs":
        each = belong * 2 / (n * (n + 1))
        triangles = f"send lower triangles, row by row, {n * (n + 1) // 2} numbers each"
        if has == each * n * n:
            said = f"`covs` has whole {n} x {n} matrices: {triangles}"
            return Finding("length", field, f"{has} numbers", said)
        if has == each * n:
            said = f"`covs` has the variances alone: {triangles}"
            return Finding("length", field, f"{has} numbers", said)
    if belong and 2 * has == belong and field in SIZES:
        said = (
            f"`{field}` has half the numbers that belong there ({has}, not {belong}): are they 32 bits? columns are f64"
        )
        return Finding("length", field, f"{has} numbers", said)
    more = ""
    if field == "means" and isinstance(raw.get("ids"), bytes):
        more = f" ({len(raw['ids']) // 8} ids, {n} components: are ids u64 and means f64?)"
    return Finding("length", field, f"{has} numbers", f"`{field}` has {has} numbers where {belong} belong{more}")


def _field(field: str, value: Any, detail: str, now: int) -> str:
    """What is wrong with one field, and how it is mended."""
    if field in TIMES:
        return _time(value, detail, now)
    if field in SIZES and isinstance(value, (list, tuple)):
        return "it is a list: columns are bytes, little-endian numbers one after another (numpy: .tobytes())"
    if field in SIZES and isinstance(value, str):
        return "it is a text: columns are MessagePack bin (numpy: .tobytes(), packed with use_bin_type)"
    if field in SIZES and "multiple of" in detail:
        return (
            f"{cut(value)} are no whole count of numbers of {8 * SIZES[field]} bits: is the type of the column right?"
        )
    if field == "ids" and "twice" in detail:
        return "one id stands twice: each track of a message has an id of its own"
    if field == "space":
        return _space(value, detail)
    if field in KINDS or field == "platform":
        return _map(field, value, detail)
    if field in WORDS:
        return f"{detail}{did_you_mean(value, WORDS[field])}"
    if field in ANGLES and _is_degrees(value, ANGLES[field]):
        return _degrees(field, value)
    if isinstance(value, (int, float)) and 1.0 < value <= 100.0 and "from 0 to 1" in detail:
        return f"it is {cut(value)}: is it in percent? it must be from 0 to 1"
    if detail == "not true or false" and value in (0, 1):
        return f"it is the number {cut(value)}: send the MessagePack bool"
    return f"it is {cut(value)}: {detail}" if value is not None else detail


def _time(value: Any, detail: str, now: int) -> str:
    if type(value) is float:
        unit = unit_of_time(value, now) or "ns, as a float" if math.isfinite(value) else ""
        asked = f"is it in {unit}? " if unit else ""
        return f"it is the float {cut(value)}: {asked}it must be a whole number of ns since 1970 UTC"
    if type(value) is str:
        return f'it is the text "{cut(value)}": it must be a whole number of ns since 1970 UTC'
    return f"it is {cut(value)}: {detail}: it must be ns since 1970 UTC"


def _space(value: Any, detail: str) -> str:
    if isinstance(value, str):
        return f'it is the text "{cut(value)}": it must be a list of texts, as in ["x", "y", "vx", "vy"]'
    if not isinstance(value, list):
        return f"it is {cut(value)}: it must be a list of texts"
    unknown = next((one for one in value[:20] if not isinstance(one, str) or one not in COMPONENTS), None)
    if unknown is None:
        return detail
    return f'unknown component "{cut(unknown)}": {component_hint(unknown) or "known are " + " ".join(COMPONENTS)}'


def _map(field: str, value: Any, detail: str) -> str:
    """A frame, coverage, motion or platform."""
    if not isinstance(value, dict):
        like = f' as in {{"kind": "{KINDS[field][0]}", ...}}' if field in KINDS else ""
        return f"it is {cut(value)}: it must be a map,{like}" if like else f"it is {cut(value)}: it must be a map"
    kind = value.get("kind")
    if field in KINDS and kind not in KINDS[field]:
        meant = did_you_mean(kind, KINDS[field]) or f": known are {', '.join(KINDS[field])}"
        return f'unknown kind "{cut(kind)}"{meant}'
    lat, lon = value.get("lat"), value.get("lon")
    if isinstance(lat, (int, float)) and isinstance(lon, (int, float)) and abs(lat) > 90.0 >= abs(lon):
        return f"lat is {lat:g} and lon {lon:g}: are they swapped? lat is from -90 to 90 degrees"
    for name, most in ANGLES.items():
        if _is_degrees(value.get(name), most):
            return _degrees(name, value[name])
    return detail


def _is_degrees(value: Any, most: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and most < abs(value) <= 360.0


def _degrees(name: str, value: float) -> str:
    return f"{name} is {value:g}: is it in degrees? angles are in rad ({math.radians(value):.4g})"
