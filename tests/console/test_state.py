from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from fusion_service.console import pictures as pictures_module
from fusion_service.console.histories import A_STEP, LINES, LOGGED
from fusion_service.console.pictures import TRAIL
from fusion_service.console.state import MOST_CENTRES, Seen, State
from schemas import Entry, Local
from schemas.messages import BORN, CONFIRMED_NOW, EXCHANGED, GATE_FAILED, KEPT, LINKED, MERGED, SPLIT
from tests.console.scenes import FIRST, SECOND, picture, status, step_log, unpacked


class Clocked:
    """A state whose clocks a test sets."""

    def __init__(self) -> None:
        self.now = 100.0
        self.state = State(lambda: self.now, lambda: round(self.now * SECOND))
        self.state.hub(True)

    def news(self, seen: Seen) -> tuple[Seen, dict[str, Any]]:
        """What is new, by its type."""
        seen, out = self.state.news(seen)
        read = [json.loads(one) if isinstance(one, str) else unpacked(one) for one in out]
        return seen, {one["type"]: one for one in read}


@pytest.fixture
def clocked() -> Clocked:
    return Clocked()


def test_a_page_gets_all_once_and_then_what_is_new(clocked: Clocked) -> None:
    clocked.state.take(picture(3, 1, identity=("mmsi:1", None, None)))
    seen, first = clocked.news(Seen("centre"))
    assert set(first) == {"places", "trail", "texts", "picture"}
    assert first["picture"]["status"].tolist() == [0, 1, 2]
    assert first["picture"]["major"].tolist() == pytest.approx([20.0] * 3, rel=1e-4)
    assert first["texts"]["tracks"][0][1:5] == [str(FIRST), "1", "", "mmsi:1"]
    assert clocked.news(seen)[1] == {}
    clocked.now += 1
    clocked.state.take(picture(2, 2, callsign=("PILOT", None), number=np.array([0, 0], dtype=np.uint32)))
    seen, second = clocked.news(seen)
    assert set(second) == {"texts", "picture"}
    assert [one[:5] for one in second["texts"]["tracks"]] == [[0, str(FIRST), "1", "PILOT", ""]]
    assert second["picture"]["slot"].tolist() == [0, 1]
    late, joined = clocked.news(Seen("centre"))
    assert joined["trail"]["counts"] == [3, 2]
    assert len(joined["texts"]["tracks"]) == 2
    assert late == seen


def test_pages_that_miss_pictures_get_the_newest_alone(clocked: Clocked) -> None:
    clocked.state.take(picture(3, 1))
    seen, _ = clocked.news(Seen("centre"))
    for step in range(2, 50):
        clocked.state.take(picture(3 + step % 2, step))
    _, out = clocked.state.news(seen)
    assert len(out) == 2
    assert isinstance(out[1], bytes)
    assert unpacked(out[1])["step"] == 49


def test_trails_and_tracks_are_bounded(clocked: Clocked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures_module, "MOST_TRACKS", 5)
    for step in range(1, 2 * TRAIL):
        clocked.now += 1
        clocked.state.take(picture(8, step))
    _, news = clocked.news(Seen("centre"))
    assert len(news["trail"]["counts"]) == TRAIL
    assert len(news["picture"]["slot"]) == 5
    assert news["picture"]["left_out"] == 3
    monkeypatch.setattr(pictures_module, "MOST_POINTS", 50)
    clocked.now += 1
    clocked.state.take(picture(8, 2 * TRAIL))
    assert len(clocked.news(Seen("centre"))[1]["trail"]["counts"]) == 10
    clocked.now += 1
    clocked.state.take(picture(8, 2 * TRAIL + 1, frame=Local("hall")))
    _, flat = clocked.news(Seen("centre"))
    assert flat["trail"]["counts"] == [5]
    assert flat["picture"]["frame"] == {"kind": "local", "name": "hall"}


def test_deltas_are_merged_and_a_run_before_is_left_aside(clocked: Clocked) -> None:
    clocked.state.take(picture(3, 1, epoch=5))
    part = picture(1, 2, epoch=5, delta=True, ended=((FIRST + 2, "lost", None),))
    clocked.state.take(part)
    clocked.state.take(picture(1, 3, epoch=4))
    _, news = clocked.news(Seen("centre"))
    assert news["picture"]["step"] == 2
    assert len(news["picture"]["slot"]) == 2


