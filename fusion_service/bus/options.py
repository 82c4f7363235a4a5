"""The options by which a command joins a hub, said once for all commands of both programs, and the joining."""

from __future__ import annotations

import argparse
import threading
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.process import argument

if TYPE_CHECKING:
    from fusion_service.bus.session import Bus

__all__ = ["PATIENCE", "bus_options", "joined"]

REALM = "fusion"
"""As in `schemas`, which is slow to load."""
PATIENCE = 5.0
"""Seconds in which the hub must be there, of a command that looks on."""


def bus_options(
    parser: argparse.ArgumentParser, security: str, realm: str | None = f"first part of every key (default {REALM})"
) -> None:
    """--connect, --security and, unless None is given for its help, --realm."""
    parser.add_argument(
        "--connect",
        action="append",
        type=argument(check_endpoint),
        metavar="ENDPOINT",
        help=f"hub to join (default {DEFAULT_ENDPOINT})",
    )
    parser.add_argument("--security", metavar="FILE", help=f"{security} (see `fusion-service keys`)")
    if realm is not None:
        parser.add_argument("--realm", default=REALM, help=realm)


def joined(
    args: argparse.Namespace, stop: threading.Event, wait: bool | float | None = None
) -> AbstractContextManager[Bus]:
    """A session by these options; wait: seconds for the hub, `PATIENCE` unless told. Raises `BusError`,
    `SecurityError`."""
    from fusion_service.bus.security import maybe_security
    from fusion_service.bus.session import open_bus

    security = maybe_security(args.security)
    patience = PATIENCE if wait is None else wait
    return open_bus(args.connect or [DEFAULT_ENDPOINT], wait=patience, stop=stop, security=security)
