"""Association against brute force: every pair, every group, one by one."""

from __future__ import annotations

import time
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.centre import association
from fusion_service.centre.association import (
    by_size,
    candidate_pairs,
    cluster,
    leave_one_out,
    pair_distance,
    uniform_ci,
)


def gaussians(count: int, n: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, n, n))
    return rng.normal(size=(n, count)), np.moveaxis(root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n), 0, 2)


def test_groups_are_gathered_by_size() -> None:
    labels = np.array([7, 3, 7, 9, 3, 7, 1], dtype=np.uint64)
    found = {
        int(label): rows.tolist() for names, group in by_size(labels) for label, rows in zip(names, group, strict=True)
    }
    assert found == {1: [6], 9: [3], 3: [1, 4], 7: [0, 2, 5]}
    assert list(by_size(labels[:0])) == []


@pytest.mark.parametrize("k", [1, 2, 5])
def test_uniform_ci_is_the_mean_of_the_informations(k: int) -> None:
    means, covariances = gaussians(k, 3, 1)
    mean, covariance = uniform_ci(means.T[:, :, None], np.moveaxis(covariances, 2, 0)[..., None])
    inverses = [np.linalg.inv(covariances[:, :, j]) for j in range(k)]
    dense = np.linalg.inv(sum(inverses) / k)
    np.testing.assert_allclose(covariance[:, :, 0], dense, rtol=1e-9)
    expected = dense @ sum(y @ means[:, j] for j, y in enumerate(inverses)) / k
    np.testing.assert_allclose(mean[:, 0], expected, rtol=1e-8, atol=1e-12)


def test_where_rounding_spoils_a_fusion_the_sharpest_source_stands_for_it() -> None:
    # a correlation matrix with a condition of 1e16: its inverse has lost all digits
    u = np.array([1.0, -16.0, -34.0, -10.0])
    spoilt = np.outer(u, u) * 1e-3 + 1e-19 * np.eye(4)
    good = np.diag([2000.0, 0.2, 1e-4, 200.0])
    fine = np.diag([1.0, 2.0, 3.0, 4.0])
    x = np.array([4e6, 3e6, 6e6, 2e6])
    covariances = np.stack([np.stack([good, fine], axis=2), np.stack([spoilt, fine], axis=2)])
    mean, covariance = uniform_ci(np.tile(x[:, None], (2, 1, 2)), covariances)
    assert linalg.is_positive_definite(covariance, 0.0).all()
    np.testing.assert_allclose(mean, np.tile(x[:, None], (1, 2)), rtol=1e-12)
    np.testing.assert_allclose(covariance[:, :, 1], fine, rtol=1e-12)
    assert any(np.array_equal(covariance[:, :, 0], one) for one in (good, spoilt))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0.5, 15), st.sampled_from([-1, 1])), min_size=2, max_size=3), st.integers(0, 10**6))
def test_a_nearly_singular_fusion_is_exact_to_four_digits_or_is_one_of_its_sources(
    correlations: list[tuple[float, int]], seed: int
) -> None:
    scale = 10.0 ** np.random.default_rng(seed).uniform(-3, 3, (len(correlations), 2))
    rho = [sign * (1 - 10.0**-digits) for digits, sign in correlations]
    P = np.array([[[a * a, r * a * b], [r * a * b, b * b]] for (a, b), r in zip(scale, rho, strict=True)])
    _, covariance = uniform_ci(np.zeros((len(P), 2, 1)), P[..., None])
    if any(np.array_equal(covariance[:, :, 0], one) for one in P):
        return

    def inverse(a: Fraction, b: Fraction, d: Fraction) -> tuple[Fraction, Fraction, Fraction]:
        det = a * d - b * b
        return d / det, -b / det, a / det

    informations = [inverse(*(Fraction(float(one[at])) for at in ((0, 0), (0, 1), (1, 1)))) for one in P]
    a, _, d = inverse(*(sum(parts, Fraction(0)) / len(P) for parts in zip(*informations, strict=True)))
    assert covariance[0, 0, 0] == pytest.approx(float(a), rel=1e-4)
    assert covariance[1, 1, 0] == pytest.approx(float(d), rel=1e-4)


def test_leave_one_out_is_the_distance_to_the_fusion_of_the_others() -> None:
    labels = np.array([4, 2, 4, 9, 4, 2])
    means, covariances = gaussians(6, 2, 2)
    got = leave_one_out(labels, means, covariances)
    for row, label in enumerate(labels):
        others = [j for j in np.flatnonzero(labels == label) if j != row]
        if not others:
            assert np.isnan(got[row])
            continue
        inverses = [np.linalg.inv(covariances[:, :, j]) for j in others]
        covariance = np.linalg.inv(sum(inverses) / len(others))
        mean = covariance @ sum(y @ means[:, j] for y, j in zip(inverses, others, strict=True)) / len(others)
        d = means[:, row] - mean
        assert got[row] == pytest.approx(d @ np.linalg.solve(covariances[:, :, row] + covariance, d), rel=1e-8)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 25), st.integers(0, 10**6), st.floats(0.5, 6))
