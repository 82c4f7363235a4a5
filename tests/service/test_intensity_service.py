"""The service with kind = "intensity": sensors that publish intensities, as processes."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened

# A sensor that expects the targets k at (1000 k, 0) as one component each, and sees places with x below `reach` m.
SENSOR = """
import sys, time
import numpy as np
from schemas import Enu, Motion, Polygon
from sensor_clients.publisher import TrackPublisher
endpoint, name, reach, *targets = sys.argv[1:]
targets = [int(k) for k in targets]
frame, space, reach = Enu(59.0, -55.0), ("x", "y", "vx", "vy"), float(reach)
rng = np.random.default_rng(len(name))
with TrackPublisher(name, connect=endpoint) as publisher:
    view = Polygon(((-500, -500), (reach, -500), (reach, 500), (-500, 500)))
    publisher.info(frame=frame, position=(0, 0, 0), period=0.2, motion=Motion("cv", 1.0), coverage=view)
    print("up", flush=True)
    while True:
        means = np.array([[1000.0 * k, 0, 0, 0] for k in targets]) + rng.normal(size=(len(targets), 4))
        publisher.intensity(time=time.time_ns(), space=space, frame=frame, weights=np.full(len(targets), 0.95),
                            means=means, covariances=np.tile(np.diag([25.0, 25.0, 4.0, 4.0]), (len(targets), 1, 1)))
        time.sleep(0.2)
"""


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_the_service_fuses_intensities_refuses_tracks_and_comes_back_after_kill_9(scene: Scene) -> None:
    """Target 5 is in the view of r2 only; what the tracker r3 publishes is refused by its reason."""
    service = scene.service('kind = "intensity"\nintensity_rule = "hybrid"')
    for name, reach, targets in (("r1", "2500", "012"), ("r2", "9000", "0125")):
        sensor = scene.start(SENSOR, scene.endpoint, name, reach, *targets)
        assert sensor.line() == "up"
    scene.sensor("r3", 7)
    eventually(scene.seen.sees(0, 1, 2, 5))
    before = scene.seen.confirmed()
    eventually(lambda: scene.seen.feeders(before[1]) == {"r1", "r2"})
    assert scene.seen.feeders(before[5]) == {"r2"}
    picture = scene.seen.pictures[-1]
    assert picture.rule == "hybrid"
    np.testing.assert_allclose(picture.existence, 0.95, atol=1e-3)
    eventually(lambda: scene.last_status().refused.get("tracks", 0) > 0)
    eventually(lambda: scene.last_status().tracks.get("expected") == 4)
    assert scene.last_status().tracks["components"] == 4
    service.kill()
    killed = len(scene.seen.pictures)
    service = scene.service('kind = "intensity"')
    eventually(lambda: len(scene.seen.pictures) > killed and scene.seen.sees(0, 1, 2, 5)())
    assert scene.seen.confirmed() == before
    service.signal(signal.SIGTERM)
    assert service.end(timeout=5.0)[0] == 0


def test_a_state_of_the_other_kind_is_set_aside(scene: Scene) -> None:
    scene.sensor("r3", 1)
    service = scene.service()
    eventually(scene.seen.sees(1))
    service.signal(signal.SIGTERM)
    assert service.end(timeout=5.0)[0] == 0
    sensor = scene.start(SENSOR, scene.endpoint, "r1", "9000", "2")
    assert sensor.line() == "up"
    service = scene.service('kind = "intensity"')
    eventually(scene.seen.sees(2))
    service.signal(signal.SIGTERM)
    code, text = service.end(timeout=5.0)
    assert code == 0
    assert "fuses tracks, not intensity" in text
