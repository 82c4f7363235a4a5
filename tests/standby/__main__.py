"""`python -m tests.standby --times 100`: how long a take-over takes, and what is kept, with real processes.

One mission of a centre of two processes, a hub and three sensors of 24 targets at rest; over and over the active one is
killed (and started again, so that it stands by), frozen and thawed, or told to hand over. Printed: seconds from that to
the first picture of the other process, seconds between the last picture before and the first after, and every id that
changed, was given twice, came back, or had a picture of the old run after one of the new.

`--what order` kills the active one at once after it has answered an order, `--what pending` (by the clock of messages,
with sensors that are frozen meanwhile) after one that waits for a step: does it stand at the other one? What is not
there is a fault.

`--what partition` has two hubs, one process of the centre at each, and a third hub between them that is killed, and
started again some seconds later: seconds from that to the first picture of the other process at its hub, and from the
start of the hub until both sides have the pictures of one process, and until the other stands by again.
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

import msgpack

import schemas
from fusion_service.cli import main as command
from fusion_service.compiled.road import VARIABLE
from tests.helpers.link import Between
from tests.helpers.pair import Pair, Watch
from tests.helpers.processes import Hub, Program, eventually
from tests.service.test_intensity_service import SENSOR as INTENSITY

TARGETS = range(24)


def sensors(count: int) -> dict[str, range]:
    """What each of three sees of so many targets: most by two or all."""
    return {
        "r1": range(count * 2 // 3),
        "r2": range(count // 3, count),
        "r3": range(count // 6, count * 5 // 6),
    }


class Mission:
    """A centre of two, and what came of doing something to the active one. rows: (seconds, gap, ids changed). lost:
    orders that were answered and did not stand; answered: seconds until they were."""

    def __init__(self, hub: Hub, folder: Path, stack: ExitStack, args: argparse.Namespace) -> None:
        self._endpoint, self._frozen = hub.endpoint, args.frozen
        centre = args.settings.replace("; ", "\n") + "\n"
        centre += 'kind = "intensity"\n' if args.intensity else ""
        centre += 'clock = "message"\n' if args.what == ["pending"] else ""
        self.pair = Pair((hub.endpoint, hub.endpoint), folder, stack, centre)
        self.watches = (self.pair.watch,)
        self.targets = range(args.targets)
        start = self._intensity if args.intensity else self.pair.sensor
        self._sensors = [start(name, *targets) for name, targets in sensors(args.targets).items()]
        self.lost: list[str] = []
        self.answered: list[float] = []
        self.pair.started(*self.targets)

    def _intensity(self, name: str, *targets: int) -> Program:
        """A sensor of an intensity: it sees all."""
        return self.pair.sensor(name, *self.targets, code=INTENSITY, order=str(1000 * len(self.targets)))

    def _order(self, track: int, what: str) -> str:
        """Give a track a new name, and return that once it is answered, by a step or as one that waits for one."""
        if what == "pending":
            for one in self._sensors:
                one.freeze()
            time.sleep(0.5)
        name = f"N{len(self.answered)}"
        asked = msgpack.packb({"what": "rename", "track": track, "name": name})
        begin = time.monotonic()
        [(_, data)] = self.pair.watch.bus.ask(schemas.global_key("centre", "orders"), asked, 10.0)
        self.answered.append(time.monotonic() - begin)
        answer = msgpack.unpackb(data)
        assert answer["done"], answer
        assert answer["kept"], answer
        assert answer.get("pending", False) == (what == "pending"), answer
        if "followed" in answer:
            self.lost.append(f"{name} was answered as not followed")
        return name

    def once(self, what: str) -> tuple[float, float, int]:
        watch = self.pair.watch
        eventually(watch.ready, 60)
        eventually(lambda: watch.sees(*self.targets), 20)
        time.sleep(random.uniform(0.0, 0.5))
        which = self.pair.active()
        program = self.pair.programs[which]
        assert program is not None
        before, number = watch.pictures[-1].targets, len(watch.pictures) - 1
        name = self._order(before[7], what) if what in ("order", "pending") else ""
        begin = time.monotonic()
        if what in ("kill", "order", "pending"):
            program.kill()
        elif what == "freeze":
            program.freeze()
        else:
            assert command(["order", "handover", "--connect", self._endpoint]) == 0
        if what == "pending":
            eventually(lambda: watch.status and watch.term() % 4 != which, 20)
            for one in self._sensors:
                one.signal(signal.SIGCONT)
        first = self.pair.taken_over(number, 30.0)
        last = [one for one in watch.pictures[number:] if one.picture.epoch != first.picture.epoch][-1]
        time.sleep(1.0)
        if what == "pending":  # tracks coast meanwhile
            eventually(lambda: watch.sees(*self.targets), 20)
        if name and name not in (watch.pictures[-1].picture.callsign or ()):
            self.lost.append(f"{name} does not stand")
        changed = sum(watch.pictures[-1].targets.get(target) != track for target, track in before.items())
        if what in ("kill", "order", "pending"):
            program.__exit__()
            self.pair.centre(which)
        elif what == "freeze":
            time.sleep(max(0.0, self._frozen - (time.monotonic() - begin)))
            program.signal(signal.SIGCONT)
        eventually(lambda: self.pair.active() != which)
        return first.at - begin, first.at - last.at, changed


class Parted:
    """A centre of two, each at a hub of its own, and what came of killing the hub between them. settled: seconds until
    both sides have the pictures of one process; healed: until all is as before; alone: pictures that the one that was
    active published meanwhile."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._hubs = stack.enter_context(Between())
        self.targets = TARGETS
        self.pair = Pair(self._hubs.endpoints, folder, stack)
        self.watches = self.pair.watch, Watch(self._hubs.endpoints[1], stack)
        self.settled: list[float] = []
        self.healed: list[float] = []
        self.alone: list[int] = []
        self.pair.sensor("r1", *range(16))
        self.pair.sensor("r2", *range(8, 24))
        self.pair.sensor("r3", *TARGETS, hub=1)
        self.pair.started(*TARGETS)

    def once(self, what: str) -> tuple[float, float, int]:
        for watch in self.watches:
            eventually(watch.ready, 60)
            eventually(lambda watch=watch: watch.sees(*TARGETS), 20)  # type: ignore[misc]
        time.sleep(random.uniform(0.0, 0.5))
        which = self.pair.active()
        here, there = self.watches[which], self.watches[1 - which]
        before, number = there.pictures[-1].targets, len(there.pictures) - 1
        begin = time.monotonic()
        self._hubs.cut()
        count = len(here.pictures)
        first = there.taken_over(number, 30.0)
        last = [one for one in there.pictures[number:] if one.picture.epoch != first.picture.epoch][-1]
        time.sleep(random.uniform(1.0, 4.0))
        self.alone.append(len(here.pictures) - count)
        epoch = first.picture.epoch
        mended = time.monotonic()
        self._hubs.mend()
        eventually(
            lambda: all(one.pictures[-1].picture.epoch == epoch and one.sees(*TARGETS) for one in self.watches), 60
        )
        self.settled.append(time.monotonic() - mended)
        eventually(lambda: all(one.ready() and one.term() == there.term() for one in self.watches), 60)
        self.healed.append(time.monotonic() - mended)
        changed = sum(there.pictures[-1].targets.get(target) != track for target, track in before.items())
        return first.at - begin, first.at - last.at, changed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10, help="of each (default 10)")
    parser.add_argument(
        "--what",
        nargs="+",
        default=["kill", "freeze", "handover"],
        help="kill, freeze, handover, order; or one of partition and pending alone",
    )
    parser.add_argument(
        "--frozen", type=float, default=3.0, metavar="S", help="how long a frozen one stays so (default 3)"
    )
    parser.add_argument("--targets", type=int, default=24, help="how many (default 24)")
    parser.add_argument("--intensity", action="store_true", help="of a centre and sensors of intensities")
    parser.add_argument("--settings", default="", metavar="TEXT", help="""of the centre, as in 'trigger = "arrival"'""")
    args = parser.parse_args()
    os.environ["PYTHONFAULTHANDLER"] = "1"
    os.environ[VARIABLE] = "off"  # a process that is killed while it compiles leaves the next one to wait for that
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        mission: Mission | Parted
        if args.what == ["partition"]:
            mission = Parted(Path(folder), stack)
        else:
            hub = Hub().start()
            stack.callback(hub.kill)
            mission = Mission(hub, Path(folder), stack, args)
        for what in args.what:
            _told(mission, what, args.times)
        faults = [one for watch in mission.watches for one in watch.faults()]
        pictures = sum(len(watch.pictures) for watch in mission.watches)
        older = [one for one in faults if one.startswith("a picture of run")]
        print(f"{pictures} pictures; of an older run after a newer one: {len(older)}", end="; ")
        print(f"other faults: {len(faults) - len(older)}")
        print(*older[:5], *[one for one in faults if one not in older][:20], sep="\n  ")
        print(f"load average {load:.1f} to {os.getloadavg()[0]:.1f}")


