"""What a centre decides in the field: each case has its right answer, whatever the road to it.

Local tracks are those of Kalman filters, so their errors go together in time as they do in life.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import schemas
from fusion_service.centre import FusionCentre, SourceFound, SourceLost, StepResult
from schemas.messages import COASTING, CONFIRMED, EXCHANGED, GATE_FAILED, TENTATIVE
from tests.centre.worlds import SECOND, START, centre, give, info, step, tracks
from tests.helpers.strategies import Array

SIGMA = np.array([30.0, 30.0, 2.0, 2.0])


class Filters:
    """One Kalman filter (constant velocity) for each of T targets, all with the same gains."""

    def __init__(self, q: float, sigma: float, dt: float = 1.0) -> None:
        self.F = np.eye(4)
        self.F[0, 2] = self.F[1, 3] = dt
        self.Q = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        self.R = sigma**2 * np.eye(2)
        self.x: Array | None = None
        self.P = np.diag([sigma**2, sigma**2, 400.0, 400.0])

    def update(self, z: Array) -> tuple[Array, Array]:
        """Means (T, 4) and the covariance (4, 4) after measurements z (T, 2)."""
        if self.x is None:
            self.x = np.column_stack([z, np.zeros_like(z)])
            return self.x.copy(), self.P.copy()
        H = np.eye(2, 4)
        P = self.F @ self.P @ self.F.T + self.Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + self.R)
        x = self.x @ self.F.T
        self.x, self.P = x + (z - x @ H.T) @ K.T, P - K @ H @ P
        return self.x.copy(), self.P.copy()


def told(name: str, second: float, means: Array, P: Array, ids: Any = None, **more: Any) -> schemas.LocalTracks:
    covariances = np.tile(P, (len(means), 1, 1))
    return tracks(name, second, means, ids, seq=round(100 * second), covariances=covariances, **more)


def shown(result: StepResult) -> Array:
    """Places (K, 2) of what an operator sees."""
    return np.asarray(result.tracks.means[result.tracks.status != TENTATIVE][:, :2])


def near(result: StepResult, place: Any) -> int:
    """The id of the shown track nearest to a place, within 150 m; 0 without."""
    rows = np.flatnonzero(result.tracks.status != TENTATIVE)
    far = np.linalg.norm(result.tracks.means[rows][:, :2] - np.asarray(place)[:2], axis=1)
    return int(result.tracks.ids[rows[far.argmin()]]) if len(rows) and far.min() < 150 else 0


# 1 and 2: jumps and identifiers


def test_a_jump_of_one_of_two_sources_is_never_fused_and_costs_nothing() -> None:
    made, rng = centre(("r1", "r2")), np.random.default_rng(3)
    ids = set()
    for second in range(1, 30):
        for name in ("r1", "r2"):
            place = np.array([[20.0 * second, 0, 20, 0]]) + 0.3 * rng.normal(size=4) * SIGMA
            if second == 15 and name == "r2":
                place[0, 0] += 10_000
            give(made, tracks(name, second, place))
        result = step(made, second)
        assert len(result.tracks.ids) == 1
        ids.add(int(result.tracks.ids[0]))
        error = result.tracks.means[0] - [20.0 * second, 0, 20, 0]
        assert error @ np.linalg.solve(result.tracks.covariances[0], error) < 9 * 4
        if second == 15:
            assert (result.log.decisions.kind == GATE_FAILED).sum() == 1
            assert result.tracks.contributor_counts.tolist() == [1]
    assert len(ids) == 1


def test_an_id_used_again_far_away_begins_a_new_track_and_the_old_one_coasts() -> None:
    made = centre(("r1",), coast=5.0)
    for second in range(1, 25):
        place = [0.0, 0, 10, 0] if second < 10 else [50_000.0, 0, 0, 10]
        place[0] += place[2] * second
        give(made, tracks("r1", second, [place], [7]))
        result = step(made, second)
        if second == 9:
            old = int(result.tracks.ids[0])
        for track, mean in zip(result.tracks.ids.tolist(), result.tracks.means, strict=True):
            assert (track == old if second >= 9 else True) == (mean[0] < 10_000) or second < 9
    assert near(result, [50_000, 0]) not in (0, old)
    assert old not in result.tracks.ids


@pytest.mark.parametrize("swapper", ["a", "b"])
def test_swapped_ids_stay_with_their_targets(swapper: str) -> None:
    made, rng = centre(("a", "b")), np.random.default_rng(5)
    for second in range(1, 25):
        truth = np.array([[10.0 * second, 0, 10, 0], [10.0 * second, 3000, 10, 0]])
        for name in ("a", "b"):
            ids = [2, 1] if name == swapper and second >= 12 else [1, 2]
            give(made, tracks(name, second, truth + 0.3 * rng.normal(size=(2, 4)) * SIGMA, ids))
        result = step(made, second)
        if second == 11:
            before = [near(result, place) for place in truth]
        if second >= 12:
            assert [near(result, place) for place in truth] == before
            assert result.tracks.contributor_counts.tolist() == [2, 2]
        if second == 12:
            assert (result.log.decisions.kind == EXCHANGED).sum() == 2


@pytest.mark.parametrize("leaves", ["a", "b"])
def test_of_two_that_part_the_prediction_keeps_the_id(leaves: str) -> None:
    """One source's target turns away unseen by the other; whichever sits where the track was going keeps it."""
    made = centre(("a", "b"))
    for second in range(1, 40):
        for name in ("a", "b"):
            gone = name == leaves and second > 10
            away = [400.0 * (second - 10), 10.0, 400.0] if gone else [0.0, 10.0, 0.0]
            give(made, tracks(name, second, [[10.0 * second, *away]]))
        result = step(made, second)
        if second == 10:
            old = int(result.tracks.ids[0])
    assert near(result, [390, 0]) == old
    assert near(result, [390, 400.0 * 29]) not in (0, old)


