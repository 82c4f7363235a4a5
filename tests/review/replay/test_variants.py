"""A recorded mission is fused again under other rules and settings, by its logs or by a clock."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.cli import main
from fusion_service.config import centre_config, config_hash
from fusion_service.config.settings import nested, plain_settings, recordable
from fusion_service.errors import ReviewError
from fusion_service.review.replay import run_replay
from schemas import StepLog
from tests.centre.worlds import SECOND, START, info, moved, seen, tracks, truth
from tests.helpers.flown import REALM, Flight, edited, messy, pictures, raws, record, verified
from tests.recording.contents import entities


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


def test_several_rules_stand_side_by_side_in_one_recording(flight: Flight, mission: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    out = tmp_path / "rules.rrd"
    rules = ["ci", "hmd-ga:criterion=trace", "bci:max_correlation=0.5", "auto:criterion=trace"]
    replay = run_replay(mission, rules=rules, out=out, say=lines.append)
    names = [player.variant.name for player in replay.players]
    assert names == ["ci", "hmd-ga-trace", "bci-0.5", "auto-trace"]
    assert "ci, hmd-ga-trace, bci-0.5, auto-trace by their logs" in lines[0]
    assert [line.split()[0] for line in lines[1:5]] == names
    kept = [raw[1:] for raw in raws(out) if not any(f"/{name}/" in raw.key for name in names)]
    assert kept == [raw[1:] for raw in raws(mission)]
    for name in names:
        made = pictures(out, name)
        assert [picture.step for picture in made] == list(range(1, 15))
        assert {(p.origin, p.source, (p.lineage or ())[-1]) for p in made} == {("replay", name, name)}
        assert f"/picture/global/{name}" in entities(out)
    same = [(a, b) for a, b in zip(pictures(out, "auto-trace"), (one.tracks for one in flight.steps), strict=True)]
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
