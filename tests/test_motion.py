"""Against matrix exponentials, integrals of the noise, the ODE of a turn, and finite differences."""

import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from fusion_service.arrays import Floats
from fusion_service.motion import predict
from schemas import Motion

SEED = 20250703
CT = ("vx", "turn_rate", "y", "x", "vy")

# Space, and for each component: what it is the derivative of, and whether the noise drives it.
CHAINS: dict[tuple[str, ...], tuple[list[tuple[str, str]], list[str]]] = {
    ("x", "vx", "y", "vy"): ([("x", "vx"), ("y", "vy")], ["vx", "vy"]),
    ("vy", "y", "x", "vx", "vz", "z"): ([("x", "vx"), ("y", "vy"), ("z", "vz")], ["vx", "vy", "vz"]),
    ("x", "y"): ([], ["x", "y"]),
    ("y", "x", "vx"): ([("x", "vx")], ["vx", "y"]),
    ("ax", "x", "vx", "y", "vy", "ay", "z"): (
        [("x", "vx"), ("vx", "ax"), ("y", "vy"), ("vy", "ay")],
        ["ax", "ay", "z"],
    ),
    ("x", "ax", "y", "vz"): ([], ["x", "ax", "y", "vz"]),
}


def spd(rng: np.random.Generator, n: int, size: int) -> Floats:
    a = rng.normal(size=(n, n, size))
    return np.asarray(np.einsum("ikb,jkb->ijb", a, a) + np.eye(n)[:, :, None])


@pytest.mark.parametrize("space", CHAINS)
@pytest.mark.parametrize("kind", ["cv", "ct"])
def test_cv_against_matrix_exponential_and_integral(space: tuple[str, ...], kind: str) -> None:
    """F = exp(A t), Q = integral of exp(A s) G q G' exp(A s)' ds. ct acts as cv in these spaces."""
    rng = np.random.default_rng(SEED)
    n, q = len(space), 2.5
    integrates, driven = CHAINS[space]
    A, G = np.zeros((n, n)), np.diag([float(name in driven) for name in space])
    for low, high in integrates:
        A[space.index(low), space.index(high)] = 1.0
    dt = np.array([0.0, 0.1, 3.0, 20.0])
    x, P = rng.normal(size=(n, 4)), spd(rng, n, 4)
    means, covs = predict(Motion(kind, q, 0.1), space, x, P, dt)
    for k, t in enumerate(dt):
        F = expm(A * t)
        Q = quad_vec(lambda s: expm(A * s) @ G @ expm(A * s).T * q, 0.0, t)[0]
        np.testing.assert_allclose(means[:, k], F @ x[:, k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covs[:, :, k], F @ P[:, :, k] @ F.T + Q, rtol=1e-11, atol=1e-12)


def turn_ode(_: float, s: Floats) -> list[float]:
    vx, w, _y, _x, vy = s
    return [-w * vy, 0.0, vy, vx, w * vx]


@pytest.mark.parametrize("rate", [0.0, 1e-9, -1e-5, 1e-3, 0.05, -0.26, 0.7])
def test_ct_against_the_ode(rate: float) -> None:
    start = np.array([-30.0, rate, 500.0, 100.0, 55.0])
    want = solve_ivp(turn_ode, (0.0, 4.0), start, rtol=1e-12, atol=1e-10).y[:, -1]
    got, _ = predict(Motion("ct", 0.0), CT, start[:, None], np.zeros((5, 5, 1)), np.array([4.0]))
    np.testing.assert_allclose(got[:, 0], want, atol=1e-7, rtol=0)


def test_ct_jacobian_against_finite_differences() -> None:
    """With P = e_j e_j' the predicted covariance is the outer product of column j of the Jacobian."""
    rates = np.concatenate([[0.0], np.geomspace(1e-8, 3.0, 40), -np.geomspace(1e-8, 3.0, 40), [0.0833, 0.0834]])
    size, dt = len(rates), np.full(len(rates), 3.0)
    mean = np.tile(np.array([[40.0], [0.0], [3.0], [-7.0], [25.0]]), size)
    mean[1] = rates
    motion = Motion("ct", 0.0)
    for j in range(5):
        P = np.zeros((5, 5, size))
        P[j, j] = 1.0
        squares = predict(motion, CT, mean, P, dt)[1]
        h = np.zeros((5, 1))
        h[j] = 1e-4
        at = [predict(motion, CT, mean + k * h, P, dt)[0] for k in (-2, -1, 1, 2)]
        column = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * 1e-4)
        np.testing.assert_allclose(squares, column[:, None] * column[None], rtol=1e-6, atol=2e-5)