# 3: formations


def formation(seed: int, gap: float = 10.0, sigma: float = 8.0) -> Iterator[tuple[int, int, int]]:
    """120 targets in a row, two sources: (second, wrong pairs in the picture, of an assignment made afresh)."""
    rng, n, q = np.random.default_rng(seed), 120, 0.05
    truth = np.column_stack([gap * np.arange(n), np.zeros(n), np.full(n, 20.0), np.full(n, 5.0)])
    order = {"a": np.arange(n), "b": rng.permutation(n)}
    filters = {name: Filters(q, sigma) for name in order}
    made = FusionCentre({"motion": {"kind": "cv", "q": q}, "lateness": 3.0})
    for name in order:
        give(made, info(name, motion=schemas.Motion("cv", q)))
    for second in range(1, 36):
        truth[:, :2] += truth[:, 2:]
        said = {}
        for name, who in order.items():
            said[name] = filters[name].update(truth[who][:, :2] + sigma * rng.normal(size=(n, 2)))
            give(made, told(name, second, *said[name]))
        picture = step(made, second).tracks
        whose = [order[picture.sources[s]][i - 1] for s, i in zip(
            picture.contributor_source.tolist(), picture.contributor_id.astype(int).tolist(), strict=True)]  # fmt: skip
        owner = np.repeat(np.arange(len(picture.ids)), picture.contributor_counts)
        wrong = sum(len({w for w, o in zip(whose, owner, strict=True) if o == g}) > 1 for g in range(len(picture.ids)))
        apart = said["a"][0][:, None] - said["b"][0][None]
        cost = np.einsum("ijk,kl,ijl->ij", apart, np.linalg.inv(said["a"][1] + said["b"][1]), apart)
        i, j = linear_sum_assignment(cost)
        yield second, wrong, int((order["a"][i] != order["b"][j]).sum())


@pytest.mark.parametrize("seed", [1, 2])
def test_a_formation_is_paired_as_well_as_afresh_and_then_right(seed: int) -> None:
    rows = list(formation(seed))
    print(seed, rows)
    assert rows[0][1] <= rows[0][2]  # the first scan by the optimal assignment
    wrong, afresh = np.array([row[1:] for row in rows]).T
    assert wrong.sum() <= 1.5 * afresh.sum()
    assert wrong[29:].max() <= 2
    assert wrong[9:].mean() <= afresh[9:].mean() + 4


