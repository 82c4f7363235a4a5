"""Tracklets against a centralised filter written here on its own, and what is no tracklet."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre
from tests.centre.worlds import FRAME, SECOND, SPACE

Floats = NDArray[np.float64]
H = np.eye(4)[:2]
Q1 = 0.7
"""m2/s3, of the targets and of every filter unless said."""


def cv(dt: float, q: float) -> tuple[Floats, Floats]:
    noise = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.eye(4) + dt * np.eye(4, k=2), q * np.kron(noise, np.eye(2))


class Kalman:
    """A tracker of many targets at once, in covariance form; q and time may be anything."""

    def __init__(self, sigma: float, q: float = Q1) -> None:
        self.R, self.q = sigma**2 * np.eye(2), q
        self.x, self.P, self.t = np.zeros((0, 4)), np.zeros((4, 4)), -1.0

    def predict(self, t: float) -> None:
        F, Q = cv(t - self.t, self.q)
        self.x, self.P, self.t = self.x @ F.T, F @ self.P @ F.T + Q, t

    def update(self, z: Floats, R: Floats) -> None:
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
        self.x = self.x + (z - self.x @ H.T) @ K.T
        self.P = (np.eye(4) - K @ H) @ self.P
        self.P = 0.5 * (self.P + self.P.T)

    def take(self, t: float, z: Floats) -> None:
        if self.t < 0:
            self.x, self.P, self.t = np.hstack([z, 0 * z]), np.diag([*np.diag(self.R), 100.0, 100.0]), t
        else:
            self.predict(t)
            self.update(z, self.R)


class World:
    """Targets far apart, sensors with a filter each, and a centre that hears them."""

    def __init__(self, sigmas: dict[str, float], targets: int = 6, seed: int = 1, **config: Any) -> None:
        print(f"seed {seed}")
        self.rng = np.random.default_rng(seed)
        self.x = np.hstack([10_000.0 * np.arange(targets)[:, None] * [1.0, 0.3], self.rng.normal(0, 15, (targets, 2))])
        self.filters = {name: Kalman(sigma) for name, sigma in sigmas.items()}
        self.seq = dict.fromkeys(sigmas, 0)
        self.t = 0.0
        self.centre = FusionCentre(
            {"rule": "ci", "memory": "tracklet", "coast": 1e3, "stale_periods": 1e3, "frame": FRAME, **config}
        )

    def say(self, name: str, **said: Any) -> None:
        fields = {"position": (0.0, 0.0, 0.0), "period": 1.0, "motion": schemas.Motion("cv", Q1), **said}
        info = schemas.SensorInfo(source=name, epoch=1, seq=self.seq[name], sent=0, frame=FRAME, **fields)
        self.centre.handle(info, 10**18)

    def move(self, t: float) -> None:
        F, Q = cv(t - self.t, Q1)
        self.x = self.x @ F.T + self.rng.multivariate_normal(np.zeros(4), Q, len(self.x))
        self.t = t

    def look(self, name: str, central: Kalman | None = None) -> schemas.LocalTracks:
        """What the sensor's tracker says now; the centralised filter sees the same measurement."""
        one = self.filters[name]
        z = self.x[:, :2] + self.rng.normal(size=(len(self.x), 2)) * np.sqrt(one.R[0, 0])
        one.take(self.t, z)
        if central is not None and central.t >= 0:
            central.predict(self.t)
            central.update(z, one.R)
        self.seq[name] += 1
        return self.message(name, one.x, one.P)

    def message(self, name: str, means: Floats, covariance: Floats, **more: Any) -> schemas.LocalTracks:
        count = len(means)
        return schemas.LocalTracks(
            source=name, epoch=1, seq=self.seq[name], sent=0, time=round(self.t * SECOND), complete=True, space=SPACE,
            frame=FRAME, ids=np.arange(1, count + 1, dtype=np.uint64), means=means.copy(),
            covariances=np.tile(covariance, (count, 1, 1)), **more,
        )  # fmt: skip

    def hear(self, *messages: schemas.LocalTracks) -> None:
        for message in messages:
            self.centre.handle(message, 10**18)

    def step(self, t: float) -> schemas.GlobalTracks:
        self.result = self.centre.step(round(t * SECOND))
        return self.result.tracks


def assert_same(picture: schemas.GlobalTracks, central: Kalman, t: float, tolerance: float = 1e-9) -> None:
    """Relative to the stated standard deviations."""
    F, Q = cv(t - central.t, central.q)
    x, P = central.x @ F.T, F @ central.P @ F.T + Q
    sigma = np.sqrt(np.diag(P))
    order = np.argsort(picture.means[:, 0])
    assert len(order) == len(x)
    assert np.abs((picture.means[order] - x) / sigma).max() < tolerance
    assert np.abs((picture.covariances[order] - P) / np.outer(sigma, sigma)).max() < tolerance


