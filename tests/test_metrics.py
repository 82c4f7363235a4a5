"""Against brute force over all assignments, cases by hand, and the properties of a metric."""

from itertools import permutations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion_service import metrics
from fusion_service.metrics import gospa, identity_switches, nees, nees_bounds, ospa

Array = NDArray[np.float64]
SEED = 20250704


def brute_force(a: Array, b: Array, c: float, p: float, alpha: float) -> float:
    """GOSPA^p by its definition: the best of all injections of the smaller set into the larger."""
    small, large = (a, b) if len(a) <= len(b) else (b, a)
    best = min(
        sum(min(float(np.linalg.norm(small[i] - large[j])), c) ** p for i, j in enumerate(chosen))
        for chosen in permutations(range(len(large)), len(small))
    )
    return float(best + c**p / alpha * (len(large) - len(small)))


def sets(count: int) -> list[Array]:
    rng = np.random.default_rng(SEED)
    return [rng.uniform(0, 10, (rng.integers(0, 6), 2)) for _ in range(count)]


@pytest.mark.parametrize(("c", "p", "alpha"), [(3.0, 2.0, 2.0), (20.0, 2.0, 2.0), (4.0, 1.0, 2.0), (4.0, 2.0, 1.0)])
def test_gospa_against_brute_force(c: float, p: float, alpha: float) -> None:
    drawn = sets(120)
    for a, b in zip(drawn[::2], drawn[1::2], strict=True):
        got, want = gospa(a, b, c, p, alpha), brute_force(a, b, c, p, alpha)
        assert got.distance**p == pytest.approx(want, abs=1e-9)
        assert got.localisation + got.missed + got.false == pytest.approx(want, abs=1e-9)
        if len(a) or len(b):
            want = brute_force(a, b, c, p, 1.0) / max(len(a), len(b))
            assert ospa(a, b, c, p) ** p == pytest.approx(want, abs=1e-9)


def test_gospa_parts_are_those_of_its_assignment() -> None:
    """alpha = 2: distances of the assigned pairs, and c^p / 2 for everything that is not assigned."""
    c, drawn = 3.0, sets(100)
    for a, b in zip(drawn[::2], drawn[1::2], strict=True):
        got = gospa(a, b, c)
        hit = np.flatnonzero(got.assignment >= 0)
        chosen = got.assignment[hit]
        assert len(set(chosen.tolist())) == len(chosen)
        d = np.linalg.norm(a[hit] - b[chosen], axis=-1)
        assert (d < c).all()
        assert got.localisation == pytest.approx((d**2).sum())
        assert got.missed == pytest.approx(c**2 / 2 * (len(a) - len(hit)))
        assert got.false == pytest.approx(c**2 / 2 * (len(b) - len(hit)))


def test_gospa_by_hand() -> None:
    """3-4-5 triangle; one object 5 from its estimate, one missed, two false."""
    truth = np.array([[0.0, 0.0], [100.0, 0.0]])
    estimates = np.array([[200.0, 0.0], [3.0, 4.0], [0.0, 300.0]])
    got = gospa(truth, estimates, 10.0)
    assert got[:4] == pytest.approx((np.sqrt(25 + 50 + 100), 25.0, 50.0, 100.0))
    assert got.assignment.tolist() == [1, -1]
    assert ospa(truth, estimates, 10.0) == pytest.approx(np.sqrt((25 + 100 + 100) / 3))
    none = np.empty((0, 2))
    assert gospa(none, none, 10.0).distance == 0.0
    assert ospa(none, none, 10.0) == 0.0
    assert gospa(truth, none, 10.0)[:4] == pytest.approx((10.0, 0.0, 100.0, 0.0))
    assert gospa(none, truth, 10.0)[:4] == pytest.approx((10.0, 0.0, 0.0, 100.0))
    assert ospa(none, truth, 10.0) == 10.0