def test_how_fresh_a_picture_is(clocked: Clocked) -> None:
    assert clocked.state.pulse("centre")["stale"] is True
    clocked.state.alive("centre", True)
    for step in range(1, 5):
        clocked.now += 2
        clocked.state.take(picture(1, step))
    assert clocked.state.pulse("centre") | {"now": 0} == {
        "type": "pulse", "now": 0, "hub": True, "trouble": "", "centres": ["centre"], "centre": "centre",
        "alive": True, "age": 0.0, "told": None, "stale": False, "patience": 8.0,
    }  # fmt: skip
    clocked.now += 9
    assert clocked.state.pulse("centre")["stale"] is True
    clocked.state.hub(False, "away")
    clocked.state.alive("centre", False)
    said = clocked.state.pulse("centre")
    assert (said["hub"], said["alive"], said["trouble"]) == (False, False, "away")
    lines = clocked.news(Seen("centre"))[1]["log"]["lines"]
    assert [one["text"] for one in lines] == [
        "centre centre is on the bus",
        "the hub is away",
        "centre centre has left the bus",
    ]


def test_a_track_is_explained(clocked: Clocked) -> None:
    clocked.state.take(picture(3, 1, kind=("cargo", None, None), kind_p=np.array([0.8, 0.0, 0.0])))
    rows = [
        (BORN, FIRST, 0, np.nan),
        (LINKED, FIRST, 0, 2.5),
        (MERGED, FIRST + 9, FIRST, 1.0),
        (KEPT, FIRST + 1, 0, 4.0),
    ]
    clocked.state.take(step_log(rows))
    for step in (2, 3, 4):
        clocked.state.take(step_log([(GATE_FAILED, FIRST, 0, 20.0 + step), (SPLIT, FIRST + 2, FIRST, 3.0)], step))
    _, news = clocked.news(Seen("centre", track=FIRST))
    told = news["track"]
    assert told["status"] == "tentative"
    assert told["what"] == [{"name": "kind", "said": "cargo", "p": 0.8}]
    assert [(one["source"], one["influence"]) for one in told["members"]] == [("r2", 0.75), ("r1", 0.25)]
    assert told["members"][1] == {"source": "r1", "epoch": str(2**63), "id": "0", "influence": 0.25, "d2": 24.0}
    assert [one[1] for one in told["history"]][:3] == ["born", "r1 0 linked, d2 2.5", "took in 10, d2 1.0"]
    assert told["history"][-1][1] == "split off it: 3, d2 3.0"
    assert told["ellipse"][:2] == pytest.approx([20.0, 10.0], rel=1e-4)
    clocked.state.take(
        picture(2, 5, ids=np.array([FIRST + 1, FIRST + 2], dtype=np.uint64), ended=((FIRST, "lost", FIRST + 1),))
    )
    gone = clocked.news(Seen("centre", track=FIRST))[1]["track"]
    assert gone["gone"] == "lost, goes on as 2"
    assert clocked.news(Seen("centre", track=12345))[1]["track"]["gone"] == "it is not in the picture"


def test_gates_that_fail_again_are_one_line_and_lines_are_bounded(clocked: Clocked) -> None:
    clocked.state.take(picture(3))
    for step in range(1, 4):
        clocked.state.take(step_log([(GATE_FAILED, FIRST, 0, float(step))], step))
    history = clocked.news(Seen("centre", track=FIRST))[1]["track"]["history"]
    assert history == [[3000, "r1 0 outside its gate, d2 3.0", 3]]
    for step in range(4, 200):
        clocked.state.take(step_log([(LINKED, FIRST, 0, 1.0)], step))
    assert len(clocked.news(Seen("centre", track=FIRST))[1]["track"]["history"]) == LINES


