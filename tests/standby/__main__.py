"""`python -m tests.standby --times 100`: how long a take-over takes, and what is kept, with real processes.

One mission of a centre of two processes, a hub and three sensors of 24 targets at rest; over and over the active one is
killed (and started again, so that it stands by), frozen and thawed, or told to hand over. Printed: seconds from that to
the first picture of the other process, seconds between the last picture before and the first after, and every id that
changed, was given twice, came back, or had a picture of the old run after one of the new.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from fusion_service.cli import main as command
from fusion_service.compiled.road import VARIABLE
from tests.helpers.pair import Pair
from tests.helpers.processes import Hub, eventually

SENSORS = {"r1": range(16), "r2": range(8, 24), "r3": range(4, 20)}
TARGETS = range(24)


class Mission:
    """A centre of two, and what came of doing something to the active one. rows: (seconds, gap, ids changed)."""

    def __init__(self, hub: Hub, folder: Path, stack: ExitStack, frozen: float) -> None:
        self._endpoint, self._frozen = hub.endpoint, frozen
        self.pair = Pair((hub.endpoint, hub.endpoint), folder, stack)
        for name, targets in SENSORS.items():
            self.pair.sensor(name, *targets)
        self.pair.started(*TARGETS)

    def once(self, what: str) -> tuple[float, float, int]:
        watch = self.pair.watch
        eventually(watch.ready, 60)
        eventually(lambda: watch.sees(*TARGETS), 20)
        time.sleep(random.uniform(0.0, 0.5))
        which = self.pair.active()
        program = self.pair.programs[which]
        assert program is not None
        before, number = watch.pictures[-1].targets, len(watch.pictures) - 1
        begin = time.monotonic()
        if what == "kill":
            program.kill()
        elif what == "freeze":
            program.freeze()
        else:
            assert command(["order", "handover", "--connect", self._endpoint]) == 0
        first = self.pair.taken_over(number, 30.0)
        last = [one for one in watch.pictures[number:] if one.picture.epoch != first.picture.epoch][-1]
        time.sleep(1.0)
        changed = sum(watch.pictures[-1].targets.get(target) != track for target, track in before.items())
        if what == "kill":
            program.__exit__()
            self.pair.centre(which)
        elif what == "freeze":
            time.sleep(max(0.0, self._frozen - (time.monotonic() - begin)))
            program.signal(signal.SIGCONT)
        eventually(lambda: self.pair.active() != which)
        return first.at - begin, first.at - last.at, changed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10, help="of each (default 10)")
    parser.add_argument("--what", nargs="+", default=["kill", "freeze", "handover"])
    parser.add_argument(
        "--frozen", type=float, default=3.0, metavar="S", help="how long a frozen one stays so (default 3)"
    )
    args = parser.parse_args()
    os.environ[VARIABLE] = "off"  # a process that is killed while it compiles leaves the next one to wait for that
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        hub = Hub().start()
        stack.callback(hub.kill)
        mission = Mission(hub, Path(folder), stack, args.frozen)
        for what in args.what:
            try:
                rows = [mission.once(what) for _ in range(args.times)]
            except AssertionError:
                print(*(one.told() for one in mission.pair.programs if one is not None), sep="\n--\n")
                raise
            took, gaps, changed = zip(*rows, strict=True)
            print(
                f"{what:9} {len(rows):4} times: picture of the other after {statistics.median(took):.2f} s (median), "
                f"{max(took):.2f} s (worst); gap in pictures {statistics.median(gaps):.2f} s, {max(gaps):.2f} s; "
                f"ids changed: {sum(changed)} of {len(rows) * len(TARGETS)}",
                flush=True,
            )
        faults = mission.pair.watch.faults()
        print(f"{len(mission.pair.watch.pictures)} pictures; faults: {len(faults)}", *faults[:20], sep="\n  ")
        print(f"load average {load:.1f} to {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
