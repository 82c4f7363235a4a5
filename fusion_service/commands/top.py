"""`fusion-service top`: centres, sources and recorders, live in the terminal, from the bus alone."""

from __future__ import annotations

import argparse
import threading
from typing import TYPE_CHECKING

from fusion_service.bus.options import bus_options, joined

if TYPE_CHECKING:
    from collections.abc import Callable

    from fusion_service.bus import Bus
    from fusion_service.lookout.ear import Ear
    from fusion_service.lookout.view import View

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "See live how centres, their sources and recorders are, those in trouble first."
EXAMPLE = """fusion-service top
  fusion-service top --sort rate --ignore 'spare-*'
  fusion-service top --once                                 one look, as plain lines
  fusion-service top --security keys/viewer-wall"""
ORDERS = ("trouble", "name", "rate", "tracks", "shared", "refused", "clock", "latency")
"""As in `lookout.layout`, which is slow to load."""
FIRST = 2.5
"""Seconds for which one look listens."""
ASKED = 1.0
"""Seconds between two questions to the recorders."""
LINES = 2.0
"""Seconds between two looks where they are printed one below the other."""
WIDTH = 100
"""Columns where there is no terminal."""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.description = (
        f"{HELP}\n\nkeys: q quit, s sort by the next column, p or space pause, arrows or j k choose a source,\n"
        "Enter shows it by itself with all that is known of it, Esc goes back. `!` stands before what is wrong,\n"
        "`-` before what rests or is ignored. The live view needs the package rich; without it, lines are printed.\n"
        "Where stdout is no terminal, it is one look. Exit code 1 where no centre answers; what is wrong with one\n"
        "is for scripts in the exit code of `status`."
    )
    parser.add_argument("--once", action="store_true", help="one look, as plain lines")
    parser.add_argument("--sort", choices=ORDERS, default="trouble", metavar="COLUMN", help=f"by: {', '.join(ORDERS)}")
    parser.add_argument("--centre", metavar="NAME", help="of this centre only (default: all of the realm)")
    parser.add_argument(
        "--ignore", action="append", default=[], metavar="NAME", help="a source whose faults do not count, as `status`"
    )
    bus_options(parser, "a certificate that may listen: a viewer's")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Look until `stop` is set or q is pressed. Raises `HealthError` where one look sees no centre; `UsageError`,
    `BusError`, `SecurityError`."""
    import sys
    import time

    from fusion_service.lookout.ear import Ear
    from fusion_service.lookout.view import view_of

    once = args.once or not sys.stdout.isatty()
    ear = Ear(args.realm)
    with joined(args, stop, None if once else True) as bus:
        ear.hear(bus, args.centre or "*")

        def look() -> View:
            ignored, centre = args.ignore, args.centre or ""
            return view_of(ear, time.time_ns(), centre=centre, ignored=ignored, hub=bus.connected)

        if once:
            _once(ear, bus, look, args.sort, stop)
            return
        asking = threading.Event()
        asker = threading.Thread(target=_ask, args=(ear, bus, asking))
        asker.start()
        try:
            _live(look, args.sort, stop)
        finally:
            asking.set()
            asker.join()


def _once(ear: Ear, bus: Bus, look: Callable[[], View], order: str, stop: threading.Event) -> None:
    import shutil

    from fusion_service.errors import HealthError
    from fusion_service.lookout.layout import Look, frame, plain

    stop.wait(FIRST)
    ear.ask(bus)
    view = look()
    for line in frame(view, Look(order), shutil.get_terminal_size((WIDTH, 0)).columns):
        print(plain(line))
    if not view.centres and not stop.is_set():
        raise HealthError(view.general[0])


def _ask(ear: Ear, bus: Bus, stop: threading.Event) -> None:
    while not stop.is_set():
        ear.ask(bus)
        ear.tend(bus)
        stop.wait(ASKED)


def _live(look: Callable[[], View], order: str, stop: threading.Event) -> None:
    """By rich, or in lines where that is not there, or the terminal can do no more."""
    import importlib.util
    import os
    import shutil
    import sys

    from fusion_service.extras import install_hint
    from fusion_service.lookout.layout import Look, frame, plain
    from fusion_service.lookout.screen import show

    simple = os.environ.get("TERM", "dumb") in ("", "dumb", "unknown")
    if importlib.util.find_spec("rich") is None:
        print(f"the live view needs the package rich: {install_hint('top')}", file=sys.stderr)
    elif not simple:
        show(look, Look(order), stop)
        return
    while not stop.wait(LINES):
        for line in frame(look(), Look(order), shutil.get_terminal_size().columns):
            print(plain(line))
        print(flush=True)
