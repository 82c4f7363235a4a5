"""Clocks that jump: of the service alone, and of the service with its sensors.

The clock is the one that Python has, put off by what is written to the process's standard input.
"""

from __future__ import annotations

import random
import time

from tests.chaos.report import Report
from tests.chaos.scene import TARGETS, Product, Watch, product
from tests.helpers.processes import eventually
from tests.helpers.scene import SENSOR

__all__ = ["jump_clocks"]

SHIFTED = """
import sys, threading, time
real, shift = time.time_ns, [0]
def jump():
    for line in sys.stdin:
        shift[0] = int(float(line) * 1e9)
time.time_ns = lambda: real() + shift[0]
time.time = lambda: time.time_ns() / 1e9
threading.Thread(target=jump, daemon=True).start()
"""
SERVICE = SHIFTED + "from fusion_service.cli import main\nraise SystemExit(main(sys.argv[1:]))\n"
JUMPS = (0.5, -0.5, 3.0, -3.0, 30.0, -30.0, 3600.0, -3600.0, 86400.0, -86400.0)
PATIENCE = 90.0
STAYS = 4.0
"""Seconds for which a service stands alone with its clock."""


def jump_clocks(seed: int, until: float, most: int = 2 * len(JUMPS)) -> Report:
    """Each jump of all clocks, and of the service's there and back, until `until` or `most` of them."""
    report = Report("clock")
    rng = random.Random(seed)
    cases = [(alone, jump) for jump in JUMPS for alone in (False, True)]
    rng.shuffle(cases)
    with product(program=("-c", SERVICE)) as (all_of, watch):
        for name in ("r1", "r2"):
            all_of.add(name, "-c", SHIFTED + SENSOR, all_of.endpoint, name, "given", *map(str, TARGETS))
        all_of.start("service", "r1", "r2")
        eventually(watch.whole, 90)
        shift = 0.0
        for alone, jump in cases[:most]:
            if time.monotonic() > until:
                break
            _jump(all_of, watch, alone, shift, jump, report)
            shift += 0.0 if alone else jump
            report.tried += 1
        if watch.returned or any(len(one) > 1 for one in watch.targets_of.values()):
            report.escaped(f"ids used twice: {watch.returned} {watch.targets_of}")
        code, _ = all_of["service"].end()
        told = all_of["service"].log.read_text(errors="replace")
        if code or "Traceback" in told:
            report.escaped(f"exit code {code}: {told[-2000:]}")
        report.say(f"exit code {code}")
    return report


def _jump(all_of: Product, watch: Watch, alone: bool, shift: float, jump: float, report: Report) -> None:
    """One jump; what it did is said."""
    before, begin = watch.confirmed(), time.monotonic()
    for name in ("service",) if alone else ("service", "r1", "r2"):
        all_of[name].tell(str(shift + jump))
    if alone:
        time.sleep(STAYS)
        all_of["service"].tell(str(shift))
    changed = time.monotonic()
    while not watch.whole(changed + 1.0) and time.monotonic() - changed < PATIENCE:
        time.sleep(0.05)
    who = "service alone, and back" if alone else "all clocks"
    if not watch.whole():
        report.escaped(f"{who} by {jump:g} s: the picture is not whole: {watch.confirmed()}")
    kept = sum(watch.confirmed().get(one) == before.get(one) for one in TARGETS)
    silence, back = watch.silence(begin), time.monotonic() - changed
    report.say(f"{who} by {jump:g} s: ids kept {kept}, silence {silence:.2f} s, whole again after {back:.1f} s")
