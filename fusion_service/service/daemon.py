"""Bus + centre + clock + signals + health: the service as a process.

The bus fills a bounded inbox; one loop takes from it, gives the centre what can be decoded, steps when the
clock says so, saves the checkpoint, and publishes. Nothing that comes in makes it exit: should a step fail,
the centre goes on from its last checkpoint under a new id generation.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import resource
import socket
import threading
import time
from collections import Counter
from typing import Any, NamedTuple

from fusion_service.bus import Bus, Inbox, open_bus
from fusion_service.centre import (
    Centre,
    MessageClock,
    Order,
    Refused,
    SourceFound,
    SourceLost,
    StepResult,
    WallClock,
    make_centre,
)
from fusion_service.config import ServiceConfig
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State, StateError, open_state
from schemas import (
    LocalIntensity,
    LocalTracks,
    MessageError,
    Status,
    decode,
    encode,
    global_key,
    local_key,
    parse_key,
)

__all__ = ["run_service"]

log = logging.getLogger(__name__)

MAX_NAMES = 4096


class Arrival(NamedTuple):
    """One sample from the bus."""

    key: str
    data: bytes
    received: int


def run_service(config: ServiceConfig, stop: threading.Event) -> None:
    """Run until `stop` is set. `BusError` or `StateError` says in one line why it cannot start."""
    with open_state(config.service.state) as state, open_bus(config.bus.connect, stop=stop) as bus:
        Service(config, bus, state).run(stop)


class Service:
    """The service on an open bus, with its state."""

    def __init__(self, config: ServiceConfig, bus: Bus, state: State) -> None:
        self._config = config
        self._bus = bus
        self._state = state
        self._inbox: Inbox[Arrival | Order] = Inbox(config.bus.queue)
        self._epoch = 0
        self._blob = state.load()
        self._generation = state.take_generation()
        self._centre = self._make_centre(self._generation)
        self._message_clock = MessageClock(config.centre) if config.centre.clock == "message" else None
        self._wall_clock = WallClock(config.centre)
        self._tokens: dict[str, bool] = {}
        self._lock = threading.Lock()
        self._seen_tokens: dict[str, bool] = {}
        self._desk = OrderDesk(lambda order: self._inbox.put("", order))
        self._desk.follow(self._centre)
        self._dropped: Counter[str] = Counter()
        self._said: Counter[str] = Counter()
        self._quiet: dict[str, tuple[float, int]] = {}
        self._counts: Counter[str] = Counter()
        self._step_seconds = {"last": 0.0, "max": 0.0, "total": 0.0}
        self._result: StepResult | None = None
        self._picture = b""
        self._statuses = 0
        self._told: dict[str, float] = {}
        self._started = time.monotonic()

    def _make_centre(self, generation: int) -> Centre:
        self._epoch = time.time_ns()
        centre, fault = make_centre(self._config.centre, self._blob, generation=generation, epoch=self._epoch)
        if fault:
            log.warning("starting without the checkpoint: %s", fault)
            self._state.set_aside()
            self._blob = None
        return centre

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set."""
        realm, name, bus = self._config.bus.realm, self._config.centre.name, self._bus
        self._out = {
            what: bus.publisher(global_key(name, what, realm), cache=2 if what == "tracks" else 1)
            for what in ("tracks", "log", "status")
        }
        bus.watch(local_key("*", "alive", realm), self._on_token)
        for what in ("info", "tracks", "intensity"):
            bus.subscribe(local_key("*", what, realm), self._on_sample, on_miss=self._on_miss)
        bus.answer(global_key(name, "picture", realm), self._on_picture)
        bus.answer(global_key(name, "orders", realm), self._desk.answer)
        bus.announce(global_key(name, "alive", realm))
        threading.Thread(target=self._wake_at, args=(stop,), daemon=True).start()
        _notify("READY=1")
        centre = self._config.centre
        rule = centre.rule if centre.kind == "tracks" else f"{centre.intensity_rule} of intensities"
        log.info("fusing by %s every %g s as %s", rule, centre.period, name)
        status_due = time.monotonic() + self._config.service.status_period
        while not stop.is_set():
            timeout = max(0.0, status_due - time.monotonic())
            if self._message_clock is None:
                timeout = min(timeout, self._wall_clock.wait(time.time_ns()))
            for _, item in self._inbox.take(timeout):
                if stop.is_set():
                    break
                self._receive(item)
            changed = self._note_tokens()
            self._note_drops()
            self._step_all(stop)
            if self._message_clock is None:
                self._warn_set_back()
            if (changed and self._allowed("status", 0.1)) or time.monotonic() >= status_due:
                status_due = time.monotonic() + self._config.service.status_period
                self._publish_status()
                _notify("WATCHDOG=1")
        _notify("STOPPING=1")
        self._publish_status()
        log.info("stopped after %d steps", self._counts["steps"])

    def _wake_at(self, stop: threading.Event) -> None:
        stop.wait()
        self._inbox.wake()

    # Called on threads of the bus: must return at once

    def _on_sample(self, key: str, data: bytes) -> None:
        name = key.rsplit("/", 2)[-2]
        self._inbox.put(name, Arrival(key, data, time.time_ns()), len(data))

    def _on_miss(self, key: str, count: int) -> None:
        self._counts["missed"] += count

    def _on_token(self, key: str, alive: bool) -> None:
        try:
            name = parse_key(key).name
        except ValueError:
            return
        with self._lock:
            if name not in self._tokens and len(self._tokens) >= MAX_NAMES:
                dead = next((one for one, there in self._tokens.items() if not there), None)
                if dead is None:
                    return
                del self._tokens[dead]
            self._tokens[name] = alive
        self._inbox.wake()

    def _on_picture(self, payload: bytes | None) -> bytes:
        if not self._picture:
            raise ValueError("no step has been made yet")
        return self._picture

    # The loop

    def _receive(self, item: Arrival | Order) -> None:
        if isinstance(item, Order):
            log.info(
                "order %d of %s: %s%s",
                item.number,
                item.who or "?",
                item.what,
                f": {item.refused}" * bool(item.refused),
            )
            self._desk.given(item)
            self._centre.handle(item, time.time_ns())
            return
        self._counts["messages"] += 1
        self._counts["bytes"] += len(item.data)
        name = item.key.rsplit("/", 2)[-2]
        try:
            name = parse_key(item.key).name
            message = decode(item.data)
        except ValueError as error:
            reason = error.reason if isinstance(error, MessageError) else "key"
            self._centre.handle(Refused(name[:64], reason), item.received)
            return
        if message.source != name:
            self._centre.handle(Refused(name, "source"), item.received)
        elif (
            self._message_clock is not None
            and isinstance(message, (LocalTracks, LocalIntensity))
            and not self._message_clock.admits(message, item.received)
        ):
            self._centre.handle(Refused(name, "future"), item.received)
        else:
            self._centre.handle(message, item.received)

    def _note_tokens(self) -> bool:
        """Tell the centre which sources came and went; whether any did."""
        with self._lock:
            tokens = dict(self._tokens)
        changed = {name: alive for name, alive in tokens.items() if self._seen_tokens.get(name) is not alive}
        for name, alive in changed.items():
            self._centre.handle(SourceFound(name) if alive else SourceLost(name), time.time_ns())
            if self._message_clock is not None:
                self._message_clock.presence(name, alive)
        self._seen_tokens = tokens
        for name, alive in changed.items():
            if self._allowed(f"tokens {self._counts['tokens'] % 20}", 1.0):  # twenty lines a second
                log.info("source %s is %s", name, "there" if alive else "gone")
                self._counts["tokens"] += 1
            elif self._allowed("many tokens", 1.0):
                log.info("many sources come and go: %d there", sum(tokens.values()))
        return bool(changed)

    def _allowed(self, what: str, interval: float) -> bool:
        """Whether `interval` seconds have passed since this was last allowed."""
        now = time.monotonic()
        if now - self._told.get(what, float("-inf")) < interval:
            return False
        self._told[what] = now
        return True

    def _note_drops(self) -> None:
        for name, total in self._inbox.dropped.items():
            if new := total - self._dropped[name]:
                self._dropped[name] = total
                self._centre.handle(Refused(name, "queue", new, dropped=True), time.time_ns())

    def _step_all(self, stop: threading.Event) -> None:
        while not stop.is_set():
            due = self._wall_clock.due(time.time_ns()) if self._message_clock is None else self._message_clock.due()
            if due is None:
                return
            if due > self._centre.time:
                self._step(due)
            else:
                self._warn_behind(due)

    def _warn_set_back(self) -> None:
        """The wall clock stands before the last step: none can be made until it has caught up."""
        seconds = self._wall_clock.behind(time.time_ns())
        if seconds > self._config.centre.period:
            self._counts["behind"] += 1
            if self._allowed("set back", 10.0):
                log.warning("the clock was set back: no step for another %.0f s", seconds)

    def _warn_behind(self, due: int) -> None:
        """The messages' time is before the checkpoint's: no step can be made there again."""
        self._counts["behind"] += 1
        words = (
            "the messages are %.0f s before the last step of the checkpoint: to begin a mission anew, "
            "stop the service and delete the folder %s"
        )
        if self._allowed(words, 10.0):
            log.warning(words, (self._centre.time - due) / 1e9, self._config.service.state)

    def _step(self, at: int) -> None:
        begin = time.perf_counter()
        try:
            result, data = self._make(at)
        except Exception:
            again = self._recover(at)
            if again is None:
                return
            result, data = again
        self._save()
        self._result = result
        self._desk.follow(self._centre)
        seconds = time.perf_counter() - begin
        self._counts["steps"] += 1
        self._step_seconds["last"] = seconds
        self._step_seconds["max"] = max(self._step_seconds["max"], seconds)
        self._step_seconds["total"] += seconds
        self._picture = data["tracks"]
        for what, payload in data.items():
            self._out[what].put(payload)
        self._log_refusals(result.status.refused, result.status.dropped)

    def _make(self, at: int) -> tuple[StepResult, dict[str, bytes]]:
        """Make a step, and all that it leaves behind, or raise with nothing left behind."""
        result = self._centre.step(at)
        blob = self._centre.checkpoint()
        sent = time.time_ns()
        tracks, journal = (dataclasses.replace(part, sent=sent) for part in (result.tracks, result.log))
        data = {"tracks": encode(tracks), "log": encode(journal)}
        self._blob = blob
        return result, data

    def _recover(self, at: int) -> tuple[StepResult, dict[str, bytes]] | None:
        """A step failed, by a fault of ours: drop what came in since the last one, and make it from the last
        checkpoint; if that fails too, begin with nothing."""
        self._counts["failed_steps"] += 1
        self._loudly("the step at %d failed: what came in for it is dropped", at)
        self._restart()
        try:
            return self._make(at)
        except Exception:
            self._loudly("the step at %d fails without input too: starting without the checkpoint", at)
            self._blob = None
            self._restart()
            return None

    def _restart(self) -> None:
        try:
            self._generation = self._state.take_generation()
        except (OSError, StateError) as error:
            self._generation += 1
            self._loudly("cannot write an id generation: %s", error)
        self._centre = self._make_centre(self._generation)
        self._seen_tokens = {}
        for order in self._desk.again(self._blob is None):
            self._centre.handle(order, time.time_ns())

    def _save(self) -> None:
        try:
            self._state.save(self._blob or b"")
        except OSError as error:
            self._counts["unsaved"] += 1
            self._loudly("cannot save the checkpoint: %s", error)

    def _loudly(self, words: str, *values: object) -> None:
        """Log an error, with its trace if there is one, at most once in ten seconds for the same words."""
        if self._allowed(words, 10.0):
            log.error(words, *values, exc_info=not isinstance(values[-1], Exception))

    def _log_refusals(self, refused: dict[str, int], dropped: dict[str, int]) -> None:
        """One line per reason and interval, with the number since the last line."""
        now = time.monotonic()
        for reason, total in {**refused, "dropped from a queue": sum(dropped.values())}.items():
            since, told = self._quiet.get(reason, (float("-inf"), 0))
            if total > told and now - since >= 1.0 / max(self._config.service.log_refusals, 1e-3):
                self._quiet[reason] = (now, total)
                log.warning("refused %d more: %s (%d in all)", total - told, reason, total)

    def _publish_status(self) -> None:
        uptime = time.monotonic() - self._started
        counts, steps = self._counts, max(self._counts["steps"], 1)
        recent = counts - self._said
        span = max(uptime - self._said["_ms"] / 1e3, 1e-3)
        self._said = Counter(counts)
        self._said["_ms"] = round(uptime * 1e3)
        last = self._result.status if self._result is not None else None
        now = time.time_ns()
        sources: dict[str, dict[str, Any]] = dict(last.sources) if last is not None else {}
        for name, alive in self._seen_tokens.items():
            sources[name] = {**sources.get(name, {}), "alive": alive}
        queue = {"waiting": len(self._inbox), "capacity": self._inbox.capacity, "high_water": self._inbox.high_water}
        refused = self._centre.refusals()
        self._log_refusals(refused, last.dropped if last is not None else {})
        status = Status(
            source=self._config.centre.name,
            epoch=self._epoch,
            seq=self._statuses,
            sent=now,
            time=last.time if last is not None else now,
            step=last.step if last is not None else 0,
            uptime=uptime,
            rates={name: recent[name] / span for name in ("messages", "bytes", "steps")},
            queue={**queue, **(last.queue if last is not None else {}), "missed": counts["missed"]},
            refused=refused,
            dropped=last.dropped if last is not None else {},
            sources=sources,
            tracks=last.tracks if last is not None else {},
            step_time={
                "last": self._step_seconds["last"],
                "max": self._step_seconds["max"],
                "mean": self._step_seconds["total"] / steps,
                "failed": float(counts["failed_steps"]),
                "unsaved": float(counts["unsaved"]),
                "skipped": float(self._wall_clock.skipped),
                "behind": float(counts["behind"]),
            },
            memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        )
        self._statuses += 1
        self._out["status"].put(encode(status))


def _notify(state: str) -> None:
    """Tell systemd, where it asked for it (sd_notify)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            try:
                sock.connect("\0" + address[1:] if address[0] == "@" else address)
                sock.send(state.encode())
            except OSError as error:
                log.warning("cannot notify the service manager: %s", error)
