"""Sources that tell less, or more, than the state of the picture: in association, in life, in every frame."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, StepResult, partial
from fusion_service.centre.evidence import chi2_by_size
from fusion_service.centre.partial import SIGMA, Unknown, apart, predict_known
from fusion_service.geodesy import enu_to_geodetic, geodetic_to_ecef, geodetic_to_enu
from fusion_service.motion import predict
from fusion_service.rules import RULES
from schemas import UNKNOWN_SIGMA, Ecef, Enu, Height, Motion
from tests.centre.worlds import FRAME, SPACE, give, info, step, tracks
from tests.helpers.random_missions import narrowed

LONG = ("x", "y", "z", "vx", "vy", "vz")
PICTURE = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
STATE = np.array([1000.0, 2000.0, 3000.0, 60.0, -20.0, 1.0])


def sent(source: str, second: float, space: tuple[str, ...], sigma: Any, state: Any = STATE, **more: Any) -> Any:
    """One track with what `space` has of a state of LONG that moves on."""
    state = np.asarray(state, dtype=float)
    now = np.concatenate([state[:3] + second * state[3:], state[3:]])
    known = dict(zip(LONG, now, strict=True)) | {"ax": 0.0, "turn_rate": 0.01}
    means = np.array([[known[name] for name in space]])
    sigma = np.broadcast_to(np.asarray(sigma, dtype=float), (len(space),))
    message = tracks(source, second, np.zeros((0, 4)), [], **more)
    covariances = np.diag(sigma**2)[None]
    return dataclasses.replace(
        message, space=space, ids=np.array([7], dtype=np.uint64), means=means, covariances=covariances
    )


def variance(result: StepResult, name: str, row: int = 0) -> float:
    k = result.tracks.space.index(name)
    return float(result.tracks.covariances[row, k, k])


def unknown(result: StepResult) -> set[str]:
    """The components that the picture's only track does not know."""
    assert len(result.tracks.ids) == 1
    names = [name for name in result.tracks.space if name not in "xy"]
    return {name for name in names if np.sqrt(variance(result, name)) >= UNKNOWN_SIGMA[name]}


@pytest.mark.parametrize("rule", [name for name in RULES if name != "bar-shalom-campo"])
@pytest.mark.parametrize("memory", ["restart", "recursive"])
def test_places_alone_begin_confirm_and_keep_a_track_and_a_full_source_brings_velocity(rule: str, memory: str) -> None:
    options = {"samples": 500, "seed": 1} if rule in ("hmd-s", "gmd-s") else {}
    made = FusionCentre({"rule": rule, "rule_options": options, "memory": memory, "frame": PICTURE, "coast": 8.0})
    give(made, info("camera"), info("radar"))
    for second in range(1, 6):
        give(made, sent("camera", second, ("x", "y"), 10.0))
        alone = step(made, second)
    track = alone.tracks.ids.tolist()
    assert alone.tracks.status.tolist() == [schemas.messages.CONFIRMED]
    assert unknown(alone) == {"vx", "vy"}
    assert np.sqrt(variance(alone, "x")) == pytest.approx(10.0, rel=0.2)
    for second in range(6, 9):
        give(made, sent("camera", second, ("x", "y"), 10.0), sent("radar", second, SPACE, [40, 40, 2, 2]))
        both = step(made, second)
    assert both.tracks.ids.tolist() == track
    assert both.tracks.contributor_counts.tolist() == [2]
    assert unknown(both) == set()
    np.testing.assert_allclose(both.tracks.means[0], [1000 + 480, 2000 - 160, 60, -20], atol=1.0)
    for second in range(9, 14):  # the radar is gone, then the camera: it coasts, and does not explode
        give(made, *([sent("camera", second, ("x", "y"), 10.0)] if second < 12 else []))
        coasting = step(made, second)
    assert coasting.tracks.ids.tolist() == track
    assert np.sqrt(variance(coasting, "x")) < 1000.0
    assert schemas.encode(coasting.tracks)


