"""Every kind of motion against its stochastic differential equation, discretised independently (Van Loan 1978)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from fusion_service.arrays import Floats
from fusion_service.motion import predict, transition
from schemas import Motion

SEED = 20250912
CHAIN = ("x", "vx", "ax")
KINDS: dict[str, tuple[Motion, tuple[str, ...]]] = {
    "cv": (Motion("cv", 0.8), ("x", "vx")),
    "ca": (Motion("ca", 0.05), ("x", "vx", "ax")),
    "singer": (Motion("singer", sigma=2.5, tau=12.0), ("x", "vx", "ax")),
    "ou": (Motion("ou", sigma=1.5, tau=15.0), ("x", "vx")),
    "still": (Motion("still", 0.3, sigma=0.2), ("x",)),
}
"""Kind -> a motion and the components of one axis in which it is complete."""


def sde(motion: Motion, n: int) -> tuple[Floats, Floats]:
    """A and W of dx = A x dt + noise of intensity W, for the first n of position, velocity, acceleration."""
    A, W = np.diag(np.ones(n - 1), 1), np.zeros((n, n))
    if motion.kind in ("singer", "ou"):
        A[-1, -1] = -1 / motion.tau
        W[-1, -1] = 2 * motion.sigma**2 / motion.tau
    else:
        W[-1, -1] = motion.q
    return A, W


def van_loan(A: Floats, W: Floats, t: float) -> tuple[Floats, Floats]:
    """F and Q of `t` seconds, short steps doubled: the block exponential loses its digits over long ones."""
    n, doublings = len(A), max(0, int(np.ceil(np.log2(max(t, 1e-9) / 0.05))))
    M = expm(np.block([[-A, W], [np.zeros((n, n)), A.T]]) * (t / 2**doublings))
    F = M[n:, n:].T
    Q = F @ M[:n, n:]
    for _ in range(doublings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return F, (Q + Q.T) / 2


def both_axes(names: tuple[str, ...]) -> tuple[str, ...]:
    return (*names, *(name.replace("x", "y") for name in names))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("t", [1e-3, 0.5, 11.9, 12.1, 60.0, 900.0])
def test_transition_against_van_loan(kind: str, t: float) -> None:
    motion, names = KINDS[kind]
    n = len(names)
    F, Q = van_loan(*sde(motion, n), t)
    got_F, got_Q = transition(motion, both_axes(names), np.zeros((2 * n, 1)), np.array([t]))
    for block in (slice(0, n), slice(n, 2 * n)):
        np.testing.assert_allclose(got_F[block, block, 0], F, rtol=1e-9, atol=1e-12)
        scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
        np.testing.assert_allclose(got_Q[block, block, 0] / scale, Q / scale, rtol=0, atol=1e-8)
    assert not got_F[:n, n:].any()
    assert not got_Q[:n, n:].any()


def test_series_and_closed_form_meet() -> None:
    """F and Q are smooth where one takes over from the other: steps of 1e-6 across differ by 1e-6."""
    motion = Motion("singer", sigma=1.0, tau=10.0)
    F, Q = transition(motion, ("x", "y", "vx", "ax"), np.zeros((4, 400)), np.linspace(9.9998, 10.0002, 400))
    for array in (F[0, 2:], Q[0, 2:], Q[2:, 3], Q[0, 0][None]):
        steps = np.diff(array.reshape(-1, 400), axis=1)
        assert np.ptp(steps, axis=1).max() < 1e-8 * np.abs(array).max()


@pytest.mark.parametrize("kind", KINDS)
def test_two_steps_are_one(kind: str) -> None:
    rng = np.random.default_rng(SEED)
    motion, names = KINDS[kind]
    space = both_axes(names)
    n, size = len(space), 40
    x, root = rng.normal(size=(n, size)), rng.normal(size=(n, n, size))
    P = np.einsum("ikb,jkb->ijb", root, root)
    a, b = rng.uniform(0, 40, size), rng.uniform(0, 40, size)
    one, two = predict(motion, space, x, P, a + b), predict(motion, space, *predict(motion, space, x, P, a), b)
    np.testing.assert_allclose(two[0], one[0], rtol=1e-10, atol=1e-10 * np.abs(one[0]).max())
    np.testing.assert_allclose(two[1], one[1], rtol=1e-10, atol=1e-10 * np.abs(one[1]).max())


@pytest.mark.parametrize("motion", [Motion("singer", sigma=2.0, tau=9.0), Motion("ou", sigma=2.0, tau=9.0)])
def test_what_covers_a_missing_derivative_makes_two_steps_one_too(motion: Motion) -> None:
    space = ("x", "y") if motion.kind == "ou" else ("x", "vx", "y", "vy")
    x, P = np.ones((len(space), 1)), np.eye(len(space))[:, :, None]
    one = predict(motion, space, x, P, np.array([7.0]))
    two = predict(motion, space, *predict(motion, space, x, P, np.array([3.0])), np.array([4.0]))
    np.testing.assert_allclose(two[1], one[1], rtol=1e-12)


ALL = [*(motion for motion, _ in KINDS.values()), Motion("ct", 0.7, 0.1), Motion("ca", 0.1, sigma=2.0)]
SPACES = [
    ("x", "y"),
    ("vx", "y", "x", "vy"),
    ("y", "ax", "x", "ay", "vy", "vx", "turn_rate"),
    ("x", "ax", "y", "vz", "az"),
    ("x", "y", "z", "vx", "vy", "vz", "turn_rate"),
]


@pytest.mark.parametrize("motion", ALL)
@pytest.mark.parametrize("space", SPACES)
def test_in_every_space(motion: Motion, space: tuple[str, ...]) -> None:
    """No time, no change of a bit; the bits of an element are its own; spread grows; Q is symmetric, no negative."""
    rng = np.random.default_rng(SEED)
    n, size = len(space), 67
    x, root = rng.normal(size=(n, size)), rng.normal(size=(n, n, size))
    P = np.einsum("ikb,jkb->ijb", root, root) + np.eye(n)[:, :, None]
    dt = rng.choice([0.0, 1e-6, 0.3, 14.0, 1e4, 1e9], size)
    means, covariances = predict(motion, space, x, P, dt)
    same = dt == 0
    assert same.any()
    assert means[:, same].tobytes() == x[:, same].tobytes()
    assert covariances[:, :, same].tobytes() == P[:, :, same].tobytes()
    F, Q = transition(motion, space, x, dt)
    np.testing.assert_array_equal(F[:, :, same], np.repeat(np.eye(n)[:, :, None], same.sum(), axis=2))
    assert not Q[:, :, same].any()
    np.testing.assert_array_equal(Q, Q.swapaxes(0, 1))
    scale = np.sqrt(np.einsum("iib->ib", Q) + 1e-300)
    assert np.linalg.eigvalsh(np.moveaxis(Q / scale[:, None] / scale[None], -1, 0)).min() > -1e-12
    for part in (slice(0, 1), slice(3, 8), slice(1, 60, 3)):
        few = predict(motion, space, x[:, part], P[:, :, part], dt[part])
        assert few[0].tobytes() == means[:, part].tobytes()
        assert few[1].tobytes() == covariances[:, :, part].tobytes()


def test_still() -> None:
    """The place walks, velocity and acceleration are forgotten at once, and the place does not follow them."""
    motion, space = Motion("still", 0.5, sigma=0.1), ("x", "vx", "ax", "y")
    P = np.array([[4.0, 1.0, 0.5, 0.0], [1.0, 9.0, 0.0, 0.0], [0.5, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    means, covariances = predict(motion, space, np.array([[3.0], [7.0], [1.0], [2.0]]), P[..., None], np.array([6.0]))
    np.testing.assert_array_equal(means[:, 0], [3.0, 0.0, 0.0, 2.0])
    np.testing.assert_allclose(covariances[..., 0], np.diag([4 + 3.0, 0.01, 0.01, 1 + 3.0]), rtol=1e-14, atol=0)


def test_acceleration_that_the_space_lacks() -> None:
    """ca: the marginal of the whole chain that starts with an acceleration of 0 +- sigma."""
    t, whole = 4.0, ("x", "vx", "ax", "y")
    start = np.diag([2.0, 1.0, 9.0, 1.0])[..., None]
    _, want = predict(Motion("ca", 0.3), whole, np.zeros((4, 1)), start, np.array([t]))
    keep = [0, 1, 3]
    few = ("x", "vx", "y")
    _, got = predict(Motion("ca", 0.3, sigma=3.0), few, np.zeros((3, 1)), start[np.ix_(keep, keep)], np.array([t]))
    np.testing.assert_allclose(got[:2, :2], want[:2, :2], rtol=1e-13)


def gap_ratio(motion: Motion, seen: int, period: float, R: float, gaps: list[float]) -> list[float]:
    """Worst eigenvalue of true over stated covariance, exactly, of a Kalman filter whose state has the first `seen`
    components of the target's chain, hears a position each `period`, and then predicts over each gap."""
    A, W = sde(motion, seen + 1)
    n = seen + 1
    names = CHAIN[:seen]
    space, dt = (*names, "y"), np.array([period])
    F, Q = (array[:seen, :seen, 0] for array in transition(motion, space, np.zeros((seen + 1, 1)), dt))
    F_true, Q_true = van_loan(A, W, period)
    H = np.eye(1, seen)
    P = np.eye(seen) * 100.0
    # Error of the filter beside the derivative that it does not know: e = x - xhat, driven by that derivative.
    joint = np.zeros((n, n))
    joint[:seen, :seen], joint[-1, -1] = P, motion.sigma**2
    for _ in range(400):
        P = F @ P @ F.T + Q
        K = P @ H.T / (H @ P @ H.T + R)
        P = P - K @ H @ P
        joint = F_true @ joint @ F_true.T + Q_true
        B = np.eye(n)
        B[:seen, :seen] -= K @ H
        joint = B @ joint @ B.T
        joint[:seen, :seen] += K @ K.T * R
    worst = []
    for gap in gaps:
        F_gap, Q_gap = van_loan(A, W, gap)
        true = (F_gap @ joint @ F_gap.T + Q_gap)[:seen, :seen]
        _, stated = predict(
            motion,
            space,
            np.zeros((seen + 1, 1)),
            np.pad(P, (0, 1))[..., None],
            np.array([gap]),
        )
        L = np.linalg.inv(np.linalg.cholesky(stated[:seen, :seen, 0]))
        worst.append(float(np.linalg.eigvalsh(L @ true @ L.T).max()))
    return worst


