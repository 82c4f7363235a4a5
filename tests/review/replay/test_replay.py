"""A recorded mission is fused again: the same to the bit, or it is told where it differs and what was not compared."""

from __future__ import annotations

import dataclasses
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.review.replay import Replay, run_replay
from fusion_service.rules import RULES
from schemas import GlobalTracks, LocalTracks, StepLog
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, moved, seen, tracks, truth
from tests.helpers import flown
from tests.helpers.flown import REALM, Flight, edited, messy, pictures, record, verified

OPTIONS: dict[str, dict[str, Any]] = {
    "hmd-s": {"samples": 200},
    "gmd-s": {"samples": 200},
    "bci": {"max_correlation": 0.5, "criterion": "trace"},
}
CENTRE_RULES = sorted(set(RULES) - {"bar-shalom-campo"})  # that one needs the cross-covariance


@pytest.mark.parametrize("memory", ["restart", "recursive"])
@pytest.mark.parametrize("rule", CENTRE_RULES)
def test_every_rule_is_made_again_to_the_bit(rule: str, memory: str, tmp_path: Path) -> None:
    """Late, lost, repeated and bad messages, restarts of sources and of the centre, orders; with the log's settings."""
    own = messy({"rule": rule, "rule_options": OPTIONS.get(rule, {}), "memory": memory}, steps=11, targets=5)
    replay = verified(own.record(tmp_path / "mission.rrd"))
    assert replay.verdict is not None
    assert (replay.verdict.compared, replay.verdict.equal, replay.passed) == (11, 11, True)
    assert replay.remarks == []
    assert len(own.steps[-1].tracks.ids) >= 4


def test_intensities_are_made_again_to_the_bit(tmp_path: Path) -> None:
    flight = Flight({"kind": "intensity", "intensity_rule": "hybrid"})
    rng = np.random.default_rng(3)
    for name in ("r1", "r2"):
        flight.put(info(name), 0.5)
    for second in range(1, 9):
        for name in ("r1", "r2"):
            means = np.array([[0.0, 0, 10, 0], [5000.0, 0, 0, 10]]) + rng.normal(size=(2, 4))
            message = schemas.LocalIntensity(
                source=name, epoch=1, seq=second, sent=0, time=START + second * SECOND, space=SPACE, frame=FRAME,
                weights=np.array([0.9, 0.8]), means=means, covariances=np.tile(np.diag([9.0, 9, 1, 1]), (2, 1, 1)),
            )  # fmt: skip
            flight.put(message, second)
        if second == 5:
            flight.begin(flight.centre.checkpoint(), 8)
        flight.step(second)
    path = flight.record(tmp_path / "mission.rrd")
    replay = verified(path)
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 8
    other = run_replay(path, rules=["aa"], out=tmp_path / "aa.rrd", draw=False, say=lambda line: None)
    assert [player.variant.name for player in other.players] == ["aa"]
    assert {picture.rule for picture in pictures(tmp_path / "aa.rrd", "aa")} == {"aa"}


