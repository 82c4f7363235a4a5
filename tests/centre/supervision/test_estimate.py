"""The estimate of errors beside dense solutions, the gauge, how long errors last, corrections and matches."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.offset_sources import SPACE, Offset
from fusion_service.centre.supervision.bias import CLOCK, PARAMETERS, design
from fusion_service.centre.supervision.correction import Bias
from fusion_service.centre.supervision.estimate import Group, Information
from fusion_service.centre.supervision.gauge import connected, gauge, gauge_weights, gauge_words
from fusion_service.centre.supervision.lasting import Lasting
from fusion_service.centre.supervision.matching import Tracks2, match
from fusion_service.centre.tracks import empty_tracks

Floats = NDArray[np.float64]
P = len(PARAMETERS)
SIGMA = np.array([1.0, 100.0, 100.0, 0.02, 100.0, 1e-3, 3e-4])


def some_group(rng: np.random.Generator, members: list[list[int]]) -> Group:
    """Targets that the sources `members` see, with any covariances."""
    source = np.array([one for group in members for one in group])
    group = np.repeat(np.arange(len(members)), [len(one) for one in members])
    start = np.searchsorted(group, np.arange(len(members)))
    place, velocity = rng.uniform(-2e4, 2e4, (2, len(source))), rng.normal(0, 100, (2, len(source)))
    H = design(place, velocity, np.zeros((2, len(source))))
    A = rng.normal(size=(2, 2, len(source)))
    spread = np.einsum("ikm,jkm->ijm", A, A) * 400 + 100 * np.eye(2)[:, :, None]
    weight = np.moveaxis(np.linalg.inv(np.moveaxis(spread, 2, 0)), 0, 2)
    return Group(source, group, start, H, rng.normal(0, 100, (2, len(source))), weight)


def dense(groups: list[Group], sigma: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of all errors by least squares with every place of every target as an unknown."""
    size = sigma.size
    rows, values, total = [], [], sum(len(group.start) for group in groups)
    first = 0
    for group in groups:
        for k in range(len(group.source)):
            root = np.linalg.cholesky(group.weight[:, :, k]).T
            row = np.zeros((2, size + 2 * total))
            row[:, group.source[k] * P : (group.source[k] + 1) * P] = group.H[:, :, k]
            at = size + 2 * (first + int(group.group[k]))
            row[:, at : at + 2] = np.eye(2)
            rows.append(root @ row)
            values.append(root @ group.z[:, k])
        first += len(group.start)
    rows.append(np.hstack([np.diag(1 / sigma.ravel()), np.zeros((size, 2 * total))]))
    values.append(np.zeros(size))
    A, b = np.vstack(rows), np.concatenate(values)
    scale = 1 / np.sqrt((A**2).sum(axis=0))
    inverse = np.linalg.inv((A * scale).T @ (A * scale)) * scale[:, None] * scale
    return (inverse @ A.T @ b)[:size].reshape(sigma.shape), inverse[:size, :size]


def test_it_is_the_least_squares_solution_with_every_place_unknown() -> None:
    rng = np.random.default_rng(3)
    groups = [some_group(rng, [[0, 1], [0, 1, 2], [1, 2], [0, 2, 3]]) for _ in range(5)]
    info = Information(("a", "b", "c", "d"))
    for group in groups:
        info.add(group)
    sigma = np.tile(SIGMA, (4, 1))
    found = info.posterior(sigma, np.zeros((0, 4, P)))
    mean, covariance = dense(groups, sigma)
    unit = np.tile(SIGMA, 4)
    assert np.abs((found.mean - mean) / SIGMA).max() < 1e-6
    assert np.abs((found.covariance.reshape(4 * P, 4 * P) - covariance) / np.outer(unit, unit)).max() < 1e-7
    assert info.shared[0, 1] == 10
    assert info.shared[1, 3] == 0


def test_what_is_forgotten_is_integrated_out() -> None:
    rng = np.random.default_rng(4)
    info, sigma = Information(("a", "b", "c")), np.tile(SIGMA, (3, 1))
    for _ in range(6):
        info.add(some_group(rng, [[0, 1], [0, 1, 2], [1, 2]]))
    wide = sigma.copy()
    wide[1, CLOCK] = 1e5
    none = np.zeros((0, 3, P))
    want = info.posterior(wide, none)
    info.forget(1, np.arange(P) == CLOCK)
    got = info.posterior(sigma, none)
    others = np.ones((3, P), dtype=np.bool_)
    others[1, CLOCK] = False
    assert np.abs(((got.mean - want.mean) / SIGMA)[others]).max() < 1e-4
    assert np.sqrt(got.variance[1, CLOCK]) == pytest.approx(1.0, rel=1e-9)
    info.arrange(("a", "c", "new"))
    assert not info.matrix[2].any()
    assert info.matrix[:2][:, :, :2].any()


