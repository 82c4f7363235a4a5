"""kill -9, and SIGSTOP with SIGCONT, of hub, service and recorder, one after the other, while two sensors report.

The picture is whole again each time, no id stands for two targets or comes back after its end, all end with 0 by
SIGTERM, and every part of the recording opens.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from pathlib import Path
from statistics import median

from fusion_service.recording import read
from tests.chaos.report import Report
from tests.chaos.scene import TARGETS, Product, Watch, product

__all__ = ["kill_and_freeze"]

PATIENCE = 90.0
"""Seconds after which a picture that is not whole has not come back."""
AWAY = (0.0, 0.0, 0.3, 1.0, 4.0)
FROZEN = (0.3, 1.0, 3.0, 6.0, 15.0)
SILENCE = 1.5


def kill_and_freeze(seed: int, until: float, most: int = 2**62) -> Report:
    """Until `until`, of the monotonic clock, or `most` times."""
    report = Report("kills")
    rng = random.Random(seed)
    with product("service", "recorder", "r1", "r2") as (all_of, watch):
        tally = Tally()
        while report.tried < most and time.monotonic() < until:
            _once(rng, all_of, watch, report, tally)
            report.tried += 1
        _ends(all_of, watch, report)
        for line in tally.lines():
            report.say(line)
        report.say(f"longest silence of a service that is there {tally.silence:.2f} s")
        told = all_of["service"].log.read_text(errors="replace")
        if "Traceback" in told:
            report.escaped(told[told.index("Traceback") :][:2000])
        _recording(all_of.folder / "recorded", report)
    return report


class Tally:
    """What came of each kind of blow."""

    def __init__(self) -> None:
        self.tried: Counter[str] = Counter()
        self.kept: Counter[str] = Counter()
        self.back: dict[str, list[float]] = {}
        self.silence = 0.0

    def lines(self) -> list[str]:
        return [
            f"{kind}: {self.tried[kind]} times, whole again after {median(self.back.get(kind) or [0.0]):.1f} s,"
            f" {max(self.back.get(kind) or [0.0]):.1f} at most,"
            f" ids kept {self.kept[kind]} of {len(TARGETS) * self.tried[kind]}"
            for kind in sorted(self.tried)
        ]


def _once(rng: random.Random, all_of: Product, watch: Watch, report: Report, tally: Tally) -> None:
    name = rng.choice(("service", "service", "hub", "recorder"))
    before, begin = watch.confirmed(), time.monotonic()
    if rng.random() < 0.6:
        kind, took = f"{name} killed", rng.choice(AWAY)
        all_of[name].kill()
        time.sleep(took)
        all_of[name].start()
    else:
        took = rng.choice(FROZEN)
        kind = f"{name} frozen for {took:g} s"
        all_of[name].freeze(took)
    back = time.monotonic()
    while not watch.whole(back) and time.monotonic() - back < PATIENCE:
        time.sleep(0.02)
    tally.tried[kind] += 1
    if not watch.whole(back):
        report.escaped(f"{kind}: the picture is not whole after {PATIENCE:g} s: {watch.confirmed()}")
        return
    tally.back.setdefault(kind, []).append(time.monotonic() - back)
    time.sleep(rng.uniform(0.5, 2.0))
    after = watch.confirmed()
    tally.kept[kind] += sum(after.get(one) == before.get(one) for one in TARGETS)
    # of a service that was there all the time, or from its first status on
    there = begin if name == "recorder" else back + watch.first(back)
    tally.silence = max(tally.silence, watch.silence(there))
    if watch.returned:
        report.escaped(f"{kind}: ids that had ended came back: {sorted(watch.returned)}")
        watch.returned.clear()
    if twice := {one for one, targets in watch.targets_of.items() if len(targets) > 1}:
        report.escaped(f"{kind}: ids of two targets: {sorted(twice)}")
        for one in twice:
            del watch.targets_of[one]


def _ends(all_of: Product, watch: Watch, report: Report) -> None:
    codes = {}
    for name in ("recorder", "service", "hub"):
        codes[name], took = all_of[name].end()
        if codes[name]:
            tail = all_of[name].log.read_text(errors="replace")[-1000:]
            report.escaped(f"SIGTERM ends the {name} with {codes[name]} after {took:.1f} s: {tail}")
    report.say(f"exit codes by SIGTERM: {codes}; {len(watch.targets_of)} ids used")


def _recording(folder: Path, report: Report) -> None:
    parts, messages = sorted(folder.glob("*.rrd")), 0
    for part in parts:
        try:
            messages += sum(1 for _ in read(part))
        except Exception as error:
            report.escaped(f"{part.name} is not read: {error!r}")
    if not messages:
        report.escaped("nothing is recorded")
    report.say(f"{len(parts)} parts of a recording open, with {messages:,} messages")
