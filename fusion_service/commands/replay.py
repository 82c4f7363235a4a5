"""`fusion-service replay`: fuse a recorded mission again."""

from __future__ import annotations

import argparse
import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_service.commands.sealed import add_authority

if TYPE_CHECKING:
    from fusion_service.review.replay import Replay

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Fuse a recorded mission again: as it was, or under other rules and settings, side by side."
EXAMPLE = """fusion-service replay mission.rrd --verify
  fusion-service replay mission.rrd --rule ci --rule hmd-ga:criterion=trace --rule naive --out rules.rrd
  fusion-service replay mission.rrd --set memory=tracklet --out tracklets.rrd
  fusion-service replay mission.rrd --set gate=0.99 --set rule_options.criterion=trace --out gate.rrd
  fusion-service replay tracks-only.rrd --config centre.toml --out fused.rrd"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recording", metavar="FILE", help="recording of a mission")
    parser.add_argument(
        "--rule",
        action="append",
        default=[],
        metavar="RULE[:OPTION=VALUE,...]",
        help="fuse by this rule, or FILE.py:FUNCTION, as a centre named after it; may be given several times (default: "
        "the mission's)",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the centre, above the mission's"
    )
    parser.add_argument("--config", metavar="FILE", help="settings to begin with, instead of the mission's own")
    parser.add_argument("--out", metavar="FILE", help="recording to write: the mission's messages, and what is made")
    parser.add_argument(
        "--verify",
        action="store_true",
        help="compare with the recorded tracks, bit for bit; exit code 1 if they differ",
    )
    parser.add_argument("--centre", metavar="NAME", help="whose step logs are followed, where there are several")
    parser.add_argument("--clock", action="store_true", help="step by the messages' own time, not by the step logs")
    parser.add_argument(
        "--without-recorded", action="store_true", help="leave out of --out what the mission's centres published"
    )
    parser.add_argument(
        "--no-drawing", action="store_true", help="write the messages alone (faster): nothing to look at"
    )
    parser.add_argument("--json", metavar="FILE", help="write what came of it here")
    add_authority(parser)


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Fuse it again. Raises `UsageError`, `ConfigError`, `ReviewError`: of --verify too, where the tracks differ."""
    from fusion_service.commands.sealed import tell
    from fusion_service.compiled import is_kept, use
    from fusion_service.errors import ReviewError, Stopped, UsageError
    from fusion_service.review.outputs import check_page, check_recording
    from fusion_service.review.replay import run_replay

    if args.out is None and not args.verify:
        raise UsageError("nothing to do: name a recording to write with --out, or compare with --verify")
    if args.json is not None:
        check_page(args.json, args.recording, *filter(None, [args.config]))
    if args.out is not None:
        check_recording(args.out, args.recording)
    try:
        tell(args.recording, args.ca, stop)
    except Stopped as stopped:
        if args.verify:
            raise ReviewError(f"{stopped}: the recording is not verified") from None
        raise
    if is_kept():  # the same bits, sooner
        use("auto")
    replay = run_replay(
        args.recording,
        rules=args.rule,
        settings=args.set,
        config=args.config,
        out=args.out,
        verify=args.verify,
        centre=args.centre,
        clock=args.clock,
        keep_recorded=not args.without_recorded,
        draw=not args.no_drawing,
        stop=stop,
    )
    if args.json is not None:
        Path(args.json).write_text(json.dumps(replay.as_json(), indent=1) + "\n", encoding="utf-8")
    if args.verify and replay.stopped:
        raise ReviewError(_unfinished(replay))
    if replay.verdict is None:
        return
    if replay.verdict.compared == 0 and replay.verdict.first is None:
        raise ReviewError("no step could be compared")
    if not replay.passed:
        raise ReviewError(replay.verdict.told)
    print(replay.verdict.told)


def _unfinished(replay: Replay) -> str:
    """What is to be said of a verification that was stopped."""
    verdict = replay.verdict
    steps = verdict.compared if verdict is not None else 0
    differs = f" (it {verdict.told})" if verdict is not None and verdict.first is not None else ""
    return f"stopped after {steps} steps were compared{differs}; the rest was not, so the recording is not verified"