def test_a_source_that_is_sure_has_no_error_and_nothing_is_no_information() -> None:
    sigma = np.tile(SIGMA, (2, 1))
    sigma[0] = 0.0
    info = Information(("a", "b"))
    info.add(some_group(np.random.default_rng(1), []))
    found = info.posterior(sigma, np.zeros((0, 2, P)))
    assert not found.mean.any()
    assert not found.variance[0].any()
    assert np.sqrt(found.variance[1]) == pytest.approx(SIGMA)
    assert Information().posterior(np.zeros((0, P)), np.zeros((0, 0, P))).mean.shape == (0, P)


def differing(offsets: list[float]) -> Floats:
    """The estimated clocks of sources with these offsets, all of which see the same 20 targets well."""
    rng, count = np.random.default_rng(7), len(offsets)
    info, sigma = Information(tuple("abcdef"[:count])), np.tile(SIGMA, (count, 1))
    weights = np.ones(sigma.shape)
    for _ in range(8):
        group = some_group(rng, [list(range(count))] * 20)
        group = replace(group, H=group.H[..., group.start][..., group.group])
        z = group.H[:, CLOCK] * np.array(offsets)[group.source] + rng.normal(0, 0.1, (2, len(group.source)))
        info.add(replace(group, z=z, weight=1e4 * group.weight))
        label = connected(info.shared)
        reference = np.zeros(count, dtype=np.bool_)
        found = info.posterior(sigma, gauge(sigma, label, reference, weights))
        weights = gauge_weights(sigma, label, found.mean, found.variance)
    return found.mean[:, CLOCK]


def test_of_two_each_gets_half_and_of_more_the_odd_one_all() -> None:
    assert differing([0.0, 0.6]) == pytest.approx([-0.3, 0.3], abs=2e-3)
    assert differing([0.0, 0.6, 0.0]) == pytest.approx([0.0, 0.6, 0.0], abs=0.03)
    assert differing([5.0, 5.0, 5.4, 5.0, 5.0]) == pytest.approx([0.0, 0.0, 0.4, 0.0, 0.0], abs=0.03)


def test_who_hangs_together_and_by_what_errors_are_measured() -> None:
    shared = np.eye(5) * 9
    for a, b in ((0, 3), (3, 4)):
        shared[a, b] = shared[b, a] = 2.0
    label = connected(shared)
    assert label.tolist() == [0, 1, 2, 0, 0]
    names, none = ("a", "b", "c", "d", "e"), np.zeros(5, dtype=np.bool_)
    assert "weighted mean of 3" in gauge_words(names, 0, label, none)
    assert "no other source" in gauge_words(names, 1, label, none)
    assert gauge_words(names, 0, label, np.arange(5) == 4) == "relative to e"
    assert "it is the reference" in gauge_words(names, 4, label, np.arange(5) == 4)
    assert "which of the two" in gauge_words(("a", "b"), 0, np.zeros(2, dtype=np.intp), none[:2])
    assert connected(np.zeros((0, 0))).shape == (0,)


@pytest.mark.parametrize(("phi", "claims", "ratio"), [(0.0, 1.0, 1.0), (0.8, 1.0, 9.0), (0.5, 1 / 3, 27.0)])
def test_how_long_errors_last_is_measured(phi: float, claims: float, ratio: float) -> None:
    """AR(1) with parameter phi: a long mean has (1 + phi) / (1 - phi) times the variance of independent errors."""
    rng, count = np.random.default_rng(5), 40
    lasting = Lasting(2)
    group = some_group(rng, [[0, 1]] * count)
    group = replace(group, weight=np.tile(np.eye(2)[:, :, None], 2 * count))
    errors = rng.normal(size=(2, 2 * count))
    ids = np.repeat(np.arange(count, dtype=np.uint64), 2)
    for step in range(300):
        errors = phi * errors + np.sqrt(1 - phi**2) * rng.normal(size=errors.shape)
        now = replace(group, weight=group.weight / lasting.ratio[group.source])
        updated = np.full(2 * count, step)
        assert lasting.unused(group.source, ids, updated).all()
        lasting.learn(now, ids, updated, errors / claims, np.ones(2 * count, dtype=np.bool_))
        assert not lasting.unused(group.source, ids, updated).any()
    assert lasting.ratio == pytest.approx([ratio, ratio], rel=0.2)
    again = Lasting.unpacked(lasting.packed())
    assert again.packed() == lasting.packed()
    lasting.arrange(np.array([-1, 0]), 1)
    assert len(lasting.rows.id) == count
    assert lasting.ratio == pytest.approx([ratio], rel=0.2)


SAID = Offset(place=(3000.0, -2000.0), x=40.0, y=-25.0, heading=0.02, range=90.0, scale=2e-3)


def states(count: int = 30) -> Floats:
    rng = np.random.default_rng(8)
    return np.concatenate([rng.uniform(-3e4, 3e4, (count, 2)), rng.normal(0, 100, (count, 2))], axis=1)


def bias(one: Offset, covariance: Floats) -> Bias:
    value = np.array([0.0, one.x, one.y, one.heading, one.range, one.scale, 0.0])
    return Bias(SPACE, np.array(one.place), value, covariance)


