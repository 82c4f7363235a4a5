"""When a process is alive, and when it is ready."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fusion_service.monitoring import Heard, Pulse
from fusion_service.monitoring.health import BEAT, FORGOTTEN, MOST_CENTRES, OLD, STALLED
from schemas import encode
from tests.monitoring.test_figures import SOURCE, status


class Clock:
    now = 100.0
    joined = True

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def pulse(clock: Clock) -> Pulse:
    return Pulse(lambda: clock.joined, clock)


def test_who_waits_for_the_hub_is_alive_and_not_ready(pulse: Pulse, clock: Clock) -> None:
    clock.now += 10 * BEAT
    assert pulse.alive() == ""
    assert pulse.ready() == "it begins, or waits for the hub"


def test_a_service_is_ready_when_it_steps(pulse: Pulse, clock: Clock) -> None:
    pulse.told("READY=1")
    assert pulse.ready() == "no status yet"
    pulse.told("WATCHDOG=1\nSTATUS=well", status(step=0))
    assert pulse.ready() == "no picture yet of 1 sources"
    pulse.told("WATCHDOG=1\nSTATUS=well", status(step=5))
    assert pulse.ready() == ""
    clock.joined = False
    assert pulse.ready() == "the hub is away"
    clock.joined = True
    clock.now += STALLED + 1
    pulse.told("WATCHDOG=1\nSTATUS=well", status(step=5))
    assert pulse.ready() == f"no step for {STALLED + 1:.0f} s, of 1 sources"
    pulse.told("WATCHDOG=1\nSTATUS=well", status({"r1": {**SOURCE, "stale": True}}, step=5))
    assert pulse.ready() == ""  # nobody is there of whom a picture could be made
    pulse.told("STOPPING=1")
    assert pulse.ready() == "it stops"


def test_without_beats_it_is_not_alive(pulse: Pulse, clock: Clock) -> None:
    pulse.told("READY=1")
    pulse.told("WATCHDOG=1\nSTATUS=x", status())
    clock.now += BEAT + 1
    pulse.told("STATUS=the loop is at one thing", status())  # the heartbeat's word, without the watchdog
    assert pulse.alive() == pulse.ready() == f"no beat for {BEAT + 1:.0f} s"
    pulse.told("WATCHDOG=1")
    assert pulse.alive() == ""


def test_one_that_stands_by_is_ready_in_step(pulse: Pulse) -> None:
    pulse.told("READY=1")
    pulse.told("WATCHDOG=1\nSTATUS=standing by: no checkpoint yet")
    assert pulse.ready() == "standing by: no checkpoint yet"
    pulse.told("WATCHDOG=1\nSTATUS=standing by: at step 7")
    assert pulse.ready() == ""


def key(name: str) -> str:
    return f"fusion/v1/global/{name}/status"


def test_centres_on_the_bus_are_heard_and_forgotten(clock: Clock) -> None:
    heard = Heard(lambda: clock.joined, clock)
    assert heard.ready() == "no centre was heard yet"
    for number in range(MOST_CENTRES + 5):
        name = f"c{number:02}"
        heard.take(key(name), encode(replace(status(), source=name)))
    assert len(heard.statuses) == MOST_CENTRES
    assert heard.ready() == ""
    heard.take(key("c00"), encode(replace(status(), source="c00", step=77)))
    assert heard.statuses[0].step == 77
    clock.now += OLD + 1
    assert heard.ready() == f"no centre was heard for {OLD + 1:.0f} s"
    clock.now += FORGOTTEN
    assert heard.statuses == []
    clock.joined = False
    assert heard.ready() == "the hub is away"


@pytest.mark.parametrize("data", [b"", b"\xff" * 50, encode(replace(status(), source="other"))])
def test_what_is_no_status_of_that_centre_is_not_told(data: Any, clock: Clock) -> None:
    heard = Heard(clock=clock)
    heard.take(key("centre"), data)
    assert heard.statuses == []
