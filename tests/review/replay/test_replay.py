"""A recorded mission is fused again: the same to the bit, or under other rules side by side."""

from __future__ import annotations

import dataclasses
import json
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.cli import main
from fusion_service.config import centre_config, config_hash
from fusion_service.config.settings import nested, plain_settings, recordable
from fusion_service.errors import ReviewError
from fusion_service.review.replay import Replay, run_replay
from fusion_service.rules import RULES
from schemas import GlobalTracks, LocalTracks, StepLog
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, moved, seen, tracks, truth
from tests.helpers import flown
from tests.helpers.flown import REALM, Flight, edited, messy, raws, record
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import COMMAND, Program, opened
from tests.recording.contents import entities

OPTIONS: dict[str, dict[str, Any]] = {
    "hmd-s": {"samples": 200},
    "gmd-s": {"samples": 200},
    "bci": {"max_correlation": 0.5, "criterion": "trace"},
}
CENTRE_RULES = sorted(set(RULES) - {"bar-shalom-campo"})  # that one needs the cross-covariance


def verified(path: Path, **asked: Any) -> Replay:
    return run_replay(path, verify=True, say=lambda line: None, **asked)


def pictures(path: Path, centre: str) -> list[GlobalTracks]:
    key = schemas.global_key(centre, "tracks", REALM)
    return [schemas.decode(raw.data) for raw in raws(path) if raw.key == key]  # type: ignore[misc]


@pytest.fixture(scope="module")
def flight() -> Flight:
    return messy({"rule_options": {"criterion": "trace"}})


