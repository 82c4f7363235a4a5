"""Sensors that move: coverage about where they are, and errors of place and heading that are in every row."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.places import Place, before, followed
from fusion_service.centre.sources import Source
from fusion_service.centre.standing import heading_sigma_of, place_of, turned
from fusion_service.centre.tracks import empty_tracks
from fusion_service.coverage import covers
from fusion_service.geodesy import transform
from fusion_service.metrics import nees_bounds
from tests.centre.worlds import FRAME, SECOND, SPACE, START, centre, give, info, step, tracks

SIGMA = np.array([5.0, 5.0, 0.5, 0.5])
WRONG = math.radians(2.0)


def turn(states: np.ndarray, angle: float, place: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """States (T, 4) as seen by one that is turned by `angle` and does not know."""
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return np.hstack([place + (states[:, :2] - place) @ R.T, velocity + (states[:, 2:] - velocity) @ R.T])


def ship(t: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Place, velocity and heading of a ship on a circle."""
    a = 0.03 * t
    return 300.0 * np.array([math.sin(a), math.cos(a)]), 9.0 * np.array([math.cos(a), -math.sin(a)]), a


def nees(seed: int, said: float | None, seconds: int = 4) -> list[float]:
    """Normalised squares (n = 4) of three targets that only a ship with a wrong heading sees, at the end."""
    rng = np.random.default_rng(seed)
    wrong, made, picture = rng.normal() * WRONG, centre(("ship",)), None
    for t in range(1, seconds + 1):
        own, velocity, heading = ship(t)
        world = np.array([[3000 + 5 * t, 1000, 5, 0], [2000 - 8 * t, 4000, -8, 0], [-2000, 2500, 0, 0]], dtype=float)
        z = turn(world, wrong, own, velocity) + rng.normal(size=world.shape) * SIGMA
        platform = schemas.Platform((*own.tolist(), 0.0), heading=heading, heading_sigma=said)
        give(made, tracks("ship", t, z, sigma=SIGMA, platform=platform))
        picture = step(made, t).tracks
    assert picture is not None
    found = []
    for state in world:
        at = int(np.linalg.norm(picture.means[:, :2] - state[:2], axis=1).argmin())
        e = picture.means[at] - state
        found.append(float(e @ np.linalg.solve(picture.covariances[at], e)))
    return found


def test_a_turning_ship_with_a_wrong_heading_is_honest() -> None:
    """NEES within its bounds over runs if the heading's error is stated, far beyond if it is not. The three targets of
    a run share the error, so each of them is tested over runs."""
    runs = 40
    print("seeds 0 to", runs - 1)
    found = np.array([nees(seed, WRONG) for seed in range(runs)])
    low, high = nees_bounds(4, runs, 0.999)
    mean = found.mean(axis=0) / 4
    assert ((mean > low) & (mean < high)).all(), mean
    assert np.mean([nees(seed, None) for seed in range(4)]) > 20.0


def source(**said: Any) -> Source:
    one = Source("ship", SPACE, empty_tracks(4))
    one.info = info("ship", **said)
    return one


def rows(means: np.ndarray, covariances: np.ndarray | None = None) -> Any:
    made = centre(("ship",))
    more: dict[str, Any] = {} if covariances is None else {"covariances": covariances}
    give(made, tracks("ship", 1, means, sigma=SIGMA, **more))
    step(made, 1)
    return made._intake.sources["ship"].tracks


def test_the_effect_of_a_heading_against_differences() -> None:
    """g g' against a state that is turned by a small angle about the platform."""
    states = np.array([[3000.0, -400.0, 7.0, -3.0], [-200.0, 900.0, 0.0, 4.0]])
    one, sigma = source(heading_sigma=0.5), 0.01
    for t in (0.0, 1.0):
        place, _, _ = ship(t)
        platform = schemas.Platform((*place.tolist(), 0.0), heading_sigma=sigma)
        one.places = followed(one.places, Place(START + round(t * SECOND), FRAME, platform))
    velocity = ship(1.0)[0] - ship(0.0)[0]
    table = rows(states)
    grown = turned(table, one, SPACE, FRAME).covariance - table.covariance
    h = 1e-6
    for k, state in enumerate(table.mean.T):
        g = (turn(state[None], h, ship(1.0)[0], velocity) - state)[0] / h
        np.testing.assert_allclose(grown[:, :, k], sigma**2 * np.outer(g, g), rtol=1e-4, atol=1e-6)