def test_what_has_no_velocity_may_have_any_plausible_one() -> None:
    """Prediction in one step of 4 s or in 16: sigma^2 + (speed t)^2 + q t, the random walk of a place alone."""
    pad = Unknown.of(SPACE)
    mean, covariance = np.zeros((4, 1, 1)), np.zeros((4, 4, 1, 1))
    covariance[0, 0], covariance[1, 1], covariance[2, 2], covariance[3, 3] = 100.0, 400.0, pad.pad[2], pad.pad[3]
    for steps in (1, 16):
        x, P = mean, covariance
        for k in range(steps):
            dt, age = np.array([4.0 / steps]), np.array([k * 4.0 / steps])
            x, P = predict_known(Motion("cv", 2.0), SPACE, x, P, pad.known(P[:, :, 0]), dt, pad, 30.0, age)
        np.testing.assert_allclose(P[[0, 1], [0, 1], 0, 0], [100 + 120**2 + 8, 400 + 120**2 + 8], rtol=1e-12)
        assert (P[[2, 3], [2, 3], 0, 0] == pad.pad[2:]).all()
        assert (x == 0).all()


def test_each_density_moves_in_the_space_of_what_it_knows() -> None:
    """Three kinds in one batch, each as `predict` has it in its own space; bits as alone."""
    rng = np.random.default_rng(3)
    pad = Unknown.of(LONG)
    kinds = [(0, 1, 2, 3, 4, 5), (0, 1, 3, 4), (0, 1, 2)]
    mean, covariance = np.zeros((6, 1, 3)), np.zeros((6, 6, 1, 3))
    for b, kind in enumerate(kinds):
        A = rng.normal(size=(len(kind), len(kind)))
        mean[kind, 0, b] = rng.normal(size=len(kind)) * 100
        covariance[range(6), range(6), 0, b] = pad.pad
        covariance[np.ix_(kind, kind, [0], [b])] = (A @ A.T + np.eye(len(kind)))[:, :, None, None] * 100
    known = pad.known(covariance[:, :, 0])
    assert known.sum(axis=0).tolist() == [6, 4, 3]
    dt = np.array([1.0, 2.0, 0.5])
    x, P = predict_known(Motion("cv", 1.5), LONG, mean, covariance, known, dt, pad, 0.0)
    for b, kind in enumerate(kinds):
        some, names = np.ix_(kind, kind), tuple(LONG[k] for k in kind)
        own = predict(Motion("cv", 1.5), names, mean[kind, :, b], covariance[some][..., b], dt[b : b + 1])
        np.testing.assert_array_equal(x[kind, 0, b], own[0][:, 0])
        np.testing.assert_array_equal(P[some][..., 0, b], own[1][:, :, 0])


def test_distances_are_over_what_is_common() -> None:
    """d2 by a dense solve on the common components, its log det with a plausible value for each other one."""
    rng = np.random.default_rng(8)
    pad = Unknown.of(LONG, speed=50.0)
    A, B = (M @ M.T * 100 + np.eye(6) for M in rng.normal(size=(2, 6, 6)))
    flat = [0, 1, 3, 4]
    padded = np.diag(np.where(np.isin(np.arange(6), flat), 0.0, pad.pad))
    padded[np.ix_(flat, flat)] = B[np.ix_(flat, flat)]
    offset = rng.normal(size=6) * 20
    distance, spread, count = apart((A + padded)[:, :, None], offset[:, None], pad)
    S = (A + B)[np.ix_(flat, flat)]
    assert count.tolist() == [4]
    assert distance[0] == pytest.approx(offset[flat] @ np.linalg.solve(S, offset[flat]), rel=1e-6)
    assert spread[0] == pytest.approx(np.log(np.linalg.det(S)) + np.log(1e4**2) + np.log(50.0**2), rel=1e-9)
    assert chi2_by_size(0.999, 6)[count[0]] == pytest.approx(18.4668, abs=1e-3)  # chi-square, 4 degrees of freedom


def test_gates_have_the_degrees_of_freedom_in_common() -> None:
    """A camera's track at d2 = 15 of a radar's: beyond the gate of 2 components (13.8), within that of 4 (18.5)."""
    far = np.sqrt(15.0 * (10**2 + 10**2))
    for d2_of, joined in ((far, False), (far * np.sqrt(13.0 / 15.0), True)):
        made = FusionCentre({"frame": PICTURE, "manoeuvre": 0.0, "unknown_speed": 0.0})
        give(made, info("camera", motion=Motion("cv", 0.0)), info("radar", motion=Motion("cv", 0.0)))
        moved = STATE.copy()
        moved[0] += d2_of
        give(made, sent("camera", 1, ("x", "y"), 10.0, moved), sent("radar", 1, SPACE, [10, 10, 2, 2]))
        assert len(step(made, 1).tracks.ids) == (1 if joined else 2)


