"""Runs of worlds as records (plain values, for JSON) and records as a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, TypeAlias

import numpy as np

from benchmarks.worlds.catalogue import make
from benchmarks.worlds.flight import fly
from benchmarks.worlds.measures import Scores, average, score

__all__ = ["HEAD", "Record", "run", "table"]

Record: TypeAlias = dict[str, Any]

HEAD = (
    "| world | ids/target mean, worst | switches | gospa, m (loc, missed, false, m2) | duplicates | ghosts "
    "| wrong pairs t = 1, 10, 30, max | leap | floor gospa |\n|---|---|---|---|---|---|---|---|---|"
)
MOMENTS = ("1", "10", "30", "max")


def run(name: str, variant: str, seed: int, runs: int, *, quick: bool = False) -> Record:
    """All runs of a world, seeds from `seed` on: {"world", "variant", "cutoff", "centre", "floor", "wrong", "fresh",
    "step_ms"}, means over the runs; "floor", "wrong" and "fresh" are None where there is none."""
    worlds = [make(name, variant, seed + k, quick=quick) for k in range(runs)]
    flights = [fly(world) for world in worlds]
    centre = [score(w.truth, f.pictures, w.cutoff) for w, f in zip(worlds, flights, strict=True)]
    floor = [score(w.truth, f.floor, w.cutoff) for w, f in zip(worlds, flights, strict=True) if f.floor is not None]
    return {
        "world": name,
        "variant": variant,
        "cutoff": worlds[0].cutoff,
        "centre": asdict(average(centre)),
        "floor": asdict(average(floor)) if floor else None,
        "wrong": _moments([flight.wrong for flight in flights]),
        "fresh": _moments([flight.fresh for flight in flights]),
        "step_ms": float(np.median([ms for flight in flights for ms in flight.milliseconds])),
    }


def _moments(runs: Sequence[Sequence[int]]) -> dict[str, float | None] | None:
    """Wrong pairs at t = 1, 10 and 30 steps, mean over runs (None after the end), and the most at any step."""
    if not runs[0]:
        return None
    at = {str(k): float(np.mean([one[k - 1] for one in runs])) if k <= len(runs[0]) else None for k in (1, 10, 30)}
    return {**at, "max": float(max(map(max, runs)))}


def _row(label: str, scores: Mapping[str, float], wrong: Mapping[str, float | None] | None, floor: str) -> str:
    s = Scores(**scores)
    pairs = "" if wrong is None else ", ".join("-" if wrong[m] is None else f"{wrong[m]:.3g}" for m in MOMENTS)
    return (
        f"| {label} | {s.ids_mean:.2f}, {s.ids_worst:g} | {s.switches:g} "
        f"| {s.gospa:.3g} ({s.localisation:.3g}, {s.missed:.3g}, {s.false:.3g}) "
        f"| {s.duplicates:.2f} | {s.ghosts:.2f} | {pairs} | {s.leap:.3g} | {floor} |"
    )


def table(records: Iterable[Record], before: Iterable[Record] = (), *, floors: bool = False) -> Iterable[str]:
    """Rows of the records; above each that of `before` where it has the world, and below it with `floors` those of
    the assignment that knows the truth, and of the fresh one."""
    old = {(one["world"], one["variant"]): one for one in before}
    for record in records:
        label = f"{record['world']}, {record['variant']} (c = {record['cutoff']:g} m)"
        floor = "-" if record["floor"] is None else f"{record['floor']['gospa']:.3g}"
        was = old.get((record["world"], record["variant"]))
        if was is not None:
            yield _row(f"{label}, before", was["centre"], was["wrong"], floor)
        yield _row(label, record["centre"], record["wrong"], floor)
        if floors and record["floor"] is not None:
            yield _row("&nbsp; floor", record["floor"], record["fresh"], floor)
