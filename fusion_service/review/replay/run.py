"""A recorded mission fused again: as it was, to the bit, or under other rules and settings, side by side.

The messages of the sources go through the same centre as in the mission, as fast as it can. What a replay makes is
written by the recorder, beside the mission's own messages, and of origin `replay`. Read as a stream: what is held does
not grow with the mission.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

from fusion_service.centre import StepResult
from fusion_service.config import config_hash, load_config
from fusion_service.config.own_rule import is_own_rule
from fusion_service.config.settings import plain_settings
from fusion_service.errors import ReviewError
from fusion_service.progress import Progress
from fusion_service.recording import RawMessage, read
from fusion_service.recording.scoring import scoring_of
from fusion_service.recording.steps import Step
from fusion_service.recording.survey import RecordedCentre, Survey, key_of, survey
from fusion_service.review.replay.clock_engine import ClockEngine
from fusion_service.review.replay.engine import Engine
from fusion_service.review.replay.log_engine import LogEngine
from fusion_service.review.replay.mission_settings import MissionSettings
from fusion_service.review.replay.player import Player
from fusion_service.review.replay.recorded_rule import with_recorded_rule
from fusion_service.review.replay.variants import variants_of
from fusion_service.review.replay.verifying import Difference, Verdict
from fusion_service.review.replay.writer import ReplayWriter
from schemas import GlobalTracks, LocalIntensity, LocalTracks, MessageError, SensorInfo, StepLog, centre_source, decode

__all__ = ["Replay", "run_replay"]

SHOWN = 200
"""Messages between two looks of the progress bar."""


@dataclass
class Replay:
    """What a replay came to. by: log or clock; verdict: None where nothing was to be compared; most_buffered: messages
    that waited for a step at a time."""

    path: Path
    by: str
    players: list[Player]
    out: Path | None = None
    verdict: Verdict | None = None
    remarks: list[str] = field(default_factory=list)
    stopped: bool = False
    most_buffered: int = 0

    @property
    def passed(self) -> bool:
        """Whether something was compared and nothing differed."""
        return self.verdict is not None and self.verdict.compared > 0 and self.verdict.first is None

    def as_json(self) -> dict[str, Any]:
        """Plain values for a file."""
        result: dict[str, Any] = {
            "recording": str(self.path),
            "out": None if self.out is None else str(self.out),
            "by": self.by,
            "stopped": self.stopped,
            "variants": [_numbers(player) for player in self.players],
            "remarks": self.remarks,
        }
        if self.verdict is not None:
            first = self.verdict.first
            result["verify"] = {
                "passed": self.passed,
                "compared": self.verdict.compared,
                "equal": self.verdict.equal,
                "by_log_alone": self.verdict.unseen,
                "largest_relative_difference": self.verdict.largest,
                "first": None if first is None else {"step": first[0], "time": first[1], **_difference(first[2])},
            }
        return result


def run_replay(
    path: str | Path,
    *,
    rules: Sequence[str] = (),
    settings: Sequence[str] = (),
    config: str | Path | None = None,
    out: str | Path | None = None,
    verify: bool = False,
    centre: str | None = None,
    clock: bool = False,
    keep_recorded: bool = True,
    draw: bool = True,
    stop: Event | None = None,
    say: Callable[[str], None] = print,
) -> Replay:
    """Fuse the recording `path` again; arguments as of the command. Differences that `verify` finds are in the result.

    `ReviewError` or `ConfigError` says what is wrong with what was asked, before anything is written.
    """
    if verify and (settings or clock or not all(map(is_own_rule, rules)) or len(rules) > 1):
        raise ReviewError("--verify makes the mission as it was: leave out --rule, --set and --clock")
    stop = stop or Event()
    given = None if config is None else load_config(config).centre
    found = survey(path, stop)
    if stop.is_set():
        return Replay(found.path, "log", [], stopped=True)
    followed = found.chosen(centre)
    if verify and followed is None:
        raise ReviewError(f"{path} has no step logs of a centre: there is nothing to verify")
    variants = variants_of(rules, settings, found.sources | set(found.centres))
    said: list[str] = []
    if followed is not None:
        variants, said = with_recorded_rule(variants, followed, verify=verify)
    players = [Player(one) for one in variants]
    own = MissionSettings(found, followed, given, by_clock=clock, ruled=all(one.rule for one in variants))
    if not found.inputs and not own.centres & {centre_source(name) for name in found.centres}:
        raise ReviewError(f"{path} holds no messages of sources: there is nothing to fuse")
    own.check([player.variant for player in players])
    if verify and own.foreign:
        raise ReviewError(f"{config} does not hold the settings of the mission (hash {own.foreign}): leave it out")
    by_log = followed is not None and not clock
    replay = Replay(found.path, "log" if by_log else "clock", players, None if out is None else Path(out))
    replay.verdict = Verdict() if verify else None
    with ExitStack() as stack:
        writer = None
        if out is not None:
            kept = {"keep_recorded": keep_recorded, "draw": draw}
            writer = stack.enter_context(ReplayWriter(out, found.realm, scoring=scoring_of(found.path), **kept))
        say(_first_line(replay, followed, own))
        begin = time.perf_counter()
        _play(replay, found, followed if by_log else None, own, writer, stop)
    replay.remarks += [*said, *own.remarks]
    _say_end(replay, time.perf_counter() - begin, say)
    return replay


def _play(
    replay: Replay,
    found: Survey,
    followed: RecordedCentre | None,
    settings: MissionSettings,
    writer: ReplayWriter | None,
    stop: Event,
) -> None:
    """Fuse all messages again; followed: by the step logs of this centre, None by the messages' own time."""
    verdict = replay.verdict

    def on_step(player: Player, result: StepResult, step: Step) -> None:
        if writer is not None:
            writer.publish(player.variant.name, result, step.received)
        if verdict is not None and not engine.apart:
            verdict.look(step, result)

    engine: Engine
    if followed is not None:
        engine = LogEngine(replay.players, settings.of, on_step)
    else:
        configs = [player.variant.config(settings.first) for player in replay.players]
        engine = ClockEngine(replay.players, configs, on_step)
    now, unread, centres = 0, 0, settings.centres
    with Progress("Fusing") as bar:
        for number, raw in enumerate(read(found.path)):
            if stop.is_set():
                replay.stopped = True
                break
            now = max(now, raw.received)
            if writer is not None:
                writer.copy(raw)
            try:
                _feed(engine, raw, found.realm, followed, centres)
            except MessageError:
                unread += 1
            replay.most_buffered = max(replay.most_buffered, engine.buffered)
            if number % SHOWN == 0:
                steps = sum(player.steps for player in replay.players)
                bar.show(number / max(found.messages, 1), f"{steps} steps")
    if not replay.stopped:
        engine.finish(now)
    if unread:
        replay.remarks.append(f"{unread} messages do not decode: they were left out")
    if verdict is not None:
        verdict.first = verdict.first or engine.changed
        replay.remarks += [f"not compared: {one}" for one in engine.uncompared]
    replay.remarks += engine.remarks()


