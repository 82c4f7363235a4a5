"""Whatever the bytes, `decode` gives a message or a `MessageError` with a known reason, at a proportional cost."""

from __future__ import annotations

import gc
import json
import struct
import sys
import time
import tracemalloc
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import schemas
from schemas.codec import MAX_ITEMS
from tests.schemas.golden import GOLDEN, changed
from tests.schemas.make_vectors import VECTORS, message_forms, page

PAGE = page()
ONE_OF_EACH = (
    "local_tracks_full",
    "local_tracks_mixture",
    "local_intensity",
    "sensor_info_disk",
    "sensor_info_sector",
    "sensor_info_polygon",
    "global_tracks",
    "global_tracks_identified",
    "step_log",
    "status",
    "truth",
)
EXT = msgpack.ExtType(5, b"abc")
STRANGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    2**64 - 1,
    1.5,
    float("nan"),
    float("inf"),
    "",
    "x" * 1000,
    "\x00*/",
    b"",
    b"123",
    bytes(8),
    [],
    [None],
    [[[]]],
    {},
    {"kind": "nothing"},
    {"kind": []},
    {b"bytes": 1},
    EXT,
    [EXT],
    {"kind": EXT},
    msgpack.Timestamp(1, 2),
)


def reason(data: bytes) -> str:
    """Why `data` is refused, "" if it is read; anything but a message or a `MessageError` fails."""
    try:
        message = schemas.decode(data)
    except schemas.MessageError as error:
        refusal = error
    else:
        return _use(message)
    assert refusal.reason in schemas.REASONS
    assert str(refusal).startswith(refusal.reason + ": ")
    assert len(str(refusal)) < 400
    return refusal.reason


def _use(message: schemas.Message) -> str:
    schemas.digest(message)
    if isinstance(message, (schemas.LocalTracks, schemas.LocalIntensity, schemas.GlobalTracks)):
        schemas.check_numbers([message])
    assert schemas.digest(schemas.decode(schemas.encode(message))) == schemas.digest(message)
    return ""


def without(name: str, key: str) -> bytes:
    raw = msgpack.unpackb(GOLDEN[name])
    del raw[key]
    return bytes(msgpack.packb(raw))


def test_reasons_are_these() -> None:
    assert set(schemas.REASONS) == {"too-large", "not-msgpack", "version", "type", "missing", "bad-field", "length"}
    assert issubclass(schemas.MessageError, ValueError)


