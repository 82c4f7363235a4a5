"""Whose covariances are wrong: the scale of squares, the joint least squares, and what a centre makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.stats import chi2

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre, Order, StepResult
from fusion_service.centre.rows import Rows
from fusion_service.centre.supervision.deciding import beyond, contradicted, pair_beyond, with_innovations
from fusion_service.centre.supervision.hat import Pairs, decidable, solved
from fusion_service.centre.supervision.honesty import Honesty, Opinion
from fusion_service.centre.supervision.scale import BINS, binned, high_bound, low_bound, robust_scale, sigmas
from fusion_service.centre.supervision.shared import shared_pairs
from fusion_service.centre.supervision.states import States
from fusion_service.centre.tracks import empty_tracks
from tests.centre.worlds import SPACE, START, centre, give, info, step, tracks

SEED = 1311
SIGMA = np.array([30.0, 30.0, 2.0, 2.0])


# ------------------------------------------------------------------ scales


def histogram(values: Floats) -> Floats:
    below, part = binned(values)
    made = np.zeros((1, BINS))
    np.add.at(made[0], below, 1.0 - part)
    np.add.at(made[0], below + 1, part)
    return made


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_a_scale_is_that_of_the_squares_and_hardly_moved_by_a_few(k: int) -> None:
    rng = np.random.default_rng(SEED)
    v = rng.chisquare(k, 40_000) / k
    exact = histogram(v)
    centres = 2.0 ** (-8.0 + np.arange(BINS) / 2)
    inside = v > centres[0]
    assert (exact[0] * centres).sum() == pytest.approx(np.maximum(v, centres[0]).sum()), inside.mean()
    for factor in (0.3, 1.0, 30.0, 1e6):
        assert robust_scale(histogram(factor * v), k)[0] == pytest.approx(factor, rel=0.03)
    spoiled = np.where(rng.random(len(v)) < 0.05, 1e5, v)
    assert 1.0 < robust_scale(histogram(spoiled), k)[0] < 1.35
    assert robust_scale(np.zeros((1, BINS)), k)[0] == 1.0


def test_bounds_are_those_of_chi_squared() -> None:
    z = sigmas(1e-5)
    for freedom in (10.0, 100.0, 1000.0):
        assert high_bound(np.array([freedom]), z)[0] == pytest.approx(chi2.isf(1e-5, freedom) / freedom, rel=0.02)
        assert low_bound(np.array([freedom]), z)[0] == pytest.approx(chi2.ppf(1e-5, freedom) / freedom, abs=0.02)


# ------------------------------------------------------------------ the joint least squares


def all_pairs(S: int, a: Floats, P: Floats, count: float, rng: np.random.Generator, k: int = 2) -> Pairs:
    """Scales of `count` simulated differences of each two sources of S, variances P (S,), errors of variance a P."""
    i, j = np.triu_indices(S, 1)
    e = rng.normal(size=(S, round(count), k)) * np.sqrt(a * P)[:, None, None]
    d = ((e[i] - e[j]) ** 2).mean(axis=(1, 2)) / (P[i] + P[j])
    return Pairs(i, j, d, P[i] / (P[i] + P[j]), np.full(len(i), count), k)


def test_factors_are_the_non_negative_least_squares_and_within_their_sigma() -> None:
    rng = np.random.default_rng(SEED)
    a, P = np.array([1.0, 1.0, 9.0, 1.0]), np.array([900.0, 400.0, 100.0, 1600.0])
    z = []
    for _ in range(200):
        pairs = all_pairs(4, a, P, 400.0, rng)
        found = solved(pairs, np.ones(4))
        A = np.zeros((6, 4))
        A[range(6), pairs.first], A[range(6), pairs.second] = pairs.share, 1.0 - pairs.share
        exact, _ = nnls(A / pairs.scale[:, None], np.ones(6))
        np.testing.assert_allclose(found.value, exact, rtol=0.02, atol=0.02)
        z.append((found.value - a)[[0, 1, 3]] / found.sigma[[0, 1, 3]])
    spread = np.std(z, axis=0)
    print(f"seed {SEED}: spread of (a - 1) / sigma {spread}")
    assert (spread < 1.15).all()
    assert (spread > 0.3).all()


def test_a_large_factor_of_few_differences_is_not_held_back() -> None:
    rng = np.random.default_rng(SEED)
    a, P = np.array([1.0, 1.0, 300.0]), np.array([400.0, 400.0, 300.0])
    found = np.array([solved(all_pairs(3, a, P, 30.0, rng), np.ones(3)).value for _ in range(100)])
    print(f"seed {SEED}: {found.mean(axis=0)}")
    assert np.median(found[:, 2]) == pytest.approx(300.0, rel=0.1)
    assert np.median(found[:, :2], axis=0) == pytest.approx(1.0, abs=0.3)


def test_a_circle_of_odd_length_decides() -> None:
    def pairs(*edges: tuple[int, int]) -> Pairs:
        one = np.ones(len(edges))
        first, second = np.array(edges, dtype=np.intp).T
        return Pairs(first, second, one, 0.5 * one, 10 * one, 2)

    assert decidable(pairs((0, 1), (1, 2), (0, 2), (2, 3)), 5).tolist() == [True, True, True, True, False]
    assert not decidable(pairs((0, 1), (1, 2), (2, 3), (0, 3)), 4).any()
    assert decidable(pairs((0, 1), (1, 1)), 2).all()


def test_many_sources_are_solved_in_parts_that_agree() -> None:
    rng = np.random.default_rng(SEED)
    a, P = np.ones(80), rng.uniform(100.0, 400.0, 80)
    a[7] = 9.0
    pairs = all_pairs(80, a, P, 100.0, rng)
    value = np.ones(80)
    for _ in range(6):
        value = solved(pairs, value).value
    assert value.argmax() == 7
    assert value[7] == pytest.approx(9.0, rel=0.3)
    assert np.abs(np.delete(value, 7) - 1.0).max() < 0.6


def test_trackers_that_began_with_one_guess_contradict_nobody() -> None:
    """Velocities that all trackers first take for 0 +- 20 m/s have one error in common, and the source that knows them
    best is beside others of which the one makes up for the other: no pair differs by more than it says, no one is
    wrong."""
    rng = np.random.default_rng(SEED)
    sigma, R, z = np.array([0.2, 0.45, 1.0]), 60, sigmas(1e-6)  # of what is known of it, in units of the first guess
    variance = sigma**2
    i, j = np.triu_indices(3, 1)
    share = variance[i] / (variance[i] + variance[j])
    alone = 0
    for _ in range(50):
        guess = rng.normal(size=(1, R, 2))
        noise = rng.normal(size=(3, R, 2)) * np.sqrt(variance * (1.0 - variance))[:, None, None]
        errors = noise - variance[:, None, None] * guess
        scale = ((errors[i] - errors[j]) ** 2).mean(axis=(1, 2)) / (variance[i] + variance[j])
        pairs = Pairs(i, j, scale, share, np.full(3, float(R)), 2)
        found = solved(pairs, np.ones(3))
        alone += int(beyond(found, z, np.ones(3, dtype=np.bool_)).any())
        assert not beyond(found, z, contradicted(pairs, pair_beyond(pairs, z), 3)).any()
    print(f"seed {SEED}: the factors alone speak against one in {alone} of 50")
    assert alone > 3


# ------------------------------------------------------------------ in a centre


Claim = Callable[[str, int], Floats]


def flown(
    names: tuple[str, ...], claim: Claim, seconds: int, seed: int = SEED, targets: int = 12, **config: Any
) -> list[StepResult]:
    """Steps of a centre whose sources see `targets` with errors of `SIGMA`; claim: what a source sends as its own at a
    second."""
    made = centre(names, **config)
    return fly(made, names, claim, range(1, seconds + 1), seed, targets)


def fly(
    made: FusionCentre, names: tuple[str, ...], claim: Claim, seconds: range, seed: int = SEED, targets: int = 12
) -> list[StepResult]:
    world = np.random.default_rng(seed)
    state = np.concatenate([world.uniform(-3e4, 3e4, (targets, 2)), world.normal(0, 50, (targets, 2))], axis=1)
    results = []
    for t in seconds:
        rng = np.random.default_rng((seed, t))
        now = state.copy()
        now[:, :2] += t * state[:, 2:]
        noise = {name: rng.normal(size=now.shape) * SIGMA for name in sorted(names)}
        for name in names:
            seen = now + noise[name]
            covs = np.tile(np.diag(claim(name, t) ** 2), (targets, 1, 1))
            give(made, tracks(name, t, seen, list(range(1, targets + 1)), covariances=covs))
        results.append(step(made, t))
    return results


def changes(results: list[StepResult]) -> list[tuple[int, str, str]]:
    return [
        (i, event["source"], event["state"])
        for i, result in enumerate(results, 1)
        for event in result.log.events
        if event["kind"] == "supervision"
    ]


def honest(_name: str, _t: int) -> Floats:
    return SIGMA


def third(name: str, _t: int) -> Floats:
    return SIGMA / 3 if name == "r3" else SIGMA


THREE = ("r1", "r2", "r3")


def test_the_odd_one_out_is_named_and_made_right() -> None:
    results = flown(THREE, third, 20)
    when, source, state = changes(results)[0]
    assert (source, state) == ("r3", "inflated")
    assert when <= 15, changes(results)
    said = results[-1].status.sources["r3"]
    assert said["state"] == "inflated"
    assert 5.0 < said["inflation_position"] < 15.0
    assert 5.0 < said["inflation_velocity"] < 15.0
    assert said["state_why"].startswith("its positions scatter ")
    assert "beside r1, r2" in said["state_why"]
    assert said["consistency"] > said["consistency_high"] > 1.0 > said["consistency_low"]
    assert results[-1].tracks.contributor_counts.mean() == 3.0
    for name in ("r1", "r2"):
        assert results[-1].status.sources[name]["state"] == "trusted"


def test_sound_sources_change_nothing() -> None:
    with_it, without = flown(THREE, honest, 12), flown(THREE, honest, 12, supervision="off")
    assert not changes(with_it)
    assert "state" not in without[-1].status.sources["r1"]
    for one, other in zip(with_it, without, strict=True):
        np.testing.assert_array_equal(one.tracks.means, other.tracks.means)
        np.testing.assert_array_equal(one.tracks.covariances, other.tracks.covariances)


def test_what_is_only_watched_is_told_and_left_alone() -> None:
    with_it, without = flown(THREE, third, 15, supervision="watch"), flown(THREE, third, 15, supervision="off")
    assert [(source, state) for _, source, state in changes(with_it)] == [("r3", "watch")]
    np.testing.assert_array_equal(with_it[-1].tracks.means, without[-1].tracks.means)


def test_beyond_repair_is_out_and_comes_back_when_it_is_mended() -> None:
    def claim(name: str, t: int) -> Floats:
        return SIGMA / 1000 if name == "r3" and t <= 15 else SIGMA

    results = flown(THREE, claim, 125)
    told = changes(results)
    assert told[0][1:] == ("r3", "out"), told
    assert told[0][0] <= 8, told
    used = results[14].tracks
    assert {used.sources[i] for i in used.contributor_source} == {"r1", "r2"}
    assert told[-1][1:] == ("r3", "trusted"), told
    assert results[-1].tracks.contributor_counts.mean() == 3.0


def test_of_two_that_contradict_each_other_neither_is_believed_alone() -> None:
    two = ("r1", "r3")
    named = flown(two, third, 20)
    assert [(source, state) for _, source, state in changes(named)] == [("r3", "inflated")], "by its own innovations"
    results = flown(two, third, 20, rule="ci")
    assert {(source, state) for _, source, state in changes(results)} == {("r1", "union"), ("r3", "union")}
    why = results[-1].status.sources["r1"]["state_why"]
    assert "which of them is wrong cannot be told" in why
    rules = results[-1].tracks.rules
    assert rules is not None
    assert "cu" in rules


def test_innovations_alone_are_no_contradiction() -> None:
    """Errors drawn anew are no filter's: the innovations of both say so, and their covariances are right."""
    two = ("r1", "r3")
    results = flown(two, honest, 20)
    assert not changes(results)
    for scale, wrong in ((1.0, False), (5.0, True)):
        rng = np.random.default_rng(SEED)
        pairs = all_pairs(2, np.array([1.0, 2.0 * scale - 1.0]), np.full(2, 100.0), 400.0, rng)
        joined, sure = with_innovations(pairs, 2, [(0, 3.0, 400.0), (1, 9.0, 400.0)], 4.0)
        assert (len(joined.first), sure.tolist()) == ((3, [True, True]) if wrong else (1, [False, False]))


