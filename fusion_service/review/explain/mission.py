"""What a recorded centre did over a mission: the lives of its tracks, the story of one, refusals, and its settings."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Event

from fusion_service.config import CentreConfig, ConfigError, centre_config
from fusion_service.errors import ReviewError, Stopped
from fusion_service.labels import Labels
from fusion_service.metrics import chi2_quantile
from fusion_service.progress import Progress
from fusion_service.recording import RawMessage, read
from fusion_service.recording.steps import Step, Steps
from fusion_service.recording.survey import RecordedCentre, key_of, survey
from fusion_service.review.explain.fused_by import FusedBy
from fusion_service.review.explain.histories import TrackHistories
from fusion_service.review.explain.story import Story
from schemas import GlobalTracks, MessageError, StepLog, Wholes, decode

__all__ = ["RecordedMission", "Refusals", "read_mission"]

RECENT = 8
"""Messages of a source that are looked at for what it says of a track."""
TOGETHER = 10
"""Steps between two refusals that are told as one."""
MOST_RUNS = 10_000
SHOWN = 200
"""Messages between two looks of the progress bar."""


@dataclass(slots=True)
class Refusals:
    """What was refused of a source for one reason, in steps not far from each other: whole messages, and tracks."""

    source: str
    reason: str
    first: int
    last: int
    number: int
    messages: int = 0
    tracks: int = 0


@dataclass
class RecordedMission:
    """What was read of a centre. Times in ns; start: of its first step; steps: how many; story: of the track asked
    for; fused_by: by which way its tracks were fused; config: its newest settings, None where they are not known."""

    path: Path
    centre: RecordedCentre
    histories: TrackHistories = field(default_factory=TrackHistories)
    labels: Labels = field(default_factory=Labels)
    fused_by: FusedBy = field(default_factory=FusedBy)
    start: int = 0
    steps: int = 0
    rule: str = ""
    config: CentreConfig | None = None
    story: Story | None = None
    refusals: list[Refusals] = field(default_factory=list)

    def seconds(self, at: int) -> float:
        """Since the start."""
        return (at - self.start) / 1e9

    def gates(self) -> tuple[float, float, float]:
        """Bounds on d2 of a new link, of a standing one and of a merge; NaN where the settings are not known."""
        if self.config is None or self.config.kind == "intensity":
            return math.nan, math.nan, math.nan
        n, config = len(self.config.space), self.config
        return chi2_quantile(config.gate, n), chi2_quantile(config.keep_gate, n), chi2_quantile(config.merge_gate, n)


def read_mission(
    path: str | Path,
    *,
    track: str | None = None,
    at: str | None = None,
    centre: str | None = None,
    stop: Event | None = None,
) -> RecordedMission:
    """Read what a centre did, and the story of `track` (a label, or a whole id) with its moment at `at`.

    `ReviewError` where the recording, the track or the time is not as it must be.
    """
    stop = stop or Event()
    found = survey(path, stop)
    if stop.is_set():
        raise Stopped("stopped")
    mission = RecordedMission(found.path, found.shown(centre))
    if track is not None:
        try:
            mission.labels.find(track)
        except ValueError:
            what = "give the number that the recording shows (7, 2.7), or the whole id"
            raise ReviewError(f"{track!r} is no track: {what}") from None
    reader = _Reader(mission, track, at)
    with Progress("Reading") as bar:
        for number, raw in enumerate(read(path)):
            if stop.is_set():
                raise Stopped(f"stopped after {mission.steps} steps")
            reader.take(raw)
            if number % SHOWN == 0:
                bar.show(number / found.messages, f"{mission.steps} steps")
    reader.finish()
    if not mission.steps:
        raise ReviewError(f"{path}: centre {mission.centre.name} made no step that can be read")
    if track is not None and (mission.story is None or mission.story.first < 0):
        number = len(mission.histories.known)
        raise ReviewError(
            f"{path}: centre {mission.centre.name} has no track {track}: it has {number}, from "
            f"{_ends(mission)}; without --track they are listed"
        )
    return mission


class _Reader:
    """Takes the messages of a recording as they came."""

    def __init__(self, mission: RecordedMission, track: str | None, at: str | None) -> None:
        self._mission = mission
        self._track = track
        self._at = at
        self._until: int | None = None
        self._steps = Steps()
        self._whole = Wholes()
        self._recent: dict[str, deque[RawMessage]] = {}
        self._runs: dict[tuple[str, str], Refusals] = {}

    def take(self, raw: RawMessage) -> None:
        key, centre = key_of(raw.key), self._mission.centre
        if key is None or key.realm != centre.realm:
            return
        if key.scope == "local" and key.what in ("tracks", "intensity"):
            self._recent.setdefault(key.name, deque(maxlen=RECENT)).append(raw)
        if key.scope != "global" or key.what not in ("tracks", "log"):
            return
        if key.what == "log" and key.name != centre.name:
            return
        try:
            message = decode(raw.data)
        except MessageError:
            return
        if isinstance(message, GlobalTracks):
            self._mission.labels.see(message)
        if key.name == centre.name and isinstance(message, GlobalTracks | StepLog):
            self._steps.add(message, raw.received)
            for step in self._steps.due(raw.received):
                self._step(step)

    def finish(self) -> None:
        for step in self._steps.due():
            self._step(step)

    def _step(self, step: Step) -> None:
        mission = self._mission
        if step.picture is not None:
            step.picture = self._whole.of(step.picture)
        if not mission.steps:
            mission.start = step.time
            self._until = None if self._at is None else time_of(self._at, step.time)
        mission.steps += 1
        mission.histories.step(step)
        if step.picture is not None:
            mission.rule = step.picture.rule
        if step.log is not None:
            self._settings(step.log)
            self._refused(step.log)
        if self._track is not None and mission.story is None:
            track = mission.labels.find(self._track)
            mission.story = None if track is None else Story(track, self._until)
        if mission.story is not None:
            mission.story.step(step, self._recent)
        mission.fused_by.step(step, None if mission.story is None else mission.story.track)

    def _settings(self, log: StepLog) -> None:
        tables = self._mission.centre.settings.get(log.config_hash)
        if tables is not None and (self._mission.config is None or _starts(log)):
            try:
                self._mission.config = centre_config(tables)
            except ConfigError:
                self._mission.config = None

    def _refused(self, log: StepLog) -> None:
        for entry in (*log.refused, *log.dropped):
            run = self._runs.get((entry.source, entry.reason))
            if run is None or log.step > run.number + TOGETHER or log.step < run.number:
                if len(self._mission.refusals) >= MOST_RUNS:
                    continue
                run = Refusals(entry.source, entry.reason, log.time, log.time, log.step)
                self._runs[entry.source, entry.reason] = run
                self._mission.refusals.append(run)
            run.last, run.number = log.time, log.step
            run.messages += entry.count == 0
            run.tracks += entry.count


def _starts(log: StepLog) -> bool:
    return any(event.get("kind") == "start" for event in log.events)


def time_of(text: str, start: int) -> int:
    """The time, ns, that `text` says: seconds from `start`, or ISO 8601 (UTC unless it says otherwise).
    Raises `ReviewError` for another text."""
    try:
        seconds = float(text)
    except ValueError:
        try:
            when = datetime.fromisoformat(text.strip())
        except ValueError:
            how = "write seconds from the start of the mission, or a time as in 2026-01-31T12:00:00Z"
            raise ReviewError(f"--at {text}: {how}") from None
        when = when if when.tzinfo is not None else when.replace(tzinfo=UTC)
        since = when - datetime(1970, 1, 1, tzinfo=UTC)
        return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
    if not math.isfinite(seconds) or abs(seconds) > 1e9:
        raise ReviewError(f"--at {text}: no time of a mission")
    return start + round(seconds * 1e9)


def _ends(mission: RecordedMission) -> str:
    """The first and the last track there are."""
    known = sorted(mission.histories.known)
    return f"{mission.labels(known[0])} to {mission.labels(known[-1])}" if known else "none"
