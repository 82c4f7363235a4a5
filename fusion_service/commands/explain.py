"""`fusion-service explain`: where a global track came from, in words."""

from __future__ import annotations

import argparse
import shlex
import threading
from pathlib import Path

from fusion_service.commands.sealed import add_authority
from fusion_service.process import argument, positive

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Where a global track came from and what became of it; who saw a target when, and why it was missed."
EXAMPLE = """fusion-service explain mission.rrd
  fusion-service explain mission.rrd --track 7
  fusion-service explain mission.rrd --track 2.7 --at 120 --out track.rrd
  fusion-service explain mission.rrd --target 18
  fusion-service explain mission.rrd --target tern --truth gps.csv --cutoff 50"""


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
    target = parser.add_argument_group("a true object", "who saw it when, which tracks followed it, and why none did")
    target.add_argument("--target", metavar="ID", help="its id, or its name in --truth")
    target.add_argument("--truth", metavar="FILE", help="truth in place of the mission's own, as of `evaluate`")
    target.add_argument(
        "--cutoff",
        type=argument(positive),
        metavar="M",
        help="largest error that still counts as followed, m (default: that which the recording keeps, else chosen)",
    )
    add_authority(parser)


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Tell what became of a track or a target, or list the tracks. Raises `UsageError`, `ReviewError`."""
    from fusion_service.commands.sealed import tell
    from fusion_service.errors import Stopped, UsageError
    from fusion_service.review.explain import explanation, listing, read_mission, write_view
    from fusion_service.review.outputs import check_recording

    if args.target is not None and (args.track is not None or args.at is not None or args.out is not None):
        raise UsageError("--target is about a true object: leave out --track, --at and --out")
    if args.target is None and (args.truth is not None or args.cutoff is not None):
        raise UsageError("--truth and --cutoff go with --target")
    if args.track is None and (args.at is not None or args.out is not None):
        raise UsageError("--at and --out are about one track: name it with --track")
    if args.out is not None:
        check_recording(args.out, args.recording)
    try:
        tell(args.recording, args.ca, stop)
        if args.target is not None:
            print(_target(args, stop))
            return
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
        print(f"\n{count} messages of this track alone: {args.out}   (look at it: rerun {shlex.quote(args.out)})")


def _target(args: argparse.Namespace, stop: threading.Event) -> str:
    """The story of a true object. Raises `ReviewError`, `Stopped`."""
    from fusion_service.commands.scored_mission import need_rerun, scored_mission
    from fusion_service.recording.scoring import Scoring, scoring_of
    from fusion_service.recording.survey import survey
    from fusion_service.review.evaluation.truth import NO_TRUTH, read_truth
    from fusion_service.review.explain.target_story import target_story

    need_rerun()
    path = Path(args.recording)
    truth = read_truth(Path(args.truth)) if args.truth else NO_TRUTH
    centre = survey(path, stop).shown(args.centre).name
    kept = scoring_of(path)
    how = Scoring(args.cutoff or kept.cutoff, kept.every)
    told = target_story(scored_mission(path, truth, how, stop, centres=[centre]), centre, args.target)
    return f"{told}\n\n{truth.note}" if truth.note else told