def test_gospa_and_ospa_are_metrics() -> None:
    """Identity, symmetry (with missed and false exchanged), triangle inequality."""
    drawn = sets(90)
    for a, b, e in zip(drawn[::3], drawn[1::3], drawn[2::3], strict=True):
        there, back = gospa(a, b, 4.0), gospa(b, a, 4.0)
        assert there.distance == pytest.approx(back.distance)
        assert (there.missed, there.false) == pytest.approx((back.false, back.missed))
        assert gospa(a, a, 4.0).distance == 0.0
        assert gospa(a, e, 4.0).distance <= there.distance + gospa(b, e, 4.0).distance + 1e-12
        assert ospa(a, e, 4.0) <= ospa(a, b, 4.0) + ospa(b, e, 4.0) + 1e-12


def test_nees_against_a_dense_solve_and_its_distribution() -> None:
    """For errors drawn from P the mean of NEES is n, with standard error sqrt(2 n / samples)."""
    rng = np.random.default_rng(SEED)
    a = rng.normal(size=(4, 3, 3))
    P = a @ a.swapaxes(1, 2) + 0.1 * np.eye(3)
    e = np.einsum("bij,kbj->kbi", np.linalg.cholesky(P), rng.standard_normal((5000, 4, 3)))
    got = nees(e, P)
    assert got.shape == (5000, 4)
    want = (e[:20] * np.linalg.solve(P, e[:20, ..., None])[..., 0]).sum(axis=-1)
    np.testing.assert_allclose(got[:20], want, rtol=1e-10)
    assert abs(got.mean() - 3) < 5 * np.sqrt(2 * 3 / got.size), f"seed {SEED}"
    low, high = nees_bounds(3, 4)
    inside = np.mean((got.mean(axis=1) / 3 >= low) & (got.mean(axis=1) / 3 <= high))
    assert abs(inside - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 5000)


def test_nees_bounds_against_the_chi_square_distribution() -> None:
    for n, samples, probability in ((2, 50, 0.95), (2, 1, 0.99), (6, 1000, 0.9)):
        low, high = nees_bounds(n, samples, probability)
        assert chi2.cdf(low * n * samples, n * samples) == pytest.approx((1 - probability) / 2)
        assert chi2.sf(high * n * samples, n * samples) == pytest.approx((1 - probability) / 2)
    assert nees_bounds(2, 50)[1] == pytest.approx(1.296, abs=5e-4), "chi-square table: 129.56 at 100 degrees, 0.975"
    with pytest.raises(ValueError, match="samples >= 1"):
        nees_bounds(2, 0)


def test_identity_switches_by_hand() -> None:
    times = [{1: "a", 2: "b"}, {1: "a"}, {1: "b", 2: "a"}, {2: "b"}, {}, {1: "b", 2: "b", 3: "c"}]
    assert identity_switches(times) == 3, "object 1: a a b . . b once; object 2: b . a b . b twice; object 3: none"
    assert identity_switches([]) == 0


@pytest.mark.parametrize("spread", [30.0, 300.0, 3000.0])
@pytest.mark.parametrize("alpha", [1.0, 2.0])
def test_many_tracks_are_assigned_as_few_are(spread: float, alpha: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only pairs within the cut-off, part by part: the same distance as one dense assignment of all of them."""
    rng = np.random.default_rng(8)
    for _ in range(5):
        truth = rng.uniform(0, spread, size=(rng.integers(60, 90), 2))
        some = truth[rng.random(len(truth)) < 0.8] + rng.normal(scale=3, size=2)
        estimates = rng.permutation(np.concatenate([some, rng.uniform(0, spread, size=(rng.integers(0, 40), 2))]))
        sparse = metrics.gospa(truth, estimates, 15.0, alpha=alpha)
        monkeypatch.setattr(metrics, "DENSE", 10**9)
        dense = metrics.gospa(truth, estimates, 15.0, alpha=alpha)
        monkeypatch.undo()
        assert sparse[:4] == pytest.approx(dense[:4])
        assert (sparse.assignment == dense.assignment).all()