@pytest.mark.parametrize("period", [0.5, 4.0, 30.0])
@pytest.mark.parametrize("R", [0.1, 100.0, 1e5])
@pytest.mark.parametrize("kind", ["singer", "ou"])
def test_a_forgotten_derivative_that_the_space_lacks_is_covered(kind: str, period: float, R: float) -> None:
    """Exact covariances, no chance in it: never more than 1, whatever the gap, and near it in long ones."""
    motion, names = KINDS[kind]
    ratios = gap_ratio(motion, len(names) - 1, period, R, [1e-3, 0.5, 3.0, 10.0, 30.0, 100.0, 1000.0])
    assert max(ratios) <= 1 + 1e-6, ratios
    assert ratios[-1] > 0.9, ratios


def simulate(motion: Motion, n: int, start: Floats, times: Floats, rng: np.random.Generator) -> Floats:
    """Exact paths (K, n, B) at `times` from states `start` (n, B)."""
    states, now = [start], 0.0
    for t in times:
        F, Q = van_loan(*sde(motion, n), t - now)
        root = np.linalg.cholesky(Q + 1e-14 * np.diag(np.diag(Q)))
        states.append(F @ states[-1] + root @ rng.normal(size=start.shape))
        now = t
    return np.array(states[1:])


@pytest.mark.parametrize("kind", KINDS)
def test_stated_covariance_is_that_of_simulated_targets_over_gaps(kind: str) -> None:
    """Eigenvalues of true over stated: of 20,000 targets each within four standard errors of 1."""
    rng = np.random.default_rng(SEED)
    motion, names = KINDS[kind]
    n, size = len(names), 20_000
    space = (*names, "y")
    P = np.diag([25.0, 4.0, 1.0][:n])
    start = np.linalg.cholesky(P) @ rng.normal(size=(n, size))
    gaps = np.array([1.0, 5.0, 20.0, 120.0])
    paths = simulate(motion, n, start, gaps, rng)
    cov = np.zeros((n + 1, n + 1, len(gaps)))
    cov[:n, :n], cov[n, n] = P[..., None], 1.0
    _, stated = predict(motion, space, np.zeros((n + 1, len(gaps))), cov, gaps)
    for k, gap in enumerate(gaps):
        L = np.linalg.inv(np.linalg.cholesky(stated[:n, :n, k]))
        white = L @ paths[k]
        ratios = np.linalg.eigvalsh(white @ white.T / size)
        error = 4 * (np.sqrt(n / size) + np.sqrt(0.5 / size))
        print(f"seed {SEED} {kind} {gap:g} s: true over stated {ratios.min():.3f} to {ratios.max():.3f} +- {error:.3f}")
        assert abs(ratios - 1).max() < error