def test_an_order_settles_it_until_it_is_withdrawn() -> None:
    made = centre(THREE)
    fly(made, THREE, third, range(1, 16))
    give_order(made, Order("supervise", "r3", state="trusted"))
    results = fly(made, THREE, third, range(16, 20))
    said = results[-1].status.sources["r3"]
    assert said["state"] == "trusted"
    assert said["state_why"] == "ordered by an operator"
    assert [one["what"] for one in made.orders.listed()] == ["supervise"]
    give_order(made, Order("supervise", "r3", state="auto"), Order("supervise", "r1", state="out"))
    give_order(made, Order("supervise", "r2", state="nonsense"), Order("supervise", "nobody", state="out"))
    results = fly(made, THREE, third, range(20, 24))
    states = {name: said["state"] for name, said in results[-1].status.sources.items()}
    assert states == {"r1": "out", "r2": "trusted", "r3": "inflated"}
    done = [event["done"] for event in results[0].log.events if event["kind"] == "order"]
    assert done == [True, True, False, False]
    assert (results[-1].tracks.contributor_counts == 2).all()


def give_order(made: FusionCentre, *orders: Order) -> None:
    for order in orders:
        made.handle(order, START)


def test_a_restart_goes_on_bit_for_bit() -> None:
    made = centre(THREE)
    fly(made, THREE, third, range(1, 9))
    blob = made.checkpoint()
    other = FusionCentre({"lateness": 3.0}, checkpoint=blob)
    one, two = (fly(each, THREE, third, range(9, 20)) for each in (made, other))
    for a, b in zip(one, two, strict=True):
        plain = [schemas.encode(replace(each.tracks, seq=0)) for each in (a, b)]
        assert plain[0] == plain[1]
        assert a.status.sources == b.status.sources


