"""What is said of payloads that cannot be read, one mistake at a time."""

from __future__ import annotations

import re
import time
from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from fusion_service.hints import read_finding

NOW = time.time_ns()
GOOD: dict[str, Any] = {
    "v": 1,
    "type": "local_tracks",
    "source": "radar",
    "epoch": 1,
    "seq": 0,
    "sent": NOW,
    "origin": "live",
    "time": NOW,
    "complete": True,
    "space": ["x", "y"],
    "frame": {"kind": "local", "name": "harbour"},
    "ids": np.array([7], "<u8").tobytes(),
    "means": np.array([1.0, 2.0], "<f8").tobytes(),
    "covs": np.array([4.0, 0.0, 9.0], "<f8").tobytes(),
}
TWO = np.array([7, 7], "<u8").tobytes()


def said(data: bytes) -> str:
    with pytest.raises(schemas.MessageError) as caught:
        schemas.decode(data)
    found = read_finding(data, caught.value, NOW)
    assert found.reason == caught.value.reason
    return found.said


def test_the_message_that_is_changed_is_good() -> None:
    assert schemas.decode(msgpack.packb(GOOD)).type == "local_tracks"


@pytest.mark.parametrize(
    ("changes", "reads"),
    [
        ({"v": "1"}, "`v` is 1: write the whole number 1"),
        ({"type": "tracks"}, "is one of|did you mean"),
        ({"time": NOW / 1e9}, "is it in seconds"),
        ({"time": "2026-01-01T00:00:00Z"}, "the text .*ns since 1970"),
        ({"time": -5}, "it must be ns since 1970"),
        ({"complete": 1}, "number 1: send the MessagePack bool"),
        ({"origin": "Live"}, 'did you mean "live"'),
        ({"space": "x,y"}, "list of texts"),
        ({"space": ["lat", "lon"]}, "x and y in metres"),
        ({"space": ["x", "x"]}, "twice"),
        ({"frame": "enu"}, "must be a map"),
        ({"frame": {"kind": "ENU", "lat": 1, "lon": 2}}, 'did you mean "enu"'),
        ({"frame": {"kind": "enu", "lat": 120.0, "lon": 30.0}}, "swapped"),
        ({"platform": {"position": [0, 0, 0], "heading": 270.0}}, "heading is 270: is it in degrees"),
        ({"ids": [7]}, "columns are bytes"),
        ({"ids": "7"}, "columns are MessagePack bin"),
        ({"ids": TWO, "means": bytes(32), "covs": bytes(48)}, "one id stands twice"),
        ({"ids": b"1234"}, "no whole count of numbers of 64 bits"),
        ({"covs": np.eye(2).tobytes()}, "whole 2 x 2 matrices"),
        ({"covs": bytes(16)}, "the variances alone"),
        ({"means": np.array([1, 2], "<f4").tobytes()}, "are they 32 bits"),
        ({"means": bytes(24)}, "3 numbers where 2 belong"),
        ({"source": "my radar"}, "bad name"),
        ({"counts": np.array([1], "<u2").tobytes()}, "`counts` without `weights`"),
    ],
)
def test_a_field_is_named_with_its_value_and_the_remedy(changes: dict[str, Any], reads: str) -> None:
    assert re.search(reads, said(msgpack.packb({**GOOD, **changes})))


@pytest.mark.parametrize(
    ("data", "reads"),
    [
        (b"", "empty"),
        (b'{"v": 1}', "JSON"),
        (b"\x1f\x8b\x08", "gzip"),
        (b"<a/>", "XML"),
        (msgpack.packb(GOOD)[:-1], "is it cut"),
        (msgpack.packb(GOOD) + b"1", "is something behind it"),
        (b"\xc1", "no MessagePack map"),
        (msgpack.packb([1]), "no MessagePack map"),
    ],
)
def test_what_is_no_message_at_all_is_told_by_what_it_is(data: bytes, reads: str) -> None:
    assert reads in said(data)


def test_a_field_by_another_name_is_found() -> None:
    one = {key: value for key, value in GOOD.items() if key != "means"} | {"Means": GOOD["means"]}
    assert 'it calls "Means"' in said(msgpack.packb(one))


def test_nothing_that_comes_makes_it_raise() -> None:
    rng = np.random.default_rng(16)
    whole, told = msgpack.packb(GOOD), []
    for _ in range(2000):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 3):
            data[place] = rng.integers(0, 256)
        try:
            schemas.decode(bytes(data))
        except schemas.MessageError as error:
            told.append(read_finding(bytes(data), error, NOW).said)
    assert len(told) > 500
    assert all(told)