@pytest.mark.parametrize("name", GOLDEN)
def test_truncated_at_every_byte(name: str) -> None:
    data = GOLDEN[name]
    assert {reason(data[:length]) for length in range(len(data))} == {"not-msgpack"}
    assert reason(data + b"\xc0") == "not-msgpack"


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_every_field_missing_or_strange(name: str) -> None:
    kind = json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))["type"]
    for key, form in message_forms(kind, PAGE).items():
        if key in ("v", "type"):
            continue
        present = key in msgpack.unpackb(GOLDEN[name])
        if present and not form.optional:
            assert reason(without(name, key)) == "missing", key
        for value in STRANGE:
            found = reason(changed(name, **{key: value}))
            if value is None:
                assert found in (("", "missing", "length") if form.optional else ("missing",)), key
            elif form.letter:
                wrong = type(value) is not bytes or len(value) % struct.calcsize("<" + form.letter)
                assert found in (("bad-field",) if wrong else ("length", "bad-field", "missing", "")), (key, value)
            else:
                assert found in ("bad-field", "length", ""), (key, value)


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_no_extension_type_anywhere(name: str) -> None:
    """A value of an extension type put in place of any value, however deep, is refused."""

    def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        inner: list[Any] = list(value.items()) if isinstance(value, dict) else []
        inner = list(enumerate(value)) if isinstance(value, list) else inner
        return [path] * bool(path) + [found for key, item in inner for found in places(item, (*path, key))]

    paths = places(msgpack.unpackb(GOLDEN[name]))
    assert len(paths) >= 8
    for path in paths:
        raw = msgpack.unpackb(GOLDEN[name])
        at = raw
        for step in path[:-1]:
            at = at[step]
        for strange in (EXT, msgpack.Timestamp(1, 2)):
            at[path[-1]] = strange
            assert reason(msgpack.packb(raw)) in ("bad-field", "version", "type"), path


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "not-msgpack"),
        (b"\xc1", "not-msgpack"),
        (msgpack.packb([1, 2]), "not-msgpack"),
        (msgpack.packb(None), "not-msgpack"),
        (msgpack.packb({1: 2}), "not-msgpack"),
        (msgpack.packb({}), "version"),
        (msgpack.packb({"v": 2, "type": "local_tracks"}), "version"),
        (msgpack.packb({"v": True, "type": "local_tracks"}), "version"),
        (msgpack.packb({"v": 1.0, "type": "local_tracks"}), "version"),
        (msgpack.packb({"v": "1", "type": "local_tracks"}), "version"),
        (msgpack.packb({"v": 1}), "type"),
        (msgpack.packb({"v": 1, "type": "nonsense"}), "type"),
        (msgpack.packb({"v": 1, "type": ["local_tracks"]}), "type"),
        (msgpack.packb({"v": 1, "type": "local_tracks"}), "missing"),
        (b"\x82\xa1v\x01\xa4type\xa3\xff\xfe\xfd", "not-msgpack"),
        (b"\x81" * 3000, "not-msgpack"),
        (b"\x91" * 3000, "not-msgpack"),
        (b"\xdf\xff\xff\xff\xff\xa1v\x01", "not-msgpack"),
        (b"\x82\xa1v\x01\xa4type\xdd\xff\xff\xff\xff", "not-msgpack"),
        (b"\x82\xa1v\x01\xa4type\xdb\xff\xff\xff\xff", "not-msgpack"),
        (b"\x82\xa1v\x01\xa4type\xc6\xff\xff\xff\xff", "not-msgpack"),
        (b"\x82\xa1v\x01\xa4type\xc9\xff\xff\xff\xff\x01", "not-msgpack"),
        (bytes(schemas.MAX_BYTES + 1), "too-large"),
    ],
)
def test_bytes_that_are_no_message(data: bytes, expected: str) -> None:
    assert reason(data) == expected


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("local_tracks_full", {"ids": bytes(24)}, "bad-field"),
        ("local_tracks_full", {"ids": bytes(8)}, "length"),
        ("local_tracks_full", {"ids": bytes(8 * 100_000)}, "bad-field"),
        ("local_tracks_full", {"existence": doubles(0.5)}, "length"),
        ("local_tracks_full", {"updated": bytes(32)}, "length"),
        ("local_tracks_full", {"kind": ["ship"]}, "length"),
        ("local_tracks_full", {"identity": [1, 2, 3]}, "bad-field"),
        ("local_tracks_full", {"covs": doubles(*range(29))}, "length"),
        ("local_tracks_full", {"means": doubles(*range(13))}, "length"),
        ("local_tracks_full", {"space": ["x", "y"]}, "length"),
        ("local_tracks_full", {"space": ["x", "vx", "y", "x"]}, "bad-field"),
        ("local_tracks_full", {"space": ["x", "vx", "y", "speed"]}, "bad-field"),
        ("local_tracks_full", {"space": ["vx", "vy", "ax", "ay"]}, "bad-field"),
        ("local_tracks_full", {"space": "xy"}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "ecef"}}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "enu", "lat": 91.0, "lon": 0.0}}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "enu", "lat": float("nan"), "lon": 0.0}}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "enu", "lat": 1.0}}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "enu", "lat": True, "lon": 0.0}}, "bad-field"),
        ("local_tracks_full", {"frame": {"kind": "local", "name": ""}}, "bad-field"),
        ("local_tracks_full", {"height": {"value": 0.0, "sigma": -1.0}}, "bad-field"),
        ("local_tracks_full", {"counts": struct.pack("<3H", 1, 1, 1)}, "missing"),
        ("local_tracks_full", {"weights": doubles(1.0, 1.0)}, "length"),
        ("local_tracks_mixture", {"counts": struct.pack("<3H", 65535, 65535, 65535)}, "length"),
        ("local_tracks_mixture", {"counts": struct.pack("<3H", 65535, 4, 3)}, "length"),
        ("local_tracks_mixture", {"counts": struct.pack("<3H", 0, 3, 3)}, "bad-field"),
        ("local_tracks_small", {"lineage": ["a"] * MAX_ITEMS}, ""),
        ("local_tracks_small", {"lineage": ["a"] * (MAX_ITEMS + 1)}, "not-msgpack"),
        ("local_tracks_mixture", {"counts": struct.pack("<3H", 2, 2, 3)}, "length"),
        ("local_tracks_full", {"source": "a/b"}, "bad-field"),
        ("local_tracks_full", {"source": "*"}, "bad-field"),
        ("local_tracks_full", {"source": "x" * 65}, "bad-field"),
        ("local_tracks_full", {"epoch": -1}, "bad-field"),
        ("local_tracks_full", {"seq": 1.0}, "bad-field"),
        ("local_tracks_full", {"seq": True}, "bad-field"),
        ("local_tracks_full", {"time": 2**63}, "bad-field"),
        ("local_tracks_full", {"time": -1}, "bad-field"),
        ("local_tracks_full", {"complete": 1}, "bad-field"),
        ("local_tracks_full", {"origin": "dream"}, "bad-field"),
        ("local_tracks_full", {"lineage": ["ok", "not ok"]}, "bad-field"),
        ("local_tracks_lineage", {"lineage": None}, "missing"),
        ("local_tracks_lineage", {"track_lineage": bytes(3)}, "length"),
        ("global_tracks_lineage", {"track_lineage": bytes(4)}, "length"),
        ("global_tracks_lineage", {"sources": ["global/centre-b", "global/global/b"]}, "bad-field"),
        ("sensor_info_disk", {"period": 0.0}, "bad-field"),
        ("sensor_info_disk", {"period": float("nan")}, "bad-field"),
        ("sensor_info_disk", {"period": -1}, "bad-field"),
        ("sensor_info_disk", {"initiation_delay": float("inf")}, "bad-field"),
        ("sensor_info_disk", {"detection_probability": 1.01}, "bad-field"),
        ("sensor_info_disk", {"position": [1.0, 2.0]}, "bad-field"),
        ("sensor_info_disk", {"position": [1.0, 2.0, float("nan")]}, "bad-field"),
        ("sensor_info_disk", {"position_covariance": doubles(1, 0, -1, 0, 0, 1)}, "bad-field"),
        ("sensor_info_disk", {"position_covariance": doubles(1, 2, 1, 0, 0, 1)}, "bad-field"),
        ("sensor_info_disk", {"position_covariance": doubles(1, 0, float("nan"), 0, 0, 1)}, "bad-field"),
        ("sensor_info_disk", {"position_covariance": doubles(1, 0, 1)}, "length"),
        ("sensor_info_disk", {"motion": {"kind": "warp", "q": 1.0}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "ca", "sigma": 1.0}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "singer", "sigma": 1.0}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "ou", "sigma": 0.0, "tau": 1.0}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "ou", "sigma": 1.0, "tau": float("inf")}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "still", "q": 1.0}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "cv", "q": float("nan")}}, "bad-field"),
        ("sensor_info_disk", {"motion": {"kind": "cv", "q": -1.0}}, "bad-field"),
        ("sensor_info_disk", {"coverage": {"kind": "disk", "radius": 1.0, "inner": 2.0}}, "bad-field"),
        ("sensor_info_disk", {"coverage": {"kind": "disk", "radius": float("inf")}}, "bad-field"),
        (
            "sensor_info_disk",
            {"coverage": {"kind": "sector", "radius": 1.0, "azimuth": 7.0, "width": 1.0}},
            "bad-field",
        ),
        ("sensor_info_disk", {"coverage": {"kind": "polygon", "points": [[0, 0], [1, 1]]}}, "bad-field"),
        ("sensor_info_disk", {"coverage": {"kind": "polygon", "points": [[0, 0, 0]] * 3}}, "bad-field"),
        ("sensor_info_polygon", {"frame": {"kind": "ecef"}}, "bad-field"),
        ("global_tracks", {"status": b"\x00\x01\x03"}, "bad-field"),
        ("global_tracks", {"ids": bytes(24)}, "bad-field"),
        ("global_tracks", {"contributor_source": struct.pack("<3H", 0, 1, 2)}, "bad-field"),
        ("global_tracks", {"contributor_counts": struct.pack("<3H", 65535, 1, 0)}, "length"),
        ("global_tracks", {"ended": [[1, "gone"]]}, "bad-field"),
        ("global_tracks", {"split_from": [[1, -1]]}, "bad-field"),
        ("step_log", {"decision_kind": b"\x00\x01\x02\x0b"}, "bad-field"),
        ("step_log", {"decision_kind": b"\x00\x01\x02"}, "length"),
        ("step_log", {"decision_source": struct.pack("<4H", 0, 1, 2, 65535)}, "bad-field"),
        ("step_log", {"taken": [["radar-1", 1, 2, 3, ""]]}, "bad-field"),
        ("step_log", {"events": [{"a": [[[[1]]]]}]}, "bad-field"),
        ("step_log", {"events": [{"a": [[[1]], b"bytes"]}]}, ""),
        ("step_log", {"events": [{"a": [[{b"bytes": 1}]]}]}, "bad-field"),
        ("status", {"uptime": float("nan")}, "bad-field"),
        ("status", {"queue": {"length": -1}}, "bad-field"),
        ("status", {"sources": {"radar-1": 1}}, "bad-field"),
        ("truth", {"ids": bytes(16)}, "bad-field"),
        ("truth", {"means": doubles(*range(7))}, "length"),
    ],
)
def test_what_is_wrong_has_its_reason(name: str, values: dict[str, Any], expected: str) -> None:
    assert reason(GOLDEN[name]) == ""
    assert reason(changed(name, **values)) == expected