def test_no_decision_depends_on_the_size_of_the_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Crowded targets of two full sources and one of places: links and places with a padding ten times larger."""

    def fly() -> list[StepResult]:
        rng = np.random.default_rng(21)
        made = FusionCentre({"frame": PICTURE, "unknown_speed": 30.0})
        give(made, *(info(name) for name in ("a", "b", "c")))
        states = np.concatenate([rng.uniform(-400, 400, (12, 2)), rng.normal(0, 20, (12, 2))], axis=1)
        results = []
        for second in range(1, 11):
            now = states.copy()
            now[:, :2] += second * states[:, 2:]
            for name in ("a", "b", "c"):
                order = rng.permutation(12)[: 11 if name == "c" else 12]
                seen = tracks(name, second, (now + rng.normal(size=now.shape) * [30, 30, 2, 2])[order], order + 1)
                give(made, narrowed(seen, ("x", "y")) if name == "c" else seen)
            results.append(step(made, second))
        return results

    small = fly()
    monkeypatch.setattr(partial, "SIGMA", {name: 10.0 * sigma for name, sigma in SIGMA.items()})
    large = fly()
    for one, other in zip(small, large, strict=True):
        for column in ("kind", "track", "source", "id"):
            left, right = (getattr(result.log.decisions, column) for result in (one, other))
            np.testing.assert_array_equal(left, right)
        np.testing.assert_allclose(one.tracks.means[:, :2], other.tracks.means[:, :2], atol=1e-4)
    assert (small[-1].tracks.contributor_counts == 3).sum() >= 9


def test_a_row_of_places_goes_to_the_nearest_of_two_whatever_they_know() -> None:
    """A full track and one of places alone, 100 m to either side: of a third source's places each gets its own."""
    made = FusionCentre({"frame": PICTURE})
    give(made, *(info(name) for name in ("camera", "radar", "lidar")))
    left, right = STATE.copy(), STATE.copy()
    left[0], right[0] = -60.0, 60.0
    for second in range(1, 8):
        give(made, sent("camera", second, ("x", "y"), 20.0, left), sent("radar", second, SPACE, [20, 20, 2, 2], right))
        if second > 3:
            ids = [5, 6]
            pair = [sent("lidar", second, ("x", "y"), 20.0, one) for one in (left, right)]
            means, covariances = (
                np.concatenate([getattr(one, name) for one in pair]) for name in ("means", "covariances")
            )
            give(
                made,
                dataclasses.replace(pair[0], ids=np.array(ids, dtype=np.uint64), means=means, covariances=covariances),
            )
        result = step(made, second)
    assert result.tracks.contributor_counts.tolist() == [2, 2]
    assert sorted(result.tracks.means[:, 0].round().tolist()) == [360.0, 480.0]


def test_sources_that_tell_different_parts_make_the_whole() -> None:
    """A 2-D radar, an altimeter with places, and a camera: one track with all of it but vz."""
    for rule in ("ci", "naive", "ici", "hmd-ga", "aa"):
        made = FusionCentre({"frame": PICTURE, "space": list(LONG), "rule": rule})
        give(made, *(info(name) for name in ("camera", "height", "radar")))
        for second in range(1, 5):
            give(
                made,
                sent("camera", second, ("x", "y"), 10.0),
                sent("height", second, ("y", "z", "x"), [50.0, 20.0, 50.0]),
                sent("radar", second, SPACE, [30, 30, 2, 2]),
            )
            result = step(made, second)
        assert result.tracks.contributor_counts.tolist() == [3], rule
        assert unknown(result) == {"vz"}
        np.testing.assert_allclose(result.tracks.means[0], [1240, 1920, 3004, 60, -20, 0], atol=1e-3)
        assert np.sqrt(variance(result, "z")) < 60
        influence = result.tracks.contributor_influence
        assert influence.sum() == pytest.approx(1.0)
        note = result.status.sources["camera"]["note"]
        assert (note == "") is RULES[rule].information
        assert result.status.sources["radar"]["note"] == note.replace("no z vx vy vz", "no z vz")


def test_more_components_are_marginalised() -> None:
    made = FusionCentre({"frame": PICTURE})
    give(made, info("a"), info("b"))
    for second in range(1, 4):
        long = sent("a", second, ("ax", "x", "vx", "turn_rate", "y", "vy", "z"), [1, 30, 2, 0.1, 30, 2, 9])
        give(made, long, sent("b", second, SPACE, [30, 30, 2, 2]))
        result = step(made, second)
    assert result.tracks.contributor_counts.tolist() == [2]
    np.testing.assert_allclose(result.tracks.means[0], [1180, 1940, 60, -20], atol=1e-6)


