"""Bus + centre + clock + signals + health: the service as a process.

The bus fills a bounded inbox; one loop takes from it, gives the centre what can be decoded, steps when the
clock says so, publishes, and saves the checkpoint (see `stepping`). Nothing that comes in makes it exit: should a
step fail, the centre goes on from its last checkpoint under a new id generation.
"""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from fusion_service.bus import Bus, Inbox
from fusion_service.bus.security import check_party, maybe_security
from fusion_service.centre import (
    ClockSet,
    Order,
    Refused,
    Skipped,
    SourceFound,
    SourceLost,
    StepResult,
    is_picture_of,
    source_of,
)
from fusion_service.compiled import begin
from fusion_service.config import ConfigError, ServiceConfig
from fusion_service.process import loading
from fusion_service.service.bounded import BoundedLog, uncounted
from fusion_service.service.complaints import Complaints
from fusion_service.service.flow import Flow
from fusion_service.service.heartbeat import Heartbeat
from fusion_service.service.notify import notify
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.overload import Overload, overtaken
from fusion_service.service.promises import Reply
from fusion_service.service.reloading import Reloads, Tuned
from fusion_service.service.state import State, open_state
from fusion_service.service.status import StatusMaker, start_line, tell_status
from fusion_service.service.stepping import LastingCentre
from fusion_service.service.succession import Process, succeed
from fusion_service.service.tenure import Tenure
from fusion_service.service.timing import StepTimes
from fusion_service.service.tokens import Tokens
from fusion_service.source_words import source_event
from schemas import (
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    MessageError,
    Status,
    StepLog,
    centre_source,
    decode,
    encode,
    global_key,
    local_key,
    order_key,
    parse_key,
)

__all__ = ["Service", "run_service"]

KEPT = 32
"""Pictures and step logs that can be had again by who missed one: the recorder, above all."""

MOST_WAITING = 64 * 2**20
"""Bytes between bus and centre: `queue` slots of as many each."""

log = logging.getLogger(__name__)


class Arrival(NamedTuple):
    """One sample from the bus."""

    key: str
    data: bytes
    received: int


def run_service(
    config: ServiceConfig, stop: threading.Event, standby: bool = False, reloads: Reloads | None = None
) -> None:
    """Run until `stop` is set; standby: begin as one that stands by; reloads: tunes it. Raises `BusError`,
    `SecurityError`, `StateError` or `ConfigError`, which says in one line why it cannot start."""
    try:
        loading()(begin)(config.service.compiled, stop, lambda road: log.info("small matrices by the road: %s", road))
    except ValueError as error:
        raise ConfigError([f"[service] compiled: {error}"]) from None
    security = maybe_security(config.bus.security)
    if security is not None:
        check_party(security, ("centre",), config.centre.name)
    log.info("%s", start_line(config))
    with open_state(config.service.state) as state:
        make = reloads.making(Service) if reloads else Service
        succeed(Process(config, state, stop, security, make), standby)


