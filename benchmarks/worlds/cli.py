"""`python -m benchmarks.worlds [--world NAME ...] [--runs N] [--seed S] [--json FILE] [--quick]`: hard worlds.

Every world is made from its seed, given to `FusionCentre` by `handle` and `step`, and measured; "floor" is what an
assignment that knows the truth makes of the same messages by the same rule. With the folder of recorded data (--data,
or FUSION_DATA) the tracks of a real traffic radar as well.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.worlds import traffic
from benchmarks.worlds.catalogue import KINDS
from benchmarks.worlds.report import HEAD, Record, run, table

__all__ = ["main"]

HEADING = """# Hard worlds

`python -m benchmarks.worlds --page docs/worlds.md` writes this page. Each row is a small world made from its seed
(`benchmarks/worlds/` says how each is made), given to the centre as messages, one step a second. Beside it the floor:
what an assignment that knows the truth makes of the same messages by the same rule.

- ids/target: distinct confirmed ids that followed a target, duplicates too, mean and worst. A target keeps its track
  while that is within c; the rest is assigned as GOSPA does.
- switches: how often a target's confirmed track was another than its last one, in the whole run.
- gospa: mean over the steps, p = 2, alpha = 2, cut off at c; its parts in m2.
- duplicates, ghosts: confirmed tracks near a target beyond one for each, and near none; mean over the steps.
- wrong pairs: global tracks whose contributors are tracks of different targets. In the rows "floor" of
  formations: those of an optimal assignment made anew at that step.
- leap: the largest error of a confirmed track from the target it followed (or one within c of that), in stated sigmas.

Last, the tracks of a real traffic radar (`radar-v2x`, MIT; with `--data DIR`), whose 64 numbers are used again and
again. A life is what one number was for as long as it was there and physically one object; joined wrongly: successive
lives of one confirmed global id that cannot be one object (`benchmarks/worlds/traffic.py` has the measure); broken:
lives with several confirmed global ids.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.worlds", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", action="append", choices=[*KINDS, traffic.NAME], help="only this one; repeatable")
    parser.add_argument("--runs", type=int, default=1, metavar="N", help="runs of each world (default 1)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="seed of the first run (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there")
    parser.add_argument("--against", type=Path, metavar="FILE", help="JSON of an earlier run, shown above each row")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table there as a page")
    parser.add_argument("--floors", action="store_true", help="a row for the assignment that knows the truth")
    parser.add_argument("--quick", action="store_true", help="small worlds, few variants")
    parser.add_argument("--data", type=Path, default=os.environ.get("FUSION_DATA"), metavar="DIR", help="recorded data")
    args = parser.parse_args(arguments)
    if args.runs < 1 or args.seed < 0:
        parser.error("--runs must be 1 or more, --seed 0 or more")
    earlier = json.loads(args.against.read_text()) if args.against else {}
    before = earlier.get("worlds", [])
    begin = time.perf_counter()
    lines, records = _say([HEAD]), []
    for name in args.world or KINDS:
        for variant in () if name == traffic.NAME else KINDS[name].quick if args.quick else KINDS[name].variants:
            records.append(run(name, variant, args.seed, args.runs, quick=args.quick))
            lines += _say(table(records[-1:], before, floors=args.floors or args.page is not None))
    recorded: Record | None = None
    if not args.world or traffic.NAME in args.world:
        recorded, told = _traffic(args.data, args.quick, earlier.get(traffic.NAME))
        lines += _say(["", *told])
    print(f"\n{len(records)} worlds in {time.perf_counter() - begin:.0f} s")
    if args.json:
        found = {"seed": args.seed, "runs": args.runs, "quick": args.quick, "worlds": records, traffic.NAME: recorded}
        args.json.write_text(json.dumps(found, indent=1) + "\n")
    if args.page:
        args.page.write_text(HEADING + "\n" + "\n".join(lines) + "\n")
    return 0


def _say(lines: Any) -> list[str]:
    said = list(lines)
    for line in said:
        print(line, flush=True)
    return said


def _traffic(data: Path | None, quick: bool, before: Record | None) -> tuple[Record | None, list[str]]:
    folder = traffic.find(data)
    if folder is None:
        where = "--data and FUSION_DATA name no folder" if data is None else f"no {traffic.NAME}/radar.csv in {data}"
        return None, [f"{traffic.NAME}: skipped: {where}."]
    found = traffic.measure(folder, seconds=60.0 if quick else None)
    return found, traffic.report(found, before)
