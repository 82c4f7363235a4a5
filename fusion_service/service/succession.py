"""Which part a process has in its centre: active, or standing by for the one that is; and what follows when it ends.

One that starts while another of its name is active stands by, whatever it was started as; one that stood down does so
too. Every part has a session of its own on the bus, so that with it everything ends that was declared; another one, on
which nothing is watched, is there all the time to ask the hub who is active.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from typing import Protocol

from fusion_service.bus import Bus, open_bus
from fusion_service.bus.security import Security
from fusion_service.config import ServiceConfig
from fusion_service.service.standby import Standby
from fusion_service.service.state import State
from fusion_service.service.tenure import Tenure, terms_held
from schemas import token_key

__all__ = ["Active", "Process", "succeed"]

log = logging.getLogger(__name__)


class Active(Protocol):
    """The service, as the part that is active."""

    def run(self, stop: threading.Event, begun: Callable[[], None] | None = None) -> None: ...

    def feed(self, source: str, key: str, data: bytes, received: int) -> None: ...


@dataclass(frozen=True)
class Process:
    """What a process has for whatever its part is. make: the service on a session on the bus."""

    config: ServiceConfig
    state: State
    stop: threading.Event
    security: Security | None
    make: Callable[[ServiceConfig, Bus, State, Tenure], Active]

    def join(self) -> AbstractContextManager[Bus]:
        """A session on the bus."""
        return open_bus(self.config.bus.connect, stop=self.stop, security=self.security)


def succeed(process: Process, standby: bool) -> None:
    """Run as what the process is, one part after the other, until `stop` is set. Raises what `join` and `make` do."""
    with process.join() as probe:
        while not process.stop.is_set():
            standby = _part(process, standby, probe)


def _part(process: Process, standby: bool, probe: Bus) -> bool:
    """Be one part until it ends; whether the next is to stand by."""
    config, state, stop = process.config, process.state, process.stop
    holds = token_key(config.centre.name, "holds", "*", config.bus.realm)
    if not standby and (terms := terms_held(probe.present(holds)[0])):
        log.warning("a centre named %s is active, term %d: standing by for it", config.centre.name, terms[-1])
        return True
    with ExitStack() as stack:
        waiting: Standby | None = None
        why = ""
        if standby:
            heard = stack.enter_context(ExitStack())
            waiting = Standby(config, heard.enter_context(process.join()), probe, state)
            heard.callback(waiting.join)
            heritage = waiting.wait(stop)
            if heritage is None:
                return True
            state.inherit(*heritage[1:])
            why = f"took over: {heritage.why}"
        bus = stack.enter_context(process.join())
        service = process.make(config, bus, state, Tenure(config, bus, probe, why))
        service.run(stop, _hand_on(waiting, service, heard, stack) if waiting is not None else None)
    return True


def _hand_on(waiting: Standby, service: Active, heard: ExitStack, stack: ExitStack) -> Callable[[], None]:
    """Gives the service that has begun what waits for it, and ends the session on which that was heard, in a thread of
    its own, since the last question there may wait for its answer; `stack` waits for that at the end."""

    def begun() -> None:
        waiting.hand_on(lambda source, one: service.feed(source, one.key, one.data, one.received))
        closing = threading.Thread(target=heard.close)
        closing.start()
        stack.callback(closing.join)

    return begun