def central_of(picture: schemas.GlobalTracks, t: float) -> Kalman:
    """A centralised filter that begins with what the picture says."""
    one = Kalman(1.0)
    order = np.argsort(picture.means[:, 0])
    one.x, one.P, one.t = picture.means[order].copy(), picture.covariances[order[0]].copy(), t
    return one


def ways(picture: schemas.GlobalTracks) -> set[str]:
    if picture.rules is None or picture.track_rule is None:
        return {picture.rule}
    return {picture.rules[which] for which in picture.track_rule.tolist()}


def test_heard_at_every_update_it_is_the_centralised_filter() -> None:
    world = World({"a": 8.0, "b": 13.0, "c": 25.0})
    for name in world.filters:
        world.say(name)
    world.move(1.0)
    world.hear(*(world.look(name) for name in world.filters))
    central = central_of(world.step(1.0), 1.0)
    for t in range(2, 60):
        world.move(float(t))
        world.hear(*(world.look(name, central) for name in world.filters))
        assert_same(world.step(float(t)), central, float(t))
    assert ways(world.result.tracks) == {"tracklet"}
    assert world.result.status.sources["b"]["tracklets"] == 1.0


def test_at_any_times_of_their_own_between_the_steps() -> None:
    world = World({"a": 8.0, "b": 13.0}, seed=2)
    for name in world.filters:
        world.say(name)
    world.move(1.0)
    world.hear(*(world.look(name) for name in world.filters))
    central = central_of(world.step(1.0), 1.0)
    for t in range(2, 40):
        for part, name in ((0.1, "a"), (0.35, "b"), (0.6, "a"), (0.85, "a"), (0.9, "b")):
            world.move(t - 1 + part)
            world.hear(world.look(name, central))
        assert_same(world.step(float(t)), central, float(t), 1e-8)


def test_a_late_source_is_put_in_its_place() -> None:
    """Once it has shown how late it is, the result is as if all had come in time."""
    late, other = (World({"a": 8.0, "b": 13.0}, seed=3) for _ in range(2))
    held: list[schemas.LocalTracks] = []
    for name in late.filters:
        late.say(name)
        other.say(name)
    for t in range(1, 100):
        for world in (late, other):
            world.move(float(t))
        other.hear(other.look("a"), other.look("b"))
        in_time = other.step(float(t))
        late.hear(late.look("a"))
        held.append(late.look("b"))
        late.hear(*held[: len(held) - (2 if t > 10 else 0)])
        held = held[-2:] if t > 10 else []
        late.step(float(t))
    late.hear(*held)
    in_time, picture = other.step(99.001), late.step(99.001)
    sigma = np.sqrt(np.diagonal(in_time.covariances, axis1=1, axis2=2))
    order, at = np.argsort(picture.means[:, 0]), np.argsort(in_time.means[:, 0])
    assert len(order) == len(at)
    assert np.abs((picture.means[order] - in_time.means[at]) / sigma[at]).max() < 1e-3
    assert np.abs(np.diagonal(picture.covariances[order], axis1=1, axis2=2) / sigma[at] ** 2 - 1).max() < 1e-3
    assert ways(picture) == {"tracklet"}
    assert late.result.status.sources["b"]["tracklets"] > 0.9


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("feedback", {"feedback": True}),
        ("registration", {"position_covariance": 25.0 * np.eye(3)}),
    ],
)
def test_what_a_source_says_of_itself_rules_tracklets_out(reason: str, said: dict[str, Any]) -> None:
    world = World({"a": 8.0, "b": 13.0}, seed=4)
    for name in world.filters:
        world.say(name, **said)
    for t in range(1, 8):
        world.move(float(t))
        world.hear(*(world.look(name) for name in world.filters))
        picture = world.step(float(t))
    assert ways(picture) == {"ci"}
    health = world.result.status.sources["a"]
    assert (health["tracklets"], health["no_tracklets"]) == (0.0, reason)


def test_a_source_that_says_nothing_of_its_motion_goes_by_the_rule() -> None:
    world = World({"a": 8.0, "b": 13.0}, seed=5)
    world.say("a")
    for t in range(1, 12):
        world.move(float(t))
        world.hear(*(world.look(name) for name in world.filters))
        picture = world.step(float(t))
    assert world.result.status.sources["b"]["no_tracklets"] == "motion"
    assert ways(picture) == {"ci"}, "a filter of one row would only do again what its tracker has done"


