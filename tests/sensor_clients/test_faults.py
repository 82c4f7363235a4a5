"""A source made wrong: each fault against its own arithmetic, and nothing changed by none."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fusion_service.errors import UsageError
from sensor_clients.events import Event
from sensor_clients.faults import Fault, faulty, read_fault
from sensor_clients.scenarios.three_radars import three_radars

SECOND = 10**9
SPACE = ("x", "y", "vx", "vy")


def said(count: int = 5) -> Iterator[Event]:
    yield Event(0, "info", {"position": (100.0, 0.0, 0.0)})
    for k in range(count):
        means = np.array([[100.0, 1000.0 + k, 0.0, 1.0], [4100.0, 3000.0, -1.0, 0.0]])
        fields = {"space": SPACE, "ids": np.array([1, 2]), "means": means, "covariances": np.tile(np.eye(4), (2, 1, 1))}
        yield Event(k * SECOND, "tracks", fields | {"updated": np.full(2, k * SECOND)})


def tracks(text: str, count: int = 5) -> list[dict[str, Any]]:
    events = list(faulty(said(count), read_fault(text)))
    return [event._asdict() for event in events if event.kind == "tracks"]


def test_no_fault_changes_nothing() -> None:
    for one, other in zip(list(said())[1:], tracks(""), strict=True):
        assert (one.time, one.time) == (other["time"], other["due"])
        for name in ("means", "covariances", "updated"):
            np.testing.assert_array_equal(one.fields[name], other["fields"][name])


def test_a_clock_moves_stamps_and_not_when_they_come() -> None:
    first = tracks("clock=0.5,delay=2")[1]
    assert (first["time"], first["due"]) == (SECOND * 3 // 2, 3 * SECOND)
    assert first["fields"]["updated"].tolist() == [SECOND * 3 // 2] * 2


def test_place_heading_and_range_are_about_the_sensor() -> None:
    (first,) = tracks("heading=90", 1)
    np.testing.assert_allclose(first["fields"]["means"][0], [-900.0, 0.0, -1.0, 0.0], atol=1e-9)
    (first,) = tracks("x=200,y=-50", 1)
    np.testing.assert_allclose(first["fields"]["means"][:, :2], [[300.0, 950.0], [4300.0, 2950.0]])
    (first,) = tracks("range=100", 1)
    np.testing.assert_allclose(first["fields"]["means"][:, :2], [[100.0, 1100.0], [4180.0, 3060.0]])
    (first,) = tracks("scale=0.01", 1)
    np.testing.assert_allclose(first["fields"]["means"][1, :2], [4140.0, 3030.0])


def test_covariances_turn_and_are_said_too_small() -> None:
    event = next(event for event in said(1) if event.kind == "tracks")
    spread = np.tile(np.diag([9.0, 1.0, 4.0, 1.0]), (2, 1, 1))
    given = iter([event._replace(fields=event.fields | {"covariances": spread})])
    (made,) = faulty(given, Fault(heading=90.0, sigma=0.5))
    np.testing.assert_allclose(made.fields["covariances"][0], np.diag([1.0, 9.0, 1.0, 4.0]) / 4, atol=1e-12)


def test_a_stuck_source_repeats_itself_with_new_times() -> None:
    found = tracks("stuck=2")
    assert [one["time"] // SECOND for one in found] == [0, 1, 2, 3, 4]
    for one in found[2:]:
        np.testing.assert_array_equal(one["fields"]["means"], found[1]["fields"]["means"])
    assert [one["fields"]["updated"][0] // SECOND for one in found] == [0, 1, 2, 3, 4]


def test_loss_is_about_the_share_and_the_same_for_a_seed() -> None:
    kept = [event.time for event in faulty(said(1000), Fault(loss=0.3), seed=5) if event.kind == "tracks"]
    assert 1000 * 0.7 - 5 * math.sqrt(210) < len(kept) < 1000 * 0.7 + 5 * math.sqrt(210)
    assert kept == [event.time for event in faulty(said(1000), Fault(loss=0.3), seed=5) if event.kind == "tracks"]


@pytest.mark.parametrize(
    "text", ["clock", "clock=x", "bogus=1", "sigma=0", "loss=1", "clock=inf", "delay=-1", "scale=-1"]
)
def test_what_is_no_fault_is_refused_with_what_is_known(text: str) -> None:
    with pytest.raises(ValueError, match=r"no fault|no number|finite|above 0"):
        read_fault(text)


def test_a_simulated_radar_may_be_wrong() -> None:
    sound = list(three_radars().sensors["radar2"](3))
    wrong = list(faulty(three_radars().sensors["radar2"](3), Fault(x=200.0), 3))
    pairs = [(a, b) for a, b in zip(sound, wrong, strict=True) if a.kind == "tracks" and len(a.fields["ids"])]
    assert pairs
    for a, b in pairs:
        x = list(a.fields["space"]).index("x")
        np.testing.assert_allclose(b.fields["means"][:, x] - a.fields["means"][:, x], 200.0, rtol=1e-6)


def test_a_demo_passes_faults_to_its_clients_and_refuses_unknown_sources() -> None:
    from fusion_service.demo.missions import plan_mission, with_faults

    plan = with_faults(plan_mission("three-radars"), ["radar2:clock=0.5,x=1"])
    assert plan.clients["radar2"][-2:] == ["--fault", "clock=0.5,x=1"]
    assert "--fault" not in plan.clients["radar1"]
    with pytest.raises(UsageError, match="SOURCE one of radar1, radar2, radar3"):
        with_faults(plan, ["truth:clock=1"])
