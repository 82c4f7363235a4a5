"""`fusion-service hub`."""

from __future__ import annotations

import argparse
import threading

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.process import argument

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The bus: a Zenoh router that everything else joins."
EXAMPLE = f"""fusion-service hub --listen {DEFAULT_ENDPOINT}
  fusion-service hub --listen tls/0.0.0.0:7447 --security keys/hub     certificates: see `fusion-service keys --help`"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument(
        "--listen",
        action="append",
        type=argument(check_endpoint),
        metavar="ENDPOINT",
        help=f"where to listen (default {DEFAULT_ENDPOINT})",
    )
    parser.add_argument("--security", metavar="FILE", help="let in only whom this file lists, each in its role")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Route until `stop` is set. Raises `BusError`, `SecurityError`."""
    from fusion_service.bus.hub import run_hub
    from fusion_service.bus.security import maybe_security

    run_hub(args.listen or [DEFAULT_ENDPOINT], stop, maybe_security(args.security))
