"""Existence in the running service: two sensors of different aspect that both say 0.8."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import opened

# argv: endpoint, name, sigma along x, sigma along y
WITNESS = """
import sys, time
import numpy as np
from schemas import Enu, Motion
from sensor_clients.publisher import TrackPublisher
endpoint, name, sx, sy = sys.argv[1:]
frame = Enu(59.0, -55.0)
with TrackPublisher(name, connect=endpoint) as publisher:
    publisher.info(frame=frame, position=(0, 0, 0), period=0.2, motion=Motion("cv", 0.01))
    print("up", flush=True)
    while True:
        publisher.tracks(time=time.time_ns(), space=("x", "y", "vx", "vy"), frame=frame, ids=[1], existence=[0.8],
                         means=[[0, 0, 0, 0]],
                         covariances=[np.diag([float(sx), float(sy), float(sx), float(sy)]) ** 2])
        time.sleep(0.2)
"""


@pytest.mark.parametrize(("method", "low", "high"), [("consistent", 0.7999, 0.8001), ("geometric", 0.0, 0.5)])
def test_who_agrees_is_believed_and_the_exponential_mixture_loses(
    hub: Hub, tmp_path: Path, method: str, low: float, high: float
) -> None:
    with opened(hub, tmp_path) as scene:
        scene.service(centre=f'existence = "{method}"')
        for name, aspect in (("r1", ("1", "30")), ("r2", ("30", "1"))):
            assert scene.start(WITNESS, scene.endpoint, name, *aspect).line() == "up"

        def both() -> bool:
            pictures = scene.seen.pictures
            return bool(pictures) and pictures[-1].contributor_counts.tolist() == [2]

        eventually(both)
        count = len(scene.seen.pictures)
        eventually(lambda: len(scene.seen.pictures) > count + 5)
        assert all(low <= picture.existence[0] <= high for picture in scene.seen.pictures[count:])
