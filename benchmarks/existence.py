"""Is existence calibrated: of tracks reported at .7, do .7 exist? `python -m benchmarks.existence [--png FILE]`.

A world in which that can be known: 20 places a mission, a share of which hold a target; two sensors with a detection
probability and a rate of false reports per place and scan, all stated to the centre, one to six scans, so that every
value occurs. Real centres through `handle` and `step`. The last column is the standard error of the share that exists.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre

SECOND, START = 10**9, 1_700_000_000 * 10**9
SPACE = ("x", "y", "vx", "vy")
FRAME = schemas.Enu(59.0, 10.0)
PLACES, PRIOR, DETECTION, FALSE = 20, 0.3, 0.6, 0.08
BINS = np.linspace(0.0, 1.0, 11)


def mission(rng: np.random.Generator) -> tuple[list[float], list[bool]]:
    """Existence as reported after the last scan of a mission, and whether there is a target."""
    centre = FusionCentre(
        {
            "lateness": 3.0, "birth_existence": PRIOR, "survival": 1.0, "coast": 1000.0, "confirm_within": 60,
            "source_defaults": {"false_track": FALSE},
        }
    )  # fmt: skip
    covariance = np.diag([900.0, 900.0, 4.0, 4.0])
    for name in ("a", "b"):
        said = schemas.SensorInfo(
            source=name, epoch=1, seq=0, sent=START, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
            motion=schemas.Motion("cv", 1.0), coverage=schemas.Disk(1e6), detection_probability=DETECTION,
        )  # fmt: skip
        centre.handle(said, START)
    exists = rng.random(PLACES) < PRIOR
    places = np.column_stack([1000.0 * np.arange(PLACES), np.zeros((PLACES, 3))])
    known = np.zeros(PLACES, dtype=np.bool_)
    for second in range(1, 1 + int(rng.integers(1, 7))):
        for name in ("a", "b"):
            shown = rng.random(PLACES) < np.where(exists, DETECTION, FALSE)
            known |= shown & (second == 1) & (name == "a")
            chosen = np.flatnonzero(shown & known)
            message = schemas.LocalTracks(
                source=name, epoch=1, seq=second, sent=START, time=START + second * SECOND, complete=True,
                space=SPACE, frame=FRAME, ids=chosen.astype(np.uint64) + np.uint64(1), means=places[chosen],
                covariances=np.tile(covariance, (len(chosen), 1, 1)),
            )  # fmt: skip
            centre.handle(message, START + 1000 * SECOND)
        picture = centre.step(START + second * SECOND).tracks
    real = [bool(exists[round(x / 1000.0)]) for x in picture.means[:, 0]]
    return picture.existence.tolist(), real


def table(said: NDArray[np.float64], real: NDArray[np.bool_]) -> list[tuple[float, float, float, int]]:
    """(mean reported, share that exists, standard error, number) for each tenth with at least thirty tracks."""
    rows = []
    for low, high in itertools.pairwise(BINS):
        some = (said >= low) & (said < high)
        if some.sum() >= 30:
            share = float(real[some].mean())
            rows.append((float(said[some].mean()), share, float(np.sqrt(0.25 / some.sum())), int(some.sum())))
    return rows


def draw(rows: list[tuple[float, float, float, int]], path: Path) -> None:
    """The plot: reported against true, with two standard errors."""
    import matplotlib.pyplot as plt

    told, true, error, _ = (np.array(column) for column in zip(*rows, strict=True))
    figure, axes = plt.subplots(figsize=(4.6, 4.4), dpi=130)
    axes.plot([0, 1], [0, 1], color="#999999", lw=1)
    axes.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color="#999999", alpha=0.15, lw=0, label="within .1")
    axes.errorbar(told, true, 2 * error, fmt="o", color="#0072b2", ms=5, label="tracks, two standard errors")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="existence reported", ylabel="share that exists")
    axes.legend(frameon=False, loc="upper left")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--png", type=Path)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    results = [mission(rng) for _ in range(args.runs)]
    said = np.array([value for one, _ in results for value in one])
    real = np.array([value for _, one in results for value in one], dtype=np.bool_)
    rows = table(said, real)
    print("| reported | exist | standard error | tracks |\n|---|---|---|---|")
    for told, share, error, number in rows:
        print(f"| {told:.2f} | {share:.2f} | {error:.2f} | {number} |")
    if args.png:
        draw(rows, args.png)


if __name__ == "__main__":
    main()
