"""What the process counts of itself, and the status that it publishes of it."""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any

from fusion_service import __version__
from fusion_service.bus import Inbox
from fusion_service.compiled import road
from fusion_service.config import ServiceConfig
from fusion_service.service.notify import notify
from fusion_service.source_words import state_of
from fusion_service.ways import reason_words
from schemas import Status

__all__ = ["StatusMaker", "start_line", "status_line", "tell_status"]

SAME_CLOCK = 3600.0
"""Seconds: pictures that are older when they go out are of a mission with a clock of its own."""
MOST_NAMED = 1000
"""Sources that a status tells of by name."""
NAMED = 5
"""Sources that a line names; of more it says the number."""


class StatusMaker:
    """counts: messages, bytes, steps, missed, overtaken, failed_steps, failed_turns, unsaved, behind; whoever sees one
    counts it."""

    def __init__(self, name: str) -> None:
        self.counts: Counter[str] = Counter()
        self._name = name
        self._number = 0
        self._before: Counter[str] = Counter()
        self._before_at = 0.0
        self._started = time.monotonic()
        self._seconds = {"last": 0.0, "max": 0.0, "total": 0.0}
        self._latency: float | None = None

    def stepped(self, seconds: float) -> None:
        """A step was made, in so many seconds."""
        self.counts["steps"] += 1
        self._seconds["last"] = seconds
        self._seconds["max"] = max(self._seconds["max"], seconds)
        self._seconds["total"] += seconds

    def published(self, time: int, now: int) -> None:
        """The picture of `time`, ns, went out at `now`. Nothing is said of missions played at another time."""
        latency = (now - time) / 1e9
        self._latency = latency if abs(latency) < SAME_CLOCK else None

    def make(
        self,
        last: Status | None,
        *,
        epoch: int,
        inbox: Inbox[Any],
        refused: dict[str, int],
        alive: Mapping[str, bool],
        skipped: int,
        overload: float | None = None,
        busy: float = 0.0,
        more: tuple[str, ...] = (),
    ) -> Status:
        """The status now. last: the centre's own, of its newest step; refused: by reason; alive: whether each source is
        there; skipped: steps that were not made; overload: seconds for which the service is behind, None: it is not;
        busy: for which its loop has been at one thing, 0: it says this itself; more: notes."""
        uptime = time.monotonic() - self._started
        counts, now = self.counts, time.time_ns()
        recent, span = counts - self._before, max(uptime - self._before_at, 1e-3)
        self._before, self._before_at = Counter(counts), uptime
        sources = _bounded(last.sources if last is not None else {}, alive)
        queue = {"waiting": len(inbox), "capacity": inbox.capacity, "high_water": inbox.high_water}
        number, self._number = self._number, self._number + 1
        return Status(
            source=self._name,
            epoch=epoch,
            seq=number,
            sent=now,
            time=last.time if last is not None else now,
            step=last.step if last is not None else 0,
            uptime=uptime,
            rates={name: recent[name] / span for name in ("messages", "bytes", "steps")},
            queue={
                **queue,
                **(last.queue if last is not None else {}),
                "missed": counts["missed"],
                "overtaken": counts["overtaken"],
            },
            refused=refused,
            dropped=last.dropped if last is not None else {},
            sources=sources,
            tracks=last.tracks if last is not None else {},
            step_time={
                "last": self._seconds["last"],
                "max": self._seconds["max"],
                "mean": self._seconds["total"] / max(counts["steps"], 1),
                "failed": float(counts["failed_steps"]),
                "unsaved": float(counts["unsaved"]),
                "skipped": float(skipped),
                "behind": float(counts["behind"]),
                **({"failed_turns": float(counts["failed_turns"])} if counts["failed_turns"] else {}),
                **({"busy": busy} if busy else {}),
                **({"latency": self._latency} if self._latency is not None else {}),
                **({"overload": overload} if overload is not None else {}),
            },
            road=road(),
            memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            notes=self._notes(last, skipped, overload, busy, more),
        )

    def _notes(
        self, last: Status | None, skipped: int, overload: float | None, busy: float, more: tuple[str, ...]
    ) -> tuple[str, ...] | None:
        """The centre's notes, after what the process has to say, and `more`."""
        said = (*more, *((last.notes if last is not None else None) or ())) or None
        if busy:
            said = (f"the service has been at one step, or at reading what came, for {busy:.1f} s", *(said or ()))
        if overload is None:
            return said
        behind = "" if self._latency is None else f", and the picture is {self._latency:.2f} s old when it goes out"
        counts = f"{skipped} steps skipped and {self.counts['overtaken']} scans overtaken by newer ones since the start"
        return (f"overload for {overload:.0f} s: more comes than can be worked off; {counts}{behind}", *(said or ()))


def _bounded(said: Mapping[str, dict[str, Any]], alive: Mapping[str, bool]) -> dict[str, dict[str, Any]]:
    """What is said of the sources, with whether each is there: of `MOST_NAMED` by name, of how many more under "*"."""
    sources = {name: said[name] for name in list(said)[:MOST_NAMED]}
    beyond = len(said) - len(sources)
    for name, there in list(alive.items()):
        if name in sources or len(sources) < MOST_NAMED:
            sources[name] = {**sources.get(name, {}), "alive": there}
        else:
            beyond += name not in said
    return {**sources, "*": {"more": beyond}} if beyond else sources


def start_line(config: ServiceConfig) -> str:
    """What starts, and where: version, centre, realm, hub, folder of the state."""
    hub, folder = ", ".join(config.bus.connect), config.service.state or "no folder"
    centre = f"centre {config.centre.name} of realm {config.bus.realm}"
    return f"fusion-service {__version__}: {centre}, hub {hub}, state in {folder}"


def tell_status(status: Status, alive: bool = True) -> None:
    """Tell who looks after the process of a status that was published; alive: its loop is, and the watchdog is
    served."""
    notify("WATCHDOG=1\n" * alive + f"STATUS={status_line(status)}", status)


def status_line(status: Status) -> str:
    """A status in a line: tracks, sources, and whose tracks are no tracklets, where that is asked for."""
    tracks = ", ".join(f"{count} {name}" for name, count in status.tracks.items()) or "no step yet"
    alive = sum(bool(said.get("alive")) and not said.get("stale") for said in status.sources.values())
    line = f"{tracks}; {alive} of {len(status.sources)} sources alive"
    if "overload" in status.step_time:
        line += (
            f"; OVERLOAD: {status.step_time['skipped']:.0f} steps skipped, {status.queue['overtaken']} scans overtaken"
        )
    doubted = {name: state for name, said in status.sources.items() if (state := state_of(said)) not in ("", "trusted")}
    if len(doubted) > NAMED:
        line = f"{line}; {len(doubted)} not trusted"
    else:
        line += "".join(f"; {name} {'in ' * (state == 'union')}{state}" for name, state in doubted.items())
    shares = {name: said for name, said in status.sources.items() if "tracklets" in said}
    if not shares:
        return line
    without = {name: said["no_tracklets"] for name, said in shares.items() if said.get("no_tracklets")}
    line = f"{line}; tracklets of {len(shares) - len(without)}"
    if len(without) > NAMED:
        return f"{line}, none of {len(without)}"
    return line + "".join(f"; none of {name}: {reason_words(why)}" for name, why in without.items())
