"""`fusion-service explain`: where a global track came from, in words."""

from __future__ import annotations

import argparse
import threading

from fusion_service.commands.sealed import add_authority

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Where a global track came from, what each source brought, and what became of it."
EXAMPLE = """fusion-service explain mission.rrd
  fusion-service explain mission.rrd --track 7
  fusion-service explain mission.rrd --track 2.7 --at 120 --out track.rrd"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recording", metavar="FILE", help="recording of a mission")
    parser.add_argument(
        "--track",
        metavar="ID",
        help="number that the recording shows (7, 2.7), or the whole id; without it the tracks are listed",
    )
    parser.add_argument(
        "--at",
        metavar="T",
        help="contributions at this time: seconds from the centre's first step, or "
        "a time as in 2026-01-31T12:00:00Z (default: the last that there are)",
    )
    parser.add_argument("--centre", metavar="NAME", help="whose track, where there are several centres")
    parser.add_argument("--all", action="store_true", help="list also the tracks that were never confirmed")
    parser.add_argument(
        "--out", metavar="FILE", help="write a recording of this track alone, with its local tracks and truth"
    )
    add_authority(parser)


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Tell what became of a track, or list them. Raises `UsageError`, `ReviewError`."""
    from fusion_service.commands.sealed import tell
    from fusion_service.errors import Stopped, UsageError
    from fusion_service.review.explain import explanation, listing, read_mission, write_view
    from fusion_service.review.outputs import check_recording

    if args.track is None and (args.at is not None or args.out is not None):
        raise UsageError("--at and --out are about one track: name it with --track")
    if args.out is not None:
        check_recording(args.out, args.recording)
    try:
        tell(args.recording, args.ca, stop)
        mission = read_mission(args.recording, track=args.track, at=args.at, centre=args.centre, stop=stop)
    except Stopped as stopped:
        print(stopped)
        return
    if args.track is None:
        print(listing(mission, everything=args.all))
        return
    print(explanation(mission))
    if args.out is not None:
        count = write_view(mission, args.out, stop)
        print(f"\n{count} messages of this track alone: {args.out}   (look at it: rerun {args.out})")
