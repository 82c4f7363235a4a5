"""Two boats side by side: a lidar sees them as one for a while, another source tells them apart throughout."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre, StepResult
from tests.centre.worlds import centre, give, info, step, tracks

LIDAR = np.array([0.5, 0.5, 0.3, 0.3])
CAMERA = np.array([1.5, 1.5, 0.5, 0.5])
SECONDS = 60
MERGED = range(23, 38)
"""Seconds at which the lidar has one track of the two."""
HULL = (7.0, 2.5, 0.0)
BLOB = (16.0, 10.5, 0.4)


class Passed(NamedTuple):
    """What a centre made of it: the result of each second, and the true places (2, 4) then."""

    results: list[StepResult]
    truth: list[NDArray[np.float64]]


def boats(second: float) -> NDArray[np.float64]:
    """The one overtakes the other at 1.5 m/s, 8 m beside it."""
    return np.array([[4.0 * (second - 30), 0.0, 4.0, 0.0], [5.5 * (second - 30), 8.0, 5.5, 0.0]])


def passing(
    *, camera: bool, blob: bool = False, seed: int = 1, new_id: bool = True, judged: bool = False, **config: Any
) -> Passed:
    """blob: the lidar says that its tracks may be blobs, and how large; new_id: after the pass the second boat is a new
    track of the lidar; judged: the lidar reports existence."""
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    made = centre((), period=1.0, **config)
    motion = schemas.Motion("cv", 0.05)
    disk = schemas.Disk(1000.0)
    more: dict[str, Any] = {"motion": motion, "coverage": disk, "detection_probability": 0.9}
    give(made, *(info(name, **more) for name in (("camera", "lidar") if camera else ("lidar",))))
    results, true = [], []
    for second in range(1, SECONDS):
        states = boats(second)
        give(made, _lidar(second, states, blob, new_id, judged, rng))
        if camera:
            give(made, tracks("camera", second, states + rng.normal(size=(2, 4)) * CAMERA, sigma=CAMERA))
        results.append(step(made, second))
        true.append(states)
    return Passed(results, true)


def _lidar(
    second: int, states: NDArray[np.float64], blob: bool, new_id: bool, judged: bool, rng: np.random.Generator
) -> schemas.LocalTracks:
    merged = second in MERGED
    means = states.mean(axis=0, keepdims=True) if merged else states
    ids = [1] if merged else [1, 3 if second >= MERGED.stop and new_id else 2]
    said: dict[str, Any] = {}
    if blob:
        said = {"reference": "blob", "extent": np.array([BLOB if merged else HULL] * len(ids)), "shape": "box"}
    if judged:
        said["existence"] = np.full(len(ids), 0.95)
    return tracks("lidar", second, means + rng.normal(size=means.shape) * LIDAR, ids, sigma=LIDAR, **said)


def again(made: FusionCentre) -> FusionCentre:
    """A centre that goes on from the checkpoint of another."""
    return FusionCentre(made.config, made.checkpoint())
