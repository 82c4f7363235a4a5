"""`Standby`: a process that stands by for the active one of the same centre, and knows when to take over.

It hears what the active process hears, follows its step logs (see `shadow`), and asks it for a sign of life four times
in `takeover` seconds (see `tenure`). It takes over when

- the active one's token is gone, and `GRACE` seconds later nobody else's is there;
- no sign of it came for `takeover` seconds, in most of which this process was awake itself, and the hub answers: the
  other is frozen, or its machine is;
- it hands over by order.

Not while the hub is away, nor for `REJOINED` seconds after that, since the other may need as long to be back; nor when
this process was frozen itself. Of several that stand by, each next one waits `RANK` seconds longer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from fusion_service.bus import Bus, BusError, Inbox
from fusion_service.centre import Order, is_picture_of
from fusion_service.config import ServiceConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.copying import Loaded, copied, pause
from fusion_service.service.deafness import Deafness
from fusion_service.service.notify import notify
from fusion_service.service.shadow import PATIENCE, Shadow
from fusion_service.service.state import State
from fusion_service.service.tenure import seconds, terms_held
from fusion_service.service.terms import MOST_GENERATION, free_node, node_of
from schemas import centre_source, decode, global_key, local_key, token_key

__all__ = ["Standby", "Succession"]

GRACE = 0.2
RANK = 0.5
REJOINED = 3.0
ALONE = 2.0
"""Seconds without any token after the start, before one that has met another before takes over."""
YIELDED = 1.0
"""Seconds for which the last log, or the checkpoint, of one that hands over is waited for."""
COPIED = 2.0
"""Seconds for which a checkpoint that cannot be followed will do."""
ROUND = 0.02
AWAKE, MOST_AWAKE = 0.7, 0.25
"""Of the time without a sign, in which this process must have been awake; seconds that one round counts at most."""
HUNG = 5.0
"""Seconds, and periods, without a round of the active one's loop after which it is as good as gone."""
KEPT = 10.0
MOST_EPOCH = 2**63 - 2**32
MOST = 100

log = logging.getLogger(__name__)


class Succession(NamedTuple):
    """What the one that takes over begins with. why: in words."""

    why: str
    checkpoint: bytes | None
    ended: NDArray[np.uint64]
    generation: int
    epoch: int
    orders: Sequence[Order]
    born: bytes


class Sample(NamedTuple):
    key: str
    data: bytes
    received: int


class Told(NamedTuple):
    """Orders that wait for a step of the active centre, of the run `epoch`."""

    epoch: int
    events: list[dict[str, Any]]