def _feed(
    engine: Engine, raw: RawMessage, realm: str, followed: RecordedCentre | None, centres: Collection[str]
) -> None:
    """Give `engine` a message of a source, those of `centres` included, or of the centre that is followed;
    `MessageError` if it does not decode."""
    key = key_of(raw.key)
    if key is None or key.realm != realm:
        return
    ours = followed is not None and key.scope == "global" and key.name == followed.name
    told = key.scope == "local" or (key.source in centres and key.what == "tracks")
    if not (ours and key.what in ("tracks", "log")) and not told:
        return
    message = decode(raw.data)
    if message.source != key.name:
        return
    if not ours and isinstance(message, LocalTracks | LocalIntensity | SensorInfo | GlobalTracks):
        engine.input(message, raw.received, len(raw.data))
    elif isinstance(message, StepLog | GlobalTracks):
        engine.output(message, raw.received)
    engine.advance(raw.received)


def _first_line(replay: Replay, followed: RecordedCentre | None, settings: MissionSettings) -> str:
    names = ", ".join(player.variant.name for player in replay.players)
    if replay.by == "log":
        assert followed is not None
        what = "verified" if replay.verdict is not None else f"fused again as {names}"
        how = f"{followed.logs} steps of centre {followed.name}, {what} by their logs"
    else:
        why = "--clock" if followed is not None else "no step logs in it"
        how = f"{why}: fused as {names} by the messages' own time, {settings.told}"
    return f"{replay.path}: {how}" + (f", into {replay.out}" if replay.out is not None else "")


def _say_end(replay: Replay, seconds: float, say: Callable[[str], None]) -> None:
    for text in replay.remarks:
        say(text)
    width = max((len(player.variant.name) for player in replay.players), default=0)
    for player in replay.players:
        numbers = _numbers(player)
        speed = numbers["times_real_time"]
        fast = "" if not speed else f"   {speed:,.0f} x real time"
        said = f"{player.steps:>7} steps  {len(player.tracks):>5} tracks  {player.seconds:>8.2f} s of fusion{fast}"
        say(f"{player.variant.name:<{width}} {said}")
    span = max((player.span[1] - player.span[0] for player in replay.players), default=0) / 1e9
    whole = f", {span / seconds:,.0f} x real time with reading and writing" if seconds > 0 and span > 0 else ""
    say(f"{'stopped' if replay.stopped else 'done'} in {seconds:.1f} s{whole}")


def _numbers(player: Player) -> dict[str, Any]:
    config = player.config
    span = (player.span[1] - player.span[0]) / 1e9
    return {
        "name": player.variant.name,
        "config": None if config is None else plain_settings(config),
        "config_hash": None if config is None else config_hash(config),
        "steps": player.steps,
        "tracks": len(player.tracks),
        "seconds": player.seconds,
        "times_real_time": span / player.seconds if player.seconds > 0 else None,
    }


def _difference(one: Difference) -> dict[str, Any]:
    track = None if one.track is None else str(one.track)  # ids have more bits than JavaScript keeps of a number
    return {**one._asdict(), "track": track, "relative": None if math.isnan(one.relative) else one.relative}
