"""How much of one source is taken: the buckets by a clock of the test, and a flood against a service at work."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.centre import FusionCentre, Refused
from fusion_service.config import ConfigError, FlowConfig, LimitsConfig, ServiceConfig, load_config
from fusion_service.service.flow import MAX_NAMES, Flow
from schemas import Status, decode, encode, local_key
from tests.centre.worlds import START, tracks
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import CONFIG, Scene, opened

SCAN = tracks("radar", 1.0, np.zeros((20, 4)), seq=0)


class Seconds:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def flow(**limits: Any) -> tuple[Flow, Seconds]:
    clock = Seconds()
    none = LimitsConfig(messages=0.0, bytes=0.0, tracks=0.0)
    return Flow(replace(none, **limits), clock), clock


@pytest.mark.parametrize(
    ("limits", "rate"), [({"messages": 10.0}, 10.0), ({"bytes": 5000.0}, 5.0), ({"tracks": 100.0}, 5.0)]
)
def test_a_source_has_its_rate_and_a_burst(limits: dict[str, float], rate: float) -> None:
    one, clock = flow(burst=2.0, **limits)
    taken = []
    for k in range(10_000):
        clock.now = 100.0 + k / 1000
        if one.takes("radar", 1000):
            one.read("radar", SCAN)
            taken.append(clock.now)
    assert len(taken) == pytest.approx(rate * (2.0 + 10.0), abs=1.5)
    assert sum(one.news().values()) == 10_000 - len(taken) == one.total["radar"]
    assert one.news() == {}
    assert one.takes("lidar", 1000)


def test_no_limit_and_limits_of_its_own() -> None:
    one, _ = flow()
    assert all(one.takes("radar", 10**9) for _ in range(1000))
    clock = Seconds()
    few = FlowConfig(messages=1.0, burst=1.0)
    two = Flow(LimitsConfig(sources={"radar": few}), clock)
    assert [two.takes("radar", 1) for _ in range(3)] == [True, False, False]
    assert all(two.takes("lidar", 1) for _ in range(100))


def test_the_defaults_are_far_above_a_heavy_load() -> None:
    """Four sources of 5,000 tracks at 10 Hz, with a second of it at once."""
    clock = Seconds()
    one = Flow(LimitsConfig(), clock)
    scan = tracks("radar", 1.0, np.zeros((5000, 4)), seq=0)
    size = len(encode(scan))
    for k in range(200):
        clock.now = 100.0 + k // 10
        for name in "abcd":
            assert one.takes(name, size)
            one.read(name, scan)


def test_made_up_names_are_bounded_and_shut_nobody_out() -> None:
    one, clock = flow(messages=10.0, burst=1.0)
    for k in range(20_000):
        one.takes(f"name{k}", 1)
        one.takes(f"name{k}", 1)
    assert len(one._accounts) <= MAX_NAMES + 1
    assert len(one.total) <= MAX_NAMES + 1
    clock.now += 2.0
    assert one.takes("radar", 1)
    assert "radar" in one._accounts


def test_it_is_said_by_name() -> None:
    one, _ = flow(messages=1.0, burst=1.0)
    status = FusionCentre({}).step(START).status
    assert one.told_in(status) is status
    for _ in range(5):
        one.takes("radar", 1)
    told = one.told_in(replace(status, sources={"radar": {"alive": True}}, notes=("before",)))
    assert told.sources["radar"] == {"alive": True, "flow": 4}
    assert told.notes == ("before", "more comes than [limits] allow, messages dropped: 4 of radar (messages)")
    again = decode(encode(told))
    assert isinstance(again, Status)
    assert again.sources == told.sources


def test_the_centre_logs_it_and_makes_steps_again_as_before() -> None:
    centre = FusionCentre({})
    centre.handle(Refused("radar", "flow", 7, dropped=True), START)
    assert not centre._intake.lossy
    log = centre.step(START).log
    assert [(one.source, one.reason, one.count) for one in log.dropped] == [("radar", "flow", 7)]
    centre.handle(Refused("radar", "queue", 7, dropped=True), START)
    assert centre._intake.lossy


def test_the_config_has_limits_for_all_and_for_one(tmp_path: Path) -> None:
    path = tmp_path / "centre.toml"
    path.write_text("[limits]\ntracks = 100\n[limits.sources.radar1]\nmessages = 7\n")
    limits = load_config(path).limits
    assert limits == LimitsConfig(tracks=100.0, sources={"radar1": FlowConfig(messages=7.0, tracks=100.0)})
    path.write_text("[limits]\ntracks = -1\n[limits.sources.radar1]\nmesages = 7\n")
    with pytest.raises(ConfigError, match=r"(?s)2: limits.tracks: is -1.*4: limits.sources.radar1.mesages: unknown"):
        load_config(path)
    assert ServiceConfig().limits == LimitsConfig()


def test_a_flood_is_cut_and_the_others_go_on(hub: Hub, tmp_path: Path) -> None:
    with opened(hub, tmp_path) as scene:
        config = tmp_path / "centre.toml"
        limits = "[limits.sources.flood]\nmessages = 50\n"
        config.write_text(CONFIG.format(centre="", endpoint=hub.endpoint, state=tmp_path / "state") + limits)
        service = scene.run(config)
        scene.sensor("radar", 0)
        eventually(scene.seen.sees(0), 20)
        out = scene.bus.publisher(local_key("flood", "tracks"))
        for seq in range(3000):
            now = time.time_ns()
            out.put(encode(replace(SCAN, source="flood", seq=seq, time=now, sent=now, epoch=START)))
        eventually(lambda: scene.said_of("flood", "flow"))
        eventually(lambda: dropped(scene) == scene.said_of("flood", "flow"))
        assert 1000 < dropped(scene) <= 2900
        assert scene.said_of("radar", "flow") is None
        assert "of flood (messages)" in (scene.last_status().notes or ("",))[-1]
        assert scene.seen.sees(0)()
        service.signal(signal.SIGINT)
        assert "messages dropped: " in service.end()[1]


def dropped(scene: Scene) -> int:
    """Messages of "flood" that step logs tell of as dropped for their flow; nobody else's are."""
    found = [one for log in scene.seen.logs for one in log.dropped if one.reason == "flow"]
    assert {one.source for one in found} <= {"flood"}
    return sum(max(one.count, 1) for one in found)
