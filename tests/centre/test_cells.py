"""Intensities fused place by place, against the densities written out on a grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, multivariate_normal

from fusion_service.centre.cells import (
    Components,
    Covering,
    Stated,
    cells_and_reach,
    find_cells,
    fuse_cells,
    merge_near,
    reduced,
)

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
    rule: str,
    sources: list[Source],
    cardinality: str = "average",
    covering: Covering | None = None,
    stated: Stated | None = None,
) -> Components:
    parts, index = joined(sources)
    n = len(parts.mean)
    places, gate = list(range(min(n, 2))), float(chi2.ppf(0.999, n))
    cell, reached = cells_and_reach(parts, index, places, gate, None if stated is None else stated.registration)
    if stated is None:
        np.testing.assert_array_equal(cell, find_cells(parts, index, places, gate))
    return fuse_cells(rule, cardinality, parts, index, cell, covering or everywhere(len(sources)), stated, reached)


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


@pytest.mark.parametrize("p", [0.3, 0.9])
def test_a_miss_leaves_one_less_the_detection_probability_of_the_number(p: float) -> None:
    """Targets of one place, Poisson, each detected with probability p: their mean number where none was, drawn."""
    rate, rng = 0.7, np.random.default_rng(8)
    number = rng.poisson(rate, 400_000)
    kept = number[rng.binomial(number, p) == 0]
    error = float(kept.std() / np.sqrt(len(kept)))
    sees: Source = [(rate, PLACES[0], 50 * np.eye(2))]
    stated = Stated(np.ones(2, dtype=np.bool_), np.array([0.0, 1 - p]))
    out = fused("aa", [sees, [(0.2, PLACES[1], 50 * np.eye(2))]], stated=stated)
    here = out.weight[np.linalg.norm(out.mean - PLACES[0][:, None], axis=0).argmin()]
    print(f"seed 8: {kept.mean():.4f} +- {error:.4f}")
    assert 2 * here - rate == pytest.approx(kept.mean(), abs=5 * error)


@pytest.mark.parametrize("rule", ["aa", "ga"])
@pytest.mark.parametrize("p", [(0.0, 0.0, 0.0), (0.5, 0.5, 0.7), (0.9, 0.6, 0.2)])
def test_what_sources_that_look_did_not_see_on_a_grid(rule: str, p: tuple[float, float, float]) -> None:
    """A silent source has 1 - p of what the others have there on the average (of the rule's own kind)."""
    rng = np.random.default_rng(10)
    here: list[Source] = [[(w, PLACES[0] + rng.normal(size=2) * 4, spread(rng))] for w in (0.9, 0.6)]
    away: Source = [(0.8, PLACES[1], 60 * np.eye(2))]
    sources = [here[0], away, here[1]]
    stated = Stated(np.ones(3, dtype=np.bool_), 1 - np.array(p))
    out = fused(rule, sources, stated=stated)
    at, area = around(PLACES[0])
    heard = [dense(source, at) for source in here]
    silent = (1 - p[1]) * AVERAGE[rule](heard)
    mass, mean, covariance = moments(AVERAGE[rule]([heard[0], silent, heard[1]]), at, area)
    k = int(np.linalg.norm(out.mean - PLACES[0][:, None], axis=0).argmin())
    assert out.weight[k] == pytest.approx(mass, rel=1e-6)
    np.testing.assert_allclose(out.mean[:, k], mean, atol=1e-4)
    np.testing.assert_allclose(out.covariance[:, :, k], covariance, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(out.share[1, k], 0.0)
    np.testing.assert_allclose(out.share.sum(axis=0), 1.0)


@pytest.mark.parametrize("rule", ["aa", "ga", "hybrid"])
def test_a_source_that_declares_no_coverage_says_nothing_by_silence(rule: str) -> None:
    one: Source = [(0.9, PLACES[0], 50 * np.eye(2))]
    two: Source = [(0.8, PLACES[1], 50 * np.eye(2))]
    part = 0.0 if rule == "ga" else 0.5
    for declared, expected in (((False, False), [0.8, 0.9]), ((True, False), [0.8 * part, 0.9])):
        stated, cover = Stated(np.array(declared), np.zeros(2)), np.array(declared)[:, None]

        def covering(mean: Array, cover: NDArray[np.bool_] = cover) -> NDArray[np.bool_]:
            return np.repeat(cover, mean.shape[1], axis=1)

        out = fused(rule, [one, two], covering=covering, stated=stated)
        np.testing.assert_allclose(np.sort(out.weight), [weight for weight in expected if weight])


def shifts(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.stack([10 * spread(rng), np.zeros((2, 2)), 90 * np.eye(2)], axis=-1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rule", ["aa", "ga"])
def test_registration_convolves_what_a_source_says(rule: str, seed: int) -> None:
    """On a grid: every source's density with the covariance of its shift added, averaged."""
    sources, R = three_sources(seed), shifts(seed)
    far = [[(w, m + 9 * PLACES[np.linalg.norm(PLACES - m, axis=1).argmin()], P) for w, m, P in s] for s in sources]
    stated = Stated(np.ones(3, dtype=np.bool_), np.zeros(3), R)
    out = fused(rule, far, stated=stated)
    assert len(out.weight) == 3
    wide = [[(w, m, P + R[:, :, i]) for w, m, P in source] for i, source in enumerate(far)]
    for place in 10 * PLACES:
        at, area = around(place, half=700.0, step=3.0)
        mass, mean, covariance = moments(AVERAGE[rule]([dense(source, at) for source in wide]), at, area)
        k = int(np.linalg.norm(out.mean - place[:, None], axis=0).argmin())
        assert out.weight[k] == pytest.approx(mass, rel=1e-5)
        np.testing.assert_allclose(out.mean[:, k], mean, atol=1e-2)
        np.testing.assert_allclose(out.spread[:, :, k], covariance, rtol=1e-3, atol=1e-1)
        assert out.common is not None
        assert (np.linalg.eigvalsh(out.covariance[:, :, k]) > 0).all()
        assert (np.linalg.eigvalsh(out.common[:, :, k]) > 0).all()


def test_the_part_of_registration_is_what_the_gains_carry() -> None:
    """Both parts written out with the gains of covariance intersection; together they are its covariance."""
    rng, R = np.random.default_rng(12), shifts(12)
    sources: list[Source] = [[(0.9, PLACES[0], spread(rng))] for _ in range(3)]
    out = fused("hybrid", sources, stated=Stated(np.ones(3, dtype=np.bool_), np.zeros(3), R))
    own = [P for ((_, _, P),) in sources]
    wide = [np.linalg.inv(P + R[:, :, i]) for i, P in enumerate(own)]
    fused_P = np.linalg.inv(np.sum(wide, axis=0) / 3)
    gains = [fused_P @ one / 3 for one in wide]
    assert out.common is not None
    within = np.sum([W @ P @ W.T for W, P in zip(gains, own, strict=True)], axis=0)
    between = np.sum([W @ R[:, :, i] @ W.T for i, W in enumerate(gains)], axis=0)
    np.testing.assert_allclose(out.covariance[:, :, 0], 3 * within)
    np.testing.assert_allclose(out.common[:, :, 0], 3 * between)
    np.testing.assert_allclose(out.spread[:, :, 0], fused_P)


def test_neighbours_stay_apart_however_unsure_the_registration_is() -> None:
    """Two targets 100 m apart at sigma 10, both sources shifted by up to 500 m: two components, not one of weight 2."""
    places = np.array([[0.0, 0.0], [100.0, 0.0]])
    sources: list[Source] = [[(0.9, place + shift, 100 * np.eye(2)) for place in places] for shift in (0.0, 20.0)]
    R = np.repeat(500.0**2 * np.eye(2)[:, :, None], 2, axis=2)
    out = reduced(fused("hybrid", sources, stated=Stated(np.ones(2, dtype=np.bool_), np.zeros(2), R)), 1e-3, 2.0, 99)
    np.testing.assert_allclose(out.weight, [0.9, 0.9])
    assert (out.spread[0, 0] > 490**2).all()


def test_who_has_a_component_in_reach_does_not_deny() -> None:
    """Three sources in a row, the outer ones out of each other's gate: whoever pairs, the middle one is not against
    the third. A source with a component in both makes them two, and then it is."""
    gate = float(chi2.ppf(0.999, 2))
    step = 0.8 * np.sqrt(2 * 50.0 * gate)
    row: list[Source] = [[(0.9, np.array([k * step, 0.0]), 50 * np.eye(2))] for k in range(3)]
    parts, index = joined(row)
    cell, reached = cells_and_reach(parts, index, [0, 1], gate)
    assert len(set(cell.tolist())) == 2
    lone = int(np.flatnonzero(np.bincount(cell) == 1)[0])
    assert reached[:, lone].tolist() == [False, True, False]
    assert reached[:, 1 - lone].sum() == 1
    masses = sorted(fused("aa", row).weight.tolist())
    np.testing.assert_allclose(masses, [0.45, 0.9])
    split: list[Source] = [[*row[0], (0.8, np.array([step, 0.0]), 50 * np.eye(2))], row[0]]
    parts, index = joined(split)
    _, reached = cells_and_reach(parts, index, [0, 1], gate)
    assert not reached.any()
    np.testing.assert_allclose(np.sort(fused("aa", split).weight), [0.4, 0.9])


@pytest.mark.parametrize("rule", ["aa", "ga", "hybrid"])
@pytest.mark.parametrize("cardinality", ["average", "consistent"])
def test_the_order_of_the_sources_does_not_matter(rule: str, cardinality: str) -> None:
    rng = np.random.default_rng(13)
    sources = three_sources(13)
    sources[1] = sources[1][:2]
    declared, miss, R = np.array([True, True, False]), np.array([0.3, 0.1, 0.0]), shifts(13)

    def run(order: NDArray[np.integer]) -> Components:
        stated = Stated(declared[order], miss[order], R[:, :, order])

        def cover(mean: Array) -> NDArray[np.bool_]:
            return np.repeat(declared[order][:, None], mean.shape[1], axis=1)

        return fused(rule, [sources[k] for k in order.tolist()], cardinality, cover, stated)

    first = run(np.arange(3))
    for _ in range(3):
        order = rng.permutation(3)
        other = run(order)
        a, b = np.argsort(first.mean[0]), np.argsort(other.mean[0])
        np.testing.assert_allclose(first.weight[a], other.weight[b], rtol=1e-9)
        np.testing.assert_allclose(first.mean[:, a], other.mean[:, b], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(first.spread[:, :, a], other.spread[:, :, b], rtol=1e-9)
        np.testing.assert_allclose(first.share[order][:, a], other.share[:, b], atol=1e-12)


def test_the_mass_of_the_geometric_average_of_six_sources_in_four_dimensions() -> None:
    """The exact integral of the product of the powers, on a grid of one standard deviation: what ga loses of targets
    that all six see is the formula's, not an error of ours."""
    rng = np.random.default_rng(14)
    lost = []
    for _ in range(5):
        sources: list[Source] = []
        for _ in range(6):
            root = rng.normal(size=(4, 4)) * 0.2 + np.eye(4)
            P = np.asarray(root @ root.T)
            sources.append([(float(rng.uniform(0.7, 1.0)), root @ rng.normal(size=4), P)])
        out = fused("ga", sources)
        if len(out.weight) != 1:
            continue
        information = sum(np.linalg.inv(P) for ((_, _, P),) in sources) / 6
        root = np.linalg.cholesky(np.linalg.inv(information))
        centre = np.linalg.solve(information, sum(np.linalg.solve(P, m) for ((_, m, P),) in sources) / 6)
        axis = np.arange(-7.0, 7.5, 1.0)
        at = centre + np.stack(np.meshgrid(*[axis] * 4), axis=-1).reshape(-1, 4) @ root.T
        exact = AVERAGE["ga"]([dense(source, at) for source in sources]).sum() * np.linalg.det(root)
        assert out.mass == pytest.approx(exact, rel=1e-6)
        lost.append(1 - out.mass / np.prod([w for ((w, _, _),) in sources]) ** (1 / 6))
    print(f"seed 14: lost {np.round(lost, 2)}")
    assert len(lost) >= 3
    assert min(lost) > 0.3
