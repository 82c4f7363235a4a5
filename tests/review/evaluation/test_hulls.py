"""Scores against the true hull: of tracks at a known distance from it, and of a mission through `evaluate`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion_service.review.evaluation import evaluate
from fusion_service.review.evaluation.hull_table import hull_lines, hull_table
from fusion_service.review.evaluation.hulls import HullTally, TrueHulls, true_hulls
from schemas import Ecef, Enu, Truth
from tests.helpers import missions

NAN = np.nan
FRAME = missions.tracks("radar", 0, [1], [(0, 0)]).frame
HULLS = np.array([[36.0, 10.0, np.pi / 2], [NAN, NAN, NAN]])


def truth(second: float, **more: object) -> Truth:
    like = missions.tracks("radar", second, [1, 2], [(0, 0), (400, 0)])
    said = Truth(
        source="sea", epoch=1, seq=round(second), sent=like.time, time=like.time, space=("x", "y"), frame=like.frame,
        ids=like.ids, means=np.array([[0.0, 0.0], [400.0, 0.0]]),
    )  # fmt: skip
    return replace(said, **more)  # type: ignore[arg-type]


def test_distance_and_nees_of_known_places() -> None:
    """A ship heading north, its antenna 8 m before its middle: the hull reaches 10 m north of it and 26 m south."""
    extent = np.array([[[36.0, 10.0, np.pi / 2], [NAN, NAN, NAN]]])
    tally = HullTally(TrueHulls(extent, np.array([[[8.0, 0.0], [NAN, NAN]]]), np.array([[True, False]])))
    places = np.array([[0.0, -25.0], [0.0, 13.0], [9.0, 0.0], [400.0, 50.0]])
    targets = np.array([0, 0, 0, 1])
    true = np.array([[0.0, 0.0]] * 3 + [[400.0, 0.0]])
    tally.add(0, targets, true, places, np.tile(np.diag([4.0, 1.0]), (4, 1, 1)))
    found = tally.score()
    assert found.pairs == 3
    assert found.inside == pytest.approx(1 / 3)
    assert found.rmse == pytest.approx(np.sqrt((0 + 3.0**2 + 4.0**2) / 3))
    assert found.anees == pytest.approx((0 + 9.0 / 1.0 + 16.0 / 4.0) / 3 / 2)
    empty = HullTally(TrueHulls(extent, np.zeros((1, 2, 2)), np.zeros((1, 2), dtype=np.bool_))).score()
    assert empty.pairs == 0
    assert empty.as_json() == {"pairs": 0, "rmse": None, "inside": None, "anees": None, "bounds": None}


def test_hulls_at_the_scored_times_are_the_nearest_told_and_turned() -> None:
    second = 10**9
    said = [truth(k, extent=np.array([[36.0, 10.0, 0.1 * k], [NAN] * 3]), shape="box") for k in (0, 1, 2)]
    times = said[0].time + np.array([-5.0, 0.4, 0.6, 2.0, 9.0]) * second
    assert FRAME is not None
    found = true_hulls(said, FRAME, times.astype(np.int64), (2, 1))
    assert found is not None
    np.testing.assert_allclose(found.extent[:, 1, 2], [0.0, 0.0, 0.1, 0.2, 0.2])
    assert np.isnan(found.extent[:, 0]).all()
    assert found.box[:, 1].all()
    assert true_hulls([truth(0)], FRAME, times.astype(np.int64), (1,)) is None
    assert true_hulls(said, Ecef(), times.astype(np.int64), (1,)) is None
    assert isinstance(FRAME, Enu)
    other = Enu(FRAME.lat, FRAME.lon + 1.0)
    turned = true_hulls(said, other, times.astype(np.int64), (1,))
    assert turned is not None
    gap = turned.extent[0, 0, 2] - found.extent[0, 1, 2]
    assert abs(gap) == pytest.approx(np.radians(1.0) * np.sin(np.radians(FRAME.lat)), rel=0.01)


def test_a_mission_is_scored_against_hulls_beside_the_points() -> None:
    places = [(0.0, -20.0), (400.0, 1.0)]
    tracks = [missions.tracks("radar", k, [1, 2], places) for k in range(6)]
    info = missions.info("radar", period=1.0)
    hulls = {"extent": HULLS, "shape": "box", "extent_offset": np.array([[8.0, 0.0], [NAN, NAN]])}
    plain = evaluate([info, *tracks, *(truth(k) for k in range(6))], c=50.0, every=1.0, frame=FRAME, space=("x", "y"))
    told = evaluate(
        [info, *tracks, *(truth(k, **hulls) for k in range(6))], c=50.0, every=1.0, frame=FRAME, space=("x", "y")
    )
    one, other = plain.sources["radar"], told.sources["radar"]
    assert one.as_json() == other.as_json(), "the scores against the points are what they were"
    assert one.hull is None
    assert hull_lines(plain.sources) == []
    assert other.hull is not None
    assert other.hull.pairs == len(told.times)
    assert (other.hull.rmse, other.hull.inside, other.hull.anees) == (0.0, 1.0, 0.0)
    lines = hull_lines(told.sources)
    assert "100 %" in lines[2]
    assert hull_table(told.sources)[1][:4] == ["radar", str(len(told.times)), "0", "100 %"]
    assert "hull" not in one.more_json()
    assert other.more_json()["hull"]["pairs"] == other.hull.pairs
