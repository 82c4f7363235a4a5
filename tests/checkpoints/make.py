"""Writes the checkpoint of a release, to be kept here as VERSION.msgpack: run this file with the code of that release
(`git archive`, and PYTHONPATH on it), as `python make.py VERSION.msgpack`. It asks for no more than the first had."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from fusion_service.centre import FusionCentre, StepResult
from schemas import Enu, LocalTracks, Motion, SensorInfo

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = Enu(59.0, -55.0)
SOURCES = ("r1", "r2")
LAST = 7
"""Seconds of the kept checkpoints: steps 1 to 7."""


def fly(centre: FusionCentre, seconds: range) -> list[StepResult]:
    """Two sources see three targets, 1000 m apart, that move by 1 m/s in x; a step a second."""
    results = []
    for second in seconds:
        now = START + second * SECOND
        for number, name in enumerate(SOURCES):
            if second == 1:
                centre.handle(
                    SensorInfo(
                        source=name, epoch=1, seq=0, sent=START, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
                        motion=Motion("cv", 1.0),
                    ),
                    START,
                )  # fmt: skip
            means = np.array([[1000.0 * k + second, 0.0, 1.0, 0.0] for k in range(3)])
            tracks = LocalTracks(
                source=name, epoch=1, seq=1 + second, sent=now, time=now, complete=True, space=("x", "y", "vx", "vy"),
                frame=FRAME, ids=np.arange(1, 4, dtype=np.uint64) + np.uint64(10 * number), means=means,
                covariances=np.tile(np.diag([100.0, 100.0, 4.0, 4.0]), (3, 1, 1)),
            )  # fmt: skip
            centre.handle(tracks, now)
        results.append(centre.step(now))
    return results


if __name__ == "__main__":
    made = FusionCentre({"period": 1.0, "frame": FRAME})
    fly(made, range(1, LAST + 1))
    Path(sys.argv[1]).write_bytes(made.checkpoint())
