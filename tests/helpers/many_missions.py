"""Fly and check the missions of many seeds, which takes minutes: `python -m tests.helpers.many_missions 0 200`."""

from __future__ import annotations

import argparse
import sys
import traceback
import warnings

from tests.centre.test_random_missions import check_mission
from tests.helpers import random_missions, source_missions, tracker_missions

KINDS = {
    "sources": source_missions.fly.__wrapped__,
    "random": random_missions.fly.__wrapped__,
    "trackers": tracker_missions.fly.__wrapped__,
}


def main() -> int:
    """How many of them failed, 1 at most."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("end", type=int)
    parser.add_argument("--kind", choices=KINDS, default="sources")
    parser.add_argument("--steps", type=int, default=30)
    said = parser.parse_args()
    warnings.simplefilter("error")
    failed = []
    for seed in range(said.first, said.end):
        try:
            check_mission(KINDS[said.kind](seed, said.steps), seed)
        except Exception:  # whatever it is, the next seed is flown
            failed.append(seed)
            print("seed", seed, flush=True)
            traceback.print_exc(limit=-3)
    print(f"{said.end - said.first} missions, failed: {failed or 'none'}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
