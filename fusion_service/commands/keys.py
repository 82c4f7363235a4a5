"""`fusion-service keys`: an authority, and certificates by it."""

from __future__ import annotations

import argparse
import threading

from fusion_service.bus.roles import ROLES
from fusion_service.process import argument, positive

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Make certificates for all who are on the bus, list them, add and remove parties."
EXAMPLE = """fusion-service keys keys --source radar-1 --source radar-2 --centre centre --recorder rec --operator alice
  fusion-service keys keys --source radar-3            one more, later: then start the hub again
  fusion-service keys keys                             who there is, and until when
  fusion-service keys keys --renew source:radar-1      a new key and certificate
  fusion-service keys keys --remove source:radar-2     the hub lets it in no more
  fusion-service keys keys --at hub.example.org        the hub is reached by this name too
  fusion-service keys keys --zenohd                    the same rules for a real zenohd
then
  fusion-service hub --security keys/hub
  fusion-service run --security keys/centre-centre
  sensor-client simulate three-radars --sensor radar1 --security keys/source-radar1"""
MOST_DAYS = 3650
MEANINGS = {
    "source": "publishes tracks under its own name, reads nothing",
    "centre": "fuses; the name is [centre] name",
    "recorder": "reads all, says nothing",
    "operator": "reads the picture and where sensors stand, gives orders under its own name",
    "viewer": "reads the picture, and where sensors stand",
    "gateway": "a source that also reads the picture",
    "scenario": "publishes the truth of a simulation",
}


def _name(text: str) -> str:
    from schemas import check_name

    return check_name(text)


def _days(text: str) -> float:
    if (days := positive(text)) > MOST_DAYS:
        raise ValueError(f"{text!r} is more than {MOST_DAYS} days, for which the authority itself holds")
    return days


def _realm(text: str) -> str:
    from schemas import check_realm

    return check_realm(text)


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("folder", metavar="DIR", help="where the authority and the folders of the parties are")
    for role in ROLES:
        parser.add_argument(
            f"--{role}",
            action="append",
            default=[],
            type=argument(_name),
            metavar="NAME",
            help=f"a new party: {MEANINGS[role]}",
        )
    parser.add_argument(
        "--at",
        action="append",
        default=[],
        metavar="HOST",
        help="a name or address that the hub is reached by, beside localhost and this computer's name",
    )
    parser.add_argument("--renew", action="append", default=[], metavar="PARTY", help="role:name, or hub")
    parser.add_argument("--remove", action="append", default=[], metavar="PARTY", help="role:name")
    parser.add_argument("--days", type=argument(_days), default=365.0, help="how long certificates hold (default 365)")
    parser.add_argument(
        "--realm", type=argument(_realm), help="first part of every key (default: as before, or fusion)"
    )
    parser.add_argument("--zenohd", action="store_true", help="print the hub's rules as the config of a zenohd")
    parser.add_argument(
        "--listen", action="append", metavar="ENDPOINT", help="with --zenohd: where it listens (default tls/[::]:7447)"
    )


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Make, change or list. Raises `SecurityError`, ImportError, OSError."""
    import json
    from pathlib import Path

    from fusion_service.bus.security import read_security, zenohd_settings

    folder = Path(args.folder)
    if args.zenohd:
        settings = zenohd_settings(read_security(folder / "hub"), args.listen or ["tls/[::]:7447"])
        print(json.dumps(settings, indent=2))
        return
    from fusion_service.bus.keyring import Keyring

    ring = Keyring(folder, args.days, args.realm)
    asked = [(role, name) for role in ROLES for name in getattr(args, role)]
    for line in ring.change(asked, hosts=args.at, renew=args.renew, remove=args.remove):
        print(line)
    print("\n".join(ring.listed()))
