"""How a step grows with the number of tracks:

    python -m benchmarks.growth [--tracks 100 1000 10000] [--scenes sparse dense formation clutter crowd] [--steps 8]

Targets lie in eight regions, each seen by two sources once a second: "sparse" 2 km apart, "dense" 150 m, "formation"
in fives within some 25 m, "crowd" in two hundreds within some 150 m, "clutter" sparse, and a twentieth of each report
false tracks with new ids. CPU time of this process, the median of the steps from the fourth on, and the exponent of it
from one number to the next.
"""

import argparse
import time

import numpy as np

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre

SCENES = ("sparse", "dense", "formation", "clutter", "crowd")
FRAME = schemas.Enu(59.0, -55.0)
SIGMA = np.array([20.0, 20.0, 2.0, 2.0])
TOGETHER = {"formation": (5, 25.0), "crowd": (200, 150.0)}
REGIONS = 8


def states(scene: str, count: int, rng: np.random.Generator) -> Floats:
    """Where targets (count, 4) are at first."""
    size, spread = TOGETHER.get(scene, (1, 0.0))
    groups = -(-count // size)
    cell = {"dense": 150.0, "formation": 8000.0, "crowd": 8000.0}.get(scene, 2000.0)
    place = np.stack(np.divmod(np.arange(groups), int(np.ceil(np.sqrt(groups)))), axis=1) * cell
    place = place + rng.uniform(-0.2, 0.2, place.shape) * cell
    velocity = rng.normal(0.0, 10.0, place.shape)
    both = np.repeat(np.concatenate([place, velocity], axis=1), size, axis=0)[:count]
    both[:, :2] += spread * rng.normal(size=(count, 2))
    return both


def run(scene: str, count: int, steps: int, seed: int = 5) -> tuple[float, int]:
    """Milliseconds of a step, and how many tracks there are at the end."""
    rng = np.random.default_rng(seed)
    truth, part = states(scene, count, rng), -(-count // REGIONS)
    names = [f"s{number:02d}" for number in range(2 * REGIONS)]
    centre = FusionCentre({"period": 1.0, "sources": {name: {"override": True, "period": 1.0} for name in names}})
    spent, clutter = [], part // 20 if scene == "clutter" else 0
    for step in range(steps):
        now = truth + step * np.concatenate([truth[:, 2:], np.zeros((count, 2))], axis=1)
        for number, name in enumerate(names):
            mine = slice(number // 2 * part, (number // 2 + 1) * part)
            means, ids = now[mine], np.arange(count)[mine] + 1
            means = means + 0.6 * SIGMA * rng.normal(size=means.shape)
            false = now[rng.integers(0, count, clutter)] + 500.0 * rng.normal(size=(clutter, 4)) * [1, 1, 0, 0]
            new = 10**7 * (step + 1) + np.arange(clutter)
            means, ids = np.concatenate([means, false]), np.concatenate([ids, new])
            message = schemas.LocalTracks(
                source=name, epoch=1, seq=step, sent=0, time=10**9 * (step + 1), complete=True,
                space=("x", "y", "vx", "vy"), frame=FRAME, ids=ids.astype(np.uint64), means=means,
                covariances=np.tile(np.diag(SIGMA**2), (len(ids), 1, 1)),
            )  # fmt: skip
            centre.handle(message, 10**18)
        begin = time.process_time()
        result = centre.step(10**9 * (step + 1))
        spent.append(1e3 * (time.process_time() - begin))
    return float(np.median(spent[3:])), len(result.tracks.ids)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--steps", type=int, default=8)
    chosen = parser.parse_args()
    print("| scene | tracks | ms a step | us a track | exponent |\n|---|---|---|---|---|")
    for scene in chosen.scenes:
        last: tuple[int, float] | None = None
        for count in chosen.tracks:
            spent, there = run(scene, count, max(chosen.steps, 4))
            grows = "" if last is None else f"{np.log(spent / last[1]) / np.log(count / last[0]):.2f}"
            print(f"| {scene} | {there} | {spent:.1f} | {1e3 * spent / count:.1f} | {grows} |", flush=True)
            last = count, spent


if __name__ == "__main__":
    main()