def test_the_order_of_arrival_does_not_matter() -> None:
    one, two = (flown(names, third, 12) for names in (THREE, THREE[::-1]))
    assert changes(one) == changes(two) != []
    np.testing.assert_array_equal(one[-1].tracks.covariances, two[-1].tracks.covariances)


def test_nothing_and_nonsense_are_taken() -> None:
    honesty = Honesty(SPACE)
    none = np.zeros(0, dtype=np.intp)
    flags = np.zeros(0, dtype=np.bool_)
    rows = Rows(
        none, none.astype(np.uint64), empty_tracks(4), flags, none.astype(np.int64), flags, np.zeros((5, 0)), flags, {}
    )
    honesty.observe(rows, ("a", "b"), shared_pairs(rows, 0), np.ones((2, 2)))
    assert honesty.opinions(1e-6, {"a": (3.0, 1e4), "nobody": (1.0, 1.0)}) == {}
    again = Honesty(SPACE)
    again.restore(honesty.packed())
    assert again.packed() == honesty.packed()
    again.restore({"space": ["x"]})
    made = centre(THREE)
    made.handle(info("r9"), START)
    results = fly(made, ("r1",), honest, range(1, 3))
    assert results[-1].status.sources["r9"]["resting"], "it has said nothing but its info"
    assert results[-1].status.sources["r1"]["state"] == "trusted"


