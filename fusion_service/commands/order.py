"""`fusion-service order`: what an operator orders a running centre to do."""

from __future__ import annotations

import argparse
import threading
from typing import Any

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Give an order to a running centre, list those that stand, or withdraw one."
EXAMPLE = """fusion-service order list
  fusion-service order delete --track 7 --why "sea clutter" --until 10min
  fusion-service order link --local radar-1 17 --to 7         a local track belongs to a global one
  fusion-service order never-link --local radar-1 17 --with radar-2 4
  fusion-service order merge --track 9 --to 7                 9 goes on as 7
  fusion-service order rename --track 7 --name "PILOT 2" --number 12
  fusion-service order identify --track 7 --identity mmsi:257054000
  fusion-service order quarantine --source radar-3
  fusion-service order supervise --source radar-3 --state trusted
  fusion-service order withdraw 4
  fusion-service order handover                               the one that stands by goes on, for an upgrade"""
HANDOVER = "handover"
ANSWER = 10.0
"""Seconds that a centre has for its answer, which comes when a step has obeyed, and the hub to be there."""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    from fusion_service.bus.options import bus_options
    from fusion_service.commands.arguments import moment
    from fusion_service.order import WHAT
    from fusion_service.process import argument

    words = "\n".join(f"  {word:<12}{meaning}" for word, meaning in WHAT.items())
    parser.description = (
        f"{HELP}\n\norders:\n  {'list':<12}the orders that stand\n{words}"
        f"\n  {HANDOVER:<12}the active process of the centre lets the one that stands by go on"
    )
    parser.add_argument("what", choices=("list", *WHAT, HANDOVER), metavar="ORDER", help="one of the above")
    parser.add_argument("withdrawn", nargs="?", type=int, metavar="N", help="withdraw: the number of the order")
    track = "whole id, number that a recording shows, or given number or callsign"
    parser.add_argument("--track", metavar="ID", help=f"the global track: {track}")
    parser.add_argument("--to", metavar="ID", help="link, merge: the global track that goes on")
    parser.add_argument("--local", nargs=2, metavar=("SOURCE", "ID"), help="the local track")
    parser.add_argument(
        "--with", nargs=2, metavar=("SOURCE", "ID"), dest="against", help="never-link: another local track"
    )
    parser.add_argument(
        "--source", metavar="NAME", help="mute, unmute, quarantine, release, drop, supervise: the source"
    )
    parser.add_argument("--state", metavar="STATE", help="supervise: trusted, watch, inflated, union, out, or auto")
    parser.add_argument("--name", metavar="TEXT", help="rename: the callsign")
    parser.add_argument("--number", type=int, metavar="N", help="rename: the number to be shown")
    parser.add_argument("--identity", metavar="TEXT", help="identify: as in mmsi:257054000, icao:4ca7b4")
    parser.add_argument(
        "--until",
        type=argument(moment),
        metavar="TIME",
        help="how long it stands: 10min, or 2026-01-31T12:00:00Z (default: always)",
    )
    parser.add_argument("--why", metavar="TEXT", help="the reason, for the log")
    parser.add_argument("--who", metavar="NAME", help="who orders (default: the user of this computer)")
    parser.add_argument("--centre", default="centre", metavar="NAME", help="name of the centre (default centre)")
    bus_options(parser, "the operator's certificate, whose name is who orders")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Give the order, or list those that stand. Raises `UsageError`, `OrderError`, `BusError`,
    `SecurityError`."""
    import msgpack

    from fusion_service.bus import DEFAULT_ENDPOINT, open_bus
    from fusion_service.bus.security import check_party, maybe_security
    from fusion_service.errors import OrderError, UsageError
    from fusion_service.hints.elsewhere import no_centre
    from schemas import global_key, order_key

    security = maybe_security(args.security)
    if security is not None:
        check_party(security, ("operator",), args.who or "")
        args.who = security.name
    try:
        key = global_key(args.centre, "orders", args.realm)
        if security is not None:
            key = order_key(args.centre, security.name, args.realm)
    except ValueError as error:
        raise UsageError(str(error)) from None
    request = _request(args)
    missing = _missing(request)
    if missing:
        raise UsageError(f"{args.what}: it needs {missing}")
    with open_bus(args.connect or [DEFAULT_ENDPOINT], wait=ANSWER, stop=stop, security=security) as bus:
        answers = bus.ask(key, msgpack.packb(request), ANSWER)
        there = [] if answers else bus.present(global_key("*", "alive", args.realm))[0]
    if not answers:
        raise OrderError(no_centre(args.centre, [one.split("/")[-2] for one in there]))
    try:
        _tell(args.what, msgpack.unpackb(answers[0][1]))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, OSError):
        raise OrderError(f"the answer in the name of centre {args.centre} cannot be read: who is it?") from None


def _tell(what: str, answer: dict[str, Any]) -> None:
    """Print what a centre has answered. Raises `OrderError` for what it refuses, and others for what is no answer."""
    from fusion_service.errors import OrderError

    if what == "list":
        print(_table(answer["orders"]))
    elif what == HANDOVER and answer["done"]:
        print(answer["outcome"])
    elif what == HANDOVER:
        raise OrderError(f"no handover: {answer['outcome']}")
    elif answer["done"]:
        more = ", when a step is made: none is at the moment" if answer.get("pending") else ""
        more += "" if answer.get("kept", True) else " (not on disk: the service keeps no state, or cannot write it)"
        more += "" if answer.get("followed", True) else " (not heard yet by the process that stands by)"
        print(f"order {answer['number']}: {answer['outcome']}{more}")
    else:
        raise OrderError(f"order {answer['number']} is refused: {answer['outcome']}")


def _request(args: argparse.Namespace) -> dict[str, Any]:
    """The order as the map that is sent."""
    import getpass

    if args.what == "list":
        return {"what": "list"}
    track, other = args.track, None
    if args.to is not None:
        track, other = (args.to, args.track) if args.what == "merge" else (args.to, None)
    try:
        who = args.who or getpass.getuser()
    except (OSError, KeyError):  # a user without a name
        who = ""
    asked = {
        "what": args.what,
        "track": track,
        "other": other,
        "local": args.local and [args.local[0], -1, args.local[1]],
        "against": args.against and [args.against[0], -1, args.against[1]],
        "source": args.source,
        "name": args.name,
        "shown": args.number,
        "identity": args.identity,
        "state": args.state,
        "number": args.withdrawn,
        "who": who,
        "why": args.why,
        **({args.until[0]: args.until[1]} if args.until else {}),
    }
    return {name: value for name, value in asked.items() if value is not None}


def _missing(request: dict[str, Any]) -> str:
    """What an order needs and was not given, in the words of the command line; empty if nothing."""
    from fusion_service.order import NEEDED

    options = {
        "track": "--track",
        "other": "--track and --to",
        "local": "--local SOURCE ID",
        "source": "--source",
        "identity": "--identity",
        "state": "--state",
        "number": "the order's number",
    }
    needed = NEEDED.get(request["what"], ())
    return " and ".join(options[name] for name in needed if name not in request)


def _giver(one: dict[str, Any]) -> str:
    from fusion_service.order import giver_of

    return giver_of(one["who"], one.get("proven", False)) if one.get("who") else ""


def _table(orders: list[dict[str, Any]]) -> str:
    """The standing orders, one a line."""
    from datetime import UTC, datetime

    lines = []
    for one in orders:
        about = [f"track {one['track']}" if one.get("track") else "", one.get("source", "")]
        about += [f"{name} {track}" for name, _, track in [one[k] for k in ("local", "against") if k in one]]
        about += [str(one[k]) for k in ("name", "shown", "identity", "state") if k in one]
        about += ["holds " + ", ".join(f"{name} {track}" for name, _, track in one.get("holds", []))] * ("holds" in one)
        until = (
            datetime.fromtimestamp(one["until"] / 1e9, UTC).strftime("until %Y-%m-%dT%H:%M:%SZ")
            if "until" in one
            else ""
        )
        said = [", ".join(part for part in about if part), until, _giver(one), one.get("why", "")]
        lines.append(f"{one['number']:>4}  {one['what']:<11}" + "  ".join(part for part in said if part))
    return "\n".join(lines) or "no order stands"
