"""Pictures that do not know all of their space are scored on what they know."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.review.evaluation import Logbook, assess, evaluate
from tests.centre.worlds import FRAME, SECOND, START, give, info, step, tracks

LONG = ("x", "y", "z", "vx", "vy", "vz")


@pytest.mark.parametrize(("space", "height"), [(LONG, False), (LONG, True), (("x", "y", "vx", "vy"), False)])
def test_a_picture_of_places_alone_is_scored(space: tuple[str, ...], height: bool) -> None:
    """A camera's places with sigma 10 m of a target 3 km up: as they are, on the plane unless height is known."""
    rng = np.random.default_rng(1)
    centre = FusionCentre({"space": list(space), "frame": {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}})
    tells = ("x", "y", "z") if height else ("x", "y")
    messages: list[schemas.Message] = [info("camera")]
    give(centre, info("camera"))
    for second in range(1, 41):
        state = np.array([[1000.0 + 20 * second, 500.0, 3000.0, 20.0, 0.0, 0.0]])
        message = dataclasses.replace(
            tracks("camera", second, np.zeros((0, 4)), []),
            space=tells,
            ids=np.array([1], dtype=np.uint64),
            means=state[:, : len(tells)] + rng.normal(size=(1, len(tells))) * 10.0,
            covariances=100.0 * np.eye(len(tells))[None],
        )
        truth = schemas.Truth(
            source="world", epoch=1, seq=second, sent=START, time=START + second * SECOND, space=LONG, frame=FRAME,
            ids=np.array([1], dtype=np.uint64), means=state,
        )  # fmt: skip
        give(centre, message)
        messages += [truth, message, step(centre, second).tracks]
    assert Logbook(messages).flat == ({"centre"} if space == LONG and not height else set())
    fused = evaluate(messages, c=200.0, every=None).fused
    assert fused.rmse_position == pytest.approx(10.0 * np.sqrt(len(tells)), rel=0.25)
    assert 0.5 < fused.anees < 1.5
    assert assess(Logbook(messages)) is not None