def test_ct_jacobian_has_its_digits_where_series_and_closed_form_meet() -> None:
    """d(x', y')/dw of a turn, in extended precision, around the change-over."""
    dt, angle = 2.0, np.linspace(0.2, 0.3, 201)
    mean = np.zeros((5, 201))
    mean[0], mean[1] = 1.0, angle / dt
    P = np.zeros((5, 5, 201))
    P[1, 1] = 1.0
    spread = predict(Motion("ct", 0.0), CT, mean, P, np.full(201, dt))[1]
    t = (mean[1] * dt).astype(np.longdouble)
    want_x = dt**2 * (t * np.cos(t) - np.sin(t)) / t**2
    want_y = dt**2 * (t * np.sin(t) - 2 * np.sin(t / 2) ** 2) / t**2
    np.testing.assert_allclose(spread[3, 3], (want_x**2).astype(float), rtol=1e-12)
    np.testing.assert_allclose(spread[2, 2], (want_y**2).astype(float), rtol=1e-12)


def test_ct_noise_is_that_of_cv_and_the_turn_rate_walks() -> None:
    x, P, dt = np.array([[3.0], [0.2], [0.0], [0.0], [-1.0]]), np.zeros((5, 5, 1)), np.array([2.0])
    _, turned = predict(Motion("ct", 1.5, 0.01), CT, x, P, dt)
    _, straight = predict(Motion("cv", 1.5), ("vx", "y", "x", "vy"), x[[0, 2, 3, 4]], P[:4, :4], dt)
    keep = [0, 2, 3, 4]
    np.testing.assert_array_equal(turned[np.ix_(keep, keep)], straight)
    assert turned[1, 1, 0] == 0.01 * 2.0
    assert not turned[1, keep].any()


@pytest.mark.parametrize("motion", [Motion("cv", 0.7, 0.1), Motion("ct", 0.7, 0.1)])
def test_two_steps_are_one(motion: Motion) -> None:
    """Chapman-Kolmogorov: exact for cv; for a turn, whose Q is an approximation, the mean."""
    rng = np.random.default_rng(SEED)
    x, P = rng.normal(size=(5, 30)), spd(rng, 5, 30)
    dt = rng.uniform(0, 5, 30)
    two = predict(motion, CT, *predict(motion, CT, x, P, dt), 2 * dt)
    one = predict(motion, CT, x, P, 3 * dt)
    np.testing.assert_allclose(two[0], one[0], atol=1e-12)
    if motion.kind == "cv":
        np.testing.assert_allclose(two[1], one[1], rtol=1e-12)


@pytest.mark.parametrize("motion", [Motion("cv", 0.7), Motion("ct", 0.7, 0.1)])
def test_bits(motion: Motion) -> None:
    """dt = 0 returns the same bits; an element's bits do not depend on its batch; symmetric."""
    rng = np.random.default_rng(SEED)
    size = 131
    x, P, dt = rng.normal(size=(5, size)) * 100, spd(rng, 5, size), rng.uniform(0, 12, size)
    dt[::7] = 0.0
    x[0, 7] = -0.0
    means, covs = predict(motion, CT, x, P, dt)
    assert means[:, ::7].tobytes() == x[:, ::7].tobytes()
    assert covs[:, :, ::7].tobytes() == P[:, :, ::7].tobytes()
    np.testing.assert_array_equal(covs, covs.swapaxes(0, 1))
    for part in (slice(0, 1), slice(130, 131), slice(3, 8), slice(1, 100, 3)):
        few, small = predict(motion, CT, x[:, part], P[:, :, part], dt[part])
        assert few.tobytes() == means[:, part].tobytes()
        assert small.tobytes() == covs[:, :, part].tobytes()
    assert predict(motion, CT, x[:, :0], P[:, :, :0], dt[:0])[1].shape == (5, 5, 0)


@pytest.mark.parametrize("dt", [-1e-9, np.nan])
def test_never_back(dt: float) -> None:
    with pytest.raises(ValueError, match="never predicted back"):
        predict(Motion("cv", 1.0), ("x", "y"), np.zeros((2, 2)), np.ones((2, 2, 2)), np.array([0.0, dt]))
