"""What happened, as lines of text and a page of health.

/log/{about}         one line per event: refusals, sources, tracks, service, recorder
/log/track           with a `focus`: every decision on this track
/health/{centre}     the newest status as a page
"""

from __future__ import annotations

from collections import Counter, deque
from datetime import UTC, datetime
from typing import Any

import numpy as np

from fusion_service.labels import utc
from fusion_service.recording.columns import ColumnWriter, Stamp, documents, entity, texts
from fusion_service.recording.drawing.tracks import Drawing
from fusion_service.source_words import consistency, source_event, source_health, state_of
from fusion_service.ways import fused_by, tracklet_health
from schemas import GlobalTracks, Status, StepLog
from schemas.messages import DECISIONS, KEPT, NO_SOURCE

__all__ = ["EventLog"]

INFO, WARN = "INFO", "WARN"
WAITING = 1000
"""Lines that wait for a mission time; the oldest are dropped."""
KNOWN = 4096
"""Sources and services whose run is remembered, the newest."""
SAID_ELSEWHERE = ("found", "lost", "restarted")
"""Events of a service that its status, or the epoch of the messages, shows as well."""


class EventLog:
    """Turns messages into lines; repeats of one fault within a message become one line with a number."""

    def __init__(self, columns: ColumnWriter, drawing: Drawing, focus: int | None = None) -> None:
        self._columns = columns
        self._focus = focus
        self._label = drawing.label
        self._epochs: dict[tuple[str, str], int] = {}
        self._health: dict[str, dict[str, str]] = {}
        self._waiting: deque[tuple[str, str, str, int]] = deque(maxlen=WAITING)
        self._ways: dict[str, str] = {}

    def say(self, about: str, level: str, text: str, stamp: Stamp) -> None:
        """One line. What has no mission time waits for the next that has."""
        if stamp.time is None:
            self._waiting.append((about, level, text, stamp.received))
            return
        self.release(stamp.time)
        self._columns.add(entity("log", about), texts, stamp, (level, f"{_clock(stamp.time)}  {text}"))

    def release(self, time: int | None) -> None:
        """Write the lines that wait for a mission time with this one (None: with none)."""
        for about, level, text, received in self._waiting:
            shown = text if time is None else f"{_clock(time)}  {text}"
            self._columns.add(entity("log", about), texts, Stamp(received, time), (level, shown))
        self._waiting.clear()

    def begin(self, kind: str, name: str, epoch: int, stamp: Stamp) -> bool:
        """Note the run of a source or service; whether it is a new one."""
        before = self._epochs.get((kind, name))
        if before == epoch:
            return False
        self._epochs[kind, name] = epoch
        if len(self._epochs) > KNOWN:
            del self._epochs[next(iter(self._epochs))]
        verb = "appears" if before is None else "has been started again"
        self.say(f"{kind}s", INFO if before is None else WARN, f"{kind} {name} {verb} (epoch {utc(epoch)})", stamp)
        return True

    def alive(self, scope: str, name: str, alive: bool, stamp: Stamp) -> None:
        """A liveliness token came or went."""
        kind = "source" if scope == "local" else "service"
        text = f"{kind} {name} {'is on the bus' if alive else 'has left the bus'}"
        self.say(f"{kind}s", INFO if alive else WARN, text, stamp)

    def status(self, message: Status, stamp: Stamp) -> list[str]:
        """A line per source whose health changed, and the page. Returns the sources that were just lost."""
        lost = []
        known = self._health.get(message.source, {})
        states = self._health[message.source] = {name: _state(said) for name, said in message.sources.items()}
        for name, state in states.items():
            before = known.get(name)
            if before is not None and before != state:
                self.say("sources", INFO if state == "alive" else WARN, f"source {name}: {before} -> {state}", stamp)
            if state == "lost" and before != state:
                lost.append(name)
        if stamp.time is not None:
            self._columns.add(entity("health", message.source), documents, stamp, _page(message), stands=True)
        return lost

    def step(self, message: StepLog, stamp: Stamp) -> None:
        """Refusals and drops by source and reason, the service's own events."""
        for verb, entries in (("refused", message.refused), ("dropped", message.dropped)):
            counts = Counter[tuple[str, str, str]]()
            for entry in entries:
                counts[entry.source, entry.reason, "tracks" if entry.count else "messages"] += entry.count or 1
            for (source, reason, what), count in sorted(counts.items()):
                self.say("refusals", WARN, f"{verb} {count} {what} of {source}: {reason}", stamp)
        for event in message.events:
            kind = str(event.get("kind", "event"))
            if kind in SAID_ELSEWHERE:
                continue
            if (said := source_event(event)) is not None:
                bad, text = said
                level = WARN if bad else INFO
                self.say("sources", level, f"source {_short(event.get('source'))}: {text}", stamp)
                continue
            rest = ", ".join(f"{key} {_short(value)}" for key, value in event.items() if key not in ("kind", "epoch"))
            self.say("services", INFO, f"service {message.source}: {kind}{f' ({rest})' if rest else ''}", stamp)
        if self._focus is not None:
            self._decisions(message, self._focus, stamp)

    def _decisions(self, message: StepLog, track: int, stamp: Stamp) -> None:
        """All on `track` but that its links are kept."""
        made = message.decisions
        for row in np.flatnonzero(((made.track == track) | (made.other == track)) & (made.kind != KEPT)).tolist():
            text = DECISIONS[int(made.kind[row])].replace("_", " ")
            source = int(made.source[row])
            if source != NO_SOURCE and source < len(message.sources):
                text += f" {message.sources[source]} track {int(made.id[row])}"
            if other := int(made.other[row]):
                text += f", other track {self._label(int(made.track[row]) if other == track else other)}"
            if np.isfinite(value := float(made.value[row])):
                text += f" ({value:.3g})"
            self.say("track", INFO, f"{message.source}: {text}", stamp)

    def tracks(self, message: GlobalTracks, stamp: Stamp) -> None:
        """Ended, merged and split global tracks; whose, where there are several centres."""
        centres = {name for kind, name in self._epochs if kind == "service"}
        whose = f" of {message.source}" if len(centres) > 1 else ""
        for track, reason, heir in message.ended:
            into = f", goes on as {self._label(heir)}" if heir is not None else ""
            self.say("tracks", INFO, f"track {self._label(track)}{whose} ended: {reason}{into}", stamp)
        for new, old in message.split_from:
            self.say("tracks", INFO, f"track {self._label(new)}{whose} split from {self._label(old)}", stamp)
        if self._focus is not None:
            self._fused_by(message, self._focus, stamp)

    def _fused_by(self, message: GlobalTracks, track: int, stamp: Stamp) -> None:
        """A line when `track` is fused in another way than before, once not all are by the rule."""
        names, which = fused_by(message)
        if message.rules is None and message.source not in self._ways:
            return
        for row in np.flatnonzero(message.ids == np.uint64(track)).tolist():
            way = names[which[row]]
            if self._ways.get(message.source) != way:
                self._ways[message.source] = way
                self.say("track", INFO, f"{message.source}: fused by {way}", stamp)


