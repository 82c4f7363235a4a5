"""`fusion-service verify`: whether a recording is as its recorder left it."""

from __future__ import annotations

import argparse
import threading

from fusion_service.commands.sealed import add_authority

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Compare a recording with its seals: nothing changed, nothing missing, signed by whom."
EXAMPLE = """fusion-service verify mission.rrd
  fusion-service verify mission.rrd --ca keys/authority/ca.pem      signed by a recorder of this authority
  fusion-service verify mission/ --ended                            all parts, the end too"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recording", metavar="PATH", help="recording (.rrd), or a folder of parts")
    add_authority(parser)
    parser.add_argument(
        "--ended", action="store_true", help="exit code 1 too for one that its recorder did not end, or has no seals"
    )


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Tell what is found. Raises `UsageError`, `ReviewError`: where it is broken too, ImportError."""
    from fusion_service.commands.sealed import find
    from fusion_service.errors import ReviewError

    found = find(args.recording, args.ca, stop)
    for fault in found.faults[1:]:
        print(fault)
    if found.bad or (args.ended and found.state != "whole"):
        raise ReviewError(f"{args.recording}: {found}")
    print(f"{args.recording}: {found}")
