"""Local Kalman filters of one target, and the joint covariance of all their errors.

With gains K_i of filters that run alone, the joint covariance J of their errors goes by

    J <- A J A' + B (1 1' x Q) B' + K R K',    A = (I - K H)(I x F), B = I - K H   (block-diagonal K, H)

(Bar-Shalom's recursion for cross-covariances), Q being the process noise that there is, whatever the filters think. A
measurement error common to the sensors is carried along as a state, b' = decay b + noise.

Shapes: batch first, pairs (B,), N filters; P (B, N, n, n) as reported, J (B, N n, N n) as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from studies.study import Floats

__all__ = ["Model", "Tracks", "alike", "blocks", "filtered", "planar", "positions", "steady"]

PLACE = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
"""Position of a state x, vx, y, vy."""


class Tracks(NamedTuple):
    """N tracks of one target, B times over: reported P (B, N, n, n), joint error covariance J (B, N n, N n). Of filters
    what follows of it from the covariances they report one after the other (`fusion_service/centre/derived.py`),
    `derived` (B, N, N, n, n), and what `left` (B, N, n, n), D_i, their start leaves unknown."""

    P: Floats
    J: Floats
    derived: Floats | None = None
    left: Floats | None = None


class Model(NamedTuple):
    """F, Q (n, n) as filters have it; H (..., N, d, n), R (N, d, d); true: the process noise there is (None: Q);
    shared: standard deviation of a common measurement error, and its correlation from one scan to the next."""

    F: Floats
    Q: Floats
    H: Floats
    R: Floats
    true: Floats | None = None
    shared: float = 0.0
    decay: float = 0.0


def planar(T: float, q: float) -> tuple[Floats, Floats]:
    """F and Q (4, 4) of nearly constant velocity in the plane: x, vx, y, vy."""
    F, Q = np.array([[1.0, T], [0.0, 1.0]]), np.array([[q * T**3 / 3, q * T**2 / 2], [q * T**2 / 2, q * T]])
    return np.kron(np.eye(2), F), np.kron(np.eye(2), Q)


def positions(T: float, q: float, sigmas: Sequence[float]) -> Model:
    """Sensors of position with these standard deviations."""
    return Model(*planar(T, q), np.tile(PLACE, (len(sigmas), 1, 1)), np.stack([s**2 * np.eye(2) for s in sigmas]))


def blocks(A: Floats) -> Floats:
    """Block-diagonal (B, N a, N b) of A (B, N, a, b)."""
    B, N, a, b = A.shape
    out = np.zeros((B, N, a, N, b))
    out[:, range(N), :, range(N)] = A.swapaxes(0, 1)
    return out.reshape(B, N * a, N * b)


def filtered(start: Tracks, model: Model, steps: int, H: Floats | None = None) -> Tracks:
    """After `steps` predictions and updates; H (steps, B, N, d, n) where it changes."""
    P, (B, size, _) = start.P, start.J.shape
    N, n, d = P.shape[1], P.shape[2], model.R.shape[1]
    J = np.zeros((B, size + d, size + d))
    J[:, :size, :size] = start.J
    J[:, size:, size:] = model.shared**2 * np.eye(d)
    Q = model.Q if model.true is None else model.true
    common = np.zeros((size + d, size + d))
    common[:size, :size] = np.tile(Q, (N, N))
    common[size:, size:] = (1.0 - model.decay**2) * model.shared**2 * np.eye(d)
    move = np.zeros_like(common)
    move[:size, :size] = np.kron(np.eye(N), model.F)
    move[size:, size:] = model.decay * np.eye(d)
    R = model.R + model.shared**2 * np.eye(d)
    A = np.broadcast_to(np.eye(size + d), J.shape).copy()
    C = np.zeros((B, N, N, n, n)) if start.derived is None else start.derived
    left = np.asarray(np.linalg.cholesky(P)) if start.left is None else start.left
    for k in range(steps):
        h = np.broadcast_to(model.H if H is None else H[k], (B, N, d, n))
        before = P = model.F @ P @ model.F.T + model.Q
        K = P @ h.swapaxes(-1, -2) @ np.linalg.inv(h @ P @ h.swapaxes(-1, -2) + R)
        P = P - K @ h @ P
        P = 0.5 * (P + P.swapaxes(-1, -2))
        told = P @ np.linalg.inv(before)
        C = told[:, :, None] @ (model.F @ C @ model.F.T + model.Q) @ told[:, None].swapaxes(-1, -2)
        left = told @ model.F @ left
        A[:, :size, :size] = blocks(np.eye(n) - K @ h)
        A[:, :size, size:] = K.reshape(B, size, d)
        J = A @ (move @ J @ move.T + common) @ A.swapaxes(1, 2)
        J[:, :size, :size] += blocks(K @ model.R @ K.swapaxes(-1, -2))
    J = J[:, :size, :size]
    return Tracks(P, 0.5 * (J + J.swapaxes(1, 2)), C, left)


def alike(P: Floats, N: int, true: Floats | None = None) -> Tracks:
    """N copies of one estimate that reports P (n, n)."""
    return Tracks(np.tile(P, (1, N, 1, 1)), np.tile(P if true is None else true, (1, N, N)))


def steady(model: Model, steps: int = 150) -> Tracks:
    """The filters' tracks once their start is forgotten."""
    N, n = model.H.shape[0], len(model.F)
    return filtered(alike(100.0 * np.mean(model.R[:, 0, 0]) * np.eye(n), N), model, steps)