def test_a_changed_recording_is_found_out_at_its_step_and_field(flight: Flight, tmp_path: Path) -> None:
    shown = [result.tracks for result in flight.steps]
    track = int(shown[6].ids[2])

    def moved_track(message: Any) -> Any:
        if isinstance(message, GlobalTracks) and message.step == 7:
            means = message.means.copy()
            means[2, 1] = np.nextafter(means[2, 1], np.inf)
            return dataclasses.replace(message, means=means)
        return message

    replay = verified(record(tmp_path / "a.rrd", edited(flight.log, moved_track)))
    assert replay.verdict is not None
    assert replay.verdict.first is not None
    step, at, difference = replay.verdict.first
    assert (step, at, difference.track, difference.field) == (7, shown[6].time, track, "mean y")
    assert difference.made == repr(float(shown[6].means[2, 1])) != difference.recorded
    assert 0 < difference.relative < 1e-14
    assert (replay.verdict.compared, replay.verdict.equal) == (14, 13)

    def other_status(message: Any) -> Any:
        if isinstance(message, GlobalTracks) and message.step == 9:
            status = message.status.copy()
            status[0] = (status[0] + 1) % 3
            return dataclasses.replace(message, status=status)
        return message

    replay = verified(record(tmp_path / "b.rrd", edited(flight.log, other_status)))
    assert replay.verdict is not None
    assert replay.verdict.first is not None
    assert (replay.verdict.first[0], replay.verdict.first[2].field) == (9, "status")

    def decided(message: Any) -> Any:
        if isinstance(message, StepLog) and message.step == 5:
            value = message.decisions.value.copy()
            value[np.flatnonzero(np.isfinite(value))[0]] += 1.0
            return dataclasses.replace(message, decisions=dataclasses.replace(message.decisions, value=value))
        return message

    replay = verified(record(tmp_path / "c.rrd", edited(flight.log, decided)))
    assert replay.verdict is not None
    assert replay.verdict.first is not None
    assert (replay.verdict.first[0], replay.verdict.first[2].field) == (5, "decision")


def test_a_changed_input_and_changed_settings_are_found_out(flight: Flight, tmp_path: Path) -> None:
    taken = [entry for entry in flight.steps[3].log.taken if entry.source == "r3"][-1]

    def other_input(message: Any) -> Any:
        if isinstance(message, LocalTracks) and schemas.digest(message) == taken.hash:
            return dataclasses.replace(message, means=message.means + 1e-6)
        return message

    replay = verified(record(tmp_path / "a.rrd", edited(flight.log, other_input)))
    assert not replay.passed
    assert replay.verdict is not None
    assert replay.verdict.first is not None
    assert replay.verdict.first[0] == 4
    assert replay.verdict.first[2].field == f"message {taken.seq} of r3 (digest)"
    assert replay.verdict.compared == 3 + 5  # before it, and from the restart of the centre on
    assert any("steps 4 to 9" in text for text in replay.remarks)

    def other_settings(message: Any) -> Any:
        if isinstance(message, StepLog):
            events = []
            for event in message.events:
                if "config" in event:
                    event = {**event, "config": {**event["config"], "gate": 0.9}}
                events.append(event)
            return dataclasses.replace(message, events=tuple(events))
        return message

    replay = verified(record(tmp_path / "b.rrd", edited(flight.log, other_settings)))
    assert not replay.passed
    assert any("the settings in the log have hash" in text for text in replay.remarks)


def test_the_order_of_arrival_does_not_matter(flight: Flight, tmp_path: Path) -> None:
    """Logs before their pictures, and up to three seconds of shuffling: inputs after the step that took them too."""
    rng = np.random.default_rng(5)
    place = [(received + rng.uniform(0, 3) * SECOND, k) for k, (_, _, received) in enumerate(flight.log)]
    shuffled = [(*flight.log[k][:2], round(when)) for when, k in sorted(place)]
    assert [one[:2] for one in shuffled] != [one[:2] for one in flight.log]
    replay = verified(record(tmp_path / "mission.rrd", shuffled))
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 14