def _state(said: dict[str, Any]) -> str:
    if not said.get("alive", True):
        return "lost"
    return "stale" if said.get("stale") else "alive"


def _short(value: Any) -> str:
    return f"{len(value)} bytes" if isinstance(value, bytes) else str(value)[:120]


def _clock(time: int) -> str:
    return datetime.fromtimestamp(time // 10**9, UTC).strftime("%H:%M:%S")


def _page(message: Status) -> str:
    tracks = ", ".join(f"{count} {name}" for name, count in message.tracks.items())
    lines = [f"# {message.source}", f"step {message.step}, up {message.uptime:.0f} s, tracks: {tracks or 'none'}", ""]
    lines += ["| source | state | trust | beside others | messages | tracks | offset s | gaps | repeats |"]
    lines += [f"|{9 * '---|'}"]
    for name, said in message.sources.items():
        cells = [said.get(key, "") for key in ("messages", "tracks", "offset", "gaps", "repeats")]
        shown = [f"{cell:.3g}" if isinstance(cell, float) else str(cell) for cell in cells]
        found = consistency(said)
        beside = "" if found is None else f"{found[0]:.2f} ({found[1]:.2f} to {found[2]:.2f})"
        lines.append(f"| {' | '.join([name, _state(said), state_of(said), beside, *shown])} |")
    health = [(name, source_health(said)) for name, said in message.sources.items()]
    lines += ["", *(f"- **{name}** {line}" for name, told in health for line in told)]
    told = [(name, tracklet_health(said)) for name, said in message.sources.items()]
    if any(text for _, text in told):
        lines += ["", "| source | tracklets and innovations |", "|---|---|"]
        lines += [f"| {name} | {text} |" for name, text in told if text]
    for title, numbers in (
        ("refused", message.refused),
        ("dropped", message.dropped),
        ("queue", message.queue),
        ("rates", message.rates),
        ("step time", message.step_time),
    ):
        if numbers:
            lines += ["", f"**{title}**: " + ", ".join(f"{key} {value:g}" for key, value in numbers.items())]
    if message.memory is not None:
        lines += ["", f"**memory**: {message.memory / 2**20:.0f} MiB"]
    return "\n".join(lines)
