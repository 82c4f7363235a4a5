"""The hub: a Zenoh router in a process of its own, which everything else joins. A real zenohd serves as well."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence

from fusion_service.bus.session import DEFAULT_ENDPOINT, open_bus

__all__ = ["run_hub"]

log = logging.getLogger(__name__)


def run_hub(listen: Sequence[str] = (DEFAULT_ENDPOINT,), stop: threading.Event | None = None) -> None:
    """Route between all who connect to `listen` until `stop` is set. Raises `BusError` if an endpoint
    is in use or bad."""
    stop = stop or threading.Event()
    with open_bus(listen=listen, mode="router"):
        log.info("the hub listens on %s", ", ".join(listen))
        stop.wait()
