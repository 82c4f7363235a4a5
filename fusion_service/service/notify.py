"""What is told to those who look after the process: the service manager (sd_notify of systemd), and who else listens
here, as the health that is served over HTTP does."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from schemas import Status

__all__ = ["Listener", "listening", "notify"]

log = logging.getLogger(__name__)

Listener: TypeAlias = "Callable[[str, Status | None], None]"
"""Called with what the service manager is told, and the status with which it is told; on any thread, and returns at
once."""
_listeners: list[Listener] = []
"""One process has one who looks after it, and whoever listens in."""


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """`listener` hears all that is told."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def notify(state: str, status: Status | None = None) -> None:
    """Tell `state` (READY=1, WATCHDOG=1, STOPPING=1): to the service manager where it has asked for it by
    NOTIFY_SOCKET."""
    for listener in list(_listeners):
        listener(state, status)
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            try:
                sock.connect("\0" + address[1:] if address[0] == "@" else address)
                sock.send(state.encode())
            except OSError as error:
                log.warning("cannot notify the service manager: %s", error)
