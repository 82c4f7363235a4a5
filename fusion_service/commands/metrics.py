"""`fusion-service metrics`: Prometheus metrics of all centres of a realm, by a process of its own."""

from __future__ import annotations

import argparse
import logging
import threading
from contextlib import ExitStack
from functools import partial

from fusion_service.bus.options import bus_options, joined
from fusion_service.commands.arguments import address
from fusion_service.commands.observed import PORTS, observed
from fusion_service.hangup import on_hangup
from fusion_service.process import argument

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Serve Prometheus metrics of all centres on the bus, which costs these nothing."
EXAMPLE = f"""fusion-service metrics                                http://127.0.0.1:{PORTS["metrics"]}/metrics
  fusion-service metrics --listen 0.0.0.0:{PORTS["metrics"]} --connect tcp/192.0.2.1:7447
  fusion-service metrics --security keys/viewer-wall"""

log = logging.getLogger(__name__)


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument(
        "--listen",
        default=("127.0.0.1", PORTS["metrics"]),
        type=argument(partial(address, port=PORTS["metrics"])),
        metavar="HOST:PORT",
        help=f"where it serves /metrics, /healthz and /readyz (default 127.0.0.1:{PORTS['metrics']}; any other host "
        "opens them to the network)",
    )
    bus_options(parser, "a certificate that may listen: a viewer's")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Serve until `stop` is set. Raises `UsageError`, `BusError`, `SecurityError`, OSError, ImportError."""
    from fusion_service.bus import Bus
    from fusion_service.bus.renewal import certificates_changed, fingerprint
    from fusion_service.errors import UsageError
    from fusion_service.monitoring import Heard
    from fusion_service.service.notify import notify
    from schemas import global_key

    try:
        key = global_key("*", "status", args.realm)
    except ValueError as error:
        raise UsageError(str(error)) from None
    files, there = fingerprint(args.security), list[Bus]()

    def reload() -> None:
        if not certificates_changed(files, args.security):
            log.info("there is nothing to reload")

    heard = Heard(lambda: bool(there) and there[0].connected)
    with ExitStack() as stack:
        stack.enter_context(on_hangup(reload))
        stack.enter_context(observed(args.listen, "metrics", heard.samples, lambda: "", heard.ready))
        bus = stack.enter_context(joined(args, stop, wait=True))
        bus.subscribe(key, heard.take)
        there.append(bus)
        stack.callback(there.clear)
        notify("READY=1")
        while not stop.wait(1.0):
            notify("WATCHDOG=1")
        notify("STOPPING=1")
