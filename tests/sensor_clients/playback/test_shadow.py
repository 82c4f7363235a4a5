"""Shadows, hulls and wakes: by polygons and by hand; what a tracker makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_clients.filters.measurement import Floats
from sensor_clients.playback.harbour import RADAR, HarbourTracker
from sensor_clients.playback.hulls import Hulls
from sensor_clients.playback.shadow import Shade, Shadows, cast

SHADE = Shade(length=36.0, beam=10.0, wake=60.0, width=0.0, seen=0.3)
SECOND = 10**9


def shadows(means: Floats, own: tuple[float, float] = (0.0, 0.0), shade: Shade = SHADE, sigma: float = 0.0) -> Shadows:
    covariances = np.zeros((4, 4, means.shape[1]))
    covariances[2, 2] = covariances[3, 3] = sigma**2
    return cast(np.array(own), means, covariances, shade)


def silhouette(mean: Floats, own: Floats) -> float:
    """The angle that the rectangle of a vessel covers, seen from so far that its corners are at one range."""
    course = mean[2:] / np.hypot(*mean[2:])
    sight = mean[:2] - own
    r = np.hypot(*sight)
    across = np.array([-sight[1], sight[0]]) / r
    corners = [a * course * 18 + b * np.array([-course[1], course[0]]) * 5 for a in (-1, 1) for b in (-1, 1)]
    seen = [float(corner @ across) for corner in corners]
    return float((max(seen) - min(seen)) / r)


def test_a_shadow_is_as_wide_as_the_rectangle_seems() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        own = rng.uniform(-100, 100, 2)
        mean = np.concatenate(
            [own + rng.uniform(100, 300) * np.array([np.sin(a := rng.uniform(0, 7)), np.cos(a)]), rng.normal(size=2)]
        )
        made = shadows(mean[:, None], tuple(own))
        assert 2 * made.half[0] == pytest.approx(silhouette(mean, own), rel=1e-9), "seed 1"


def test_what_is_behind_is_hidden_and_nothing_else() -> None:
    abeam = shadows(np.array([[0.0], [100.0], [3.0], [0.0]]))  # goes east, 100 m north: 36 m wide
    places = np.array([[0.0, 0.0, 50.0, 30.0, 0.0, 0.0], [200.0, 90.0, 200.0, 200.0, -200.0, 110.0]])
    assert abeam.over(places).tolist() == [True, False, False, True, False, False]
    ahead = shadows(np.array([[0.0], [100.0], [0.0], [3.0]]))  # end on: 10 m wide
    assert ahead.over(places).tolist() == [True, False, False, False, False, False]
    assert shadows(np.array([[0.0], [100.0], [0.0], [3.0]]), sigma=6.0).over(places)[3], "who knows how it lies"


def test_north_is_no_seam() -> None:
    """Bearings to either side of south, where atan2 jumps."""
    made = shadows(np.array([[0.5], [-100.0], [3.0], [0.0]]))
    assert made.over(np.array([[-5.0, 5.0], [-200.0, -200.0]])).all()


def test_hull_and_wake_follow_the_course() -> None:
    made = shadows(np.array([[0.0], [0.0], [0.0], [4.0]]), own=(500.0, 0.0))  # goes north
    along = np.array([[0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 30.0, 40.0, -50.0, -70.0]])
    assert made.part(along).tolist() == [False, True, False, True, False], "itself, bow, ahead, wake, behind the wake"
    abeam = np.array([[15.0, -15.0, 26.0, 40.0], [0.0, 0.0, -50.0, -50.0]])
    # 50 m behind, Kelvin's angle opens by 50 tan 19.47 deg = 17.7 m beyond 10 m.
    assert made.part(abeam).tolist() == [False, False, True, False], "a boat abeam is another boat"


def test_nobody_hides_nothing() -> None:
    made = shadows(np.zeros((4, 0)))
    assert not made.unproven(np.zeros((2, 3))).any()
    assert made.unproven(np.zeros((2, 0))).shape == (0,)


def follow(second_one: list[tuple[float, float]]) -> list[list[float]]:
    """A ship that goes east 100 m north of a radar, and at each scan a return where `second_one` says: the x of the
    tracks that are reported at each scan."""
    tracker, out = HarbourTracker(RADAR), []
    for k, other in enumerate(second_one):
        t = k * RADAR.period
        ship = np.array([-80.0 + 2.5 * t, 100.0])
        returns = np.stack([ship, np.array(other)], axis=1)
        tracker.step(round(t * SECOND), np.zeros(2), returns)
        out.append(sorted(tracker.report(round(t * SECOND)).means[:, 0].tolist()))
    return out


def test_an_echo_that_goes_round_behind_a_ship_is_no_vessel() -> None:
    """It begins when the ship is known: an echo that is found before its ship is not known for one."""
    echo = [(2.5 * (-80.0 + 2.5 * k * RADAR.period), 250.0) if k >= 10 else (1e4, 1e4) for k in range(40)]
    reported = follow(echo)
    assert all(len(tracks) == 1 for tracks in reported[10:])


def test_a_boat_beside_the_shadow_is_found_and_kept_when_it_goes_behind_the_ship() -> None:
    """For so long that its place stays sure enough (`max_sigma`)."""
    times = np.arange(40) * RADAR.period
    boat = [(100.0 - 4.0 * t, 220.0) for t in times.tolist()]
    hidden = [abs(x / 220.0 - (-80.0 + 2.5 * t) / 100.0) < 0.08 for (x, _), t in zip(boat, times.tolist(), strict=True)]
    assert 1 <= sum(hidden) <= 3
    unseen = [(1e4, 1e4) if behind else place for place, behind in zip(boat, hidden, strict=True)]
    reported = follow(unseen)
    assert all(len(tracks) == 2 for tracks in reported[10:])


def test_a_length_is_learned_from_bow_and_stern_and_lies_along_the_course() -> None:
    rng = np.random.default_rng(2)
    hulls, ids = Hulls(36.0, 7.0), np.array([4, 9])
    means = np.array([[0.0, 200.0], [0.0, 0.0], [3.0, 0.0], [4.0, 2.0]])
    u = np.array([0.6, 0.8])
    for _ in range(100):
        points = np.stack([u * rng.choice([-12.0, 12.0]), u * 12.0, means[:2, 1]], axis=1)
        hulls.learn(ids, means, points)
    ship, boat = hulls.lengths(ids)
    assert 18.0 < ship <= 24.0, "seed 2: a span of 24 m in half of the scans"
    assert boat == 0.0
    np.testing.assert_allclose(hulls.reference(ids, means)[..., 0], ship**2 / 12 * np.outer(u, u))
    hulls.learn(ids[1:], means[:, 1:], np.zeros((2, 0)))
    assert hulls.lengths(ids).tolist() == [0.0, 0.0], "a track that is gone is forgotten"
    hulls.learn(ids[:0], means[:, :0], np.zeros((2, 3)))
