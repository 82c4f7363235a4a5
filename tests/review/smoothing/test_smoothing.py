"""The smoothed reference: against a dense least-squares solution, and on missions with known truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion_service.errors import ReviewError
from fusion_service.motion import transition
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.smoothing import smoothed_truth
from fusion_service.review.smoothing.gained import gain_of
from fusion_service.review.smoothing.linked import LEAST, Links
from fusion_service.review.smoothing.smoother import smooth
from schemas import Message, Motion
from tests.helpers.missions import SPACE, at, info, picture, tracks

SEED = 7
CV = Motion("cv", 2.0)


def test_it_is_the_dense_joint_solution() -> None:
    """Two objects; one begins later. By the information matrix of all states at once, inverted whole."""
    rng = np.random.default_rng(SEED)
    times = np.array([0, 1_000, 1_700, 4_000, 4_500], dtype=np.int64) * 10**6
    count, n, begin = len(times), 4, np.array([0, 2])
    L, y = np.zeros((count, 2, n, n)), np.zeros((count, 2, n))
    for k, o in ((0, 0), (1, 0), (2, 0), (2, 1), (3, 1), (4, 0), (4, 1)):
        H = rng.normal(size=(3, n))
        L[k, o], y[k, o] = H.T @ H, H.T @ rng.normal(size=3)
    means, covariances = smooth(times, y.copy(), L.copy(), begin, CV, SPACE)
    for o in range(2):
        some = np.arange(begin[o], count)
        A, b = np.zeros((len(some) * n,) * 2), np.zeros(len(some) * n)
        for i, k in enumerate(some):
            here = slice(i * n, (i + 1) * n)
            A[here, here] += L[k, o]
            b[here] += y[k, o]
            if i:
                dt = np.array([(times[k] - times[k - 1]) / 1e9])
                F, Q = (part[..., 0] for part in transition(CV, SPACE, np.zeros((n, 1)), dt))
                J = np.zeros((n, len(b)))
                J[:, here], J[:, (i - 1) * n : i * n] = np.eye(n), -F
                A += J.T @ np.linalg.inv(Q) @ J
        P = np.linalg.inv(A)
        x = P @ b
        for i, k in enumerate(some):
            np.testing.assert_allclose(means[k, o], x[i * n : (i + 1) * n], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(
                covariances[k, o], P[i * n : (i + 1) * n, i * n : (i + 1) * n], rtol=1e-6, atol=1e-6
            )


def test_what_an_update_added_is_its_measurement() -> None:
    """Of a Kalman update with H, R and z: L = H'R^-1 H, y = H'R^-1 z, whatever was known before."""
    rng = np.random.default_rng(SEED)
    root, H = rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    P, x, R, z = root @ root.T + np.eye(4), rng.normal(size=4), np.diag([2.0, 5.0]), rng.normal(size=2)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    after, mean = P - K @ H @ P, x + K @ (z - H @ x)
    A = np.asarray(np.linalg.inv(P), dtype=np.float64)
    y, L = gain_of(mean, 0.5 * (after + after.T), A @ x, A)
    np.testing.assert_allclose(L, H.T @ np.linalg.inv(R) @ H, atol=1e-9)
    np.testing.assert_allclose(y, H.T @ np.linalg.inv(R) @ z, atol=1e-9)
    y, L = gain_of(x, P, A @ x, A)
    assert not L.any(), "a version that only coasted adds nothing"
    y, L = gain_of(x, 2 * P, A @ x, A)
    assert not L.any(), "nor does one that has forgotten"


def linked(seconds: float, ids: list[int], by: list[list[tuple[int, int]]], **rest: Any) -> Any:
    """A picture whose tracks are made of local ones, each (index of a, b; id)."""
    flat = [one for some in by for one in some]
    given: dict[str, Any] = {
        "contributor_counts": np.array([len(some) for some in by], dtype=np.uint16),
        **rest,
    }
    shown = picture(seconds, ids, [[0.0, 0.0]] * len(ids), **given)
    return replace(
        shown,
        sources=("a", "b"),
        contributor_source=np.array([source for source, _ in flat], dtype=np.uint16),
        contributor_epoch=np.ones(len(flat), dtype=np.uint64),
        contributor_id=np.array([one for _, one in flat], dtype=np.uint64),
        contributor_influence=np.zeros(len(flat)),
    )


def test_an_object_goes_on_under_another_number() -> None:
    """Track 5 ends; the next picture has 6 with the same local track. 7 is another object, and 8 merged into it."""
    links = Links()
    for t in range(LEAST):
        links.add(linked(t, [5, 7], [[(0, 1)], [(1, 2)]]))
    links.add(linked(20, [6, 7, 8], [[(0, 1)], [(1, 2)], [(0, 9)]]))
    links.add(linked(21, [6, 7], [[(0, 1)], [(1, 2), (0, 9)]], ended=((8, "merged", 7),)))
    assert len(links.objects()) == 2
    assert links.object_of(("a", 1, 1), at(3)) == links.object_of(("a", 1, 1), at(21)) in links.objects()
    assert links.object_of(("a", 1, 9), at(19.5)) == links.object_of(("b", 1, 2), at(0)) in links.objects()
    assert links.object_of(("a", 1, 1), at(-5)) == links.object_of(("a", 1, 1), at(3)), "before the first link"
    assert links.object_of(("b", 1, 3), at(3)) == 0


def filtered(name: str, seed: int, paths: np.ndarray[Any, Any], bias: float = 0.0) -> list[Message]:
    """A source with Kalman filters (R = 100 m2 on positions, q = 2) on paths (K, T, 4), a scan each second."""
    rng = np.random.default_rng(seed)
    K, T, _ = paths.shape
    F, Q = (part[..., 0] for part in transition(CV, SPACE, np.zeros((4, 1)), np.ones(1)))
    H, R = np.eye(4)[[0, 2]], 100.0 * np.eye(2)
    said: list[Message] = [info(name, q=CV.q)]
    z = paths[:, :, [0, 2]] + 10.0 * rng.normal(size=(K, T, 2)) + [bias, 0.0]
    x, P = np.zeros((T, 4)), np.diag([1e4, 1e3, 1e4, 1e3])
    x[:, [0, 2]] = z[0]
    for k in range(K):
        if k:
            x, P = x @ F.T, F @ P @ F.T + Q
        G = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + (z[k] - x @ H.T) @ G.T, P - G @ H @ P
        P = 0.5 * (P + P.T)
        said.append(tracks(name, k, list(range(T)), [], means=x.copy(), covariances=np.tile(P, (T, 1, 1))))
    return said


@pytest.fixture(scope="module")
def flight() -> tuple[np.ndarray[Any, Any], list[Message]]:
    """Three targets that move as declared, two sources, and a centre that links them rightly."""
    rng = np.random.default_rng(SEED)
    K, T = 60, 3
    F, Q = (part[..., 0] for part in transition(CV, SPACE, np.zeros((4, 1)), np.ones(1)))
    root = np.linalg.cholesky(Q)
    paths = np.zeros((K, T, 4))
    paths[0] = [[1000.0 * t, 10.0, 0.0, 5.0] for t in range(T)]
    for k in range(1, K):
        paths[k] = paths[k - 1] @ F.T + rng.normal(size=(T, 4)) @ root.T
    mission = [*filtered("a", 1, paths), *filtered("b", 2, paths, bias=40.0)]
    mission += [linked(k, [10, 11, 12], [[(0, t), (1, t)] for t in range(T)], means=paths[k]) for k in range(K)]
    return paths, mission


def rmse(truths: Any, paths: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Of x and y, over the inner times."""
    errors = np.stack([one.means for one in truths])[10:-10][:, :, [0, 2]] - paths[10:-10][:, :, [0, 2]]
    found: np.ndarray[Any, Any] = np.sqrt((errors**2).mean(axis=(0, 1)))
    return found


