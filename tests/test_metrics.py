"""Against brute force over all assignments, cases by hand, and the properties of a metric."""

from collections import deque
from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from fusion_service import metrics
from fusion_service.arrays import Floats
from fusion_service.metrics import gospa, identity_switches, near_pairs, nees, nees_bounds, ospa
from fusion_service.review.evaluation.continuity import Following, Instant, ospa2, siap_of

SEED = 20250704


def brute_force(a: Floats, b: Floats, c: float, p: float, alpha: float) -> float:
    """GOSPA^p by its definition: the best of all injections of the smaller set into the larger."""
    small, large = (a, b) if len(a) <= len(b) else (b, a)
    best = min(
        sum(min(float(np.linalg.norm(small[i] - large[j])), c) ** p for i, j in enumerate(chosen))
        for chosen in permutations(range(len(large)), len(small))
    )
    return float(best + c**p / alpha * (len(large) - len(small)))


def sets(count: int) -> list[Floats]:
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


def test_a_large_connected_part_is_assigned_on_its_pairs() -> None:
    """A cut-off so wide that hundreds of pairs hang together: the same as SciPy's dense assignment."""
    rng = np.random.default_rng(SEED)
    truth, estimates = rng.uniform(0, 100, (150, 2)), rng.uniform(0, 100, (170, 2))
    for c in (12.0, 30.0):
        distance = np.linalg.norm(truth[:, None] - estimates[None], axis=-1)
        cost = np.minimum(distance, c) ** 2
        rows, columns = linear_sum_assignment(cost)
        got = gospa(truth, estimates, c)
        assert got.distance**2 == pytest.approx(cost[rows, columns].sum() + c**2 / 2 * 20, rel=1e-12)
        i, j, d = near_pairs(truth, estimates, c)
        assert len(i) == (distance < c).sum()
        np.testing.assert_allclose(d, distance[i, j])


def moments(
    rng: np.random.Generator, times: int
) -> tuple[list[Instant], list[dict[int, Floats]], list[dict[int, Floats]]]:
    """Objects and tracks that come and go at random in a small place; the numbers are not 0, 1, 2."""
    found, objects, tracks, c = [], [], [], 5.0
    for _ in range(times):
        here, shown = (
            {int(n): rng.uniform(0, 9, 2) for n in rng.choice([3, 5, 8, 13], rng.integers(0, 5), replace=False)}
            for _ in range(2)
        )
        objects.append(here)
        tracks.append(shown)
        a, b = (np.array(list(one.values())).reshape(-1, 2) for one in (here, shown))
        numbers = [np.array(list(one), dtype=np.intp) for one in (here, shown)]
        i, j, d = near_pairs(a, b, c)
        found.append(Instant(numbers[0], numbers[1], numbers[0][i], numbers[1][j], d))
    return found, objects, tracks


@pytest.mark.parametrize("times", [1, 2, 5])
def test_ospa2_against_brute_force(times: int) -> None:
    """By its definition: time averages for each pair of tracks, then the best of all injections."""
    rng, c, p = np.random.default_rng(SEED), 5.0, 2.0

    def base(a: int, b: int, objects: list[dict[int, Floats]], tracks: list[dict[int, Floats]]) -> float:
        costs = []
        for here, shown in zip(objects, tracks, strict=True):
            if a in here and b in shown:
                costs.append(min(float(np.linalg.norm(here[a] - shown[b])), c))
            elif a in here or b in shown:
                costs.append(c)
        return float(np.mean(costs))

    for _ in range(40):
        window, objects, tracks = moments(rng, times)
        names = [sorted({n for one in sets for n in one}) for sets in (objects, tracks)]
        small, large = sorted(names, key=len)
        swapped = small is not names[0]
        table = {
            (a, b): base(b, a, objects, tracks) if swapped else base(a, b, objects, tracks)
            for a in small
            for b in large
        }
        most = len(large)
        best = min(
            sum(table[a, b] ** p for a, b in zip(small, chosen, strict=True))
            for chosen in permutations(large, len(small))
        )
        want = ((best + c**p * (most - len(small))) / most) ** (1 / p) if most else 0.0
        assert ospa2(deque(window), c, p) == pytest.approx(want), f"seed {SEED}"
    first, shown = (np.array(list(one[0].values())).reshape(-1, 2) for one in (objects, tracks))
    assert ospa2(deque(window[:1]), c, p) == pytest.approx(ospa(first, shown, c, p)), "a window of one time is OSPA"


def test_siap_by_hand() -> None:
    """Object 0 at times 0 to 9: track 4 from 0 to 3, track 5 from 2 to 6, nothing at 7, track 5 again at 8 and 9.
    Object 1: track 6 all the time. Least numbers: 4, 5, 5 and 6."""
    following = Following(2)
    of_zero = {4: range(4), 5: [*range(2, 7), 8, 9]}
    for k in range(10):
        tracks = [track for track, when in of_zero.items() if k in when]
        following.add(k, np.array([0] * len(tracks) + [1]), np.array([*tracks, 6]))
    segments = following.segments(9)
    assert segments.tolist() == [[0, 4, 0, 3], [0, 5, 2, 6], [0, 5, 8, 9], [1, 6, 0, 9]]
    times = np.arange(10) * 2 * 10**9
    siap = siap_of(segments, times, np.array([18.0, 18.0]), (20.0, 19.0, 25.0, 21.0), (3.0, np.nan))
    assert siap.track_number_changes == pytest.approx((3 - 1 + 1 - 1) / (12 + 2 + 18))
    assert siap.longest_segment == pytest.approx((8 + 18) / 36)
    assert (siap.completeness, siap.ambiguity, siap.spuriousness) == pytest.approx((19 / 20, 21 / 19, 4 / 25))
    assert np.isnan(siap_of(segments[:0], times, np.zeros(0), (0, 0, 0, 0), (np.nan, np.nan)).completeness)
