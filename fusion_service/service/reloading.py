"""SIGHUP to the service: its config is read again. What changes no result is taken at once; the rest is named, and
waits for a restart.

At once: how much one source may send (`limits`), how much is logged (`log_level`, `log_refusals`), how often the status
comes (`status_period`). Everything under [centre] changes results, and what changes a result is an event that replay
knows: the start of a run is one, a reload is not. Sessions, certificates and the state are opened at the start.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar

from fusion_service.bus import Bus
from fusion_service.bus.renewal import certificates_changed, fingerprint
from fusion_service.config import ConfigError, ServiceConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.flow import Flow
from fusion_service.service.heartbeat import Heartbeat
from fusion_service.service.state import State
from fusion_service.service.tenure import Tenure

__all__ = ["AT_ONCE", "Reloads", "Tuned", "changed", "set_level"]

AT_ONCE = ("limits", "service.log_level", "service.log_refusals", "service.status_period")
"""Keys, and tables, that a reload takes."""
MOST_NAMED = 20

log = logging.getLogger(__name__)


class Tuned:
    """The parts of a running service that take what a reload brings."""

    def __init__(self, flow: Flow, told: BoundedLog, heart: Heartbeat) -> None:
        self._flow, self._told, self._heart = flow, told, heart

    def take(self, config: ServiceConfig) -> None:
        """Go on by these limits and periods. On any thread."""
        self._flow.limit(config.limits)
        self._told.limit(config.service.log_refusals)
        self._heart.period = config.service.status_period


class Service(Protocol):
    """What is reloaded."""

    tuned: Tuned


S = TypeVar("S", bound=Service)


class Reloads:
    """Reloads of the service of `config`. read: the config as the file says it now; verbose: -v was given, and goes
    before `log_level`."""

    def __init__(self, config: ServiceConfig, read: Callable[[], ServiceConfig], verbose: bool = False) -> None:
        self.config = config
        self._active: Service | None = None
        self._bus: Bus | None = None
        self._read = read
        self._verbose = verbose
        self._files = fingerprint(config.bus.security)

    def making(
        self, make: Callable[[ServiceConfig, Bus, State, Tenure], S]
    ) -> Callable[[ServiceConfig, Bus, State, Tenure], S]:
        """As `make`, by the config as it is then; what is made is reloaded from now on."""

        def made(_: ServiceConfig, bus: Bus, state: State, tenure: Tenure) -> S:
            service = make(self.config, bus, state, tenure)
            self._active, self._bus = service, bus
            return service

        return made

    def joined(self) -> bool:
        """Whether the service that was made last has the bus. On any thread."""
        try:
            return self._bus is None or self._bus.connected
        except Exception:  # a session that is being closed
            return False

    def reload(self) -> None:
        """Read the config, take what can be taken, and say what was done. A file that is no good changes nothing."""
        try:
            new = self._read()
        except ConfigError as error:
            for line in str(error).splitlines():
                log.error("not reloaded: %s", line)
            log.error("not reloaded: the old config goes on; mend the file, and reload again")
            return
        taken, waiting = changed(self.config, new)
        service = dataclasses.replace(
            self.config.service,
            **{key.split(".")[1]: getattr(new.service, key.split(".")[1]) for key in AT_ONCE if "service." in key},
        )
        self.config = dataclasses.replace(self.config, service=service, limits=new.limits)
        if self._active is not None:
            self._active.tuned.take(self.config)
        set_level(self.config, self._verbose)
        if taken:
            log.info("reloaded, at once: %s", _few(taken))
        if waiting:
            log.warning("changed in the file, and taken by a restart only: %s", _few(waiting))
        renewed = certificates_changed(self._files, self.config.bus.security)
        if not taken and not waiting and not renewed:
            log.info("reloaded: nothing has changed")


def set_level(config: ServiceConfig, verbose: bool) -> None:
    """Log from the config's level on; -v goes before it."""
    logging.getLogger().setLevel(logging.DEBUG if verbose else config.service.log_level.upper())


def changed(old: ServiceConfig, new: ServiceConfig) -> tuple[list[str], list[str]]:
    """Keys whose values differ: those that are taken at once, and those that need a restart, each as `key: old -> new`
    where both are short."""
    taken: list[str] = []
    waiting: list[str] = []
    for key, before, now in _differences("", old, new):
        at_once = any(key == one or key.startswith(f"{one}.") for one in AT_ONCE)
        values = f"{_shown(before)} -> {_shown(now)}"
        (taken if at_once else waiting).append(f"{key}: {values}" if len(values) <= 60 else key)
    return taken, waiting


def _differences(key: str, old: Any, new: Any) -> list[tuple[str, Any, Any]]:
    """The deepest keys under which two values differ."""
    if dataclasses.is_dataclass(old) and type(old) is type(new):
        pairs = [(one.name, getattr(old, one.name), getattr(new, one.name)) for one in dataclasses.fields(old)]
    elif isinstance(old, Mapping) and isinstance(new, Mapping):
        pairs = [(str(name), old.get(name), new.get(name)) for name in dict.fromkeys([*old, *new])]
    else:
        return [] if repr(old) == repr(new) else [(key, old, new)]
    return [one for name, *both in pairs for one in _differences(f"{key}.{name}" if key else name, *both)]


def _shown(value: Any) -> str:
    return "none" if value is None else str(value)


def _few(words: list[str]) -> str:
    more = f", and {len(words) - MOST_NAMED} more" if len(words) > MOST_NAMED else ""
    return ", ".join(words[:MOST_NAMED]) + more