def test_unknown_keys_are_ignored_everywhere() -> None:
    raw = msgpack.unpackb(GOLDEN["sensor_info_sector"])
    raw["colour"], raw["coverage"]["sweep"], raw["frame"]["datum"] = {"deep": [1]}, 3, "G1762"
    assert schemas.encode(schemas.decode(msgpack.packb(raw))) == GOLDEN["sensor_info_sector"]


def test_duplicate_keys_give_a_message_or_a_reason() -> None:
    data = GOLDEN["local_tracks_small"]
    head, body = data[:1], data[1:]
    assert head == b"\x8e"
    for extra in (b"\xa3seq\x05", b"\xa3ids\xc0", b"\xa1v\x02"):
        assert reason(b"\x8f" + body + extra) in ("", "missing", "version")


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300))
def test_random_bytes(data: bytes) -> None:
    reason(data)


@settings(max_examples=600, deadline=None)
@given(st.sampled_from(ONE_OF_EACH), st.data())
def test_flipped_bits(name: str, data: st.DataObject) -> None:
    changed_bytes = bytearray(GOLDEN[name])
    for position in data.draw(st.lists(st.integers(0, 8 * len(changed_bytes) - 1), min_size=1, max_size=4)):
        changed_bytes[position // 8] ^= 1 << position % 8
    reason(bytes(changed_bytes))


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=40),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4) | st.just("kind"), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=600, deadline=None)
@given(st.sampled_from(ONE_OF_EACH), st.data())
def test_random_values_in_fields(name: str, data: st.DataObject) -> None:
    raw = msgpack.unpackb(GOLDEN[name])
    for key in data.draw(st.lists(st.sampled_from(sorted(raw)), min_size=1, max_size=3)):
        raw[key] = data.draw(VALUES)
    reason(msgpack.packb(raw))


