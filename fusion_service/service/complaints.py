"""`Complaints`: which source is refused, why, and how that is mended: for the log and the status.

Of each source the last refusal is kept, and what is doubtful in what it sends (`fusion_service.hints`). The centre
refuses without a word of its own, by the step log; the messages that it may refuse are kept until then. All of it is
bounded, and nothing of it changes what the centre does.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from fusion_service.centre.notes import UNPLACED
from fusion_service.config import CentreConfig
from fusion_service.hints import Finding, Listened, read_finding, refusal_finding
from fusion_service.service.bounded import BoundedLog
from schemas import Frame, Message, Status, StepLog

__all__ = ["Complaints"]

MOST_NAMED = 1000
"""Sources whose last refusal is kept."""
MOST_HEARD = 256
"""Sources that are listened to for doubts."""
MOST_WAITING, MOST_BYTES = 4096, 2**25
"""Messages that are kept until a step says whether they are refused, and their bytes."""
AGAIN = 1.0
"""Seconds in which the same refusal of the same source is counted, not explained again."""
AT_ONCE = 40
"""Refusals of a step that are explained."""
THINKING = 0.005
"""Seconds at a time in which sources are looked at, one after another; the others are next."""
LOUD, SELDOM = 10.0, 600.0
"""Seconds between two lines about the same refusal of a source, and about the same doubt."""
BENIGN = ("repeat", "muted")
"""Reasons that do not stand in the way of another, which is told instead for so many seconds:"""
STANDS = 30e9

log = logging.getLogger(__name__)


class _Waiting(NamedTuple):
    message: Message
    size: int
    received: int


class Complaints:
    """Of a centre of `config`; what is logged is bounded by `told`."""

    def __init__(self, config: CentreConfig, told: BoundedLog) -> None:
        self._config = config
        steps = config.clock == "wall" and config.trigger == "period"
        self._on_time = (config.period, config.delay, config.lateness, config.revise > 0.0) if steps else None
        self._bounds = told
        self._often = BoundedLog(1.0)
        self._last: dict[str, dict[str, Any]] = {}
        self._waiting: dict[tuple[str, int, int, str], _Waiting] = {}
        self._bytes = 0
        self._heard: dict[str, Listened] = {}
        self._doubts: dict[str, list[str]] = {}
        self._figures: dict[str, dict[str, float]] = {}
        self._step = 0
        self._turn = 0

    def heard(self, name: str, message: Message, size: int, received: int) -> None:
        """A message of so many bytes could be read."""
        key = (name, message.epoch, message.seq, message.type)
        if key in self._waiting:
            self._bytes -= self._waiting.pop(key).size
        self._waiting[key] = _Waiting(message, size, received)
        self._bytes += size
        while len(self._waiting) > MOST_WAITING or self._bytes > MOST_BYTES:
            self._bytes -= self._waiting.pop(next(iter(self._waiting))).size
        if name not in self._heard and len(self._heard) < MOST_HEARD:
            self._heard[name] = Listened()
        if name in self._heard:
            self._heard[name].heard(message, received)

    def misread(self, name: str, data: bytes, error: ValueError, received: int) -> None:
        """A payload could not be read."""
        reason = str(getattr(error, "reason", "key"))
        if self._is_due(name, reason, received, 1):
            if reason == "key":
                self._note(name, Finding("key", "key", name, f"{error}"), received)
            else:
                self._note(name, self._found(reason, lambda: read_finding(data, error, received)), received)

    def misnamed(self, name: str, said: str, received: int) -> None:
        """A message on the key of `name` says that it is of another source."""
        if self._is_due(name, "source", received, 1):
            words = (
                f'its messages say that they are of "{said}", its key says "{name}": make `source` the name in the key'
            )
            self._note(name, Finding("source", "source", said, words), received)

    def refused(self, name: str, reason: str, message: Message | None, received: int, count: int = 1) -> None:
        """A message that could be read is refused."""
        if self._is_due(name, reason, received, count):
            now = self._step if self._config.clock == "message" and self._step else received
            origins = sorted(self._config.source(name).allowed_origins)
            found = self._found(reason, lambda: refusal_finding(reason, message, now, origins))
            self._note(name, found, received)

    def stepped(self, journal: StepLog) -> None:
        """A step was made: tell what it refused, and note who is taken again."""
        self._step = journal.time
        now, explained = time.time_ns(), 0
        for name in {one.source for one in journal.taken} - {
            one.source for one in (*journal.refused, *journal.dropped)
        }:
            if (last := self._last.get(name)) is not None:
                last["well"] = now
        for entry in (*journal.refused, *journal.dropped):
            if entry.reason == "overtaken":  # the service is behind, which it says itself
                continue
            if not entry.hash and entry.reason not in ("queue", "flow", "failed", "too-many-sources"):
                continue
            one = next(
                (
                    self._waiting[key]
                    for kind in ("local_tracks", "local_intensity", "sensor_info", "global_tracks")
                    if (key := (entry.source, entry.epoch, entry.seq, kind)) in self._waiting
                ),
                None,
            )
            explained += 1
            if explained > AT_ONCE:
                break
            self.refused(
                entry.source,
                entry.reason,
                None if one is None else one.message,
                now if one is None else one.received,
                max(entry.count, 1),
            )

    def think(self, alive: Mapping[str, bool], frame: Frame | None) -> None:
        """Look at some of the sources for what is doubtful. alive: by liveliness tokens; frame: of the picture."""
        now, names, begin = time.time_ns(), list(self._heard), time.perf_counter()
        for _ in names:
            name = names[self._turn % len(names)]
            self._turn += 1
            one = self._heard[name]
            try:
                doubts = one.doubts(now, frame)
            except Exception:  # a fault of ours, which must not hold up the service
                self._bounds.error("what %s sends could not be looked at", name)
                continue
            if one.messages >= 4 and name not in alive and not name.startswith("global/"):
                doubts.append(
                    "it holds no liveliness token, so that nobody hears when it is gone: declare one on its .../alive"
                )
            if self._on_time and (late := one.lateness(*self._on_time)):
                doubts.append(late)
            for doubt in doubts:
                if self._often.allows(f"{name}: {doubt[:40]}", SELDOM):
                    self._say(f"source {name}: {doubt}", source=name)
            self._doubts[name], self._figures[name] = doubts, _figures(one)
            if time.perf_counter() - begin > THINKING:
                break

    def told_in(self, status: Status) -> Status:
        """A status with the last refusal of each source, its figures, and what is doubtful. On any thread."""
        out = dict(status.sources)
        for note in status.notes or ():
            if note.startswith(UNPLACED) and self._often.allows(UNPLACED, SELDOM):
                self._say(note)
        for name, last in list(self._last.items()):
            if name in out or len(out) < MOST_NAMED:
                out[name] = {**out.get(name, {}), "last_refusal": dict(last)}
        for name, figures in list(self._figures.items()):
            if name in out:
                out[name] = {**out[name], **figures}
        for name, doubts in list(self._doubts.items()):
            if doubts and (name in out or len(out) < MOST_NAMED):
                out[name] = {**out.get(name, {}), "doubts": list(doubts)}
        return replace(status, sources=out)

    def _found(self, reason: str, find: Callable[[], Finding]) -> Finding:
        """What is found, or the reason alone should that fail."""
        try:
            return find()
        except Exception:  # a fault of ours, which must not hold up the service
            self._bounds.error("what is wrong with a message (%s) could not be told", reason)
            return Finding(reason, "", "", f"{reason}: see WIRE.md, Refusals")

    def _is_due(self, name: str, reason: str, received: int, count: int) -> bool:
        """Whether a refusal is to be explained; else it is counted with the last one."""
        last = self._last.get(name)
        if last is not None and reason in BENIGN and last["reason"] not in BENIGN and received - last["time"] < STANDS:
            return False
        if last is not None and last["reason"] == reason:
            last["count"] += count
            if received - last["time"] < AGAIN * 1e9:
                return False
        return True

    def _note(self, name: str, found: Finding, received: int) -> None:
        before = self._last.pop(name, None)
        count = before["count"] if before is not None and before["reason"] == found.reason else 1
        while len(self._last) >= MOST_NAMED:
            del self._last[next(iter(self._last))]
        self._last[name] = {
            "reason": found.reason,
            "field": found.field,
            "value": found.value,
            "said": found.said,
            "time": received,
            "count": count,
        }
        if found.reason != "repeat" and self._often.allows(f"refused {name} {found.reason}", LOUD):
            self._say(f"source {name}: refused ({found.reason}): {found.said}", source=name, reason=found.reason)

    def _say(self, line: str, **fields: str) -> None:
        """Twenty lines a second at most. fields: of `fusion_service.logs`."""
        for place in range(20):
            if self._bounds.allows(f"complaint {place}", 1.0):
                log.warning("%s", line, extra=fields)
                return


def _figures(one: Listened) -> dict[str, float]:
    """Messages with tracks a second, the period that it declares, and by how much its clock is ahead, s."""
    declared = None if one.info is None else one.info.period
    said = {"rate": one.rate, "declared_period": declared, "clock": one.clock}
    return {key: value for key, value in said.items() if value is not None}