def test_it_is_nearer_than_any_source_and_does_not_see_what_all_share(flight: Any) -> None:
    """Source b is 40 m east: of the reference of both half of it is left, of that without b nothing. A filter's own
    error is about 5 m, a smoother's of one source's measurements about 3."""
    paths, mission = flight
    without = rmse(smoothed_truth(Logbook(mission), left_out="b"), paths)
    assert (without < 4.5).all(), f"seed {SEED}"
    both = rmse(smoothed_truth(Logbook(mission)), paths)
    assert both[0] == pytest.approx(20.0, abs=3.0)
    assert both[1] < without[1]
    biased = rmse(smoothed_truth(Logbook(mission), left_out="a"), paths)
    assert biased[0] == pytest.approx(40.0, abs=3.0)


def test_what_cannot_be_smoothed_is_told(flight: Any) -> None:
    _, mission = flight
    with pytest.raises(ReviewError, match="no source 'c' in this recording; there are: a, b"):
        smoothed_truth(Logbook(mission), left_out="c")
    alone = [one for one in mission if one.source != "centre"]
    with pytest.raises(ReviewError, match="no centre"):
        smoothed_truth(Logbook(alone))
    pictures = [one for one in mission if one.source == "centre"]
    with pytest.raises(ReviewError, match="no object of centre was told of often enough"):
        smoothed_truth(Logbook(pictures))
