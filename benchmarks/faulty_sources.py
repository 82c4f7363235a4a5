"""Does looking after sources ever make the picture worse, and does it help where it should?

    python -m benchmarks.faulty_sources [WORLD ...] [--mode MODE ...] [--seed 1] [--runs 1] [--events]

Every world of `benchmarks.faulty_worlds` (or those whose names begin with WORLD) through a centre with nothing looked
after (`off`: supervision and registration "off"), with the defaults (`act`: "act", "estimate") and with errors taken
off (`correct`). From the tenth second on: tracks shown for each target (1 is right); RMSE, m, of those that follow one;
ANEES (1 is right, below it is cautious); the largest eigenvalue of true beside stated mean squared error; identity
switches; when a wrong source was named first, s, and events about sound ones (`act`, `correct`). A cell has the modes
in this order. The last column says what is worse than `off` by 3 % or more.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.faulty_worlds import WORLDS, World
from benchmarks.worlds.flight import confirmed
from benchmarks.worlds.measures import correspondence
from benchmarks.worlds.world import DELAY, ns
from fusion_service.centre import FusionCentre, SourceFound
from fusion_service.metrics import gospa, identity_switches, nees
from studies.correlation import excess

__all__ = ["MODES", "Found", "run"]

MODES: dict[str, dict[str, str]] = {
    "off": {"supervision": "off", "registration": "off"},
    "act": {},
    "correct": {"registration": "correct"},
}
BEGIN = 10
WORSE = 1.03


@dataclass
class Found:
    """What a run showed."""

    shown: float
    gospa: float
    rmse: float
    anees: float
    excess: float
    switches: int
    named: float
    false: int
    words: str
    events: list[dict[str, Any]] = field(default_factory=list)


def run(world: World, mode: str, **config: Any) -> Found:
    """A world through a centre in a mode."""
    centre = FusionCentre({**world.config, **MODES[mode], **config})
    for name in sorted({message.source for _, message in world.said}):
        centre.handle(SourceFound(name), ns(0.0))
    events: list[dict[str, Any]] = []
    shown, errors, spreads, parts, follows, last = [], [], [], [], [], dict[int, int]()
    named, false, at = np.nan, 0, 0
    for second, there in enumerate(world.truth, start=1):
        while at < len(world.said) and world.said[at][0] <= ns(second + DELAY):
            centre.handle(world.said[at][1], world.said[at][0])
            at += 1
        result = centre.step(ns(float(second)))
        for event in result.log.events:
            if event["kind"] in ("supervision", "registration", "alarm"):
                events.append({"second": second, **event})
                good = event.get("state") == "trusted"
                if event["source"] in world.wrong:
                    named = second if np.isnan(named) and not good else named
                elif not good:
                    false += 1
        picture = confirmed(result.tracks)
        last = correspondence(last, there, picture, world.near)
        if second <= BEGIN:
            continue
        follows.append(last)
        shown.append(len(picture.id) / max(int(np.isfinite(there[:, 0]).sum()), 1))
        parts.append(gospa(there, picture.place, world.near / 4).distance)
        row = {one: j for j, one in enumerate(picture.id.tolist())}
        for target, one in last.items():
            errors.append(picture.place[row[one]] - there[target])
            spreads.append(picture.covariance[row[one]])
    e, P = np.array(errors).reshape(-1, 2), np.array(spreads).reshape(-1, 2, 2)
    square = e.T @ e / len(e)
    words = "; ".join(f"{name}: {_words(result.status.sources[name])}" for name in sorted(world.wrong))
    return Found(
        float(np.mean(shown)), float(np.mean(parts)), float(np.sqrt(np.trace(square))), float(nees(e, P).mean() / 2),
        float(excess(square, P.mean(axis=0))), identity_switches(follows), named, false, words, events,
    )  # fmt: skip


def _words(said: dict[str, Any]) -> str:
    parts = [said.get("state", "")]
    if said.get("bias_note", "").startswith("no ") is False:
        parts.append(said.get("bias_note", ""))
    parts += [*said.get("alarms", [])[:1], *([said["note"]] if said.get("note") else [])]
    if said.get("state") == "inflated":
        parts[0] += f" x {said['inflation_position']:.3g}, {said['inflation_velocity']:.3g}"
    return ", ".join(part for part in parts if part) or "-"


def _mean(found: Sequence[Found], name: str) -> float:
    values = np.array([getattr(one, name) for one in found], dtype=np.float64)
    return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan


def worse(found: Sequence[Found], off: Sequence[Found]) -> list[str]:
    """In what a mode is worse than with nothing looked after."""

    def more(name: str, least: float = 0.0) -> bool:
        return max(_mean(found, name), least) > WORSE * max(_mean(off, name), least)

    marks = [name for name in ("rmse", "gospa") if more(name)] + (["anees"] if more("anees", 1.0) else [])
    if abs(_mean(found, "shown") - 1) > abs(_mean(off, "shown") - 1) + WORSE - 1:
        marks.append("shown")
    return marks + (["switches"] if _mean(found, "switches") > _mean(off, "switches") else [])


def line(name: str, found: dict[str, list[Found]]) -> str:
    """Of the table: each cell has all modes, means over the runs."""
    cells = [name]
    for what, digits in (("shown", 2), ("gospa", 0), ("rmse", 1), ("anees", 2), ("excess", 2), ("switches", 1)):
        cells.append(", ".join(f"{_mean(one, what):.{digits}f}" for one in found.values()))
    last = list(found.values())[-2 if len(found) > 2 else -1 :]
    cells.append(", ".join("-" if np.isnan(_mean(one, "named")) else f"{_mean(one, 'named'):.0f}" for one in last))
    cells.append(", ".join(f"{_mean(one, 'false'):g}" for one in last))
    off = next(iter(found.values()))
    marks = {mode: worse(one, off) for mode, one in found.items()}
    cells.append("; ".join(f"{mode}: {', '.join(some)}" for mode, some in marks.items() if some))
    return f"| {' | '.join(cells)} |"


HEAD = """\
| world | shown | GOSPA | RMSE | ANEES | excess | switches | named | false | worse than off |
|---|---|---|---|---|---|---|---|---|---|"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", nargs="*")
    parser.add_argument("--mode", action="append", choices=list(MODES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--events", action="store_true", help="what status and step log say of sources")
    args = parser.parse_args(arguments)
    chosen = [name for name in WORLDS if not args.world or any(name.startswith(one) for one in args.world)]
    print(f"load {os.getloadavg()[0]:.1f}\n\n{HEAD}", flush=True)
    for name in chosen:
        worlds = [World.made(WORLDS[name], args.seed + k) for k in range(args.runs)]
        found = {mode: [run(world, mode) for world in worlds] for mode in args.mode or MODES}
        print(line(name, found), flush=True)
        for mode, (first, *_) in found.items() if args.events else ():
            print(f"  {mode}: {first.words}", *(f"    {event}" for event in first.events), sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
