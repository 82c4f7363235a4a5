"""Late data: a run in disorder beside the ordered one, with and without loss: `python -m benchmarks.disorder`.

Tracks of `benchmarks.load` come `delay` s late at most, each message by its own delay, some of them twice, so that they
are swapped; a part of them, `loss`, never comes. Each run is made with every message in time (ordered), and in disorder
with `revise` without bound (exact), with its default, and with late data taken as they come (revise 0). Told are:

* GOSPA (c = 300 m, p = 2) of the pictures as they were published, and of the same steps as they stand at the end, all
  late data in their places; beside the ordered run without loss;
* at how many of the steps the tracks stand at the end as in the ordered run of the same messages: status, existence,
  mean and covariance to the bit, whatever the ids;
* CPU of a step, its ratio to the ordered run, and how many steps were made again.

In the last `delay` s nothing is late, so that all has come at the end.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import schemas
from benchmarks.load import FRAME, Load, World
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.publishing import Contributions
from fusion_service.metrics import gospa

SECOND = 10**9
START = 10 * SECOND
PERIOD = 0.1
MEMORIES: dict[str, dict[str, Any]] = {
    "ci restart": {"rule": "ci", "memory": "restart"},
    "ci recursive": {"rule": "ci", "memory": "recursive"},
    "auto": {},
}


@dataclass(frozen=True)
class Arrival:
    """A message: when it holds and when it comes, s after the start."""

    holds: float
    comes: float
    data: bytes


@dataclass
class Flown:
    """A run: GOSPA of each picture as published and as it stands at the end, the tracks of each step as they stand
    then, CPU s a step, steps made again."""

    published: Floats
    standing: Floats
    tracks: list[list[bytes]]
    cpu: float
    again: int


class Watched(FusionCentre):
    """A centre that lets look at its steps as they stand. pictures: by time, ns."""

    pictures: dict[int, Picture]

    def _make(self, time: int, *rest: Any) -> Contributions:
        made = super()._make(time, *rest)
        self.pictures[time] = self._picture
        return made


def arrivals(world: World, steps: int, delay: float, loss: float, seed: int) -> list[Arrival]:
    """The messages of `steps` scans of every source; all have come at the end."""
    rng = np.random.default_rng(seed)
    end = (steps - 1) * PERIOD
    found = []
    for k in range(steps):
        for source in range(world.load.sources):
            message = world.message(source, k, START)
            holds = (message.time - START) / SECOND
            late, again, lost = rng.uniform(0, delay), rng.uniform(0, delay), rng.random() < loss
            if lost:
                continue
            data = schemas.encode(message)
            found.append(Arrival(holds, max(holds, min(holds + late, end)), data))
            if rng.random() < 0.1:
                found.append(Arrival(holds, max(holds, min(holds + again, end)), data))
    return found


def fly(world: World, given: Sequence[Arrival], steps: int, ordered: bool, config: dict[str, Any]) -> Flown:
    """A centre that is given them as they come, or as they hold."""
    frame = {"kind": FRAME.kind, "lat": FRAME.lat, "lon": FRAME.lon}
    centre = Watched({"period": PERIOD, "lateness": 5.0, "frame": frame, **config})
    centre.pictures = {}
    order = sorted(given, key=lambda one: one.holds if ordered else one.comes)
    published, at, cpu, again = [], 0, 0.0, 0
    for k in range(steps):
        now = round(k * PERIOD * SECOND)
        messages = []
        while at < len(order) and (order[at].holds if ordered else order[at].comes) <= now / SECOND + 1e-9:
            messages.append(schemas.decode(order[at].data))
            at += 1
        begin = time.process_time()
        for message in messages:
            centre.handle(message, START + now)
        result = centre.step(START + now)
        cpu += time.process_time() - begin
        again = result.status.queue.get("revised", 0)
        published.append(error(world, now, result.tracks.means.T))
    standing = [error(world, one - START, picture.mean) for one, picture in sorted(centre.pictures.items())]
    tracks = [rows(picture) for _, picture in sorted(centre.pictures.items())]
    return Flown(np.array(published), np.array(standing), tracks, cpu / steps, again)


def error(world: World, since: int, mean: Floats) -> float:
    """GOSPA of the tracks (n, G), `since` ns after the start."""
    return float(gospa(world.truth(since)[:, :2], np.ascontiguousarray(mean[:2].T), c=300.0, p=2.0).distance)


def rows(picture: Picture) -> list[bytes]:
    """What stands of each track but its id, sorted."""
    columns = picture.mean.T, np.moveaxis(picture.covariance, 2, 0), picture.status, picture.existence
    return sorted(b"".join(np.asarray(part[k]).tobytes() for part in columns) for k in range(len(picture.id)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Late data beside the ordered run.")
    parser.add_argument("--sources", type=int, default=3)
    parser.add_argument("--tracks", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--delay", type=float, nargs="+", default=[0.5, 5.0], help="s, the longest")
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.2])
    parser.add_argument("--memory", choices=MEMORIES, nargs="+", default=list(MEMORIES))
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    world = Load(given.sources, given.tracks, given.sources, 1 / PERIOD, seed=given.seed).world()
    steps = round(given.seconds / PERIOD)
    print(f"load of other processes: {os.getloadavg()[0]:.1f}; seed {given.seed}; {world.load.targets} targets")
    print(
        "memory        delay loss  run          GOSPA published  standing   as ordered   CPU ms a step  ratio    again"
    )
    for memory in given.memory:
        whole = fly(world, arrivals(world, steps, 0.0, 0.0, given.seed), steps, True, MEMORIES[memory])
        for delay in given.delay:
            for loss in given.loss:
                _compare(
                    world,
                    arrivals(world, steps, delay, loss, given.seed),
                    whole,
                    f"{memory:13} {delay:5.1f} {loss:4.2f}",
                )


def _compare(world: World, messages: Sequence[Arrival], whole: Flown, what: str) -> None:
    steps = len(whole.tracks)
    memory = MEMORIES[what[:13].strip()]
    ordered = fly(world, messages, steps, True, memory)
    runs = {"no loss": whole, "ordered": ordered}
    for name, revise in (("exact", {"revise": 1e6}), ("default", {}), ("as it comes", {"revise": 0.0})):
        runs[name] = fly(world, messages, steps, False, memory | revise)
    late = steps // 4
    for name, run in runs.items():
        equal = sum(one == other for one, other in zip(run.tracks, ordered.tracks, strict=True))
        print(
            f"{what}  {name:11} {run.published[late:].mean():13.2f} m {run.standing[late:].mean():7.2f} m"
            f" {equal:6} of {steps} {1e3 * run.cpu:11.1f} {run.cpu / ordered.cpu:11.1f} {run.again:8}", flush=True
        )  # fmt: skip


if __name__ == "__main__":
    main()