def test_what_is_taken_off_is_what_was_put_on() -> None:
    truth, rng = states(), np.random.default_rng(9)
    A = rng.normal(size=(len(truth), 4, 4))
    tracks = replace(
        empty_tracks(4), mean=SAID.says(truth).T, covariance=np.moveaxis(A @ A.transpose(0, 2, 1) + np.eye(4), 0, 2)
    )
    one = bias(SAID, np.zeros((P, P)))
    off = one.off(tracks)
    assert np.abs(off.mean[:2] - truth[:, :2].T).max() < 1e-6
    assert np.abs(off.mean[2:] - truth[:, 2:].T).max() < 0.02 * 100, "range and scale turn and stretch a velocity"
    for k in range(len(truth)):  # places by the numerical Jacobian
        J = np.zeros((2, 2))
        for axis in (0, 1):
            ends = [tracks.mean[:, k : k + 1] + side * np.eye(4)[:, axis : axis + 1] for side in (-0.5, 0.5)]
            low, high = (one.moved(end, tracks.covariance[..., :1])[0][:2, 0] for end in ends)
            J[:, axis] = high - low
        G = np.kron(np.eye(2), J)
        assert np.abs(G @ tracks.covariance[..., k] @ G.T - off.covariance[..., k]).max() < 1e-4
    none = one.off(empty_tracks(4))
    assert none.mean.shape == (4, 0)


def test_errors_act_to_first_order_as_the_design_says() -> None:
    truth, small = states(), np.array([1e-3, 0.1, 0.1, 1e-6, 0.1, 1e-6, 1.0])
    H = design(truth[:, :2].T, truth[:, 2:].T, np.repeat(np.array(SAID.place)[:, None], len(truth), axis=1))
    before = truth - small[CLOCK] * np.concatenate([truth[:, 2:], np.zeros((len(truth), 2))], axis=1)
    for k, name in enumerate(PARAMETERS):
        more: dict[str, Any] = {name: float(small[k])} if k else {}
        one = Offset(place=SAID.place, **more)
        moved = one.says(truth if k else before)[:, :2] - truth[:, :2]
        assert np.abs(moved.T / small[k] - H[:, k]).max() < 1e-4 * max(np.abs(H[:, k]).max(), 1.0)


def test_what_stays_uncertain_is_common_to_all() -> None:
    rng = np.random.default_rng(10)
    sd = np.array([0.0, 5.0, 3.0, 1e-3, 0.0, 0.0, 0.0])
    truth = states(4)
    one = bias(Offset(place=SAID.place), np.diag(sd**2))
    want = one.common(truth.T)
    drawn = rng.normal(size=(4000, P)) * sd
    said = np.stack([Offset(SAID.place, 0.0, *draw[1:4]).says(truth) for draw in drawn])
    got = np.einsum("rta,rtb->abt", said - truth, said - truth) / len(drawn)
    assert np.abs(got - want).max() < 0.1 * np.abs(want).max()


def two(rng: np.random.Generator, truth: Floats, other: Floats) -> tuple[Tracks2, Tracks2]:
    out = []
    for one in (truth, other):
        seen = one + rng.normal(size=one.shape) * [20, 20, 2, 2]
        spread = np.repeat(np.eye(2)[:, :, None], len(one), axis=2)
        out.append(Tracks2(seen[:, :2].T, seen[:, 2:].T, 400 * spread, 4 * spread))
    return out[0], out[1]


@pytest.mark.parametrize(
    "what", [{"clock": 2.5}, {"x": 180.0, "y": -220.0}, {"heading": 0.02}, {"range": 250.0}], ids=lambda w: "+".join(w)
)
def test_tracks_that_one_error_keeps_apart_are_matched(what: dict[str, Any]) -> None:
    rng = np.random.default_rng(11)
    truth = states(25)
    clock = what.get("clock", 0.0)
    late = truth - clock * np.concatenate([truth[:, 2:], np.zeros((25, 2))], axis=1)
    said = replace(Offset(place=SAID.place), **what).says(late)
    order = rng.permutation(25)[:20]
    i, j = match(*two(rng, truth[3:], said[order]), np.array(SAID.place), SIGMA)
    assert len(i) >= 12
    assert (i + 3 == order[j]).all()


def test_nothing_is_matched_by_chance_or_where_one_cannot_tell() -> None:
    rng = np.random.default_rng(12)
    for trial in range(20):
        truth = states(25)
        other = np.concatenate([truth[:, :2] + rng.uniform(-2000, 2000, (25, 2)), rng.normal(0, 100, (25, 2))], axis=1)
        i, _ = match(*two(rng, truth, other), np.zeros(2), SIGMA)
        assert not len(i), f"trial {trial}"
    convoy = np.array([[200.0 * k, 0.0, 20.0, 0.0] for k in range(12)])
    i, _ = match(*two(rng, convoy, convoy + np.array([0.0, 250.0, 0.0, 0.0])), np.zeros(2), SIGMA)
    assert not len(i), "shifted by any number of places they fit nearly as well"
    none = two(rng, convoy[:0], convoy)
    assert len(match(*none, np.zeros(2), SIGMA)[0]) == 0
