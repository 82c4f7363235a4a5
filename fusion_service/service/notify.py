"""What the service manager is told (sd_notify of systemd)."""

from __future__ import annotations

import logging
import os
import socket

__all__ = ["notify"]

log = logging.getLogger(__name__)


def notify(state: str) -> None:
    """Tell it `state` (READY=1, WATCHDOG=1, STOPPING=1), where it has asked for it by NOTIFY_SOCKET."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            try:
                sock.connect("\0" + address[1:] if address[0] == "@" else address)
                sock.send(state.encode())
            except OSError as error:
                log.warning("cannot notify the service manager: %s", error)