# 4: one datum is one datum


@pytest.mark.parametrize("far", [300.0, 3000.0])
def test_one_outlier_of_a_slow_source_changes_no_id(far: float) -> None:
    made, rng = centre(("r1",)), np.random.default_rng(4)
    give(made, info("slow", period=10.0))
    ids = set()
    for second in range(1, 121):
        truth = np.array([[10.0 * second, 0, 10, 0]])
        give(made, tracks("r1", second, truth + 0.3 * rng.normal(size=4) * SIGMA))
        if second % 10 == 0:
            give(made, tracks("slow", second, truth + np.array([far * (second == 70), 0, 0, 0])))
        result = step(made, second)
        ids |= set(result.tracks.ids.tolist())
        assert np.linalg.norm(result.tracks.means[0] - truth[0]) < 100
    assert len(ids) == 1


# 5: registration bias


UNSEEN = {"supervision": "off", "registration": "off"}


@pytest.mark.parametrize(
    ("bias", "how"),
    [
        *((bias, UNSEEN) for bias in (15.0, 30.0)),
        *(pytest.param(bias, UNSEEN, marks=pytest.mark.slow) for bias in (0.0, 25.0, 40.0, 60.0)),
        (60.0, {}),
    ],
)
def test_a_registration_bias_makes_no_churn(bias: float, how: dict[str, str]) -> None:
    """25 targets, local sigma 6 m: at most two ids to a target, one track or two, and no coming and going. By default
    the bias is found, and covered: one track in the end."""
    rng, n, q, sigma = np.random.default_rng(7), 25, 0.5, 11.0
    grid = np.array(np.unravel_index(np.arange(n), (5, 5))).T
    truth = np.column_stack([5000.0 * grid, np.full((n, 2), 10.0)])
    filters = {name: Filters(q, sigma) for name in ("a", "b")}
    made = FusionCentre({"motion": {"kind": "cv", "q": q}, "lateness": 3.0, **how})
    for name in filters:
        give(made, info(name, motion=schemas.Motion("cv", q)))
    ids: dict[int, set[int]] = {k: set() for k in range(n)}
    numbers = []
    for second in range(1, 151):
        truth[:, :2] += truth[:, 2:]
        for name, one in filters.items():
            z = truth[:, :2] + sigma * rng.normal(size=(n, 2)) + [bias * (name == "b"), 0]
            give(made, told(name, second, *one.update(z)))
        picture = step(made, second).tracks
        seen = picture.status != TENTATIVE
        target = np.linalg.norm(picture.means[seen][:, None, :2] - truth[None, :, :2], axis=2).argmin(axis=1)
        for track, k in zip(picture.ids[seen].tolist(), target.tolist(), strict=True):
            ids[k].add(track)
        numbers.append(np.bincount(target, minlength=n))
    assert max(len(one) for one in ids.values()) <= 2
    changes = np.abs(np.diff(np.array(numbers)[10:], axis=0)).sum(axis=0)
    assert changes.max() <= 2  # once from one to two, at most
    if bias <= 15:
        assert (np.array(numbers)[10:] == 1).all()
    if bias == 60:
        assert (numbers[-1] == (2 if how else 1)).all()


# 6: a source that splits a target


def test_a_second_track_of_one_source_is_held_until_it_separates() -> None:
    made, rng = centre(("r1", "r2")), np.random.default_rng(6)
    for second in range(1, 41):
        truth = np.array([[10.0 * second, 0, 10, 0]])
        split = 10 <= second < 30
        own = np.repeat(truth, 1 + split, axis=0)
        give(made, tracks("r1", second, own + 0.5 * rng.normal(size=own.shape) * SIGMA, [1, 2][: len(own)]))
        give(made, tracks("r2", second, truth + 0.5 * rng.normal(size=(1, 4)) * SIGMA))
        result = step(made, second)
        assert len(shown(result)) == 1