def test_mixtures_without_velocity() -> None:
    """A source of places with two components, alone (kept), and with a full one, by a mixture rule and by moments."""
    for mixture_rule in ("moments", "gm-ga", "aa"):
        made = FusionCentre({"frame": PICTURE, "mixture_rule": mixture_rule})
        give(made, info("camera"), info("radar"))
        for second in range(1, 7):
            one = sent("camera", second, ("x", "y"), 15.0)
            means = one.means + np.array([[-20.0, 0.0], [20.0, 0.0]])
            both = dataclasses.replace(
                one, means=means, covariances=np.repeat(one.covariances, 2, axis=0),
                counts=np.array([2], dtype=np.uint16), weights=np.array([0.5, 0.5]),
            )  # fmt: skip
            give(made, both, *([sent("radar", second, SPACE, [40, 40, 2, 2])] if second > 3 else []))
            result = step(made, second)
            if second == 3:
                assert result.tracks.counts is not None
                assert result.tracks.counts.tolist() == [2]
        assert result.tracks.contributor_counts.tolist() == [2]
        mean = np.average(result.tracks.means, axis=0, weights=result.tracks.weights)
        np.testing.assert_allclose(mean, [1360, 1880, 60, -20], atol=1.0)
        assert (result.tracks.covariances[:, 2, 2] < 15**2).all()


def test_a_vague_component_is_one_that_is_not_told() -> None:
    """A client that pads its velocity itself, beyond what can be, is as one that leaves it out."""
    pictures = []
    for told in (("x", "y"), SPACE):
        made = FusionCentre({"frame": PICTURE})
        give(made, info("camera"), info("radar"))
        for second in range(1, 4):
            at = second - 0.5  # so that it is predicted
            give(made, sent("camera", at, told, [10, 10, 1e5, 1e5][: len(told)], seq=second))
            give(made, sent("radar", second, SPACE, [40, 40, 2, 2]))
            result = step(made, second)
        pictures.append(result.tracks)
    np.testing.assert_allclose(pictures[0].means, pictures[1].means, rtol=1e-12)
    np.testing.assert_allclose(pictures[0].covariances, pictures[1].covariances, rtol=1e-12)


def there(second: float) -> tuple[np.ndarray, float]:
    """The target's place in FRAME at a time, and its altitude."""
    now = STATE[:3] + second * STATE[3:]
    return now, float(np.asarray(enu_to_geodetic(now[0], now[1], now[2], FRAME)[2]))


def test_a_stated_height_with_a_sigma_is_information() -> None:
    """A radar 40 km away with height 3000 +- 100 m above the ellipsoid: z in the picture, curvature and all."""
    site = Enu(FRAME.lat + 0.3, FRAME.lon + 0.3)
    for sigma, knows in ((0.0, False), (100.0, True)):
        made = FusionCentre({"frame": PICTURE, "space": list(LONG)})
        give(made, info("radar", frame=site))
        for second in range(1, 4):
            place, altitude = there(second)
            own = geodetic_to_enu(*enu_to_geodetic(place[0], place[1], place[2], FRAME), site)
            message = sent("radar", second, ("x", "y"), 30.0)
            message = dataclasses.replace(
                message, means=np.array([[own[0], own[1]]]), frame=site, height=Height(altitude, sigma)
            )
            give(made, message)
            result = step(made, second)
        np.testing.assert_allclose(result.tracks.means[0, :2], place[:2], atol=1e-3)
        if knows:
            assert result.tracks.means[0, 2] == pytest.approx(place[2], abs=1e-3)
            assert np.sqrt(variance(result, "z")) == pytest.approx(100.0, rel=1e-3)
            assert unknown(result) == {"vx", "vy", "vz"}
        else:
            assert unknown(result) == {"z", "vx", "vy", "vz"}


def test_a_flat_source_in_an_ecef_picture() -> None:
    """A 2-D radar beside one with height: one track, in which height is the other's and the plane of both."""
    made = FusionCentre({"frame": {"kind": "ecef"}, "space": list(LONG)})
    site = Enu(FRAME.lat + 0.1, FRAME.lon - 0.1)
    give(made, info("adsb"), info("radar", frame=site))
    for second in range(1, 6):
        place, _ = there(second)
        own = geodetic_to_enu(*enu_to_geodetic(place[0], place[1], place[2], FRAME), site)
        flat = sent("radar", second, SPACE, [20, 20, 2, 2])
        flat = dataclasses.replace(flat, means=np.array([[own[0], own[1], *STATE[3:5]]]), frame=site)
        give(made, sent("adsb", second, LONG, [60, 60, 30, 4, 4, 4]), flat)
        result = step(made, second)
    assert result.tracks.contributor_counts.tolist() == [2], result.status.refused
    place, _ = there(5)
    truth = np.array(geodetic_to_ecef(*enu_to_geodetic(place[0], place[1], place[2], FRAME)))
    # its height above the ellipsoid is unknown to the radar: 0 +- 10 km, and moves the place by little
    np.testing.assert_allclose(result.tracks.means[0, :3], truth, atol=2.0)
    up = truth / np.linalg.norm(truth)
    P = result.tracks.covariances[0, :3, :3]
    assert np.sqrt(up @ P @ up) < 60
    assert np.sqrt(np.trace(P) - up @ P @ up) < 60 * np.sqrt(2)


