"""`fusion-service listen`: the messages on the bus, decoded, one a line, with what is wrong with each."""

from __future__ import annotations

import argparse
import threading
from typing import Any

from fusion_service.bus.options import bus_options, joined
from fusion_service.process import argument, positive, reader_left, whole

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Print the messages on the bus, of any realm, with what is wrong with each."
EXAMPLE = """fusion-service listen
  fusion-service listen --source radar-1 --type local_tracks --tracks 3
  fusion-service listen "fusion/v1/local/*/info" --raw
  fusion-service listen --count 1 --for 5 || echo "nobody publishes\""""
WAITING = 4096
"""Messages that wait to be printed; more are left out."""
TYPES = ("local_tracks", "local_intensity", "sensor_info", "global_tracks", "step_log", "status", "truth")


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("key", nargs="?", metavar="KEY", help="a key expression (default: all that may be heard)")
    parser.add_argument("--raw", action="store_true", help="what is on the wire: the map as JSON, columns in hex")
    parser.add_argument("--source", action="append", metavar="NAME", help="of this source, centre or scenario only")
    parser.add_argument("--type", action="append", choices=TYPES, metavar="TYPE", help=f"only: {', '.join(TYPES)}")
    parser.add_argument("--wrong", action="store_true", help="only those with which something is wrong")
    parser.add_argument(
        "--tracks", type=argument(whole), default=0, metavar="N", help="with the first N tracks of each"
    )
    parser.add_argument("--count", type=argument(whole), default=0, metavar="N", help="end after N messages")
    parser.add_argument("--for", dest="seconds", type=argument(positive), metavar="S", help="end after S seconds")
    bus_options(parser, "a certificate that may listen", "with which keys are compared (default fusion)")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Print until `stop` is set, or enough came. Raises `HealthError` where nothing did, `BusError`,
    `SecurityError`."""
    import time

    from fusion_service.bus import Inbox
    from fusion_service.errors import HealthError
    from fusion_service.hints.inspecting import inspect
    from fusion_service.hints.showing import raw_line, shown

    inbox: Inbox[tuple[str, bytes, int]] = Inbox(WAITING)
    printed, dropped = 0, 0
    with joined(args, stop) as bus:
        keys = [args.key] if args.key else bus.readable
        if not keys:
            raise HealthError("this certificate may hear nothing: give that of a recorder, a centre or a viewer")
        for one in keys:
            bus.subscribe(one, lambda key, data: inbox.put(key, (key, data, time.time_ns()), len(data)))
        begin = time.monotonic()
        while (
            not reader_left()
            and not stop.is_set()
            and (args.seconds is None or time.monotonic() - begin < args.seconds)
        ):
            for _, (key, data, received) in inbox.take(0.1):
                if stop.is_set() or reader_left() or (args.count and printed >= args.count):
                    break
                found = inspect(data, received, key, args.realm)
                if not _wanted(args, key, data, found):
                    continue
                lines = [raw_line(key, data)] if args.raw else shown(key, data, found, received, args.tracks)
                print("\n".join(lines), flush=True)
                printed += 1
            if args.count and printed >= args.count:
                break
            if (lost := sum(inbox.dropped.values())) > dropped:
                print(f"({lost - dropped} messages left out: more comes than can be printed)", flush=True)
                dropped = lost
    if not printed and not stop.is_set():
        raise HealthError(f"nothing was heard on {', '.join(keys)}: does anybody publish, at this hub?")


def _wanted(args: argparse.Namespace, key: str, data: bytes, found: Any) -> bool:
    """Whether a message is one of those that are asked for; of one that cannot be read by its key and what it says."""
    from fusion_service.hints.payload import raw_map

    if args.wrong and not found.findings:
        return False
    if not args.source and not args.type:
        return True
    raw = {} if found.message is not None else raw_map(data)
    name = found.message.source if found.message is not None else raw.get("source")
    kind = found.message.type if found.message is not None else raw.get("type")
    if args.type and kind not in args.type:
        return False
    return not args.source or name in args.source or any(one in key.split("/") for one in args.source)
