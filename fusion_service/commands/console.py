"""`fusion-service console`: an operator's console in a browser."""

from __future__ import annotations

import argparse
import logging
import threading

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT
from fusion_service.bus.options import bus_options
from fusion_service.hangup import on_hangup
from fusion_service.process import argument

__all__ = ["EXAMPLE", "HELP", "add", "run"]

log = logging.getLogger(__name__)

HELP = "An operator's console in a browser: map, tracks, sources, alarms, log, and orders where they are allowed."
EXAMPLE = """fusion-service console
  fusion-service console --allow-orders
  fusion-service console --security keys/watch-officer --allow-orders
  fusion-service console --listen 0.0.0.0:8787 --name console.example.org --certificate web.pem --key web.key
  fusion-service console --tiles "https://tiles.example.org/{z}/{x}/{y}.png" --attribution "Example Maps\""""
LISTEN = "127.0.0.1:8787"


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument(
        "--listen",
        type=argument(_listen),
        default=_listen(LISTEN),
        metavar="HOST:PORT",
        help=f"where the page is served (default {LISTEN}: this computer alone); elsewhere it takes the token of the "
        "address that is printed",
    )
    parser.add_argument(
        "--allow-orders", action="store_true", help="the page may give orders, confirmed in a dialog with who and why"
    )
    parser.add_argument("--centre", metavar="NAME", help="this centre only (default: all of the realm, one at a time)")
    parser.add_argument(
        "--tiles",
        default="",
        metavar="URL",
        help="a map below the tracks, as https://HOST/{z}/{x}/{y}.png (default: none)",
    )
    parser.add_argument("--attribution", default="", metavar="TEXT", help="to whom the map is owed, shown on it")
    parser.add_argument(
        "--name",
        action="append",
        default=[],
        metavar="HOST",
        help="a name by which browsers may call the console, beside localhost and bare addresses",
    )
    parser.add_argument("--certificate", metavar="FILE", help="serve by https with this certificate (PEM)")
    parser.add_argument("--key", metavar="FILE", help="and this key")
    parser.add_argument(
        "--token-file", metavar="FILE", help="file that holds the token (default: a new one every time)"
    )
    bus_options(parser, "a viewer's certificate, or an operator's, whose name is who orders")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Serve until stopped. Raises `UsageError`, `BusError`, `SecurityError`."""
    from pathlib import Path

    from fusion_service.bus.security import check_party, maybe_security
    from fusion_service.console import ConsoleOptions, run_console
    from fusion_service.errors import UsageError
    from fusion_service.service.notify import notify
    from schemas import global_key

    security = maybe_security(args.security)
    if security is not None:
        check_party(security, ("operator",) if args.allow_orders else ("operator", "viewer", "recorder"))
    if (args.certificate is None) != (args.key is None):
        raise UsageError("--certificate and --key go together")
    files = [None if path is None else Path(path) for path in (args.certificate, args.key, args.token_file)]
    for path in files:
        if path is not None and not path.is_file():
            raise UsageError(f"{path}: there is no such file")
    try:
        global_key(args.centre or "*", "tracks", args.realm)
    except ValueError as error:
        raise UsageError(str(error)) from None
    options = ConsoleOptions(
        connect=args.connect or [DEFAULT_ENDPOINT],
        listen=args.listen,
        realm=args.realm,
        centre=args.centre,
        security=security,
        orders=args.allow_orders,
        names=[name.lower() for name in args.name],
        tiles=args.tiles,
        attribution=args.attribution[:200],
        certificate=files[0],
        key=files[1],
        token=files[2],
    )
    told = "options, certificates and token are read at the start: a change needs a restart"
    with on_hangup(lambda: log.warning(told)):
        run_console(options, stop, lambda: notify("READY=1"))
    notify("STOPPING=1")


def _listen(text: str) -> tuple[str, int]:
    """Host and port; port 0 is one that is free. Raises ValueError in one line."""
    host, colon, port = text.rpartition(":")
    host = host.strip("[]")
    if not (colon and host and port.isascii() and port.isdigit() and int(port) < 65536):
        raise ValueError(f"{text!r} is not HOST:PORT, as in {LISTEN}")
    return host, int(port)
