"""`fusion-service status`: how a running centre and its sources are, from the bus alone."""

from __future__ import annotations

import argparse
import threading
from typing import Any

from fusion_service.bus.options import PATIENCE, bus_options, joined
from fusion_service.process import argument, positive

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "How a running centre and its sources are, and what is wrong: 0 all is well, 1 something is wrong, or no answer."
EXAMPLE = """fusion-service status
  fusion-service status --json | jq '.centres[].sources'
  fusion-service status --centre north --for 10 || echo "see to it"
  fusion-service status --ignore 'spare-*' --ignore radar7        gone, and meant to be
  fusion-service status --security keys/viewer-wall"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("--centre", metavar="NAME", help="of this centre only (default: all of the realm)")
    parser.add_argument("--json", action="store_true", help="as JSON, for scripts")
    parser.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="NAME",
        help="a source whose faults do not count; * stands for any letters; several times",
    )
    parser.add_argument(
        "--for",
        dest="seconds",
        type=argument(positive),
        default=2.5,
        metavar="S",
        help="how long it listens, s (default 2.5); whoever publishes less often on a wrong key is not heard",
    )
    bus_options(parser, "a certificate that may listen: a viewer's")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Listen, print, and raise `HealthError` where something is wrong. Raises `UsageError`, `BusError`,
    `SecurityError` besides."""
    import json
    import time

    from fusion_service.errors import HealthError
    from fusion_service.lookout.ear import Ear
    from fusion_service.lookout.view import view_of

    ear = Ear(args.realm)
    with joined(args, stop) as bus:
        ear.hear(bus, args.centre or "*")
        begin = time.monotonic()
        while not stop.is_set() and time.monotonic() - begin < args.seconds + PATIENCE:
            stop.wait(0.05)
            if ear.statuses and time.monotonic() - begin >= args.seconds:
                break
        ear.ask(bus)
        view = view_of(ear, time.time_ns(), centre=args.centre or "", ignored=args.ignore)
    if args.json:
        said = {
            "well": not view.wrong,
            "wrong": view.wrong,
            "beside": view.beside,
            "centres": [one.health.data for one in view.centres],
            "recorders": [{"name": one.name, **one.said, "wrong": one.wrong} for one in view.keepers],
        }
        print(json.dumps(said, indent=1, default=_plain))
    else:
        for one in view.centres:
            print("\n".join(one.health.lines))
        print("\n".join(one.line for one in view.keepers) or "recorder: none is there, nothing is kept")
        for line in view.twice:
            print(line)
        for line in view.beside:
            print(f"beside: {line}")
        if not view.everywhere:
            print("only this realm was heard: the certificate lets in no more")
    if view.wrong:
        wrong = view.wrong
        raise HealthError(wrong[0] if len(wrong) == 1 else f"{len(wrong)} things are wrong; the first: {wrong[0]}")


def _plain(value: Any) -> Any:
    """What JSON has no form for."""
    return value.hex() if isinstance(value, bytes) else str(value)
