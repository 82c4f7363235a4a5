"""Bearings as Gaussians and mixtures: their moments, what the wire says of them, and positions made of two of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.config import centre_config
from fusion_service.rules import RULES, fuse
from schemas import LocalTracks, Motion
from sensor_clients.bearings import THINNEST, along_sight, by_range
from tests.centre.worlds import FRAME, START, give, info, step, tracks

PICTURE = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
WEST, EAST = np.array([-5000.0, 0.0]), np.array([5000.0, 0.0])
SIGMA = math.radians(0.1)


def seen(origin: np.ndarray, targets: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    away = targets - origin
    return np.asarray(np.arctan2(away[:, 0], away[:, 1]) + rng.normal(size=len(targets)) * SIGMA)


def message(source: str, second: float, kind: str, origin: np.ndarray, bearings: np.ndarray) -> LocalTracks:
    parts: dict[str, Any] = {"space": ("x", "y"), "ids": np.arange(1, len(bearings) + 1).astype(np.uint64)}
    if kind == "along":
        parts["means"], parts["covariances"] = along_sight(origin, bearings, SIGMA, 100.0, 30_000.0)
    else:
        bank = by_range(origin, bearings, SIGMA, 100.0, 30_000.0)
        parts |= {"counts": bank.counts, "weights": bank.weights}
        parts |= {"means": bank.means, "covariances": bank.covariances}
    header = {key: getattr(tracks(source, second, []), key) for key in ("source", "epoch", "seq", "sent", "frame")}
    return schemas.decode(
        schemas.encode(LocalTracks(**header, time=START + round(second * 1e9), complete=True, **parts))
    )  # type: ignore[return-value]


def test_the_moments_are_those_of_ranges_drawn() -> None:
    """Against 400,000 draws of range: mean and spread along the line of sight; across it the sigma at the far end."""
    rng = np.random.default_rng(4)
    bearing, near, far = 0.7, 500.0, 9000.0
    mean, P = along_sight([10.0, 20.0], bearing, 0.01, near, far)
    u, v = np.array([np.sin(0.7), np.cos(0.7)]), np.array([np.cos(0.7), -np.sin(0.7)])
    ranges = rng.uniform(near, far, 400_000)
    assert (mean[0] - [10, 20]) @ u == pytest.approx(ranges.mean(), rel=0.003)
    assert np.sqrt(u @ P[0] @ u) == pytest.approx(ranges.std(), rel=0.003)
    assert np.sqrt(v @ P[0] @ v) == pytest.approx(90.0)
    bank = by_range([10.0, 20.0], bearing, 0.01, near, far, 12)
    logs = np.exp(rng.uniform(np.log(near), np.log(far), 400_000))  # uniform in the logarithm, nearly
    along = (bank.means - [10, 20]) @ u
    assert bank.weights @ along == pytest.approx(logs.mean(), rel=0.01)
    second = bank.weights @ (along**2 + np.einsum("i,cij,j->c", u, bank.covariances, u))
    assert second == pytest.approx(np.mean(logs**2), rel=0.02)
    assert np.abs((bank.means - [10, 20]) @ v).max() < 1e-9


def test_any_number_of_bearings_at_once() -> None:
    bearings, origins = np.array([0.0, 1.0, -2.0]), np.arange(6.0).reshape(3, 2)
    means, covariances = along_sight(origins, bearings, [0.01, 0.02, 0.03], 0.0, 1000.0)
    bank = by_range(origins, bearings, [0.01, 0.02, 0.03], 1.0, 1000.0, 5)
    assert bank.counts.tolist() == [5, 5, 5]
    for k in range(3):
        one = along_sight(origins[k], bearings[k], [0.01, 0.02, 0.03][k], 0.0, 1000.0)
        np.testing.assert_array_equal(means[k], one[0][0])
        np.testing.assert_array_equal(covariances[k], one[1][0])
        own = by_range(origins[k], bearings[k], [0.01, 0.02, 0.03][k], 1.0, 1000.0, 5)
        np.testing.assert_array_equal(bank.means[5 * k : 5 * k + 5], own.means)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"sigma": 0.0}, "sigma"), ({"bearing": math.nan}, "finite"), ({"far": 10.0}, "far"), ({"near": -1.0}, "near")],
)
def test_what_fits_no_target_is_refused(change: dict[str, float], word: str) -> None:
    given: dict[str, Any] = {"bearing": 0.1, "sigma": 0.01, "near": 100.0, "far": 1000.0} | change
    for make in (along_sight, by_range):
        with pytest.raises(ValueError, match=word):
            make([0.0, 0.0], **given)
    with pytest.raises(ValueError, match="near"):
        by_range([0.0, 0.0], 0.1, 0.01, 0.0, 1000.0)


@pytest.mark.parametrize("rule", [name for name, rule in RULES.items() if rule.information and name[0] != "b"])
def test_the_thinnest_line_is_sound_in_every_rule(rule: str) -> None:
    """Two lines, a million times as long as wide, that cross at right angles far off: the crossing, to a thousandth of
    its sigma, in any direction."""
    for turn in (0.0, 0.3, 0.785398, 1.2):
        angle = np.array([turn, turn + np.pi / 2])
        sight = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        target = np.array([4e5, -3e5])
        origin = target - sight * [[2e5], [7e5]]
        means, covariances = along_sight(origin, angle, 1e-12, 0.0, 3.0e6)
        thin = 3.0e6 / math.sqrt(12) * THINNEST
        assert np.sqrt(np.linalg.eigvalsh(covariances)[:, 0]) == pytest.approx([thin, thin], rel=1e-3)
        out = fuse(rule, means, covariances)
        sigma = np.sqrt(np.diag(out.covariance))
        assert (sigma < 1.6 * thin).all()
        assert (np.abs(out.mean - target) < 0.01 * sigma).all()


def test_the_thinnest_line_passes_the_border() -> None:
    bearings = np.linspace(-3.1, 3.1, 60)
    means, covariances = along_sight([0.0, 0.0], bearings, 1e-15, 0.0, 1e7)
    made = tracks("df", 1, np.zeros((60, 4)))
    sent = LocalTracks(
        source="df", epoch=1, seq=1, sent=START, time=made.time, complete=True, space=("x", "y"), frame=FRAME,
        ids=made.ids, means=means, covariances=covariances,
    )  # fmt: skip
    assert not schemas.check_numbers([sent])[0].any()
    centre = FusionCentre({"frame": PICTURE})
    give(centre, info("df", period=1.0), sent)
    result = step(centre, 1)
    assert result.status.refused == {}
    assert len(result.tracks.ids) == 60


@pytest.mark.parametrize("kind", ["along", "bank"])
@pytest.mark.parametrize("mixture_rule", ["moments", "gm-ga"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_two_bearings_make_a_position(kind: str, mixture_rule: str, seed: int) -> None:
    """One target that moves, two direction finders: triangulated within a few sigma, alive, and honest."""
    rng = np.random.default_rng(seed)
    print("seed", seed)
    centre = FusionCentre({"frame": PICTURE, "mixture_rule": mixture_rule})
    give(centre, *(info(name, motion=Motion("cv", 1.0)) for name in ("west", "east")))
    ids, far = set(), []
    for second in range(1, 31):
        target = np.array([[2000.0 - 20 * second, 9000.0 + 15 * second]])
        for name, origin in (("west", WEST), ("east", EAST)):
            give(centre, message(name, second, kind, origin, seen(origin, target, rng)))
        picture = step(centre, second).tracks
        assert picture.contributor_counts.tolist() == [2]
        ids |= set(picture.ids.tolist())
        w = np.ones(1) if picture.weights is None else picture.weights
        mean = w @ picture.means[:, :2]
        apart = picture.means[:, :2] - mean
        P = np.einsum("c,cij->ij", w, picture.covariances[:, :2, :2] + apart[:, :, None] * apart[:, None])
        far.append((mean - target[0]) @ np.linalg.solve(P, mean - target[0]))
        # rays of 11 km that cross at 55 degrees: some 30 m; a line alone is 9 km long
        assert np.linalg.norm(mean - target[0]) < 6 * 11_000 * SIGMA / math.sin(math.radians(55)) * 2
    assert len(ids) == 1
    assert np.mean(far) < 2.5
    assert picture.status.tolist() == [schemas.messages.CONFIRMED]


def test_two_targets_that_two_direction_finders_see_far_apart() -> None:
    """With the limits of range known, the two right crossings of four are within them: targets near either sensor.
    The ghosts lie beyond."""
    rng = np.random.default_rng(3)
    centre = FusionCentre(centre_config({"frame": PICTURE}))
    give(centre, info("west"), info("east"))
    targets = np.array([[-4000.0, 6000.0], [4000.0, 6000.0]])
    for second in range(1, 11):
        now = targets + second * np.array([[5.0, 5.0], [-5.0, 5.0]])
        for name, origin in (("west", WEST), ("east", EAST)):
            bearings = seen(origin, now, rng)
            parts = along_sight(origin, bearings, SIGMA, 5000.0, 13_000.0)
            own = message(name, second, "along", origin, bearings)
            give(centre, LocalTracks(**{
                **{key: getattr(own, key) for key in ("source", "epoch", "seq", "sent", "time", "complete", "space",
                                                      "frame", "ids")},
                "means": parts[0], "covariances": parts[1],
            }))  # fmt: skip
        picture = step(centre, second).tracks
    assert picture.contributor_counts.tolist() == [2, 2]
    order = np.argsort(picture.means[:, 0])
    assert (np.linalg.norm(picture.means[order, :2] - now, axis=1) < 150).all()


def test_a_line_helps_a_sharp_track() -> None:
    """A radar that is poor across its own line of sight, and a camera's bearing across that: better than either."""
    rng = np.random.default_rng(9)
    centre = FusionCentre({"frame": PICTURE})
    give(centre, info("radar"), info("west"))
    errors = []
    for second in range(1, 41):
        target = np.array([[0.0, 10_000.0 + 10 * second]])
        state = np.array([[target[0, 0], target[0, 1], 0.0, 10.0]])
        sigma = np.array([200.0, 20.0, 5.0, 5.0])
        give(centre, tracks("radar", second, state + rng.normal(size=(1, 4)) * sigma, [1], sigma=sigma))
        give(centre, message("west", second, "along", WEST, seen(WEST, target, rng)))
        picture = step(centre, second).tracks
        assert picture.contributor_counts.tolist() == [2]
        errors.append(picture.means[0, 0] - target[0, 0])
    assert np.sqrt(np.mean(np.square(errors))) < 60.0
