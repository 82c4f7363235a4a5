"""The batched Kalman filter against one dense Gaussian of the whole trajectory, and change of coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_clients.filters import kalman
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.measurement import Floats


def spd(rng: np.random.Generator, n: int, *batch: int) -> Floats:
    A = rng.standard_normal((n, n, *batch))
    return np.asarray(np.einsum("ik...,jk...->ij...", A, A) + 0.5 * np.eye(n).reshape(n, n, *(1,) * len(batch)))


def filtered(F: Floats, Q: Floats, H: Floats, R: Floats, prior: Estimate, z: Floats) -> Estimate:
    state = prior
    for one in z:
        state = kalman.update(kalman.predict(state, F, Q), H, R, one)
    return state


def posterior(F: Floats, Q: Floats, H: Floats, R: Floats, m: Floats, P: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Of the last state of one run: x_0, the process noise of every step and z are one linear map of independent
    Gaussians; condition on all z at once. z (K, d)."""
    K, n = len(z), len(m)
    to_state = np.zeros((K, n, n * (K + 1)))
    row = np.concatenate([np.eye(n), np.zeros((n, n * K))], axis=1)
    for k in range(K):
        row = F @ row
        row[:, n * (k + 1) : n * (k + 2)] += np.eye(n)
        to_state[k] = row
    sources = np.zeros((n * (K + 1), n * (K + 1)))
    sources[:n, :n] = P
    for k in range(1, K + 1):
        sources[n * k : n * (k + 1), n * k : n * (k + 1)] = Q
    seen = np.concatenate([H @ one for one in to_state])
    S = seen @ sources @ seen.T + np.kron(np.eye(K), R)
    cross = to_state[-1] @ sources @ seen.T
    mean = np.concatenate([m, np.zeros(n * K)])
    x = to_state[-1] @ mean + cross @ np.linalg.solve(S, z.ravel() - seen @ mean)
    return x, to_state[-1] @ sources @ to_state[-1].T - cross @ np.linalg.solve(S, cross.T)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(("n", "d"), [(1, 1), (3, 2), (4, 2), (2, 3)])
def test_it_is_the_joint_posterior_of_all_steps(n: int, d: int, shared: bool) -> None:
    rng = np.random.default_rng([n, d])
    B, K = 5, 7
    batch = () if shared else (B,)
    F, H = rng.standard_normal((n, n, *batch)) / np.sqrt(n), rng.standard_normal((d, n, *batch))
    Q, R = spd(rng, n, *batch), spd(rng, d, *batch)
    prior = Estimate(rng.standard_normal((n, B)), spd(rng, n, B))
    z = 3 * rng.standard_normal((K, d, B))
    state = filtered(F, Q, H, R, prior, z)
    for b in range(B):
        f, q, h, r = (a if shared else a[..., b] for a in (F, Q, H, R))
        x, P = posterior(f, q, h, r, prior.mean[:, b], prior.covariance[..., b], z[..., b])
        np.testing.assert_allclose(state.mean[:, b], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(state.covariance[..., b], P, rtol=1e-9, atol=1e-9)


def test_a_change_of_coordinates_changes_nothing_else() -> None:
    """y = T x + c: filtering in y is filtering in x, transformed."""
    rng = np.random.default_rng(3)
    n, d, B, K = 4, 2, 6, 5
    F, H, Q, R = rng.standard_normal((n, n)), rng.standard_normal((d, n)), spd(rng, n), spd(rng, d)
    T = rng.standard_normal((n, n)) + 3 * np.eye(n)
    back = np.linalg.inv(T)
    prior = Estimate(rng.standard_normal((n, B)), spd(rng, n, B))
    z = rng.standard_normal((K, d, B))
    there = Estimate(T @ prior.mean, np.einsum("ik,klb,jl->ijb", T, prior.covariance, T))
    x = filtered(F, Q, H, R, prior, z)
    y = filtered(T @ F @ back, T @ Q @ T.T, H @ back, R, there, z)
    np.testing.assert_allclose(y.mean, T @ x.mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(y.covariance, np.einsum("ik,klb,jl->ijb", T, x.covariance, T), rtol=1e-8, atol=1e-8)


def test_two_sensors_in_turn_are_both_at_once() -> None:
    rng = np.random.default_rng(4)
    n, B = 3, 4
    prior = Estimate(rng.standard_normal((n, B)), spd(rng, n, B))
    H, R, z = rng.standard_normal((3, n)), np.diag([1.0, 2.0, 0.5]), rng.standard_normal((3, B))
    both = kalman.update(prior, H, R, z)
    turns = kalman.update(kalman.update(prior, H[:2], R[:2, :2], z[:2]), H[2:], R[2:, 2:], z[2:])
    np.testing.assert_allclose(turns.mean, both.mean, atol=1e-10)
    np.testing.assert_allclose(turns.covariance, both.covariance, atol=1e-10)