def test_no_gated_pair_of_different_sources_is_missed_among_candidates(count: int, seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    position = rng.uniform(-100, 100, (2, count))
    axis = 10.0 ** rng.uniform(-1, 3, (2, count))
    source = np.sort(rng.integers(-1, 3, count))
    covariance = np.zeros((2, 2, count))
    covariance[0, 0], covariance[1, 1] = axis**2
    i, j = candidate_pairs(position, np.sqrt((axis**2).sum(axis=0)), reach, source)
    pairs = list(zip(i.tolist(), j.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert all(a < b and (source[a] != source[b] or source[a] == -1) for a, b in pairs)
    everyone = np.array(list(combinations(range(count), 2)), dtype=np.intp).reshape(-1, 2)
    distance, spread = pair_distance(position, covariance, everyone[:, 0], everyone[:, 1])
    differ = (source[everyone[:, 0]] != source[everyone[:, 1]]) | (source[everyone[:, 0]] == -1)
    gated = {tuple(pair) for pair in everyone[(distance <= reach**2) & differ].tolist()}
    assert gated <= set(pairs)
    for (a, b), logdet in zip(everyone.tolist(), spread, strict=True):
        assert logdet == pytest.approx(
            np.linalg.slogdet(covariance[:, :, a] + covariance[:, :, b])[1], rel=1e-9, abs=1e-9
        )


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_a_crowd_keeps_its_nearest_and_costs_no_more_than_its_rows(spread: float) -> None:
    count = 1000
    position = np.random.default_rng(3).normal(size=(2, 4 * count)) * spread
    source = np.repeat([-1, 0, 1, 2], count)
    begin = time.process_time()
    i, j = candidate_pairs(position, np.full(4 * count, 1e3), 3.0, source)
    assert time.process_time() - begin < 5.0
    assert len(i) <= 256 * 4 * count
    pairs = set(zip(i.tolist(), j.tolist(), strict=True))
    assert len(pairs) == len(i)
    for row in range(0, 4 * count, 97):
        for other in {-1, 0, 1, 2} - {int(source[row])}:
            rows = np.flatnonzero(source == other)
            far = np.hypot(*(position[:, rows] - position[:, [row]]))
            # where all are equally near: those whose place in their source is like the row's own
            order = np.argsort(far) if spread else np.argsort(np.abs(rows % count - row % count), kind="stable")
            assert all((min(row, k), max(row, k)) in pairs for k in rows[order[:50]].tolist())


def test_coincident_sources_are_paired_first_with_first() -> None:
    count = 300
    source = np.repeat([0, 1, 2], count)
    i, j = candidate_pairs(np.zeros((2, 3 * count)), np.ones(3 * count), 3.0, source)
    root, _ = cluster(i, j, np.zeros(len(i)), 1 << source, np.zeros(3 * count, dtype=np.bool_))
    assert sorted(np.unique(root, return_counts=True)[1].tolist()) == [3] * count


def test_a_row_that_is_not_finite_has_no_partner() -> None:
    position = np.array([[0.0, np.nan, 0.0, 0.0], [0.0, 0.0, np.inf, 0.0]])
    i, j = candidate_pairs(position, np.array([1.0, 1.0, 1.0, np.inf]), 3.0, np.arange(4))
    assert len(i) == len(j) == 0
    i, j = candidate_pairs(position[:, [1, 0, 0]], np.ones(3), 3.0, np.arange(3))
    assert (i.tolist(), j.tolist()) == ([1], [2])


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_clusters_obey_their_rule_in_any_order_of_pairs(data: st.DataObject) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(association, "CHUNK", data.draw(st.integers(1, 40)))
        obey(data)


def obey(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 9))
    everyone = list(combinations(range(count), 2))
    chosen = data.draw(st.lists(st.sampled_from(everyone), unique=True) if everyone else st.just([]))
    cost = [data.draw(st.integers(0, 5)) for _ in chosen]
    sources = [1 << data.draw(st.integers(0, 3)) for _ in range(count)]
    whole = [data.draw(st.booleans()) for _ in range(count)]

    def run(order: list[int]) -> list[int]:
        i = np.array([chosen[k][0] for k in order], dtype=np.intp)
        j = np.array([chosen[k][1] for k in order], dtype=np.intp)
        return cluster(i, j, np.array([cost[k] for k in order], dtype=float), np.array(sources), np.array(whole))[0]

    root = run(list(range(len(chosen))))
    assert run(data.draw(st.permutations(range(len(chosen))))) == root
    clusters = {r: [k for k in range(count) if root[k] == r] for r in set(root)}
    for r, nodes in clusters.items():
        assert r == min(nodes)
        assert len({sources[k] for k in nodes}) == len(nodes)
        assert sum(whole[k] for k in nodes) <= 1
        assert all(pair in chosen for pair in combinations(nodes, 2))
    for (a, b), (c, d) in combinations(clusters.items(), 2):
        joinable = (
            all((min(x, y), max(x, y)) in chosen for x in b for y in d)
            and not {sources[k] for k in b} & {sources[k] for k in d}
            and sum(whole[k] for k in b + d) <= 1
        )
        assert not joinable, f"{a} and {c} should be one"


def test_a_sharp_pair_wins_over_a_vague_one() -> None:
    means = np.array([[0.0, 1.0, 0.5], [0.0, 0.0, 0.0]])
    covariances = np.stack([np.eye(2) * v for v in (1.0, 1.0, 400.0)], axis=2)
    i, j = np.array([0, 0]), np.array([1, 2])
    distance, spread = pair_distance(means, covariances, i, j)
    assert distance[1] < distance[0]
    root, joins = cluster(i, j, distance + spread, np.array([1, 2, 2]), np.zeros(3, dtype=np.bool_))
    assert root == [0, 0, 2]
    assert [join[:2] for join in joins] == [(0, 1)]
