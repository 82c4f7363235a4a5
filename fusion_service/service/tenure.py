"""`Tenure`: by what the active process holds the name of its centre, and when it must let go.

A token `holds/{term}` says under which term it is active; who sees one of a greater term stands down. Nothing is
published before that was looked at: whoever has not come by for `takeover / 2` seconds (it was frozen, or a step took
long), or has lost the hub while another stands by, asks the hub for the tokens first, and publishes nothing until the
hub has told them, its own among them, and within that time. Clocks that go on while a machine sleeps tell. The hub is
asked on a session that watches no tokens: one that does would answer from what it heard before it was frozen.

Those who stand by ask `.../state`: for a sign of life, with which they say how far they have come; or for a checkpoint,
a part at a time, which is made between two steps. What they say tells which orders they have, so that an order is
answered when it outlives this process, and they are told of those that wait for a step. Where somebody stands by a
step's log goes out before its picture: who sees a track in the picture sees it again after a take-over. An operator may
order to hand over (`handover`): then the last step is published, a checkpoint held ready for who cannot follow,
`yields/{term}.{step}` announced, and no step made any more; should nobody have taken over in `HANDOVER` seconds, it
goes on.

Where the bus was split, hubs have been seen to lose what was declared before, for good, as the link between them came
and went (Zenoh's issue 1886). One that stands by, as its token says, and asks nothing, is told of `.../state` anew.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, cast

import msgpack

from fusion_service.bus import Bus
from fusion_service.config import ServiceConfig
from fusion_service.service.handover import Handover
from fusion_service.service.promises import Promises, Reply
from fusion_service.service.terms import MOST_GENERATION
from schemas import global_key, token_key

__all__ = ["PART", "Held", "Tenure", "seconds", "terms_held"]

PART = 2**20
"""Bytes of a checkpoint in one answer."""
HANDOVER = 2.0
OFTEN = 0.05
"""Seconds after one look until the next."""
LOOK = 2.0
"""Seconds after which the hub is asked in any case, where another stands by."""
FRESH = 2.0
"""Seconds for which one that stands by is there after it was heard."""
UNHEARD = 5.0
"""Seconds for which one that stands by may ask nothing, until it is told anew where to."""
MOST = 8
MOST_BYTES = 1000
TOLD = 600.0
"""Seconds for which the status tells of what has happened."""

log = logging.getLogger(__name__)


def seconds() -> float:
    """A clock that never goes back, nor stands still while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def terms_held(keys: list[str]) -> list[int]:
    """The terms that tokens tell, the greatest last."""
    names = [key.rsplit("/", 1)[-1] for key in keys]
    terms = [int(name) for name in names if len(name) <= 10 and name.isascii() and name.isdigit()]
    return sorted(term for term in terms if term < MOST_GENERATION)


class Held(NamedTuple):
    """A checkpoint to be fetched: of the run `epoch`, after its step `step`."""

    epoch: int
    step: int
    blob: bytes


class Centre(Protocol):
    """What is asked of the centre that is active."""

    @property
    def epoch(self) -> int: ...

    def checkpoint(self) -> bytes: ...


@dataclass(slots=True)
class Follower:
    """One that stands by: its node, the step it stands at, whether it could take over, and why not, the greatest number
    of an order that it has, its patience, s, and when it was heard."""

    node: int
    step: int
    ready: bool
    why: str
    known: int
    takeover: float
    heard: float


