"""What an ear has heard, at one moment: centres, recorders, and all that is wrong."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import pytest

import schemas
from fusion_service.bus import Bus
from fusion_service.lookout.ear import Ear
from fusion_service.lookout.view import size_words, view_of
from tests.lookout.test_layout import NOW, STATUS

KEEPS = {"file": "/data/a.rrd", "host": "mast", "bytes": 2_500_000, "parts": 1, "messages": 7, "lost": 0, "silent": 0.5}


def heard(**recorders: list[dict[str, Any]] | None) -> Ear:
    ear = Ear("fusion")
    ear.take("fusion/v1/global/centre/status", schemas.encode(STATUS))
    ear.recorders = dict(recorders)
    return ear


def test_a_recorder_tells_what_it_keeps() -> None:
    (one,) = view_of(heard(rec=[{**KEEPS, "free": 10**12}]), NOW).keepers
    assert one.line == "recorder rec: /data/a.rrd on mast, 2.5 MB, 7 messages, 0 lost"
    assert one.wrong == ()
    (one,) = view_of(heard(rec=[{**KEEPS, "parts": 3, "undecodable": 2}]), NOW).keepers
    assert one.line.endswith("2.5 MB in 3 parts, 7 messages, 0 lost, 2 that cannot be read")


@pytest.mark.parametrize(
    ("said", "reads"),
    [
        (None, "recorder rec: it does not answer"),
        ([{**KEEPS, "silent": 60.0}], "it has written nothing for 60 s: is its disk held up?"),
        ([{**KEEPS, "free": 5e8}], "its disk has 500 MB left"),
        ([{"silent": "x", "bytes": [], "messages": None, "free": True}], ""),
    ],
)
def test_what_is_wrong_with_a_recorder_is_told(said: list[dict[str, Any]] | None, reads: str) -> None:
    view = view_of(heard(rec=said), NOW)
    told = [one for one in view.general if "recorder" in one]
    assert (len(told) == 1 and reads in told[0]) if reads else told == []
    assert set(view.general) <= set(view.wrong)


def test_a_centre_that_is_gone_and_a_hub_that_is_away() -> None:
    ear = heard()
    ear.came["centre"] = time.monotonic() - 60.0
    ear.alive["fusion/v1/global/centre/alive"] = False
    (one,) = view_of(ear, NOW).centres
    assert one.gone
    assert "centre centre is gone for 60 s: its liveliness token is no more" in view_of(ear, NOW).general
    assert view_of(ear, NOW, hub=False).general == ["the hub is away: what is shown is as it was"]
    assert (
        "no centre named north answers: is `fusion-service run` there"
        in view_of(Ear("fusion"), NOW, centre="north").general[0]
    )
    other = Ear("fusion")
    other.alive = {schemas.global_key("centre", "alive"): True, schemas.record_key("rec", "alive"): True}
    assert view_of(other, NOW, centre="north").general[0].endswith("answers, but centre: give --centre centre")


def test_sizes_are_short() -> None:
    assert [size_words(one) for one in (0, 999, 1500, 123e6, 4.2e9, 5e15)] == [
        *("0 B", "999 B", "1.5 kB", "123 MB", "4.2 GB", "5000.0 TB"),
    ]


class Listening:
    """Stands for a bus on which one overhears."""

    def __init__(self) -> None:
        self.open = 0

    def overhear(self, key: str, callback: Callable[[str, int], None]) -> Listening:
        self.open += 1
        self.say = callback
        return self

    def close(self) -> None:
        self.open -= 1


@pytest.mark.parametrize(("sizes", "pauses"), [([100] * 5, False), ([3 * 2**20], True), ([10] * 1200, True)])
def test_where_much_is_overheard_one_pauses(sizes: list[int], pauses: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ear, bus = Ear("fusion"), Listening()
    ear.everywhere = True
    ear.tend(cast(Bus, bus))
    assert bus.open == 1
    for k, size in enumerate(sizes):
        bus.say(f"fusoin/v1/local/m{k}/tracks", size)
    bus.say("fusion/v1/local/right/tracks", 10)
    assert len(ear.beside()) == min(len(sizes), 500)
    ear.tend(cast(Bus, bus))
    assert bus.open == (0 if pauses else 1)
    ear.tend(cast(Bus, bus))
    assert bus.open == (0 if pauses else 1)
    later = time.monotonic() + 60
    monkeypatch.setattr("fusion_service.lookout.ear.time.monotonic", lambda: later)
    assert ear.beside() == []
    ear.tend(cast(Bus, bus))
    assert bus.open == 1