def test_what_cannot_be_compared_is_told(flight: Flight, tmp_path: Path) -> None:
    """A recording that begins in the middle of a run; a lost log; a lost message. The restart at step 10 mends it."""

    def verdict(log: list[tuple[str, bytes, int]], name: str) -> Replay:
        return verified(record(tmp_path / name, log))

    begun = [one for one in flight.log if one[2] > START + 4.5 * SECOND]
    replay = verdict(begun, "begun.rrd")
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 5
    assert replay.remarks == ["not compared: steps 5 to 9: the start of the run is not in the recording"]

    lost = edited(flight.log, lambda m: None if isinstance(m, StepLog) and m.step == 6 else m)
    replay = verdict(lost, "lost.rrd")
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 5 + 5
    assert replay.remarks == ["not compared: steps 6 to 9: a step has no log"]

    both = edited(flight.log, lambda m: None if isinstance(m, StepLog | GlobalTracks) and m.step == 6 else m)
    replay = verdict(both, "both.rrd")
    assert replay.passed
    assert replay.remarks == ["not compared: steps 7 to 9: steps before it are not in the recording"]

    taken = flight.steps[1].log.taken[0]
    gone = edited(flight.log, lambda m: None if schemas.digest(m) == taken.hash else m)
    replay = verdict(gone, "gone.rrd")
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 1 + 5
    assert replay.remarks == [
        f"not compared: steps 2 to 9: message {taken.seq} of {taken.source} is not in the recording"
    ]

    unseen = edited(flight.log, lambda m: None if isinstance(m, GlobalTracks) and m.step == 6 else m)
    replay = verdict(unseen, "unseen.rrd")
    assert replay.passed
    assert replay.verdict is not None
    assert (replay.verdict.compared, replay.verdict.unseen) == (14, 1)
    assert "1 of them by their log alone" in replay.verdict.told


def test_a_checkpoint_too_large_for_its_log_is_replaced_by_the_replays_own(flight: Flight, tmp_path: Path) -> None:
    def left_out(message: Any) -> Any:
        if isinstance(message, StepLog):
            events = tuple(
                {("left_out" if key == "checkpoint" else key): value for key, value in event.items()}
                for event in message.events
            )
            return dataclasses.replace(message, events=events)
        return message

    log = edited(flight.log, left_out)
    assert verified(record(tmp_path / "whole.rrd", log)).passed
    begun = [one for one in log if one[2] > START + 4.5 * SECOND]
    replay = verified(record(tmp_path / "begun.rrd", begun))
    assert replay.verdict is not None
    assert replay.verdict.compared == 0
    assert not replay.passed
    assert any("too large for its log" in text for text in replay.remarks)


def test_little_is_held_however_long_the_mission(tmp_path: Path) -> None:
    """And a source's last messages are still there for a service that begins with nothing."""
    flight = Flight({"lateness": 2.0})
    rng, states = np.random.default_rng(2), truth(3)
    last: list[Any] = [info(name) for name in flown.SOURCES]
    for message in last:
        flight.put(message, 0.5)
    for second in range(1, 91):
        if second == 70:
            flight.begin(None, 8)
            for message in last:
                flight.centre.handle(message, START + second * SECOND)
        for name in flown.SOURCES:
            flight.put(tracks(name, second, seen(moved(states, second), rng)), second)
        flight.step(second)
    replay = verified(flight.record(tmp_path / "mission.rrd"))
    assert replay.passed
    assert replay.verdict is not None
    assert replay.verdict.compared == 90
    assert replay.most_buffered <= 3 * (8 + 1) + 3 * 2


def test_garbage_and_a_stop_end_it_in_words(flight: Flight, mission: Path, tmp_path: Path) -> None:
    """Undecodable messages, a start whose checkpoint is nonsense, decisions of nobody."""

    def spoiled(message: Any) -> Any:
        if isinstance(message, StepLog) and message.step == 10:
            events = tuple(
                {**event, "checkpoint": b"nonsense"} if event["kind"] == "start" else event for event in message.events
            )
            return dataclasses.replace(message, events=events)
        return message

    log = edited(flight.log, spoiled)
    log.insert(5, (schemas.local_key("r1", "tracks", REALM), b"\xff\x00", log[5][2]))
    log.insert(9, ("nobody's key", b"x", log[9][2]))
    replay = verified(record(tmp_path / "bad.rrd", log))
    assert replay.verdict is not None
    assert replay.verdict.compared == 9
    assert any("the checkpoint that the run began from cannot be used" in text for text in replay.remarks)
    assert any("1 messages do not decode" in text for text in replay.remarks)
    stop = threading.Event()
    stop.set()
    assert run_replay(mission, verify=True, stop=stop, say=lambda line: None).stopped
