"""Intensities fused place by place, against the densities written out on a grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, multivariate_normal

from fusion_service.centre.cells import Components, Covering, find_cells, fuse_cells, merge_near, reduced

Array = NDArray[np.float64]
Source = list[tuple[float, Array, Array]]
"""(weight, mean, covariance) of its components."""

PLACES = np.array([[0.0, 0.0], [400.0, 50.0], [-100.0, -500.0]])


def joined(sources: list[Source]) -> tuple[Components, NDArray[np.intp]]:
    rows = [(i, *component) for i, source in enumerate(sources) for component in source]
    index = np.array([row[0] for row in rows], dtype=np.intp)
    mean, covariance = np.array([row[2] for row in rows]).T, np.array([row[3] for row in rows]).transpose(1, 2, 0)
    weight, share = np.array([row[1] for row in rows]), np.eye(len(sources))[:, index]
    return Components(weight, np.ascontiguousarray(mean), np.ascontiguousarray(covariance), share), index


def everywhere(sources: int) -> Covering:
    return lambda mean: np.ones((sources, mean.shape[1]), dtype=np.bool_)


def fused(
    rule: str, sources: list[Source], cardinality: str = "average", covering: Covering | None = None
) -> Components:
    parts, index = joined(sources)
    n = len(parts.mean)
    cell = find_cells(parts, index, list(range(min(n, 2))), float(chi2.ppf(0.999, n)))
    return fuse_cells(rule, cardinality, parts, index, cell, covering or everywhere(len(sources)))


def spread(rng: np.random.Generator, n: int = 2) -> Array:
    root = rng.normal(size=(n, n)) * 12
    return np.asarray(root @ root.T + 60 * np.eye(n))


def three_sources(seed: int) -> list[Source]:
    """Each with its own view of each of the places."""
    rng = np.random.default_rng(seed)
    return [
        [
            (float(rng.uniform(0.3, 1.1)), place + rng.normal(size=2) * 6, spread(rng))
            for place in rng.permutation(PLACES)
        ]
        for _ in range(3)
    ]


def dense(source: Source, at: Array) -> Array:
    return np.asarray(sum(w * multivariate_normal.pdf(at, m, P) for w, m, P in source))


def around(place: Array, half: float = 225.0, step: float = 1.5) -> tuple[Array, float]:
    axis = np.arange(-half, half, step)
    return np.stack(np.meshgrid(axis, axis), axis=-1) + place, step * step


def moments(values: Array, at: Array, area: float) -> tuple[float, Array, Array]:
    mass = values.sum() * area
    mean = np.einsum("ab,abi->i", values, at) * area / mass
    away = at - mean
    return float(mass), mean, np.einsum("ab,abi,abj->ij", values, away, away) * area / mass


AVERAGE: dict[str, Callable[[list[Array]], Array]] = {
    "aa": lambda f: np.asarray(sum(f) / len(f)),
    "ga": lambda f: np.asarray(np.prod(f, axis=0) ** (1 / len(f))),
}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rule", ["aa", "ga"])
def test_mass_mean_and_covariance_of_every_place_are_those_of_the_dense_average(rule: str, seed: int) -> None:
    sources = three_sources(seed)
    out = fused(rule, sources)
    assert len(out.weight) == 3
    for place in PLACES:
        at, area = around(place)
        mass, mean, covariance = moments(AVERAGE[rule]([dense(source, at) for source in sources]), at, area)
        k = int(np.linalg.norm(out.mean - place[:, None], axis=0).argmin())
        assert out.weight[k] == pytest.approx(mass, rel=1e-6)
        np.testing.assert_allclose(out.mean[:, k], mean, atol=1e-4)
        np.testing.assert_allclose(out.covariance[:, :, k], covariance, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("seed", range(4))
def test_the_geometric_average_is_that_of_the_grid_at_every_point(seed: int) -> None:
    sources = three_sources(seed)
    mixture = fused("ga", sources).mixture()
    assert mixture is not None
    for place in PLACES:
        at, _ = around(place, step=15.0)
        expected = AVERAGE["ga"]([dense(source, at) for source in sources])
        np.testing.assert_allclose(mixture.pdf(at), expected, rtol=1e-6, atol=1e-9 * expected.max())


@pytest.mark.parametrize("seed", range(4))
def test_the_hybrid_has_the_number_of_one_average_and_the_place_of_the_other(seed: int) -> None:
    """Li-2nd 5.1: normalised to densities, fused by GA, weighted so that the sum is the average of the weight sums."""
    sources = [source[:1] for source in three_sources(seed)]
    sources = [[(w, PLACES[0] + 5 * i, P)] for i, ((w, _, P),) in enumerate(sources)]
    mixture = fused("hybrid", sources).mixture()
    assert mixture is not None
    at, area = around(PLACES[0])
    values = [dense(source, at) for source in sources]
    shape = AVERAGE["ga"]([one / (one.sum() * area) for one in values])
    expected = np.mean([one.sum() * area for one in values]) * shape / (shape.sum() * area)
    np.testing.assert_allclose(mixture.pdf(at), expected, rtol=1e-6, atol=1e-9 * expected.max())


def test_the_example_of_figure_7() -> None:
    """The isolated component at 90: half of it stays by aa and the hybrid, nothing by ga. Products of components
    of different targets left out, the mass of ga is nearer to the exact integral than the first order with them."""
    first: Source = [
        (w, np.array([m]), np.array([[P]])) for w, m, P in ((0.7, 10.0, 100.0), (0.6, 50, 100), (0.5, 90, 200))
    ]
    second: Source = [(w, np.array([m]), np.array([[P]])) for w, m, P in ((0.9, 11.0, 100.0), (0.8, 52, 120))]
    x = np.arange(-150.0, 250.0, 0.01)[:, None]
    exact = np.sqrt(dense(first, x) * dense(second, x)).sum() * 0.01
    assert exact == pytest.approx(1.5634, abs=1e-3)
    aa, ga, hybrid = (fused(rule, [first, second]) for rule in ("aa", "ga", "hybrid"))
    assert len(aa.weight) == len(hybrid.weight) == 3
    np.testing.assert_allclose(aa.weight, hybrid.weight)
    assert aa.mass == pytest.approx(1.75)
    assert aa.weight[np.abs(aa.mean[0] - 90).argmin()] == pytest.approx(0.25)
    assert np.abs(ga.mean[0] - 90).min() > 30
    assert abs(ga.mass - exact) < 1.8964 - exact
    assert (hybrid.covariance[0, 0] <= aa.covariance[0, 0] + 1e-9).all(), "Li-2nd remark 5"


def equidistant_rate(a: float, b: float) -> float:
    """The Poisson rate as far, in Kullback-Leibler divergence, from rate a as from rate b."""

    def divergence(x: float, y: float) -> float:
        return x * float(np.log(x / y)) - x + y

    return float(brentq(lambda x: divergence(x, a) - divergence(x, b), min(a, b), max(a, b)))


def test_the_consistent_number_is_equally_far_from_the_least_and_the_largest() -> None:
    sources = three_sources(9)
    masses = sorted(sum(w for w, _, _ in source) for source in sources)
    assert masses[2] > 1.05 * masses[0]
    out, average = fused("hybrid", sources, "consistent"), fused("hybrid", sources)
    assert average.mass == pytest.approx(np.mean(masses))
    assert out.mass == pytest.approx(equidistant_rate(masses[0], masses[2]))
    np.testing.assert_allclose(out.weight / out.mass, average.weight / average.mass)
    np.testing.assert_array_equal(out.mean, average.mean)


def test_consistency_is_of_places_with_the_same_sources() -> None:
    near = [(0.9, PLACES[0], 50 * np.eye(2))]
    far = [(0.4, PLACES[1], 50 * np.eye(2))]
    sources = [near, [(0.5, PLACES[0], 50 * np.eye(2)), *far]]

    def covering(mean: Array) -> NDArray[np.bool_]:
        return np.stack([mean[0] < 200, np.ones(mean.shape[1], dtype=np.bool_)])

    out = fused("hybrid", sources, "consistent", covering)
    np.testing.assert_allclose(np.sort(out.weight), [0.4, equidistant_rate(0.5, 0.9)])


@pytest.mark.parametrize(("rule", "blind"), [("aa", 1 / 3), ("ga", 0.0), ("hybrid", 1 / 3)])
def test_what_one_of_three_can_see_stays_where_the_others_do_not_look(rule: str, blind: float) -> None:
    """With coverage its mass is that of its one source; without, aa and the hybrid keep a third and ga nothing."""
    common = [(0.9, PLACES[0], 50 * np.eye(2))]
    sources: list[Source] = [[*common, (0.98, PLACES[1], 50 * np.eye(2))], common, common]

    def covering(mean: Array) -> NDArray[np.bool_]:
        return np.stack([mean[0] < limit for limit in (1e3, 200, 200)])

    def there(out: Components) -> float:
        return float(out.weight[out.mean[0] > 200].sum())

    assert there(fused(rule, sources, covering=covering)) == pytest.approx(0.98)
    assert there(fused(rule, sources)) == pytest.approx(0.98 * blind)
    for out in (fused(rule, sources, covering=covering), fused(rule, sources)):
        assert out.weight[out.mean[0] < 200].sum() == pytest.approx(0.9)
        np.testing.assert_allclose(out.share.sum(axis=0), 1.0)


def test_who_does_not_cover_a_place_does_not_count_there_unless_nobody_does() -> None:
    one: Source = [(0.8, PLACES[0], 50 * np.eye(2))]
    two: Source = [(0.2, PLACES[0] + 3, 50 * np.eye(2))]
    out = fused("aa", [one, two], covering=lambda mean: np.array([[True], [False]]))
    assert out.weight.tolist() == [0.8]
    assert out.mean[:, 0].tolist() == PLACES[0].tolist()
    assert out.share[:, 0].tolist() == [1.0, 0.0]
    none = fused("aa", [one, two], covering=lambda mean: np.zeros((2, 1), dtype=np.bool_))
    assert none.weight[0] == pytest.approx(0.5)
    np.testing.assert_allclose(none.share[:, 0], [0.8, 0.2])


def test_two_near_targets_are_matched_each_with_its_own() -> None:
    rng = np.random.default_rng(4)
    places = np.array([[0.0, 0.0], [40.0, 0.0]])
    sources = [[(0.9, place + rng.normal(size=2) * 3, 80 * np.eye(2)) for place in places] for _ in range(3)]
    sources[1].append((0.05, places[0] + 1, 80 * np.eye(2)))
    for rule in ("aa", "ga", "hybrid"):
        out = reduced(fused(rule, sources), 0.1, 0.0, 9)
        assert len(out.weight) == 2
        gap = np.linalg.norm(out.mean[:, :, None] - places.T[:, None], axis=0)
        assert sorted(gap.argmin(axis=1).tolist()) == [0, 1]
        assert gap.min(axis=1).max() < 6
        assert out.weight.min() > 0.8


def test_merging_keeps_the_moments_and_reduction_the_heaviest() -> None:
    rng = np.random.default_rng(7)
    source: Source = [(float(w), rng.normal(size=2) * 30, spread(rng)) for w in rng.exponential(size=40)]
    parts, _ = joined([source])
    merged = merge_near(parts, 4.0)
    assert 1 < len(merged.weight) < 40
    assert (np.diff(merged.weight) <= 0).all()

    def whole(p: Components) -> list[Array]:
        mass = p.weight.sum()
        mean = p.mean @ p.weight / mass
        away = p.mean - mean[:, None]
        return [np.array(mass), mean, (p.covariance @ p.weight + (p.weight * away) @ away.T) / mass]

    for a, b in zip(whole(merged), whole(parts), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-9)
    few = reduced(parts, 0.1, 0.0, 5)
    np.testing.assert_array_equal(few.weight, np.sort(parts.weight)[::-1][:5])
    assert len(reduced(parts, 1e9, 1.0, 5).weight) == 0


def test_a_place_has_the_same_bits_whatever_is_elsewhere() -> None:
    sources = three_sources(5)
    far = [[*source, (0.7, np.array([9e3 + i, 9e3]), 30 * np.eye(2))] for i, source in enumerate(sources)]
    for rule in ("aa", "ga", "hybrid"):
        alone, among = fused(rule, sources), fused(rule, far)
        here = among.take(np.abs(among.mean[0]) < 5e3)
        for name in ("weight", "mean", "covariance", "share"):
            assert getattr(alone, name).tobytes() == np.ascontiguousarray(getattr(here, name)).tobytes()
