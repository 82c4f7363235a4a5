"""`fusion-service hub`."""

from __future__ import annotations

import argparse
import logging
import threading
from contextlib import ExitStack

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.commands.observed import add_metrics, observed
from fusion_service.hangup import on_hangup
from fusion_service.process import argument

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The bus: a Zenoh router that everything else joins."
EXAMPLE = f"""fusion-service hub --listen {DEFAULT_ENDPOINT}
  fusion-service hub --listen tls/0.0.0.0:7447 --security keys/hub     certificates: see `fusion-service keys --help`"""

log = logging.getLogger(__name__)


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
    add_metrics(parser, "hub")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Route until `stop` is set. Raises `BusError`, `SecurityError`, OSError, ImportError."""
    from fusion_service.bus.hub import open_hub
    from fusion_service.bus.renewal import certificates_changed, fingerprint
    from fusion_service.bus.security import maybe_security
    from fusion_service.monitoring import Links, Pulse
    from fusion_service.service.notify import listening, notify

    files = fingerprint(args.security)

    def reload() -> None:
        if not certificates_changed(files, args.security):
            log.info("there is nothing to reload: where it listens, and whom it lets in, a restart changes")

    pulse, links = Pulse(), Links()
    with ExitStack() as stack:
        stack.enter_context(on_hangup(reload))
        stack.enter_context(listening(pulse.told))
        stack.enter_context(observed(args.metrics, "hub", links.samples, lambda: "", pulse.begun))
        bus = stack.enter_context(open_hub(args.listen or [DEFAULT_ENDPOINT], maybe_security(args.security)))
        if args.metrics:
            bus.on_link(links.change)
        notify("READY=1\nSTATUS=routing")
        while not stop.wait(1.0):  # see `hangup`
            pass
        notify("STOPPING=1")