def test_a_tracker_that_is_too_sure_is_seen_and_left_out() -> None:
    world = World({"a": 8.0, "b": 13.0}, targets=20, seed=6)
    for name in world.filters:
        world.say(name)
    world.filters["b"].R = world.filters["b"].R.copy()
    for t in range(1, 40):
        world.move(float(t))
        world.hear(world.look("a"))
        message = world.look("b")
        world.hear(world.message("b", message.means, message.covariances[0] / 9.0))
        world.step(float(t))
    one, other = (world.result.status.sources[name] for name in "ab")
    assert one["no_tracklets"] == ""
    assert one["innovation_low"] < one["innovation"] < one["innovation_high"]
    assert other["no_tracklets"] == "innovations"
    assert other["innovation"] > other["innovation_high"]
    told = [event for event in world.result.log.events if event["kind"] == "tracklets"]
    assert told == [] or told[0]["source"] == "b"


def test_a_restarted_source_joins_anew_and_counts_nothing_twice() -> None:
    """Its old estimate, said again under a new epoch, is in the filter already."""
    world = World({"a": 8.0}, seed=7)
    world.say("a")
    for t in range(1, 10):
        world.move(float(t))
        world.hear(world.look("a"))
        picture = world.step(float(t))
    one = world.filters["a"]
    world.move(10.0)
    one.predict(10.0)
    again = world.message("a", one.x, one.P, updated=np.full(6, 9 * SECOND))
    before = cv(1.0, Q1)[0] @ picture.covariances[0] @ cv(1.0, Q1)[0].T + cv(1.0, Q1)[1]
    world.hear(replace(again, epoch=2, seq=0))
    picture = world.step(10.0)
    order = np.argsort(picture.means[:, 0])
    assert np.linalg.eigvalsh(picture.covariances[order[0]] - (1 - 1e-6) * before)[0] > 0


def test_a_common_error_never_averages_out() -> None:
    world = World({"a": 8.0}, seed=8)
    world.say("a", position_covariance=np.diag([900.0, 400.0, 1.0]))
    for t in range(1, 50):
        world.move(float(t))
        world.hear(world.look("a"))
        picture = world.step(float(t))
    expected = world.filters["a"].P + np.diag([900.0, 400.0, 0.0, 0.0])
    assert np.abs(picture.covariances - expected).max() < 1e-6 * 900


def test_a_note_says_in_words_why_there_are_no_tracklets_and_only_where_they_are_asked_for() -> None:
    derived: dict[str, Any] = {"memory": "restart", "rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}}
    for asked in (True, False):
        world = World({"a": 8.0, "b": 13.0}, seed=4, **({} if asked else derived))
        world.say("a")
        for t in range(1, 5):
            world.move(float(t))
            world.hear(*(world.look(name) for name in world.filters))
            world.step(float(t))
            told = [event for event in world.result.log.events if event["kind"] == "tracklets"]
            assert len(told) == (asked and t == 1)
        sources = world.result.status.sources
        assert sources["a"]["note"] == ""
        assert sources["b"]["note"].startswith("no tracklets of it: nobody declares") == asked
        assert ("tracklets" in sources["a"]) == asked
        assert sources["a"]["innovation"] > 0


def test_feedback_that_is_not_told_is_seen() -> None:
    """A tracker that goes on from the fused result adds to it what is in it already."""
    world = World({"a": 8.0, "b": 13.0, "c": 25.0}, targets=40, seed=9)
    for name in world.filters:
        world.say(name)
    errors, stated = [], []
    for t in range(1, 50):
        world.move(float(t))
        world.hear(*(world.look(name) for name in world.filters))
        picture = world.step(float(t))
        order = np.argsort(picture.means[:, 0])
        assert len(order) == len(world.x)
        fed = world.filters["c"]
        fed.x, fed.P = picture.means[order].copy(), picture.covariances[order].mean(axis=0)
        if t > 15:
            errors.append(picture.means[order] - world.x)
            stated.append(picture.covariances[order])
    health = world.result.status.sources
    assert {name: health[name]["no_tracklets"] for name in "abc"} == {"a": "", "b": "", "c": "dependent"}
    e, P = np.concatenate(errors), np.concatenate(stated)
    nees = np.einsum("bi,bij,bj->b", e, np.linalg.inv(P), e).mean() / 4
    assert 0.8 < nees < 1.15, "1.6 where it is taken for a tracker of its own"