class Standby:
    """Stands by on `bus`. probe: a session that watches nothing. state: the process' own, where its node, and now and
    then what it holds, is kept."""

    def __init__(self, config: ServiceConfig, bus: Bus, probe: Bus, state: State) -> None:
        self._config, self._bus, self._probe, self._state = config, bus, probe, state
        self._takeover = config.service.takeover
        self._shadow = Shadow(config.centre, seconds)
        self._inbox: Inbox[Sample | Loaded | Told] = Inbox(config.bus.queue)
        self._deafness = Deafness(seconds)
        self._told = BoundedLog(1.0)
        self._name = f"{time.time_ns():x}"
        self._lock = threading.Lock()
        now = seconds()
        self._holding: dict[int, float] = {}
        """Terms under which the name is held, and since when, s, this is known."""
        self._yielded: dict[int, tuple[int, float]] = {}
        self._begun = self._none_since = now
        self._sign = now
        self._awake = 0.0
        """Seconds since the last sign in which this process was awake itself."""
        self._age = 0.0
        self._away = -REJOINED
        self._round = self._saved = self._fetched = now
        self._nodes: Mapping[str, int] = {}
        self._generation = self._epoch = 0
        self._met = False
        self._following = 0
        self._asking: threading.Thread | None = None
        self._over, self._hurry = threading.Event(), threading.Event()

    def wait(self, stop: threading.Event) -> Succession | None:
        """Stand by until it is time to take over, or `stop` is set: None."""
        self._declare()
        self._asking = threading.Thread(target=self._ask, args=(stop,), daemon=True)
        self._asking.start()
        notify("READY=1")
        name = self._config.centre.name
        log.info("standing by for %s", name)
        try:
            while not stop.is_set():
                for _, item in self._inbox.take(ROUND):
                    self._receive(item)
                if not self._shadow.wanted:
                    self._shadow.advance()
                self._say()
                if why := self._due():
                    log.warning("takes over as %s: %s", name, why)
                    return self._succession(why)
            return None
        finally:
            self._over.set()
            self._hurry.set()
            self._token.close()

    def join(self) -> None:
        """Wait until the last question has had its time: before the bus is closed."""
        if self._asking is not None:
            self._asking.join()

    def hand_on(self, feed: Callable[[str, Sample], None]) -> None:
        """Give the service that has begun here what was in no step yet, and hear nothing any more."""
        oldest = time.time_ns() - round((self._config.centre.lateness + self._config.centre.period + 5.0) * 1e9)
        for _, item in self._inbox.take(0.0):
            self._receive(item)
        for source, one in self._shadow.left(oldest):
            feed(source, Sample(one.key, one.data, one.received))

    def _declare(self) -> None:
        realm, name, bus = self._config.bus.realm, self._config.centre.name, self._bus
        for what in ("info", "tracks", "intensity"):
            bus.subscribe(local_key("*", what, realm), self._on_sample)
        for centre in filter(None, map(is_picture_of, self._config.centre.sources)):
            bus.subscribe(global_key(centre, "tracks", realm), self._on_sample)
        for what in ("tracks", "log"):
            bus.subscribe(global_key(name, what, realm), self._on_sample)
        bus.watch(token_key(name, "holds", "*", realm), self._on_term)
        bus.watch(token_key(name, "yields", "*", realm), self._on_yield)
        self._token = bus.announce(token_key(name, "standby", self._name, realm))

    # On threads of the bus

    def _on_sample(self, key: str, data: bytes) -> None:
        scope, name, _ = key.rsplit("/", 3)[-3:]
        source = centre_source(name) if scope == "global" else name
        if scope == "global" and name == self._config.centre.name:
            self._sign, self._awake = seconds(), 0.0
        else:
            self._deafness.sample()
        self._inbox.put(source, Sample(key, data, time.time_ns()), len(data))

    def _on_term(self, key: str, alive: bool) -> None:
        with self._lock:
            for term in terms_held([key]):
                if alive and len(self._holding) < MOST:
                    self._holding[term] = self._sign = seconds()
                    self._met = True
                elif not alive and term in self._holding:
                    del self._holding[term]
                    self._none_since = seconds()
        self._inbox.wake()

    def _on_yield(self, key: str, alive: bool) -> None:
        term, _, step = key.rsplit("/", 1)[-1].partition(".")
        if len(step) < 19 and step.isascii() and step.isdigit() and terms_held([term]):
            with self._lock:
                self._yielded.pop(int(term), None)
                if alive and len(self._yielded) < MOST:
                    self._yielded[int(term)] = int(step), seconds()
            self._hurry.set()
            self._inbox.wake()

    # On the thread that asks

    def _ask(self, stop: threading.Event) -> None:
        while not (stop.is_set() or self._over.is_set()):
            begin = seconds()
            self._ask_once({"what": "sign"})
            if self._yielded and self._shadow.wanted:
                self._fetch(stop, last=True)
            elif self._shadow.lacks and self._holding and begin > self._fetched:
                came = self._fetch(stop)
                self._fetched = seconds() + pause(seconds() - begin, came)
            self._hurry.wait(max(0.0, begin + self._takeover / 4 - seconds()))
            self._hurry.clear()

    def _ask_once(self, request: dict[str, Any]) -> dict[str, Any]:
        """Ask the active process; its answer, empty if none came."""
        shadow, realm = self._shadow, self._config.bus.realm
        behind = shadow.newest[1] - shadow.mark[1] if shadow.newest[0] == shadow.mark[0] else 1
        ready = shadow.ready and ((not shadow.wanted and behind <= 1) or seconds() - shadow.loaded < COPIED)
        said = {"name": self._name, "node": self._state.node, "step": shadow.mark[1], "ready": ready}
        said |= {"takeover": self._takeover, "ordered": shadow.orders.known, "why": shadow.wanted[:200]}
        payload = msgpack.packb(request | said)
        key = global_key(self._config.centre.name, "state", realm)
        patience = 0.75 * self._takeover
        try:
            answers = [msgpack.unpackb(data) for _, data in self._bus.ask(key, payload, patience)]
        except (BusError, ValueError):
            answers = []
        sound = [one for one in answers if isinstance(one, dict) and terms_held([str(one.get("term"))])]
        answer: dict[str, Any] = max(sound, key=lambda one: int(one["term"]), default={})
        if answer:
            self._heard(answer)
        return answer

    def _heard(self, answer: dict[str, Any]) -> None:
        generation, epoch, nodes, age = (answer.get(name) for name in ("generation", "epoch", "nodes", "age"))
        with self._lock:
            self._sign, self._met, self._awake = seconds(), True, 0.0
            self._age = float(age) if isinstance(age, (int, float)) else 0.0
            said = list(nodes.items())[:MOST] if isinstance(nodes, dict) else []
            self._nodes = {str(name): node for name, node in said if type(node) is int}
            self._following = int(answer["term"])
            if isinstance(generation, int) and isinstance(epoch, int):
                self._generation = max(self._generation, min(generation, MOST_GENERATION))
                self._epoch = max(self._epoch, min(epoch, MOST_EPOCH))
        self._deafness.told(answer.get("heard"))
        if isinstance(held := answer.get("orders"), list) and isinstance(epoch, int):
            self._inbox.put("", Told(epoch, [one for one in held if isinstance(one, dict)]))

    def _fetch(self, stop: threading.Event, last: bool = False) -> bool:
        """A checkpoint of the active process into the inbox; whether it came. last: the one that it has made by itself,
        since it hands over."""
        copy = copied(self._ask_once, lambda wait: self._over.wait(wait) or stop.is_set(), seconds, last)
        if copy is not None:
            self._inbox.put("", copy)
        return copy is not None

    # The loop

    def _receive(self, item: Sample | Loaded | Told) -> None:
        known = self._shadow.orders.known
        if isinstance(item, Told):
            self._shadow.orders.tell(item.epoch, item.events)
        elif isinstance(item, Loaded):
            fault = self._shadow.load(item.blob, (item.epoch, item.step))
            if fault:
                self._told.warn("the active centre's checkpoint cannot be used: %s", fault)
            else:
                log.info("in step with the active centre, from its step %d on", item.step)
        else:
            self._read(item)
        if self._shadow.orders.known > known:
            self._hurry.set()  # whoever gave the order waits for that

    def _read(self, item: Sample) -> None:
        try:
            message = decode(item.data)
        except ValueError:
            return
        realm, name = self._config.bus.realm, self._config.centre.name
        if item.key.startswith(f"{global_key(name, 'log', realm)[:-3]}"):
            self._shadow.output(message)
        else:
            self._shadow.local(message, item.key, item.data, item.received)

    def _say(self) -> None:
        shadow, now = self._shadow, seconds()
        if shadow.wanted and shadow.fetched:
            self._told.warn("not in step with the active centre: %s; its checkpoint is fetched", shadow.wanted)
        if self._told.allows("watchdog", 0.5):
            where = f"at step {shadow.mark[1]}" if not shadow.wanted else shadow.wanted
            notify(f"WATCHDOG=1\nSTATUS=standing by: {where}")
        if not self._met and now - self._begun > ALONE and self._told.allows("nobody", 30.0):
            log.warning("nobody is active as %s: waiting for one (`fusion-service run`)", self._config.centre.name)
        if shadow.ready and not shadow.wanted and now - self._saved > KEPT:
            self._saved = now
            try:
                self._state.save(shadow.heritage().checkpoint or b"")
            except OSError as error:
                self._told.error("cannot save the checkpoint: %s", error)

    def _due(self) -> str:
        """Why it is time to take over, "" while it is not."""
        now = seconds()
        passed, self._round = now - self._round, now
        self._awake += min(passed, MOST_AWAKE)
        with self._lock:
            if not self._bus.connected:
                self._away = now
            if passed > self._takeover / 2:
                self._none_since = now
            if not self._met and not self._state.has_node:
                return ""
            self._settle_node()
            if now - self._away < REJOINED:
                self._sign, self._awake, self._none_since = now, 0.0, now
                return ""
            patience = RANK * self._rank()
            if self._holding:
                why = self._why_not_holding(max(self._holding), now, patience)
            elif now - self._none_since < (GRACE if self._met else ALONE) + patience + PATIENCE * self._shadow.waits:
                return ""
            else:
                why = "its token is gone: it has ended, or the bus is split" if self._met else "nobody is active"
        return why if why and self._is_so(why) else ""

    def _why_not_holding(self, term: int, now: float, patience: float) -> str:
        """Why the one that holds the name under `term` is to be followed on."""
        if term in self._yielded:
            step, since = self._yielded[term]
            if self._shadow.mark[1] >= step or now - since > YIELDED:
                return "it hands over"
        if min(now - self._sign, self._awake / AWAKE) > self._takeover + patience:
            return f"no sign of it for {now - self._sign:.1f} s"
        hung = HUNG * max(1.0, self._config.centre.period, self._config.service.status_period)
        if self._age > hung:
            return f"its loop stands still for {self._age:.0f} s"
        deaf = self._deafness.seconds()
        return f"it has heard nothing for {deaf:.0f} s of what comes here" if deaf > hung else ""

    def _is_so(self, why: str) -> bool:
        """Whether the hub, asked now, does not say otherwise."""
        keys, answered = self._probe.present(
            token_key(self._config.centre.name, "holds", "*", self._config.bus.realm), self._takeover / 2
        )
        held = terms_held(keys)
        with self._lock:
            for term in held:
                self._holding.setdefault(term, seconds())
        return answered and (not held or not why.startswith(("its token", "nobody")))

    def _settle_node(self) -> None:
        """Take a node of its own beside those that are known."""
        others = [node_of(term) for term in self._holding]
        others += [node for name, node in self._nodes.items() if name < self._name]
        node = free_node(self._state.node, others)
        if (node != self._state.node or not self._state.has_node) and self._holding:
            try:
                self._state.keep_node(node)
            except OSError as error:
                self._state.node = node
                self._told.error("cannot keep the node: %s", error)

    def _rank(self) -> int:
        return sum(name < self._name for name in self._nodes)

    def _succession(self, why: str) -> Succession:
        checkpoint, ended, orders, born = self._shadow.heritage()
        if self._shadow.wanted and checkpoint is not None:
            log.warning("takes over from step %d of the other: %s", self._shadow.mark[1], self._shadow.wanted)
        with self._lock:
            terms = [*self._holding, self._following, self._generation]
        return Succession(why, checkpoint, ended, max(terms), max(self._epoch, self._shadow.newest[0]), orders, born)
