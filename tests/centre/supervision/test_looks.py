"""Sources are compared at a bounded pace, and nothing is missed for it."""

from typing import Any

import numpy as np

from fusion_service.centre import FusionCentre, StepResult
from fusion_service.centre.supervision.supervisor import LOOK
from tests.centre.worlds import START, centre, give, info, moved, seen, step, tracks, truth


class World:
    """Three sources of ten targets, steps ten times a second; every: seconds between the scans of each; phase: of the
    first; claims: of its standard deviations, what the last says."""

    def __init__(self, every: float, phase: float = 0.0, claims: float = 1.0) -> None:
        self.every, self.phase, self.claims = every, phase, claims
        self.centre, self.states, self.number = self.new(), truth(10), 0
        self.rng = np.random.default_rng(3)

    def new(self, **known: Any) -> FusionCentre:
        if known:
            return FusionCentre({"lateness": 3.0, "period": 0.1}, **known)
        made = centre((), period=0.1)
        for name in ("r1", "r2", "r3"):
            made.handle(info(name, period=self.every), START)
        return made

    def step(self) -> StepResult:
        second = round(0.1 * self.number, 3)
        scan, rest = divmod(round(10 * (second - self.phase)), round(10 * self.every))
        if rest == 0 and scan >= 0:
            for name in ("r1", "r2", "r3"):
                claims = self.claims if name == "r3" else 1.0
                means = seen(moved(self.states, second), self.rng)
                sigma = claims * np.array([30.0, 30.0, 2.0, 2.0])
                give(self.centre, tracks(name, second, means, seq=scan + 1, sigma=sigma))
        self.number += 1
        return step(self.centre, second)


def test_a_look_every_half_second() -> None:
    world = World(0.1)
    for _ in range(31):
        result = world.step()
    assert world.centre._supervisor._looks == 3.0 / LOOK + 1
    assert 0.5 < result.status.sources["r1"]["consistency"] < 2.0


def test_what_comes_between_two_looks_is_compared_in_the_next() -> None:
    world = World(1.0, phase=0.3)
    for _ in range(60):
        result = world.step()
    assert 0.5 < result.status.sources["r2"]["consistency"] < 2.0


def test_a_source_that_says_too_little_is_named_after_some_looks() -> None:
    world, steps = World(0.1, claims=0.3), 0
    while world.step().status.sources["r3"]["state"] == "trusted" and steps < 80:
        steps += 1
    assert 10 < steps < 60, "6 s"


def test_a_centre_that_is_restarted_between_two_looks_goes_on_to_the_bit() -> None:
    world = World(0.1, claims=0.3)
    for _ in range(64):
        world.step()
    blob = world.centre.checkpoint()
    kept, rng = world.centre, world.rng.bit_generator.state
    want = [world.step() for _ in range(9)]
    end, world.number, world.rng.bit_generator.state = kept.checkpoint(), 64, rng
    world.centre = world.new(checkpoint=blob, epoch=kept.epoch)
    for one in want:
        got = world.step()
        assert got.tracks.means.tobytes() == one.tracks.means.tobytes()
        assert got.tracks.covariances.tobytes() == one.tracks.covariances.tobytes()
        assert got.status.sources["r3"]["state_why"] == one.status.sources["r3"]["state_why"]
    assert "variance" in got.status.sources["r3"]["state_why"]
    assert world.centre.checkpoint() == end