def _told(mission: Mission | Parted, what: str, times: int) -> None:
    """Do it so often, and print what came of it."""
    rows: list[tuple[float, float, int]] = []
    try:
        while len(rows) < times:
            rows.append(mission.once(what))
    except AssertionError:
        running = [one for one in mission.pair.programs if one]
        for one in running:
            one.signal(signal.SIGABRT)  # where its threads are
        print(f"{what}: after {len(rows)} times", *(one.end()[1] for one in running), sep="\n--\n")
        raise
    took, gaps, changed = zip(*rows, strict=True)
    print(
        f"{what:9} {len(rows):4} times: picture of the other after {statistics.median(took):.2f} s (median), "
        f"{max(took):.2f} s (worst); gap in pictures {statistics.median(gaps):.2f} s, {max(gaps):.2f} s; "
        f"ids changed: {sum(changed)} of {len(rows) * len(mission.targets)}",
        flush=True,
    )
    if isinstance(mission, Mission) and mission.answered:
        answered = mission.answered
        print(f"orders lost: {len(mission.lost)} of {len(answered)}", *mission.lost[:20], sep="\n  ")
        print(f"answered after {statistics.median(answered):.2f} s (median), {max(answered):.2f} s (worst)")
    if isinstance(mission, Parted):
        for words, some in (("one process on both sides", mission.settled), ("whole again", mission.healed)):
            longest = ", ".join(f"{one:.2f}" for one in sorted(some)[-5:])
            print(f"{words} after {statistics.median(some):.2f} s (median), the longest {longest} s")
        print(f"pictures of the other side meanwhile: {min(mission.alone)} at least, {sum(mission.alone)} in all")


if __name__ == "__main__":
    main()