def cost(data: bytes) -> tuple[float, int]:
    start = time.process_time()
    reason(data)
    seconds = time.process_time() - start
    tracemalloc.start()
    reason(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return seconds, peak


def nested(levels: int, items: int, size: int) -> bytes:
    return (b"\xdd" + struct.pack(">I", items)) * levels + b"\xc0" * (size - 5 * levels)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(nested(500, 15 * 2**20, 15 * 2**20), id="lists in lists that announce millions"),
        pytest.param(nested(500, MAX_ITEMS, 2**20), id="lists in lists as long as may be"),
        pytest.param(msgpack.packb({"v": 1, "type": "x" * 15_000_000}), id="a long text"),
        pytest.param(msgpack.packb({"v": [[]] * MAX_ITEMS}), id="many lists"),
        pytest.param(msgpack.packb({"v": 1, "type": "truth", "source": "a" * 15_000_000}), id="a long name"),
        pytest.param(
            changed("local_tracks_full", space=["x", "y", *("x" * 1000 for _ in range(10_000))]), id="a long space"
        ),
        pytest.param(changed("local_tracks_full", ids=bytes(8 * 10**6)), id="a million ids"),
        pytest.param(changed("global_tracks", contributor_counts=b"\xff" * 8 * 10**6), id="counts of billions"),
    ],
)
def test_cost_is_proportional(data: bytes) -> None:
    """A few seconds and a hundred times its bytes at most, whatever a payload announces (it holds 16 MiB at most)."""
    seconds, peak = cost(data)
    assert seconds < 3.0
    assert peak < 100 * len(data) + 2**20


def test_hostile_texts_are_not_remembered() -> None:
    def refuse(count: int) -> int:
        for index in range(count):
            bad = {"source": f"{index} " + "x" * 100}, {"space": [f"{index}"]}, {"frame": {"kind": f"{index}"}}
            assert {reason(changed("local_tracks_full", **values)) for values in bad} == {"bad-field"}
        gc.collect()
        return sys.getallocatedblocks()

    before = refuse(100)
    assert refuse(2000) - before < 1000