@pytest.fixture(scope="module")
def mission(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flight.record(tmp_path_factory.mktemp("replay") / "mission.rrd")


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


def test_settings_come_back_from_a_log_as_they_were() -> None:
    configs: list[dict[str, Any]] = [
        {},
        {"rule": "bci", "rule_options": {"max_correlation": 0.3}},
        {"frame": schemas.Enu(59, 10), "space": ("x", "y", "z", "vx", "vy", "vz"), "motion": {"kind": "cv", "q": 3}},
        {"frame": {"kind": "local", "name": "harbour"}, "mixture_rule": "gm-ga", "mixture_options": {}},
        {"sources": {"a.b": {"period": 2.5}, "r:1": {"motion": {"kind": "ct", "q": 1.0, "q_turn": 0.1}}}},
        {"source_defaults": {"height": {"value": 10.0, "sigma": 2.0}, "ignore": True}, "sources": {"r": {}}},
        {"kind": "intensity", "intensity_rule": "ga", "rule": "ci", "rule_options": {"criterion": "trace"}},
    ]
    kinds = ("u1", "u8", "u2", "u8", "u8", "u8", "f8")
    nothing = schemas.Decisions(*(np.zeros(0, dtype=kind) for kind in kinds))
    for raw in configs:
        config = centre_config(raw)
        log = StepLog(
            source="c", epoch=1, seq=0, sent=0, step=1, time=1, config_hash="", version="", taken=(), refused=(),
            dropped=(), events=({"kind": "start", "config": recordable(config)},), sources=(),
            decisions=nothing,
        )  # fmt: skip
        back = schemas.decode(schemas.encode(log))
        assert isinstance(back, StepLog)
        again = centre_config(nested(back.events[0]["config"]))
        assert config_hash(again) == config_hash(config)
        assert again == config


def test_settings_that_no_log_can_hold_are_left_out() -> None:
    config = dataclasses.replace(centre_config({}), rule_options={"x": [[[[1.0]]]]})
    assert recordable(config) is None
    config = dataclasses.replace(centre_config({}), rule_options={"x": "x" * 2**21})
    assert recordable(config) is None
    assert "rule" in plain_settings(config)


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


def test_several_rules_stand_side_by_side_in_one_recording(flight: Flight, mission: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    out = tmp_path / "rules.rrd"
    rules = ["ci", "hmd-ga:criterion=trace", "bci:max_correlation=0.5", "ci:criterion=trace"]
    replay = run_replay(mission, rules=rules, out=out, say=lines.append)
    names = [player.variant.name for player in replay.players]
    assert names == ["ci", "hmd-ga-trace", "bci-0.5", "ci-trace"]
    assert "ci, hmd-ga-trace, bci-0.5, ci-trace by their logs" in lines[0]
    assert [line.split()[0] for line in lines[1:5]] == names
    kept = [raw[1:] for raw in raws(out) if not any(f"/{name}/" in raw.key for name in names)]
    assert kept == [raw[1:] for raw in raws(mission)]
    for name in names:
        made = pictures(out, name)
        assert [picture.step for picture in made] == list(range(1, 15))
        assert {(p.origin, p.source, (p.lineage or ())[-1]) for p in made} == {("replay", name, name)}
        assert f"/picture/global/{name}" in entities(out)
    same = [(a, b) for a, b in zip(pictures(out, "ci-trace"), (one.tracks for one in flight.steps), strict=True)]
    assert all(np.array_equal(a.means, b.means) and np.array_equal(a.ids, b.ids) for a, b in same)
    assert not np.array_equal(pictures(out, "hmd-ga-trace")[5].means, pictures(out, "ci")[5].means)

    assert main(["replay", str(out), "--verify", "--centre", "hmd-ga-trace"]) == 0
    with pytest.raises(ReviewError, match="no centre 'nobody': name one of its centres"):
        run_replay(out, verify=True, centre="nobody")

    bare = tmp_path / "bare.rrd"
    run_replay(mission, rules=["naive"], out=bare, keep_recorded=False, draw=False, say=lines.append)
    assert {raw.key.split("/")[3] for raw in raws(bare) if "/global/" in raw.key} == {"naive"}


def test_another_rule_gives_what_the_mission_would_have_given(tmp_path: Path) -> None:
    """Without a restart, and where links do not depend on the rule: the same messages flown under it."""
    settings = {"lateness": 2.0, "coast": 2.0}
    one, other = (messy({"rule": rule, **settings}, steps=9) for rule in ("ci", "naive"))
    path = one.record(tmp_path / "mission.rrd")
    out = tmp_path / "naive.rrd"
    run_replay(path, rules=["naive"], out=out, draw=False, say=lambda line: None)
    for made, flown_one in zip(pictures(out, "naive"), (step.tracks for step in other.steps), strict=True):
        np.testing.assert_array_equal(made.ids, flown_one.ids)
        np.testing.assert_array_equal(made.means, flown_one.means)
        np.testing.assert_array_equal(made.covariances, flown_one.covariances)
    run_replay(path, settings=["rule=naive"], out=tmp_path / "set.rrd", draw=False, say=lambda line: None)
    again = pictures(tmp_path / "set.rrd", "replay")
    assert all(np.array_equal(a.means, b.means) for a, b in zip(again, pictures(out, "naive"), strict=True))


def test_two_replays_give_the_same_bytes(mission: Path, tmp_path: Path) -> None:
    for name in ("a.rrd", "b.rrd"):
        run_replay(mission, rules=["ci", "naive"], out=tmp_path / name, draw=False, say=lambda line: None)
    assert raws(tmp_path / "a.rrd") == raws(tmp_path / "b.rrd")


def test_a_recording_without_step_logs_is_fused_by_the_message_clock(tmp_path: Path) -> None:
    rng, states = np.random.default_rng(2), truth(5)
    log = []
    for second in range(1, 13):
        for name in ("r1", "r2"):
            if second == 1:
                log.append((schemas.local_key(name, "info", REALM), schemas.encode(info(name)), START))
            message = tracks(name, second, seen(moved(states, second), rng))
            log.append((schemas.local_key(name, "tracks", REALM), schemas.encode(message), START + second * SECOND))
    path = record(tmp_path / "local.rrd", log)
    lines: list[str] = []
    out = tmp_path / "fused.rrd"
    replay = run_replay(path, out=out, draw=False, say=lines.append)
    assert "no step logs in it: fused as replay by the messages' own time, default settings" in lines[0]
    made = pictures(out, "replay")
    assert [(picture.time - START) // SECOND for picture in made] == list(range(1, 13))
    last = made[-1]
    nearest = np.linalg.norm(last.means[:, None, :2] - moved(states, 12)[None, :, :2], axis=2).argmin(axis=1)
    assert sorted(nearest.tolist()) == list(range(5))
    assert replay.players[0].steps == 12
    with pytest.raises(ReviewError, match="nothing to verify"):
        run_replay(path, verify=True)


def test_the_clock_can_be_asked_for(flight: Flight, mission: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    out = tmp_path / "clock.rrd"
    run_replay(mission, settings=["period=2.0"], clock=True, out=out, draw=False, say=lines.append)
    assert "--clock: fused as replay by the messages' own time, its own settings" in lines[0]
    times = [(picture.time - START) / SECOND for picture in pictures(out, "replay")]
    assert times == list(np.arange(2.0, times[-1] + 1, 2.0))
    assert times[-1] >= 12


def test_old_recordings_need_their_config(flight: Flight, tmp_path: Path) -> None:
    def plain(message: Any) -> Any:
        if isinstance(message, StepLog):
            events = tuple({k: v for k, v in event.items() if k != "config"} for event in message.events)
            return dataclasses.replace(message, events=events)
        return message

    path = record(tmp_path / "old.rrd", edited(flight.log, plain))
    with pytest.raises(ReviewError, match="give the config of the mission with --config"):
        verified(path)
    config = tmp_path / "centre.toml"
    config.write_text('[centre]\nlateness = 2.0\ncoast = 2.0\nrule_options = {criterion = "trace"}\n')
    assert verified(path, config=config).passed
    config.write_text("[centre]\ncoast = 3.0\n")
    with pytest.raises(ReviewError, match="does not hold the settings of the mission"):
        verified(path, config=config)


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
    assert replay.most_held <= 3 * (8 + 1) + 3 * 2


def test_mistakes_are_told_before_anything_is_written(mission: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.rrd"
    (mission.parent / "parts").mkdir()
    (mission.parent / "parts" / "0001.rrd").touch()
    cases: list[tuple[list[str], int, str]] = [
        (["--rule", "magic", "--out", str(out)], 2, "magic"),
        (["--rule", "ci:criterion", "--out", str(out)], 2, "write NAME or NAME:OPTION=VALUE"),
        (["--rule", "ci:colour=red", "--out", str(out)], 2, "ci has no option 'colour'"),
        (["--set", "gate=7", "--out", str(out)], 2, "gate"),
        (["--set", "gate", "--out", str(out)], 2, "write KEY=VALUE"),
        ([], 2, "nothing to do"),
        (["--verify", "--rule", "ci"], 1, "leave out --rule"),
        (["--out", str(mission)], 1, "exists already"),
        (["--out", str(mission.parent / "parts")], 1, "exists already"),
        (["--out", str(mission.parent)], 1, "exists already"),
        (["--verify", "--json", str(mission)], 1, "is what is read"),
        (["--verify", "--json", str(tmp_path / "gone" / "r.json")], 1, "in a folder that exists"),
        (["--out", str(out), "--config", "nowhere.toml"], 2, "cannot be read"),
        (["--out", str(out), "--centre", "nobody"], 1, "holds no centre 'nobody'"),
    ]
    for arguments, code, words in cases:
        assert main(["replay", str(mission), *arguments]) == code, arguments
        assert words in capsys.readouterr().err
        assert not out.exists()
    assert main(["replay", str(tmp_path / "none.rrd"), "--verify"]) == 1
    assert "no recording at" in capsys.readouterr().err


def test_a_missing_extra_is_told_in_one_line(mission: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["replay", str(mission), "--verify"]) == 1
    errors = capsys.readouterr().err
    assert "pip install 'track-fusion-centre[record]'" in errors
    assert len(errors.strip().splitlines()) == 1


def test_the_verdict_is_the_exit_code(flight: Flight, mission: Path, tmp_path: Path, capsys: Any) -> None:
    result = tmp_path / "result.json"
    assert main(["replay", str(mission), "--verify", "--json", str(result)]) == 0
    assert "14 steps made again: equal to the bit" in capsys.readouterr().out
    told = json.loads(result.read_text())
    assert told["verify"]["passed"] is True
    assert told["variants"][0]["config_hash"] == config_hash(flight.config)

    def changed(message: Any) -> Any:
        if isinstance(message, GlobalTracks) and message.step == 3:
            return dataclasses.replace(message, existence=message.existence * 0.5)
        return message

    bad = record(tmp_path / "bad.rrd", edited(flight.log, changed))
    assert main(["replay", str(bad), "--verify"]) == 1
    errors = capsys.readouterr().err
    assert "differs first at step 3" in errors
    assert "existence" in errors
    assert len(errors.strip().splitlines()) == 1


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


def test_a_service_killed_and_started_again_is_verified_from_its_recording(hub: Hub, tmp_path: Path) -> None:
    """Real processes: hub, sensors, a service that is killed and comes back with its checkpoint, and the recorder."""
    path = tmp_path / "mission.rrd"
    with opened(hub, tmp_path) as scene:
        recorder = scene.start(COMMAND, "record", "--out", str(path), "--connect", scene.endpoint)
        eventually(path.exists, 20)
        scene.sensor("r1", 0, 1, 2)
        scene.sensor("r2", 1, 2, 3)
        service = scene.service('rule = "hmd-ga"\nmemory = "recursive"')
        eventually(scene.seen.sees(0, 1, 2, 3), 15)
        eventually(lambda: len(scene.seen.pictures) > 10)
        service.kill()
        killed = len(scene.seen.pictures)
        service = scene.service('rule = "hmd-ga"\nmemory = "recursive"')
        eventually(lambda: len(scene.seen.pictures) > killed + 10, 15)
        service.signal(flown.SIGTERM)
        assert service.end()[0] == 0
        recorder.signal(flown.SIGTERM)
        assert recorder.end()[0] == 0
    result = tmp_path / "result.json"
    with Program(COMMAND, "replay", str(path), "--verify", "--json", str(result)) as program:
        assert program.end(60) == (0, "")
    told = json.loads(result.read_text())
    assert told["verify"]["compared"] >= 20
    assert told["remarks"] == []
    assert told["variants"][0]["config"]["rule"] == "hmd-ga"