class Tenure:
    """The active process' hold of a centre's name on `bus`. probe: a session that watches nothing; without it the hub
    is not asked. why: how it came to be active, for the status. handed: whether it ended by an order."""

    def __init__(self, config: ServiceConfig, bus: Bus, probe: Bus | None = None, why: str = "") -> None:
        self._realm, self._name, self._bus, self._probe = config.bus.realm, config.centre.name, bus, probe
        self._takeover = config.service.takeover
        self._lock = threading.Lock()
        self._wake: Callable[[], None] = lambda: None
        self._followers: dict[str, Follower] = {}
        self._there: set[str] = set()
        self._wanted: dict[str, None] = {}
        self._held: dict[str, Held] = {}
        self._newer = 0
        self._lower: set[int] = set()
        self._doubt = self._accompanied = False
        self._handover = Handover(seconds)
        self._promises = Promises()
        self._heard = seconds()
        self._passed = self._asked = self._round = seconds()
        self._step = self._time = -1
        self._epoch = self._generation = 0
        self._said: tuple[str, float] = (why, seconds())
        self.term = 0
        self.handed = False

    @property
    def pace(self) -> float:
        """Seconds after which the loop should come by again."""
        return self._takeover / 4

    def begin(self, term: int, epoch: int, wake: Callable[[], None]) -> None:
        """Hold the name from now on. wake: lets the loop come by at once."""
        self.term = self._generation = term
        self._epoch, self._wake = epoch, wake
        self._bus.announce(self._key("holds", str(term)))
        self._bus.watch(self._key("holds", "*"), self._on_term)
        self._bus.watch(self._key("standby", "*"), self._on_follower)
        self._answers = self._bus.answer(global_key(self._name, "state", self._realm), self._answer)
        self._told_anew = self._passed = self._heard = seconds()
        log.info("active as %s, term %d", self._name, term)

    def vouch(self, promises: Promises) -> None:
        """Let the answers to orders wait for those who stand by."""
        promises.may, promises.followed = self.may_publish, self._known
        self._promises = promises

    def hears(self) -> None:
        """Something came from a source. Returns at once."""
        self._heard = seconds()

    @property
    def order(self) -> tuple[str, ...]:
        """In which order the messages of a step are published."""
        return ("log", "tracks") if self._there else ("tracks", "log")

    def _key(self, what: str, name: str) -> str:
        return token_key(self._name, what, name, self._realm)

    # On threads of the bus

    def _on_term(self, key: str, alive: bool) -> None:
        for term in terms_held([key]):
            if term > self.term and alive:
                self._newer = max(self._newer, term)
                self._wake()
            elif term < self.term and alive and term not in self._lower and len(self._lower) < 1000:
                self._lower.add(term)
                self._say(f"another {self._name} was active under term {term}: this one's, {self.term}, holds")

    def _on_follower(self, key: str, alive: bool) -> None:
        name = key.rsplit("/", 1)[-1]
        with self._lock:
            self._accompanied = True
            if alive and len(self._there) < MOST:
                self._there.add(name)
            elif not alive:
                self._there.discard(name)
                self._followers.pop(name, None)
        if alive:
            log.info("%s stands by", name)
        else:
            self._say(f"{name} stands by no more: it has ended, or the bus is split")

    def _say(self, text: str) -> None:
        self._said = text, seconds()
        log.warning("%s", text)

    def _answer(self, payload: bytes | None) -> bytes:
        raw = msgpack.unpackb(payload) if payload and len(payload) < MOST_BYTES else {}
        asked = raw if isinstance(raw, dict) else {}
        what, name = asked.get("what"), str(asked.get("name", ""))[:64]
        answer: dict[str, Any] = {"term": self.term, "epoch": self._epoch, "step": self._step, "time": self._time}
        answer |= {"generation": self._generation, "age": max(0.0, seconds() - self._round)}
        answer |= {"heard": seconds() - self._heard} | ({"orders": held} if (held := self._promises.held()) else {})
        if what in ("sign", "state"):
            self._note(name, asked)
            with self._lock:
                answer["nodes"] = {name: one.node for name, one in self._followers.items()}
            if what == "state":
                answer |= self._part(name, asked.get("part"))
        return cast(bytes, msgpack.packb(answer))

    def ordered(self, payload: bytes | None, operator: str, reply: Reply) -> bool:
        """Whether this was an order to hand over, which is answered later. operator: on whose key it came."""
        taken = self._handover.take(payload, operator, reply)
        if taken:
            self._wake()
        return taken

    def _note(self, name: str, asked: dict[str, Any]) -> None:
        node, step, takeover = asked.get("node"), asked.get("step"), asked.get("takeover")
        if not (type(node) is int and type(step) is int and isinstance(takeover, float) and takeover > 0):
            return
        known, why = asked.get("ordered"), str(asked.get("why", ""))[:200]
        ready, known = asked.get("ready") is True, known if type(known) is int else 0
        with self._lock:
            before = self._followers.get(name)
            if before is not None or len(self._followers) < MOST:
                self._followers[name] = Follower(node, step, ready, why, known, takeover, seconds())
        if before is not None and (known, ready) != (before.known, before.ready):
            self._wake()

    def _part(self, name: str, part: object) -> dict[str, Any]:
        """A part of the checkpoint that was made for `name`; without one, a new one is to be made."""
        with self._lock:
            if type(part) is not int or part < 0:
                self._held.pop(name, None)
                if len(self._wanted) < MOST:
                    self._wanted[name] = None
                self._wake()
                return {}
            held = self._held.get(name)
            if held is None or part * PART >= len(held.blob):
                return {}
        parts = -(-len(held.blob) // PART)
        if part == parts - 1:
            with self._lock:
                self._held.pop(name, None)
        said = {"of": [held.epoch, held.step], "parts": parts, "part": part}
        return said | {"data": held.blob[part * PART : (part + 1) * PART]}

    def _ready(self) -> dict[str, Follower]:
        now = seconds()
        return {name: one for name, one in self._followers.items() if one.ready and now - one.heard < FRESH}

    def _known(self) -> int | None:
        """The greatest number of an order that all who stand by have; None where nobody does. Also who is not in step:
        it would give again what its state does not know."""
        now = seconds()
        with self._lock:
            fresh = [one for name, one in self._followers.items() if name in self._there and now - one.heard < FRESH]
        return min((one.known for one in fresh), default=None)

    def _others(self) -> dict[str, str]:
        """Who stands by, and why each could not take over."""
        with self._lock:
            ready, said = self._ready(), {name: one.why for name, one in self._followers.items()}
            there = sorted(self._there)
        return {name: "" if name in ready else said.get(name) or "is not in step yet" for name in there}

    # In the loop

    def stepped(self, step: int, time: int, epoch: int, generation: int) -> None:
        """A step was made and published."""
        self._step, self._time, self._epoch, self._generation = step, time, epoch, generation

    def goes_on(self, centre: Centre, stop: threading.Event) -> bool:
        """Come by once a round: hand out what was asked for. Whether the process is still the active one."""
        self._round = seconds()
        handing = not stop.is_set() and self._handover.due(self._others()) and self.may_publish()
        if (self._wanted or handing) and self._step >= 0:
            with self._lock:
                names, self._wanted = [*self._wanted, *(self._followers if handing else ())], {}
            held = Held(centre.epoch, self._step, centre.checkpoint())
            with self._lock:
                self._held = dict(list(self._held.items())[-MOST:]) | dict.fromkeys(names, held)
        if handing:
            self._yield(stop)
        self._tell_anew()
        gone = self._gone()
        if gone or stop.is_set():
            self._handover.done(self._newer, "the service stops")
        return not gone

    def may_publish(self) -> bool:
        """Look, before anything is published, whether the name is still this process' own. On any thread."""
        now = seconds()
        if now - self._passed < OFTEN:
            return not (self._doubt and self._probe is not None) and not self._newer
        patience = min([self._takeover, *(one.takeover for one in list(self._followers.values()))])
        late = now - self._passed > patience / 2
        connected = self._bus.connected if late or self._accompanied else True
        due = self._accompanied and now - self._asked > LOOK
        if (late and connected) or (self._accompanied and not connected) or due:
            self._doubt = True
        if self._doubt and self._probe is not None and not self._newer:
            keys, answered = self._probe.present(self._key("holds", "*"), patience / 2)
            self._asked, terms = seconds(), terms_held(keys)
            self._newer = max([self._newer, *(term for term in terms if term > self.term)])
            self._doubt = not answered or self.term not in terms or seconds() - now > patience / 2
        self._passed = seconds()
        return not (self._doubt and self._probe is not None) and not self._newer

    def _gone(self) -> bool:
        """Whether another holds the name."""
        self.may_publish()
        return bool(self._newer)

    def _tell_anew(self) -> None:
        """Declare the answers to questions once more, where one that stands by asks none."""
        now = seconds()
        with self._lock:
            asking = {name for name, one in self._followers.items() if now - one.heard < UNHEARD}
            if not self._there - asking:
                self._told_anew = now
        if now - self._told_anew > UNHEARD:
            self._told_anew = now
            self._answers.close()
            self._answers = self._bus.answer(global_key(self._name, "state", self._realm), self._answer)
            log.warning("one that stands by asks nothing: it is told anew where to")

    def _yield(self, stop: threading.Event) -> None:
        """Make no step until another has taken over, or the time for that is over."""
        token = self._bus.announce(self._key("yields", f"{self.term}.{max(self._step, 0)}"))
        deadline = seconds() + HANDOVER
        while not self._newer and not stop.is_set() and seconds() < deadline:
            time.sleep(0.005)
        token.close()
        self.handed = bool(self._newer)
        if not self._newer and not stop.is_set():
            self._say("nobody took over: this process goes on")
        self._handover.done(self._newer, f"nobody took over within {HANDOVER:g} s: this process goes on")

    @property
    def farewell(self) -> str:
        """Why it stands down, in words."""
        if self.handed:
            return f"handed over to term {self._newer}"
        return f"another is active under term {self._newer}, after {self.term}: this one froze, or the bus was split"

    def notes(self) -> tuple[str, ...]:
        """What the status says of it."""
        text, at = self._said
        return (text,) if text and seconds() - at < TOLD else ()

    def numbers(self) -> dict[str, int]:
        """How many stand by, and how many of them could take over."""
        with self._lock:
            return {"there": len(self._there), "ready": len(self._ready())}
