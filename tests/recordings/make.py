"""Makes the kept recordings anew, for a release that changes results: `python -m tests.recordings.make`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import schemas
from fusion_service.centre import Order
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, tracks
from tests.helpers.flown import SOURCES, Flight, messy

FOLDER = Path(__file__).parent
COVARIANCE = np.diag([900.0, 900.0, 4.0, 4.0])


def mixtures() -> Flight:
    """Mixtures, existence, coverage, targets that come together and part, ids that are swapped: links are made,
    exchanged, broken, merged and split."""
    flight = Flight({"rule": "hmd-ga", "mixture_rule": "gm-ga", "min_existence": 0.05, "coast": 2.0})
    rng = np.random.default_rng(4)
    for name in SOURCES:
        flight.put(info(name, detection_probability=0.9, coverage=schemas.Disk(30e3), initiation_delay=2.0), 0.5)
    for second in range(1, 25):
        gap = 150.0 * abs(second - 12)
        places = np.array([[0.0, gap, 10, 0], [0.0, -gap, 10, 0], [4000.0, 0, 0, 5], [-3000, 100, 0, 0]])
        for number, name in enumerate(SOURCES):
            some = [0, 1, 2] if second % 5 or number else [0, 1, 2, 3]
            some = [1, 0, 2] if number == 2 and second > 15 else some
            means = places[some] + rng.normal(size=(len(some), 4)) * [30, 30, 2, 2]
            ids = np.arange(1, len(some) + 1)
            existence = np.full(len(some), 0.8 + 0.05 * number)
            if number:
                flight.put(tracks(name, second, means, ids, existence=existence), second)
                continue
            both = np.repeat(means, 2, axis=0)
            both[1::2, :2] += 80
            flight.put(
                tracks(
                    name, second, both, ids.repeat(1), existence=existence, weights=np.tile([0.7, 0.3], len(some)),
                    counts=np.full(len(some), 2, dtype=np.uint16),
                ),
                second,
            )  # fmt: skip
        if second == 20:
            flight.centre.handle(Order("delete", track=int(flight.steps[-1].tracks.ids[-1])), START)
        flight.step(second + 0.1)
    return flight


def intensity() -> Flight:
    """Two sources of intensities, and a restart of the centre."""
    flight = Flight({"kind": "intensity", "intensity_rule": "hybrid"})
    rng = np.random.default_rng(3)
    for name in ("r1", "r2"):
        flight.put(info(name, coverage=schemas.Disk(30e3), detection_probability=0.9), 0.5)
    for second in range(1, 12):
        for name in ("r1", "r2"):
            means = np.array([[0.0, 0, 10, 0], [5000.0, 0, 0, 10]]) + rng.normal(size=(2, 4))
            message = schemas.LocalIntensity(
                source=name, epoch=1, seq=second, sent=0, time=START + second * SECOND, space=SPACE, frame=FRAME,
                weights=np.array([0.9, 1.8]), means=means, covariances=np.tile(np.diag([9.0, 9, 1, 1]), (2, 1, 1)),
            )  # fmt: skip
            flight.put(message, second)
        if second == 5:
            flight.begin(flight.centre.checkpoint(), 8)
        flight.step(second)
    return flight


def main() -> None:
    flights = {
        "tracks": messy({"rule": "ci"}, steps=20, targets=8),
        "memory": messy(
            {"rule": "bci", "rule_options": {"max_correlation": 0.5}, "memory": "recursive"},
            steps=12,
            targets=6,
            seed=3,
        ),
        "mixtures": mixtures(),
        "intensity": intensity(),
    }
    for name, flight in flights.items():
        path = FOLDER / f"{name}.rrd"
        path.unlink(missing_ok=True)
        flight.record(path)
        print(f"{path.name}: {path.stat().st_size} bytes, {len(flight.steps)} steps")


if __name__ == "__main__":
    main()
