"""`fusion-service repair`."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Make a torn or damaged recording whole, in place."
EXAMPLE = "fusion-service repair mission.rrd\n  fusion-service repair mission/         every part of a mission"


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recording", metavar="PATH", help="recording (.rrd), or a folder of parts")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Mend one recording, or all of a folder. Raises `ReviewError`."""
    from fusion_service.errors import ReviewError
    from fusion_service.recording.repair import mend_all

    failed = 0
    alone = not Path(args.recording).is_dir()
    for path, done in mend_all(Path(args.recording), stop.is_set):
        if alone and isinstance(done, ReviewError):
            raise done
        failed += isinstance(done, ReviewError)
        print(f"{done}" if isinstance(done, ReviewError) else f"{path}: {done}", flush=True)
    if failed:
        raise ReviewError(f"{failed} of what is there could not be made whole: see above")
