"""How often honest sources are suspected, and how soon others are seen; and what is bounded, whatever is sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.correlation import Correlation
from fusion_service.centre.derived import Followed
from fusion_service.centre.shared_noise import SharedNoise
from fusion_service.centre.tracklets import MOST_OPEN, closed
from fusion_service.centre.versions import MOST_VERSIONS, versions_of
from fusion_service.centre.watch import Record
from fusion_service.config import centre_config
from schemas import Motion
from tests.centre.test_tracklets import World, central_of, ways
from tests.centre.worlds import FRAME, SPACE, info, tracks

NOW = 4 * 10**18
HOUR = 3600
RUNS = 300


def suspected(scale: float, tracks_each: int, steps: int, seed: int) -> tuple[float, float, float]:
    """Of `RUNS` sources with increments of two degrees of freedom: the share that ever fails, the share whose
    increments are ever divided, and the median step of the first failure."""
    print("seed", seed)
    rng, freedom = np.random.default_rng(seed), 2.0 * tracks_each
    fails, divided, first = 0, 0, []
    for _ in range(RUNS):
        record, failed, other = Record(), -1, False
        for step, innovation in enumerate(scale * rng.chisquare(freedom, steps), 1):
            record.add(float(innovation), freedom, tracks_each, tracks_each, 0)
            other |= record.inflation > 1.0
            if record.fails:
                failed = step
                break
        fails, divided = fails + (failed > 0), divided + other
        first.append(failed if failed > 0 else steps + 1)
    return fails / RUNS, divided / RUNS, float(np.median(first))


@pytest.mark.parametrize("tracks_each", [1, 10, 1000])
def test_an_honest_source_is_not_suspected_in_an_hour(tracks_each: int) -> None:
    """Seldom: looked at in every step from the first on, with few degrees of freedom then."""
    fails, divided, _ = suspected(1.0, tracks_each, HOUR if tracks_each < 1000 else 300, tracks_each)
    assert fails <= 0.01
    assert divided <= 0.01


@pytest.mark.parametrize(("scale", "one", "ten"), [(4.0, 15, 3), (2.5, 30, 5), (0.4, 100, 12), (0.25, 40, 5)])
def test_another_is_seen_soon(scale: float, one: int, ten: int) -> None:
    for tracks_each, most in ((1, one), (10, ten)):
        fails, _, median = suspected(scale, tracks_each, 300, 8)
        assert fails == 1.0
        assert median <= most


def test_ids_that_change_owner_say_nothing_of_the_measurements() -> None:
    """Half of a source's targets exchange their ids, twice: their links are mended, and it stays believed."""
    world = World({"a": 8.0, "b": 13.0}, targets=20, seed=3)
    for name in world.filters:
        world.say(name)
    for t in range(1, 30):
        world.move(float(t))
        world.hear(world.look("a"))
        message = world.look("b")
        ids = message.ids.copy()
        if t in range(12, 20):
            ids[:10] = np.roll(ids[:10], 1)
        world.hear(replace(message, ids=ids))
        world.step(float(t))
    said = world.result.status.sources["b"]
    assert said["no_tracklets"] == ""
    assert 0.7 < said["innovation"] < 1.3
    assert ways(world.result.tracks) == {"tracklet"}


def test_many_versions_of_a_track_in_a_step_are_taken_as_fewer() -> None:
    world, many = World({"a": 8.0, "b": 13.0}, targets=2, seed=5), 150
    for name in world.filters:
        world.say(name, period=1.0 / many)
    world.move(1.0)
    world.hear(*(world.look(name) for name in world.filters))
    central = central_of(world.step(1.0), 1.0)
    for step in range(1, 4):
        for part in range(1, many + 1):
            world.move(step + part / many)
            world.hear(*(world.look(name, central) for name in world.filters))
        picture = world.step(step + 1.0)
        assert max(len(source.pairs) for source in world.centre._intake.sources.values()) == many
    sigma = np.sqrt(np.diag(central.P))
    order, at = np.argsort(picture.means[:, 0]), np.argsort(central.x[:, 0])
    assert ways(picture) == {"tracklet"}
    assert np.abs((picture.means[order] - central.x[at]) / sigma).max() < 0.05
    assert np.abs(np.sqrt(np.diagonal(picture.covariances, axis1=1, axis2=2)) / sigma - 1).max() < 0.01