def test_a_second_track_that_separates_becomes_one_of_its_own() -> None:
    made = centre(("r1", "r2"))
    for second in range(1, 40):
        gap = 30.0 * max(0, second - 15)
        own = np.array([[10.0 * second, 0, 10, 0], [10.0 * second, gap, 10, 30.0 * (second > 15)]])
        give(made, tracks("r1", second, own[: 1 + (second >= 10)]))
        give(made, tracks("r2", second, own[:1]))
        result = step(made, second)
        if second == 15:
            assert len(shown(result)) == 1
    assert len(shown(result)) == 2


def test_two_sources_that_both_see_one_more_are_believed_at_once() -> None:
    made = centre(("r1", "r2"))
    for second in range(1, 16):
        both = np.array([[0.0, 0, 0, 0], [40.0, 0, 0, 0]])
        for name in ("r1", "r2"):
            give(made, tracks(name, second, both[: 1 + (second >= 10)]))
        result = step(made, second)
    assert len(shown(result)) == 2


# 7 and 8: life by data


def test_a_manoeuvre_costs_no_id_and_a_jump_does() -> None:
    """A turn of 5 g at 200 m/s, then a displacement that no target can do."""
    made = centre(("r1", "r2"), motion={"kind": "cv", "q": 20.0})
    place, velocity = np.array([0.0, 0.0]), np.array([200.0, 0.0])
    ids = set()
    for second in range(1, 30):
        turn = np.deg2rad(14.0) if 10 <= second < 20 else 0.0  # 200 m/s * .244 rad/s = 5 g
        c, s = np.cos(turn), np.sin(turn)
        velocity = np.array([[c, -s], [s, c]]) @ velocity
        place = place + velocity
        for name in ("r1", "r2"):
            give(made, tracks(name, second, [[*place, *velocity]], sigma=np.array([30.0, 30, 10, 10])))
        ids |= set(step(made, second).tracks.ids.tolist())
    assert len(ids) == 1


@pytest.mark.parametrize("period", [0.5, 1.0, 4.0])
def test_confirmation_depends_on_the_sources_rate_and_not_on_the_steps(period: float) -> None:
    made = FusionCentre({"lateness": 3.0, "period": 0.25, "confirm_hits": 3, "confirm_within": 4})
    give(made, info("r1", period=period))
    confirmed = None
    for k in range(1, 80):
        now = 0.25 * k
        if now % period == 0:
            give(made, tracks("r1", now, [[0, 0, 0, 0]], seq=k))
        if confirmed is None and (step(made, now).tracks.status == CONFIRMED).any():
            confirmed = now
        elif confirmed is not None:
            break
    assert confirmed == 3 * period


def test_a_radar_of_ten_seconds_may_miss_a_scan() -> None:
    made = centre((), coast=5.0)
    give(made, info("slow", period=10.0))
    ids = set()
    for second in range(1, 101):
        if second % 10 == 0 and second not in (50, 70):
            give(made, tracks("slow", second, [[10.0 * second, 0, 10, 0]]))
        result = step(made, second)
        ids |= set(result.tracks.ids.tolist())
    assert len(ids) == 1
    assert result.tracks.status.tolist() == [CONFIRMED]


def test_a_track_that_is_only_predicted_on_coasts_and_ends() -> None:
    made = centre(("r1",), coast=5.0)
    for second in range(1, 30):
        last = min(second, 10)
        give(made, tracks("r1", second, [[10.0 * second, 0, 10, 0]], updated=np.array([START + last * SECOND])))
        result = step(made, second)
        if second == 10:
            assert result.tracks.status.tolist() == [CONFIRMED]
        if second == 14:
            assert result.tracks.status.tolist() == [COASTING]
    assert len(result.tracks.ids) == 0


def test_a_lost_token_begins_coasting_at_the_next_expected_report() -> None:
    """Of a source of 4 s: at 4 s with its token gone, at 6 s (half an interval later) while it is there."""
    begins: dict[bool, int] = {}
    for lost in (False, True):
        made = centre((), coast=30.0)
        give(made, info("r1", period=4.0), SourceFound("r1"))
        for second in range(1, 20):
            if second in (1, 5, 9):
                give(made, tracks("r1", second, [[0, 0, 0, 0]]))
            if second == 10 and lost:
                give(made, SourceLost("r1"))
            if (step(made, second).tracks.status == COASTING).any():
                begins.setdefault(lost, second)
    assert begins == {True: 9 + 4 + 1, False: 9 + 6 + 1}