def test_ecef_without_z_is_refused_with_a_note() -> None:
    made = FusionCentre({"frame": {"kind": "ecef"}, "space": list(LONG)})
    give(made, info("a"), dataclasses.replace(sent("a", 1, ("x", "y"), 30.0), frame=Ecef()))
    result = step(made, 1)
    assert result.status.refused == {"frame": 1}
    assert "needs z" in result.status.sources["a"]["note"]


def test_an_unknown_height_does_not_spill_over_when_a_picture_is_heard_by_another_centre() -> None:
    """The picture of a centre in one frame as the tracks of a source of another, with z padded."""
    first = FusionCentre({"name": "first", "frame": PICTURE, "space": list(LONG)})
    other = FusionCentre({"name": "second", "frame": {"kind": "enu", "lat": 59.5, "lon": -54.0}, "space": list(LONG)})
    give(first, info("radar"))
    give(other, info("first"))
    for second in range(1, 4):
        give(first, sent("radar", second, SPACE, [20, 20, 2, 2]))
        picture = step(first, second).tracks
        heard = dataclasses.replace(
            sent("first", second, LONG, 1.0), means=picture.means, covariances=picture.covariances
        )
        give(other, heard)
        result = step(other, second)
    assert unknown(result) == {"z", "vz"}
    assert np.sqrt(variance(result, "x")) == pytest.approx(20.0, rel=0.05)


def test_a_checkpoint_goes_on_with_partial_tracks() -> None:
    results = []
    for broken in (False, True):
        made = FusionCentre({"frame": PICTURE, "space": list(LONG), "memory": "recursive"})
        give(made, info("camera"), info("radar"))
        for second in range(1, 9):
            give(made, sent("camera", second, ("x", "y"), 10.0))
            if second % 3:
                give(made, sent("radar", second, SPACE, [30, 30, 2, 2]))
            last = step(made, second)
            if broken and second in (4, 6):
                made = FusionCentre(made.config, made.checkpoint())
        results.append(last.tracks)
    np.testing.assert_array_equal(results[0].means, results[1].means)
    np.testing.assert_array_equal(results[0].covariances, results[1].covariances)


@pytest.mark.parametrize("seed", range(3))
def test_better_than_the_full_source_and_honest(seed: int) -> None:
    """200 targets' worth of errors: sigma of places 40 m (full) and 10 m (places alone). For CI the fused place is
    no worse than the better, and NEES over place is not above its dimension."""
    rng = np.random.default_rng(seed)
    print("seed", seed)
    count = 200
    states = np.concatenate([np.arange(count)[:, None] * [3000.0, 0.0], rng.normal(0, 30, (count, 2))], axis=1)
    made = FusionCentre({"frame": PICTURE, "rule_options": {"criterion": "trace"}})
    give(made, info("camera", motion=Motion("cv", 0.0)), info("radar", motion=Motion("cv", 0.0)))
    for second in range(1, 6):
        now = states.copy()
        now[:, :2] += second * states[:, 2:]
        full = tracks(
            "radar", second, now + rng.normal(size=now.shape) * [40, 40, 2, 2], sigma=np.array([40.0, 40, 2, 2])
        )
        place = tracks(
            "camera", second, now + rng.normal(size=now.shape) * [10, 10, 2, 2], sigma=np.array([10.0, 10, 2, 2])
        )
        give(made, full, narrowed(place, ("x", "y")))
        picture = step(made, second).tracks
    assert (picture.contributor_counts == 2).all()
    order = np.argsort(picture.means[:, 0])
    errors = picture.means[order] - now[np.argsort(now[:, 0])]
    place_rms = np.sqrt(np.mean(errors[:, :2] ** 2))
    assert place_rms < 10.5
    P = picture.covariances[order]
    nees = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(P), errors).mean() / 4
    assert nees < 1.1