def test_what_is_thinned_is_a_chain_still(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def spied(intake: object, rows: object, time: int) -> object:
        seen.append(versions_of(intake, rows, time))  # type: ignore[arg-type]
        return seen[-1]

    monkeypatch.setattr("fusion_service.centre.memory.versions_of", spied)
    made = FusionCentre({"memory": "tracklet", "frame": FRAME})
    made.handle(info("a", period=0.01), NOW)
    for part in range(200):
        made.handle(tracks("a", 1 + part / 200, np.zeros((3, 4)), seq=part), NOW)
    made.step(1_700_000_002 * 10**9)
    (versions,) = seen
    for row in range(3):
        mine = versions.take(versions.row == row)
        assert len(mine.time) == MOST_VERSIONS
        assert np.array_equal(mine.before[1:], mine.time[:-1])
        assert mine.time[-1] - mine.before[0] == round(199 / 200 * 1e9)


def test_what_is_done_again_is_bounded() -> None:
    rng = np.random.default_rng(2)
    at = np.sort(rng.integers(0, 5, 2000))
    at = at[at != 3]
    times = rng.integers(0, 500, len(at))
    times = times[np.lexsort((times, at))]
    cut = np.array([10, 499, 0, 5, 200])
    after = closed(cut, at, times)
    assert (after >= cut).all()
    for k in range(5):
        mine = times[at == k]
        assert (mine > after[k]).sum() <= MOST_OPEN
        assert after[k] == cut[k] or (mine >= after[k]).sum() > MOST_OPEN


def test_many_motions_are_asked_for_once_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """1,000 sources that declare as many; beside what pairs of them share, found two by two."""
    asked = []
    plain = SharedNoise._transition

    def counted(self: SharedNoise, motion: Motion, dt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.append(motion)
        return plain(self, motion, dt)

    monkeypatch.setattr(SharedNoise, "_transition", counted)
    SharedNoise([Motion("cv", 0.5 + 0.001 * k) for k in range(1000)], SPACE)
    assert len(asked) <= 3000
    kinds = [
        Motion("cv", 0.5), Motion("cv", 2.0), Motion("ca", 0.1), Motion("ou", sigma=3.0, tau=9.0), None,
        Motion("ou", sigma=1.0, tau=9.0), Motion("cv", 2.0), Motion("ou", sigma=3.0, tau=8.0),
    ]  # fmt: skip
    noise = SharedNoise(kinds, SPACE)
    for i, one in enumerate(kinds):
        for j, other in enumerate(kinds):
            shared = int(noise.of(np.array([i]), np.array([j]))[0])
            if one is None or other is None:
                assert shared == -1
                continue
            (F, Q), (G, R) = (plain(noise, motion, np.ones(1)) for motion in (one, other))
            if not np.array_equal(F, G):
                assert shared == -1
                continue
            _, S = noise.between(np.array([shared]), np.ones(1))
            assert np.trace(S[:, :, 0]) == max(np.trace(Q[:, :, 0]), np.trace(R[:, :, 0]))


def test_a_track_of_very_many_rows_is_fused_without_its_pairs() -> None:
    """400 rows of one track: what all its pairs would take, 160,000 matrices, is never made."""
    rng, N = np.random.default_rng(1), 400
    means, covariances = rng.normal(size=(N, 4, 1)), np.tile(np.eye(4)[None, :, :, None], (N, 1, 1, 1))
    followed = Followed(np.zeros(0, dtype=np.intp), np.zeros((4, 4, 0)), np.zeros(0), np.zeros(0), N)
    known = Correlation(centre_config({"rule": "auto"}), followed=followed)
    members = np.arange(N)[None]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Followed, "of", lambda *_: pytest.fail("pairs of all rows"))
        fused, way = known.fuse(None, members, means, covariances, None, np.arange(4))  # type: ignore[arg-type]
    assert np.isfinite(fused.covariance).all()
    assert len(way) == 1


def test_tracks_of_a_source_that_is_not_heard_do_not_come_together() -> None:
    """Two global tracks are merged while a source that tells them apart is muted: one of its tracks goes on there."""
    made = FusionCentre({"frame": FRAME, "coast": 100.0})
    for name in "ab":
        made.handle(info(name), NOW)
        made.handle(tracks(name, 1, [[0.0, 0, 0, 0], [8000.0, 0, 0, 0], [16000.0, 0, 0, 0]]), NOW)
    made.step(1_700_000_001 * 10**9)
    first, second, third = made.view().ids.tolist()
    made._relink({second: first, third: first})
    for name in "ab":
        assert made._intake.sources[name].tracks.link.tolist() == [first, 0, 0]
    made._relink({first: 0})
    assert not made._intake.sources["b"].tracks.link.any()


def test_motions_that_change_with_every_message_are_forgotten() -> None:
    world = World({"a": 8.0, "b": 13.0}, seed=9)
    for t in range(1, 200):
        for name in world.filters:
            world.seq[name] += 1
            world.say(name, motion=schemas.Motion("cv", 0.7 + 1e-6 * t))
        world.move(float(t))
        world.hear(*(world.look(name) for name in world.filters))
        world.step(float(t))
        motions = world.centre._memory.motions
        assert len(motions.known) <= 64
        assert {motions.motion(code).q for code in world.centre._picture.motion.tolist()} <= {0.7 + 1e-6 * t}
    plain = {"memory": "tracklet", "coast": 1e3, "stale_periods": 1e3, "frame": FRAME}
    again = FusionCentre(plain, world.centre.checkpoint())
    codes = again._picture.motion.tolist()
    assert {again._memory.motions.motion(code).q for code in codes} == {0.7 + 1e-6 * 199}