def test_a_fast_source_on_a_slow_link_has_its_tracks() -> None:
    """10 Hz, .9 s late, lateness 5 s."""
    made = centre((), lateness=5.0)
    give(made, info("fast", period=0.1))
    for second in range(1, 12):
        for k in range(10):
            at = second - 0.9 - 0.1 * k
            give(made, tracks("fast", at, [[10.0 * at, 0, 10, 0]], seq=1000 + round(10 * at)))
        result = step(made, second)
    assert result.tracks.status.tolist() == [CONFIRMED]
    assert result.tracks.ids.tolist() == [1]


def test_live_and_exercise_are_told_apart() -> None:
    made = centre(("r1", "r2"))
    both = FusionCentre({"lateness": 3.0, "fuse_origins": True})
    give(both, info("r1"), info("r2"))
    for second in range(1, 5):
        for one in (made, both):
            give(one, tracks("r1", second, [[0, 0, 0, 0]]), tracks("r2", second, [[0, 0, 0, 0]], origin="exercise"))
        apart, together = step(made, second), step(both, second)
    assert (len(apart.tracks.ids), len(together.tracks.ids)) == (2, 1)


# What goes out, and gates of a source


def test_what_is_published_can_be_chosen_by_status_and_region() -> None:
    places = np.array([[0.0, 0, 0, 0], [5000.0, 0, 0, 0], [0.0, 9000, 0, 0]])
    whole = FusionCentre({"lateness": 3.0})
    part = FusionCentre(
        {"lateness": 3.0, "publish_status": ["confirmed"], "publish_region": {"kind": "disk", "radius": 6000.0}}
    )
    for second in range(1, 4):
        for made in (whole, part):
            give(made, tracks("r1", second, places), tracks("r2", second, places[[1, 2]], [7, 8]))
        seen, chosen = step(whole, second).tracks, step(part, second).tracks
        wanted = (seen.status == CONFIRMED) & (np.hypot(*seen.means[:, :2].T) <= 6000.0)
        assert chosen.ids.tolist() == seen.ids[wanted].tolist()
        np.testing.assert_array_equal(chosen.means, seen.means[wanted])
        assert chosen.contributor_counts.tolist() == seen.contributor_counts[wanted].tolist()
        assert len(chosen.contributor_id) == chosen.contributor_counts.sum()
        assert schemas.decode(schemas.encode(chosen)).ids.tolist() == chosen.ids.tolist()  # type: ignore[union-attr]
    assert len(seen.ids) == 3
    assert len(chosen.ids) == 2


@pytest.mark.parametrize(("gate", "expected"), [(0.9, 2), (None, 1), (1 - 1e-9, 1)])
def test_a_source_may_have_a_gate_of_its_own(gate: float | None, expected: int) -> None:
    """Two states 3.4 sigma apart in one of four dimensions: d2 11.6, beyond .9 (7.8), within .999 (18.5)."""
    said: dict[str, Any] = {"source_defaults": {"gate": gate}} if gate else {}
    made = centre(("r1", "r2"), **said)
    give(made, tracks("r1", 1, [[0, 0, 0, 0]]), tracks("r2", 1, [[3.4 * 30 * 2**0.5, 0, 0, 0]]))
    assert len(step(made, 1).tracks.ids) == expected


def test_a_track_may_need_several_sources() -> None:
    made = centre(("r1", "r2"), min_sources=2)
    for second in range(1, 6):
        give(made, tracks("r1", second, [[0, 0, 0, 0]]))
        assert step(made, second).tracks.status.tolist() == [TENTATIVE]
    give(made, tracks("r1", 6, [[0, 0, 0, 0]]), tracks("r2", 6, [[0, 0, 0, 0]]))
    assert step(made, 6).tracks.status.tolist() == [CONFIRMED]