def test_the_log_tells_decisions_events_refusals_and_orders(clocked: Clocked) -> None:
    clocked.state.take(picture(1))
    order = {
        "kind": "order",
        "what": "rename",
        "track": FIRST,
        "name": "PILOT",
        "who": "anna",
        "why": "asked",
        "done": True,
    }
    events = (
        {"kind": "found", "source": "r1"},
        {"kind": "start", "config": {"x": 1}},
        {"kind": "alarm", "source": "r1", "what": "clock"},
        {"kind": "never heard of", "x": 1, "deep": {"y": [1]}},
        {"kind": "skipped", "steps": 4},
        order,
    )
    refused = (Entry("r2", 1, 1, 1, "late", 3), Entry("r2", 1, 2, 1, "late", 0))
    many = [(CONFIRMED_NOW, FIRST + k, 0, np.nan) for k in range(100)]
    clocked.state.take(step_log([*many, (EXCHANGED, FIRST, FIRST + 1, 1.0)], events=events, refused=refused))
    lines = clocked.news(Seen("centre"))[1]["log"]["lines"]
    told = [one["text"] for one in lines]
    assert told[:2] == ["r2: 1 message refused (late)", "r2: 3 tracks refused (late)"]
    assert told[2:8] == [
        "r1 is on the bus", "the service began, without a checkpoint", "r1: alarm: clock", "never heard of (x 1)",
        "4 steps were skipped: more comes than can be worked off",
        "order rename track 1, PILOT by anna (unproven) (asked)",
    ]  # fmt: skip
    assert len(told) == 8 + A_STEP + 1
    assert told[-1] == "76 decisions more in this step"
    assert lines[7]["track"] == str(FIRST)
    for step in range(2, 60):
        clocked.state.take(step_log(many, step))
    assert len(clocked.news(Seen("centre"))[1]["log"]["lines"]) == LOGGED


def test_sources_and_alarms_are_those_of_the_status(clocked: Clocked) -> None:
    now = round(clocked.now * SECOND)
    last = {"reason": "late", "said": "is `time` in seconds? it must be ns", "time": now, "count": 7}
    sources: dict[str, dict[str, Any]] = {
        "r1": {"alive": True, "stale": False, "messages": 5, "tracks": 3, "rate": 1.0},
        "m01": {"alive": True, "stale": True, "messages": 5, "last_refusal": last},
    }
    clocked.state.take(picture(3))
    clocked.state.take(status(now, sources))
    told = clocked.news(Seen("centre"))[1]["health"]
    assert [one["name"] for one in told["sources"]] == ["m01", "r1"], "those in trouble first"
    assert told["sources"][0]["refusal"]["said"] == last["said"]
    assert told["sources"][1]["share"] == 1.0
    assert any(last["said"] in one["text"] for one in told["alarms"])
    clocked.now += 2
    clocked.state.take(
        status(now + 2 * SECOND, {**sources, "m01": {**sources["m01"], "last_refusal": {**last, "count": 9}}})
    )
    again = clocked.news(Seen("centre"))[1]["health"]
    assert {one["since"] for one in again["alarms"]} == {100_000}, "it is the same alarm as before"


def test_centres_are_bounded_and_garbage_harms_nothing(clocked: Clocked) -> None:
    for number in range(2 * MOST_CENTRES):
        clocked.state.take(picture(1, name=f"c{number}"))
    assert len(clocked.state.names()) == MOST_CENTRES
    clocked.state.take(picture(2, 2, name="c0", means=np.full((2, 4), np.nan), existence=np.full(2, np.nan)))
    clocked.state.take(picture(2, 3, name="c0", identity=("x" * 10**6, "<b>"), means=np.full((2, 4), 1e12)))
    clocked.state.take(
        step_log([], events=({"kind": 7, "source": ["x"]}, {"kind": "order", "track": "x", "who": 3}), source="c0")
    )
    clocked.state.take(status(sources={"r1": {"tracks": "many", "last_refusal": 3, "alarms": 3}}, name="c0"))
    _, news = clocked.news(Seen("c0"))
    assert all(len(one[4]) <= 80 for one in news["texts"]["tracks"])
    assert clocked.news(Seen("nobody")) == (Seen("nobody"), {})


def test_pictures_that_come_several_at_a_time_are_not_stale_between(clocked: Clocked) -> None:
    """As by the messages' own time: ten steps at once, every ten seconds; and an outage is no usual time."""

    def come(step: int) -> None:
        clocked.state.take(picture(1, step))
        clocked.now += 0.01

    step = 0
    for burst in range(3):
        for _ in range(10):
            come(step := step + 1)
        clocked.now += 9.9
        assert clocked.state.pulse("centre")["stale"] is (burst == 0)
    for _ in range(150):
        come(step := step + 1)
        clocked.now += 1
    clocked.state.hub(False)
    clocked.now += 300
    clocked.state.hub(True)
    come(step := step + 1)
    clocked.state.alive("centre", True)
    clocked.state.alive("centre", False)
    clocked.now += 300
    come(step + 1)
    assert clocked.state.pulse("centre")["patience"] == pytest.approx(4 * 1.01)