class Service:
    """The service on an open bus, with its state; tenure: its hold of the centre's name."""

    def __init__(self, config: ServiceConfig, bus: Bus, state: State, tenure: Tenure | None = None) -> None:
        self._config = config
        self._bus = bus
        self._tenure = tenure or Tenure(config, bus)
        self._inbox: Inbox[Arrival | Order] = Inbox(
            config.bus.queue, slot_bytes=max(1, MOST_WAITING // config.bus.queue)
        )
        self._status = StatusMaker(config.centre.name)
        self._counts = self._status.counts
        self._told = BoundedLog(config.service.log_refusals)
        self._complaints = Complaints(config.centre, self._told)
        self._tokens = Tokens(self._inbox.wake)
        self._desk = OrderDesk(lambda order: self._inbox.put("", order), secured=config.bus.security is not None)
        self._lasting = LastingCentre(config.centre, state, self._desk, self._told, self._counts, self._tokens.forget)
        self._tenure.vouch(self._desk.promises)
        self._times = StepTimes(config.centre, authenticated=config.bus.security is not None)
        self._flow = Flow(config.limits)
        self._overload = Overload(self._times.patience)
        self._dropped: Counter[str] = Counter()
        self._result: StepResult | None = None
        self._stepped = False
        self._status_due = time.monotonic() + config.service.status_period
        self._taken = 0
        """When everything that had come was taken from the inbox, ns."""
        self._refused: dict[str, int] = {}
        self._saying = threading.Lock()
        self._heart = Heartbeat(config.service.status_period, self._say_late)
        self.tuned = Tuned(self._flow, self._told, self._heart)

    def feed(self, source: str, key: str, data: bytes, received: int) -> None:
        """Take a sample as if it came now: of one that stood by."""
        self._inbox.put(source, Arrival(key, data, received), len(data))

    def run(self, stop: threading.Event, begun: Callable[[], None] | None = None) -> None:
        """Work until `stop` is set, or another holds the centre's name. begun: called when all is declared."""
        self._tenure.begin(self._lasting.generation, self._lasting.centre.epoch, self._inbox.wake)
        self._declare()
        if begun is not None:
            begun()
            self._times.resume(self._lasting.centre.time, time.time_ns())
        threading.Thread(target=self._wake_at, args=(stop,), daemon=True).start()
        notify("READY=1")
        centre = self._config.centre
        rule = centre.rule if centre.kind == "tracks" else f"{centre.intensity_rule} of intensities"
        log.info("fusing by %s, memory %s, every %g s as %s", rule, centre.memory, centre.period, centre.name)
        gc.collect()
        gc.freeze()  # what is loaded stays: it is not looked through again in the middle of a step
        with self._heart:
            while self._tenure.goes_on(self._lasting.centre, stop) and not stop.is_set():
                try:
                    self._turn(stop)
                except Exception:  # a fault of ours: the next turn may be better
                    self._counts["failed_turns"] += 1
                    self._told.error("the loop failed %d times", self._counts["failed_turns"])
                    stop.wait(0.1)
        self._lasting.save(at_once=True)
        self._desk.promises.close()
        if not stop.is_set():
            log.warning("stands down: %s", self._tenure.farewell)
            return
        notify("STOPPING=1")
        self._publish_status()
        log.info("stopped after %d steps", self._counts["steps"])

    def _turn(self, stop: threading.Event) -> None:
        """Take what has come, make a step if one is due, and say how it goes. At most one step between two readings of
        the inbox."""
        self._heart.turned()
        due = min(self._status_due - time.monotonic(), self._times.wait(time.time_ns()), self._tenure.pace)
        wait = 0.0 if self._stepped else max(0.0, due)
        for item in self._take(wait):
            if stop.is_set():
                break
            self._receive(item)
        changed = self._note_tokens()
        self._note_drops()
        self._stepped = not stop.is_set() and self._step_due()
        self._lasting.save()
        if (changed and self._told.allows("status", 0.1)) or time.monotonic() >= self._status_due:
            self._status_due = time.monotonic() + self._heart.period
            tell_status(self._publish_status())

    def _declare(self) -> None:
        realm, name, bus = self._config.bus.realm, self._config.centre.name, self._bus
        self._out = {
            what: bus.publisher(global_key(name, what, realm), cache=KEPT if what != "status" else 1)
            for what in ("tracks", "log", "status")
        }
        self._tokens.watch(bus, realm)
        for what in ("info", "tracks", "intensity"):
            bus.subscribe(local_key("*", what, realm), self._on_sample, on_miss=self._on_miss)
        for centre in filter(None, map(is_picture_of, self._config.centre.sources)):
            bus.watch(global_key(centre, "alive", realm), self._tokens.note)
            bus.subscribe(global_key(centre, "tracks", realm), self._on_sample, on_miss=self._on_miss)
        bus.answer(global_key(name, "picture", realm), self._on_picture)
        bus.answer_later(global_key(name, "orders", realm), lambda _, asked, reply: self._on_order(asked, reply))
        bus.answer_later(
            order_key(name, "*", realm), lambda key, asked, reply: self._on_order(asked, reply, key.rsplit("/", 1)[1])
        )
        bus.announce(global_key(name, "alive", realm))

    def _wake_at(self, stop: threading.Event) -> None:
        stop.wait()
        self._inbox.wake()

    # Called on threads of the bus: must return at once

    def _on_sample(self, key: str, data: bytes) -> None:
        scope, name, _ = key.rsplit("/", 3)[-3:]
        source = centre_source(name) if scope == "global" else name
        self._tenure.hears()
        if self._flow.takes(source, len(data)):
            self._inbox.put(source, Arrival(key, data, time.time_ns()), len(data))

    def _on_miss(self, key: str, count: int) -> None:
        self._counts["missed"] += count

    def _on_order(self, payload: bytes | None, reply: Reply, operator: str = "") -> None:
        may = bool(operator) or self._config.bus.security is None
        if not (may and self._tenure.ordered(payload, operator, reply)):
            self._desk.answer(payload, reply, operator)

    def _on_picture(self, payload: bytes | None) -> bytes:
        if self._result is None:
            raise ValueError("no step has been made yet")
        return encode(self._result.picture)

    # The loop

    def _take(self, timeout: float) -> list[Arrival | Order]:
        """What has come; where the service is behind, of each source the newest complete scan only."""
        items = self._inbox.take(min(timeout, self._desk.promises.wait()))
        self._taken = time.time_ns()
        oldest = next((item.received for _, item in items if isinstance(item, Arrival)), self._taken)
        if self._overload.look(time.monotonic(), (self._taken - oldest) / 1e9, self._times.skipped):
            items, gone = overtaken(items, lambda item: item.data if isinstance(item, Arrival) else None)
            for name, count in gone.items():
                self._counts["overtaken"] += count
                self._lasting.handle(Refused(name, "overtaken", count, dropped=True), self._taken)
        return [item for _, item in items]

    def _receive(self, item: Arrival | Order) -> None:
        if isinstance(item, Order):
            fault = f": {item.refused}" * bool(item.refused)
            if self._told.allows(f"orders {item.number % 20}", 1.0):  # twenty lines a second: the step log has them all
                log.info("order %d of %s: %s%s", item.number, item.giver, item.what, fault)
            self._lasting.handle(item, time.time_ns())
            return
        self._counts["messages"] += 1
        self._counts["bytes"] += len(item.data)
        name = item.key.rsplit("/", 2)[-2]
        try:
            name = parse_key(item.key).source
            message = decode(item.data)
        except ValueError as error:
            reason = error.reason if isinstance(error, MessageError) else "key"
            self._lasting.handle(Refused(name[:64], reason), item.received)
            self._complaints.misread(name[:64], item.data, error, item.received)
            return
        if source_of(message) != name:
            self._lasting.handle(Refused(name, "source"), item.received)
            self._complaints.misnamed(name, source_of(message), item.received)
            return
        self._complaints.heard(name, message, len(item.data), item.received)
        self._flow.read(name, message)
        fault = ""
        if isinstance(message, (LocalTracks, LocalIntensity, GlobalTracks)):
            fault = self._times.fault(message, item.received)
            if fault:
                self._complaints.refused(name, fault, message, item.received)
        self._lasting.handle(Refused(name, fault) if fault else message, item.received)

    def _note_tokens(self) -> bool:
        """Tell the centre which sources came and went; whether any did."""
        changed = self._tokens.changes()
        for name, alive in changed.items():
            self._lasting.handle(SourceFound(name) if alive else SourceLost(name), time.time_ns())
            self._times.presence(name, alive)
        for name, alive in changed.items():
            if self._told.allows(f"tokens {self._counts['tokens'] % 20}", 1.0):  # twenty lines a second
                log.info("source %s is %s", name, "there" if alive else "gone", extra={"source": name})
                self._counts["tokens"] += 1
            elif self._told.allows("many tokens", 1.0):
                log.info("many sources come and go: %d there", sum(self._tokens.told.values()))
        return bool(changed)

    def _note_drops(self) -> None:
        for name, total in self._inbox.dropped.items():
            if new := total - self._dropped[name]:
                self._dropped[name] = total
                self._lasting.handle(Refused(name, "queue", new, dropped=True), time.time_ns())
        beyond = self._flow.news()
        for name, new in beyond.items():
            self._lasting.handle(Refused(name[:64], "flow", new, dropped=True), time.time_ns())
        if beyond:
            self._told.warn("flow: %s", self._flow.line(beyond))

    def _step_due(self) -> bool:
        """Make the step that is due; whether one was, so that another may be."""
        due = self._times.due(self._taken, self._lasting.centre.time)
        if due is None:
            return False
        if skipped := self._times.untold():
            self._lasting.handle(Skipped(skipped), time.time_ns())
        if due <= self._lasting.centre.time:
            self._lasting.handle(ClockSet(due), time.time_ns())
        if due > self._lasting.centre.time:
            self._step(due)
        else:
            self._warn_behind(due)
        return True

    def _warn_behind(self, due: int) -> None:
        """The clock stands before the last step: none is made until it has caught up, or a new era begins."""
        self._counts["behind"] += 1
        words = "the clock is %.1f s before the last step, which waits for it: if it stays behind, a new era begins"
        self._told.warn(words, (self._lasting.centre.time - due) / 1e9)

    def _step(self, at: int) -> None:
        begin = time.perf_counter()
        made = self._lasting.step(at)
        self._times.made(time.perf_counter() - begin)
        if made is None:
            return
        for what in self._tenure.order:
            self._put(what, made.messages[what])
        self._tenure.stepped(made.result.log.step, at, self._lasting.centre.epoch, self._lasting.generation)
        self._status.published(at, time.time_ns())
        notes = made.result.status.notes
        if notes and self._told.allows(uncounted(notes[0]), 600.0):
            log.warning("%s", "; ".join(notes))
        self._tell_sources(made.result.log)
        self._complaints.stepped(made.result.log)
        self._result = made.result
        self._status.stepped(time.perf_counter() - begin)
        self._told.refusals(made.result.status.refused, made.result.status.dropped)

    def _put(self, what: str, payload: bytes) -> None:
        """Publish it, if this process is still the one that does."""
        if self._tenure.may_publish():
            self._out[what].put(payload)

    def _tell_sources(self, journal: StepLog) -> None:
        """Say what has changed about sources: how they are trusted, shifted, used: twenty lines a second at most."""
        for event in journal.events:
            if (said := source_event(event)) is None:
                continue
            bad, text = said
            if self._told.allows(f"sources {self._counts['sources'] % 20}", 1.0):
                name = str(event.get("source"))
                log.log(logging.WARNING if bad else logging.INFO, "source %s: %s", name, text, extra={"source": name})
                self._counts["sources"] += 1
            elif self._told.allows("many sources", 1.0):
                log.warning("much has changed about many sources: the status has it all")

    def _publish_status(self) -> Status:
        last = self._result.status if self._result is not None else None
        self._tokens.compare(last.sources if last is not None else {})
        self._refused = self._lasting.centre.refusals()
        self._told.refusals(self._refused, last.dropped if last is not None else {})
        self._complaints.think(self._tokens.told, self._result.picture.frame if self._result is not None else None)
        status = self._say_status()
        if self._overload.since is not None and status.notes:
            self._told.warn("%s", status.notes[0])
        return status

    def _say_status(self, busy: float = 0.0) -> Status:
        """Publish it. busy: seconds for which the loop has been at one thing, where another thread says it."""
        with self._saying:
            since = self._overload.since
            status = self._status.make(
                self._result.status if self._result is not None else None,
                epoch=self._lasting.centre.epoch,
                inbox=self._inbox,
                refused=self._refused,
                alive=self._tokens.told,
                skipped=self._times.skipped,
                overload=None if since is None else time.monotonic() - since,
                busy=busy,
                more=(*self._tenure.notes(), *filter(None, [self._lasting.alarm]), *self._tokens.beside()),
            )
            status = self._complaints.told_in(self._flow.told_in(status))
            status = replace(status, term=self._tenure.term, standby=self._tenure.numbers())
            self._put("status", encode(status))
            self._heart.beat()
        return status

    def _say_late(self, busy: float, alive: bool) -> None:
        """On the heartbeat's thread: the loop is late with the status."""
        try:
            tell_status(self._say_status(busy), alive)
        except Exception:
            self._told.error("no status could be published in place of the loop, at one thing for %.0f s", busy)
