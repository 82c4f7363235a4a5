"""`fusion-service export`."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

from fusion_service.commands.sealed import add_authority

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Tracks of a recording as a table, CSV or Parquet, or as a map, GeoJSON or KML."
EXAMPLE = (
    "fusion-service export mission.rrd --out tracks.csv\n"
    "  fusion-service export mission.rrd --what radar1 --out radar1.parquet\n"
    "  fusion-service export mission.rrd --what truth --out truth.csv\n"
    "  fusion-service export mission.rrd --out tracks.geojson\n"
    "  fusion-service export mission.rrd --out tracks.kml     with times: Google Earth plays it\n"
    "  sensor-client playback tracks.csv --sensor centre      publishes them again, as a source"
)


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recording", metavar="FILE", help="recording (.rrd)")
    parser.add_argument("--out", required=True, metavar="FILE", help="new file, .csv, .parquet, .geojson or .kml")
    parser.add_argument("--what", default="global", metavar="WHAT", help="global (default), truth, or a source's name")
    parser.add_argument("--centre", metavar="NAME", help="whose global tracks (default: the first centre's)")
    add_authority(parser)


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Write the table. Raises `ReviewError`, FileExistsError, OSError."""
    from fusion_service.commands.sealed import tell
    from fusion_service.review.export import export

    tell(args.recording, args.ca, stop)
    done = export(Path(args.recording), Path(args.out), args.what, args.centre, stop.is_set)
    print(f"{args.out}: {done.rows} rows, {done.times} times" + (", stopped early" if stop.is_set() else ""))
    for reason, count in sorted(done.left_out.items()):
        print(f"left out: {count} messages, {reason}")
