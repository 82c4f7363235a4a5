"""What a centre remembers of its targets: whatever else changes beside the filters, the picture is what they say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.partial import Unknown
from tests.centre.test_random_missions import check_mission
from tests.centre.test_tracklets import Kalman, World, ways
from tests.centre.worlds import FRAME, SECOND, START, info, tracks
from tests.helpers import tracker_missions

NOW = 4 * 10**18
FOLLOWING: list[dict[str, Any]] = [
    {"memory": "tracklet"},
    {"memory": "restart", "rule": "auto"},
    {"memory": "restart", "rule": "bci", "rule_options": {"max_correlation": "derived"}},
    {"memory": "restart", "rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}},
]


def tracked(world: World, first: int, last: int) -> schemas.GlobalTracks:
    for t in range(first, last):
        world.move(float(t))
        world.hear(*(world.look(name) for name in world.filters))
        picture = world.step(float(t))
    return picture


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 8))])
def test_any_mission_of_trackers(seed: int) -> None:
    print("seed", seed)
    check_mission(tracker_missions.fly(seed), seed)


def test_these_missions_hold_what_they_should() -> None:
    by, why = set[str](), set[str]()
    for seed in range(8):
        for result in tracker_missions.fly(seed).results:
            by |= ways(result.tracks) if len(result.tracks.ids) else set()
            why |= {str(said["no_tracklets"]) for said in result.status.sources.values() if "no_tracklets" in said}
    assert by >= {"tracklet", "ci", "bci"}
    assert why >= {"", "feedback", "innovations", "space", "motion", "registration"}


@pytest.mark.parametrize("config", FOLLOWING)
def test_versions_where_nothing_is_tracked_yet(config: dict[str, Any]) -> None:
    made = FusionCentre({"frame": FRAME, **config})
    made.handle(info("a", may_start=False), NOW)
    for second in range(1, 5):
        made.handle(tracks("a", second, [[0, 0, 0, 0]]), NOW)
        assert len(made.step(START + second * SECOND).tracks.ids) == 0


@pytest.mark.parametrize("config", FOLLOWING)
def test_what_tracks_are_fused_by_can_be_sent(config: dict[str, Any]) -> None:
    world = World({"a": 8.0, "b": 13.0}, **config)
    for name in world.filters:
        world.say(name)
    picture = tracked(world, 1, 25)
    assert ways(picture) & {"tracklet", "bci derived", "bar-shalom-campo derived"}
    again = schemas.decode(schemas.encode(picture))
    assert isinstance(again, schemas.GlobalTracks)
    assert again.rules == picture.rules
    assert ways(again) == ways(picture)


@pytest.mark.parametrize("space", [("x", "vx", "y", "vy"), ("vy", "y", "x", "vx"), ("x", "y", "z", "turn_rate")])
def test_a_config_with_as_many_components_that_are_others(space: tuple[str, ...]) -> None:
    """Filters and pairs of the checkpoint are in its space, whose size says nothing."""
    for config in FOLLOWING:
        world = World({"a": 8.0, "b": 13.0}, **config)
        for name in world.filters:
            world.say(name)
        tracked(world, 1, 12)
        world.centre = FusionCentre({**_plain(world.centre), "space": list(space)}, world.centre.checkpoint())
        picture = tracked(world, 12, 14)
        at = [space.index("x"), space.index("y")]
        order = np.argsort(picture.means[:, at[0]])
        assert len(order) == len(world.x)
        assert np.abs(picture.means[order][:, at] - world.x[:, :2]).max() < 60.0


def _plain(made: FusionCentre) -> dict[str, Any]:
    own = made.config
    some = {"memory": own.memory, "rule": own.rule, "rule_options": dict(own.rule_options), "frame": FRAME}
    return {**some, "coast": own.coast, "stale_periods": own.stale_periods}


@pytest.mark.parametrize("config", [*FOLLOWING, {"rule": "ci"}, {"memory": "recursive"}])
def test_any_other_config_goes_on_from_any_checkpoint(config: dict[str, Any]) -> None:
    for before in FOLLOWING:
        world = World({"a": 8.0, "b": 13.0}, **before)
        for name in world.filters:
            world.say(name)
        tracked(world, 1, 8)
        plain = {**_plain(world.centre), "rule": "ci", "rule_options": {}, "memory": "restart", **config}
        world.centre = FusionCentre(plain, world.centre.checkpoint())
        picture = tracked(world, 8, 12)
        if not world.centre.config.by_tracklets:
            assert len(world.centre._memory.filters.id) == 0
        order = np.argsort(picture.means[:, 0])
        assert np.abs(picture.means[order, :2] - world.x[:, :2]).max() < 40.0


def test_a_filter_that_was_put_down_is_not_taken_up_again() -> None:
    """A checkpoint of a centre without tracklets, made of one with them: what that one knew is long past."""
    world = World({"a": 8.0, "b": 13.0})
    for name in world.filters:
        world.say(name)
    tracked(world, 1, 8)
    plain = _plain(world.centre)
    world.centre = FusionCentre({**plain, "memory": "restart"}, world.centre.checkpoint())
    tracked(world, 8, 30)
    world.centre = FusionCentre(plain, world.centre.checkpoint())
    world.t = 30.0
    picture = world.step(30.0)
    assert np.diagonal(picture.covariances, axis1=1, axis2=2)[:, :2].max() < 200.0


def test_a_configured_motion_wins_over_one_that_was_declared_before() -> None:
    world = World({"a": 8.0, "b": 13.0})
    for name in world.filters:
        world.say(name)
    tracked(world, 1, 8)
    variances = []
    for more in ({}, {"motion": {"kind": "cv", "q": 500.0}}):
        made = FusionCentre({**_plain(world.centre), **more}, world.centre.checkpoint())
        variances.append(made.step(10 * SECOND).tracks.covariances[0, 0, 0])
    assert variances[1] > variances[0] + 0.9 * 499.0 * 3**3 / 3


def test_a_track_that_was_a_mixture_is_what_its_filter_says() -> None:
    made = FusionCentre({"memory": "tracklet", "mixture_rule": "gm-ga", "frame": FRAME})
    rng, filters = np.random.default_rng(3), {"a": Kalman(30.0, 1.0), "b": Kalman(30.0, 1.0)}
    for name in "abc":
        made.handle(info(name), NOW)
    counts = []
    for second in range(1, 20):
        for name, one in filters.items():
            if name == "a" or second >= 10:
                one.take(float(second), rng.normal(0, 30, (1, 2)))
                made.handle(replace(tracks(name, second, one.x), covariances=one.P[None].copy()), NOW)
        two = replace(
            tracks("c", second, [[20.0, 0, 0, 0], [-20.0, 0, 0, 0]]), ids=np.ones(1, dtype=np.uint64),
            counts=np.full(1, 2, dtype=np.uint16), weights=np.full(2, 0.5),
        )  # fmt: skip
        made.handle(two, NOW)
        picture = made.step(START + second * SECOND).tracks
        counts.append(None if picture.counts is None else picture.counts.tolist())
        assert len(picture.ids) == 1
        if second >= 10:
            assert ways(picture) == {"tracklet"}
            assert np.array_equal(picture.means[0], made._picture.mean[:, 0])
            assert np.array_equal(picture.covariances[0], made._picture.covariance[:, :, 0])
    assert counts[8] == [2]
    assert counts[9] is None


def test_what_is_derived_in_one_frame_says_nothing_in_another() -> None:
    dock = schemas.Local("dock")
    made = FusionCentre({**FOLLOWING[2], "frame_wait": 1.0, "stale_periods": 30.0})
    for name in "ab":
        made.handle(info(name), NOW)
    begun = []
    for second in range(1, 20):
        frame = dock if second < 10 else FRAME
        for name in "ab":
            made.handle(tracks(name, second, [[0, 0, 0, 0]], frame=frame), NOW)
        result = made.step(START + second * SECOND)
        if any(event["kind"] == "frame" for event in result.log.events):
            begun.append(second)
            assert len(made._memory.derived) == 1
            assert not made._memory.derived._pairs.cross.any()
            assert made._memory.derived._pairs.left.any(axis=(0, 1, 2)).all()
    assert len(begun) == 2


def test_what_is_published_of_a_component_that_noise_has_made_unknown() -> None:
    """Its variance is told smaller than it is: the correlation that went with it would be more than 1."""
    unknown = Unknown.of(("x", "y", "vx", "vy"))
    for scale in (1.0, 30.0, 1e6):
        covariance = np.kron(np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.eye(2))[:, :, None] * 1e7 * scale
        told = unknown.told(covariance)[:, :, 0]
        sigma = np.sqrt(np.diag(told))
        assert np.linalg.eigvalsh(told / np.outer(sigma, sigma)).min() > 0
        assert np.array_equal(unknown.known(told), unknown.known(covariance[:, :, 0]))
        assert np.array_equal(told[:2, :2], covariance[:2, :2, 0])