def test_states_go_up_at_once_and_down_when_it_is_calm() -> None:
    states = States()
    bad = Opinion(2.0, 0.8, 1.2, (4.0, 1.0), (4.0, 1.0), (True, False), compared=100.0, beside=("b",))
    good = Opinion(1.0, 0.8, 1.2, (1.05, 1.0))
    second = 10**9

    def go(opinion: Opinion, t: float) -> str:
        states.settle(("a",), {"a": opinion}, {}, {}, round(t * second))
        return states.of("a").state

    assert go(bad, 1) == "inflated"
    assert states.of("a").inflation == (4.0, 1.0)
    slightly = Opinion(2.0, 0.8, 1.2, (4.5, 1.0), (4.5, 1.0), (True, False), compared=100.0, beside=("b",))
    assert go(slightly, 2) == "inflated"
    assert states.of("a").inflation == (4.0, 1.0)
    assert go(good, 3) == "inflated"
    assert go(bad, 4) == "inflated"
    assert go(good, 5) == "inflated"
    assert go(good, 14) == "inflated"
    assert go(good, 15) == "trusted"
    states.settle(("a",), {"a": good}, {}, {"a": "its tracks stand still"}, 16 * second)
    assert states.of("a").state == "out"
    assert states.of("a").why == "its tracks stand still"