def scaled(motion: Motion, factor: float) -> Motion:
    """The motion with the intensity of its noise multiplied."""
    q = motion.q * factor
    return Motion(motion.kind, q, sigma=motion.sigma * (1 if q else factor**0.5), tau=motion.tau)


def nis(truth: Motion, told: Motion, names: tuple[str, ...], rng: np.random.Generator) -> tuple[float, int]:
    """Sum of the normalised innovations squared, and their number, of Kalman filters that hear positions with gaps."""
    n, size, R = len(names), 60, 4.0
    space = (*names, "y")
    times = np.cumsum(rng.choice([1.0, 5.0, 20.0], 40))
    P0 = np.diag([25.0, 4.0, 1.0][:n])
    paths = simulate(truth, n, np.linalg.cholesky(P0) @ rng.normal(size=(n, size)), times, rng)
    x, P = np.zeros((n + 1, size)), np.zeros((n + 1, n + 1, size))
    P[:n, :n], P[n, n] = P0[..., None], 1.0
    total, now = 0.0, 0.0
    for t, path in zip(times, paths, strict=True):
        x, P = predict(told, space, x, P, np.full(size, t - now))
        innovation, S = path[0] + rng.normal(size=size) * R**0.5 - x[0], P[0, 0] + R
        total += float((innovation**2 / S).sum())
        gain = P[:, 0] / S
        x, P = x + gain * innovation, P - gain[:, None] * P[None, 0]
        now = t
    return total, size * len(times)


@pytest.mark.parametrize("kind", KINDS)
def test_nis_tells_a_wrong_intensity(kind: str) -> None:
    rng = np.random.default_rng(SEED)
    motion, names = KINDS[kind]
    for factor in (0.25, 1.0, 4.0):
        total, count = nis(motion, scaled(motion, factor), names, rng)
        low, high = chi2.ppf([0.0005, 0.9995], count) / count
        print(f"seed {SEED} {kind} q x {factor:g}: NIS {total / count:.3f}, bounds {low:.3f} to {high:.3f}")
        assert bool(low <= total / count <= high) is (factor == 1.0)
        assert factor == 1.0 or (total / count > 1) is (factor < 1)