def test_the_effect_is_about_the_vertical_in_ecef_and_only_of_what_is_known() -> None:
    space = ("x", "y", "z")
    flat = np.array([[0.0, 0.0, 0.0], [2000.0, 1000.0, 0.0], [2000.0 - 1.0, 1000.0 + 2.0, 0.0]])
    (here, target, turned_to), _ = transform(flat, np.zeros((3, 3, 3)), space, FRAME, schemas.Ecef())
    one = Source("ship", space, empty_tracks(3))
    platform = schemas.Platform((0.0, 0.0, 0.0), heading_sigma=1e-3)
    one.places = (Place(START, FRAME, platform),)
    made = FusionCentre({"space": space, "frame": {"kind": "ecef"}})
    message = tracks("s", 1, np.zeros((0, 4)))
    ecef: dict[str, Any] = {
        "space": space,
        "frame": schemas.Ecef(),
        "means": target[None],
        "covariances": np.eye(3)[None] * 25.0,
    }
    give(made, info("s"), replace(message, ids=np.array([1], dtype=np.uint64), **ecef))
    made.step(message.time)
    table = made._intake.sources["s"].tracks
    grown = turned(table, one, space, schemas.Ecef()).covariance - table.covariance
    g = turned_to - target
    np.testing.assert_allclose(grown[:, :, 0], np.outer(g, g), rtol=2e-3, atol=1e-4)
    assert np.linalg.norm(here) > 6e6

    unknown = np.diag([25.0, 25.0, 1e9, 1e9])[None]
    still = source(heading_sigma=0.1)
    table = rows(np.array([[1000.0, 0.0, 0.0, 0.0]]), unknown)
    grown = turned(table, still, SPACE, FRAME).covariance - table.covariance
    assert grown[1, 1, 0] == pytest.approx((0.1 * 1000.0) ** 2)
    assert not grown[2:].any()


def test_what_a_source_says_of_its_heading_and_place() -> None:
    one = source()
    assert heading_sigma_of(one) == 0.0
    assert place_of(Source("x", SPACE, empty_tracks(4))) is None
    one = source(heading_sigma=0.2, position=(1.0, 2.0, 3.0))
    assert heading_sigma_of(one) == 0.2
    assert place_of(one) is not None
    one.places = (Place(START, FRAME, schemas.Platform((7.0, 8.0, 9.0))),)
    place = place_of(one)
    assert place is not None
    assert (heading_sigma_of(one), place.platform.position) == (0.2, (7.0, 8.0, 9.0))
    one.places = (Place(START, FRAME, schemas.Platform((7.0, 8.0, 9.0), heading_sigma=0.0)),)
    assert heading_sigma_of(one) == 0.0
    empty = empty_tracks(4)
    assert turned(empty, source(heading_sigma=0.2), SPACE, FRAME) is empty


@pytest.mark.parametrize("period", [0.01, 0.2, 0.5, 1.0, 60.0])
def test_a_velocity_is_of_places_well_apart(period: float) -> None:
    places: tuple[Place, ...] = ()
    for k in range(300):
        places = followed(places, Place(START + round(k * period * SECOND), FRAME, schemas.Platform((0.0, 0.0, 0.0))))
    last = before(places)
    assert last is not None
    assert len(places) <= 3
    gap = (places[-1].time - last.time) / SECOND
    assert max(0.5, period) <= gap <= max(1.01 + period, period)
    assert followed(places, places[0]) is places


def test_coverage_goes_with_the_platform_and_stays_from_a_checkpoint() -> None:
    made = centre(())
    give(made, info("ship", coverage=schemas.Disk(1000.0), detection_probability=0.9))
    for t in range(1, 4):
        platform = schemas.Platform((5000.0 * t, 0.0, 0.0), heading=0.1, position_covariance=100.0 * np.eye(3))
        give(made, tracks("ship", t, np.array([[5000.0 * t, 10.0, 0.0, 0.0]]), sigma=SIGMA, platform=platform))
        step(made, t)
    for one in (made, FusionCentre({"lateness": 3.0}, made.checkpoint())):
        known = one._intake.sources["ship"]
        said = one._intake.sensor(known)
        assert said is not None
        places = np.array([[0.0, 15_000.0, 15_900.0, 16_100.0], [0.0, 0.0, 0.0, 0.0]])
        assert covers(said, places, FRAME).tolist() == [False, True, True, False]
        assert [place.time for place in known.places] == [START + t * SECOND for t in (1, 2, 3)]
        shift = known.places[-1].platform.position_covariance
        assert shift is not None
        assert shift.tolist() == (100.0 * np.eye(3)).tolist()
    picture = made.step(START + 4 * SECOND).tracks
    assert picture.covariances[0, 0, 0] >= 100.0 + SIGMA[0] ** 2, "the error of the place is in every row"


def test_a_source_with_an_error_of_heading_gives_no_tracklets() -> None:
    made = centre(("a", "b"))
    for t in range(1, 5):
        for name in ("a", "b"):
            platform = schemas.Platform((0.0, 0.0, 0.0), heading_sigma=0.01 if name == "a" else None)
            z = np.array([[1000.0, 10.0 * t, 0.0, 10.0]])
            give(made, tracks(name, t, z, sigma=SIGMA, platform=platform))
        sources = step(made, t).status.sources
    assert (sources["a"]["no_tracklets"], sources["b"]["no_tracklets"]) == ("registration", "")
