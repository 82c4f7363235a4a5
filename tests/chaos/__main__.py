"""Fuzz and chaos: what is thrown at the product by chance, part by part, and what got through.

    python -m tests.chaos [--minutes N] [--part NAME ...] [--seed S]

decode: mutated messages through `schemas.decode`; centre: through a real centre under drawn settings; orders: mutated
orders through the desk and a centre; kills: kill -9 and freezes of hub, service and recorder; disk: full disks; clock:
clocks that jump; connections: what each leaves in memory; floods: `python -m benchmarks.floods`. The minutes are
divided among the parts, and a part of processes may take longer to end. The exit code is 1 if anything got through.
`--part centre --seed S` begins with the world S, which is how one that got through is made again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import floods
from tests.chaos.centres import fuzz_centres
from tests.chaos.clocks import jump_clocks
from tests.chaos.connections import count_connections
from tests.chaos.decoding import fuzz_decoding
from tests.chaos.disks import fill_disks
from tests.chaos.kills import kill_and_freeze
from tests.chaos.ordering import fuzz_orders
from tests.chaos.report import Report

__all__ = ["PARTS", "main"]


def _floods(_seed: int, _until: float) -> Report:
    """They print their own table."""
    report = Report("floods")
    for name in floods.FLOODS:
        line = floods.flood(name, 8.0)
        report.say(line)
        report.tried += 1
        if "honest NO" in line or "code 0" not in line:
            report.escaped(name)
    return report


PARTS: dict[str, Callable[[int, float], Report]] = {
    "decode": fuzz_decoding,
    "centre": fuzz_centres,
    "orders": fuzz_orders,
    "kills": kill_and_freeze,
    "clock": jump_clocks,
    "disk": lambda _seed, _until: fill_disks(),
    "connections": lambda _seed, until: count_connections(2000, until),
    "floods": _floods,
}


def main(argv: list[str] | None = None) -> int:
    """0 if nothing got through."""
    parser = argparse.ArgumentParser(description="fuzz and chaos, and what got through")
    parser.add_argument("--minutes", type=float, default=5.0, help="for all parts together (default 5)")
    parser.add_argument("--part", action="append", choices=PARTS, help="only this one; may be said again")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6, help="of an earlier run: the same again")
    parser.add_argument("--keep", type=Path, help="folder for the bytes of messages that got through")
    args = parser.parse_args(argv)
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
        Report.folder = args.keep
    print(f"seed {args.seed}", flush=True)
    names = args.part or list(PARTS)
    end, escapes = time.monotonic() + 60 * args.minutes, 0
    for number, name in enumerate(names):
        left = max(0.0, end - time.monotonic())
        report = PARTS[name](args.seed, time.monotonic() + left / (len(names) - number))
        print(report, flush=True)
        escapes += report.escapes
    return 1 if escapes else 0


if __name__ == "__main__":
    raise SystemExit(main())
