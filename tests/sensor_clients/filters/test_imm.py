"""The IMM: against a recursion written out for one track, its mixing as properties, its errors by Monte Carlo."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import schemas
from fusion_service import densities
from schemas import Motion
from sensor_clients.filters import ImmTracker, LocalTracker, Modes, Position, TrackerConfig
from sensor_clients.filters.imm import mix
from sensor_clients.filters.measurement import Floats
from sensor_clients.scenarios import three_radars as world

SECOND = 10**9
SIGMA = 4.0
MODEL = Position(SIGMA, SIGMA)
CONFIG = TrackerConfig(
    motion=Motion("cv", 0.0),
    survival=0.99,
    sigma_speed=8.0,
    gate=1e3,
    confirm=0.0,
    drop=0.0,
    drop_tentative=1e-6,
)


def everywhere(place: Floats) -> Floats:
    return np.full(place.shape[1], 0.9)


def cv(dt: float, q: float) -> tuple[Floats, Floats]:
    axis = np.eye(2)
    F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), axis)
    return F, q * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), axis)


def transition(modes: Modes, dt: float) -> Floats:
    """As the limit of many small steps."""
    M = len(modes.sojourns)
    G = np.array([[-1 / t if a == b else 1 / t / (M - 1) for b in range(M)] for a, t in enumerate(modes.sojourns)])
    return np.asarray(np.linalg.matrix_power(np.eye(M) + G * dt / 2**20, 2**20))


def scan_by_hand(
    state: tuple[float, Floats, list[Floats], list[Floats]], modes: Modes, dt: float, returns: Floats, clutter: float
) -> tuple[float, Floats, list[Floats], list[Floats]]:
    """One scan of one track: every pair of a mode and a return (or none) as one hypothesis, then merged by mode."""
    r, mu, means, covariances = state
    M, p, Pi, H = len(mu), 0.9, transition(modes, dt), np.eye(4)[:2]
    c = mu @ Pi
    predicted = []
    for b in range(M):
        share = Pi[:, b] * mu / c[b]
        x0 = sum(share[a] * means[a] for a in range(M))
        P0 = sum(share[a] * (covariances[a] + np.outer(means[a] - x0, means[a] - x0)) for a in range(M))
        F, Q = cv(dt, modes.intensities[b])
        predicted.append((F @ x0, F @ P0 @ F.T + Q))
    r = r * CONFIG.survival**dt
    new_mu, new_means, new_covariances, exists = np.zeros(M), [], [], 0.0
    for b, (x, P) in enumerate(predicted):
        hypotheses = [((1 - p) * c[b], x, P)]
        S = H @ P @ H.T + SIGMA**2 * np.eye(2)
        K = P @ H.T @ np.linalg.inv(S)
        for z in returns.T:
            weight = p * c[b] * multivariate_normal.pdf(z, H @ x, S) / clutter
            hypotheses.append((weight, x + K @ (z - H @ x), P - K @ S @ K.T))
        total = sum(weight for weight, _, _ in hypotheses)
        mean = sum(weight * m for weight, m, _ in hypotheses) / total
        new_means.append(mean)
        new_covariances.append(sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in hypotheses) / total)
        new_mu[b] = total
        exists += total
    return r * exists / (1 - r + r * exists), new_mu / new_mu.sum(), new_means, new_covariances


@pytest.mark.parametrize("modes", [Modes((0.1, 20.0), (30.0, 5.0)), Modes((0.0, 1.0, 50.0), (40.0, 10.0, 3.0))])
def test_one_track_among_returns_is_the_recursion_written_out(modes: Modes) -> None:
    rng = np.random.default_rng(3)
    tracker = ImmTracker(CONFIG, modes)
    clutter, first = 1e-4, np.array([10.0, -20.0])
    tracker.step(0, first[:, None], MODEL, np.array([clutter]), np.array([clutter]), everywhere)
    M = len(modes.sojourns)
    state = (
        0.5,
        np.array(modes.sojourns) / sum(modes.sojourns),
        [np.array([*first, 0.0, 0.0])] * M,
        [np.diag([SIGMA**2, SIGMA**2, 64.0, 64.0])] * M,
    )
    time = 0
    for dt in (1.0, 2.5, 0.5, 1.0, 4.0):
        time += round(dt * SECOND)
        returns = first[:, None] + rng.normal(size=(2, 3)) * 15
        tracker.step(time, returns, MODEL, np.full(3, clutter), np.full(3, 1e-30), everywhere)
        state = scan_by_hand(state, modes, dt, returns, clutter)
        assert tracker.ids.tolist() == [1]
        np.testing.assert_allclose(tracker.existence[0], state[0], rtol=1e-6)
        np.testing.assert_allclose(tracker.weights[:, 0], state[1], rtol=1e-4)
        np.testing.assert_allclose(tracker.parts[..., 0].T, state[2], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(tracker.spreads[..., 0].transpose(2, 0, 1), state[3], rtol=1e-4, atol=1e-3)


def test_transitions_are_a_semigroup_that_keeps_the_stationary_probabilities() -> None:
    modes = Modes((0.0, 1.0, 9.0), (40.0, 10.0, 3.0))
    for a, b in itertools.product((0.1, 2.0, 30.0), repeat=2):
        np.testing.assert_allclose(modes.transition(a) @ modes.transition(b), modes.transition(a + b), atol=1e-12)
    np.testing.assert_allclose(modes.stationary() @ modes.transition(7.0), modes.stationary(), atol=1e-12)
    np.testing.assert_allclose(modes.transition(0.0), np.eye(3), atol=1e-15)
    # Two modes: 1 - (1 - exp(-(1/a + 1/b) t)) (1/a) / (1/a + 1/b) to stay.
    stay = Modes((0.0, 1.0), (20.0, 5.0)).transition(3.0)[0, 0]
    assert stay == pytest.approx(1 - (1 - np.exp(-0.25 * 3)) * 0.05 / 0.25)


def test_mixing_keeps_the_moments_of_the_whole() -> None:
    rng = np.random.default_rng(4)
    M, T = 3, 5
    weights, means = rng.dirichlet(np.ones(M), T).T, rng.normal(size=(4, M, T)) * 10
    root = rng.normal(size=(4, 4, M, T))
    covariances = np.einsum("ijmt,kjmt->ikmt", root, root)
    after = mix(weights, means, covariances, rng.dirichlet(np.ones(M), M))

    def whole(w: Floats, m: Floats, P: Floats) -> tuple[Floats, Floats]:
        rows = m.transpose(2, 1, 0).reshape(-1, 4), P.transpose(3, 2, 0, 1).reshape(-1, 4, 4), w.T.ravel()
        return densities.moments(*rows, np.full(T, M, dtype=np.uint16))

    for before, now in zip(whole(weights, means, covariances), whole(*after), strict=True):
        np.testing.assert_allclose(now, before, atol=1e-9)


@pytest.mark.parametrize(("intensities", "sojourns"), [((1.0,), (1.0,)), ((1.0, 2.0), (1.0,)), ((1.0, 2.0), (1.0, 0))])
def test_modes_that_are_none_are_refused(intensities: tuple[float, ...], sojourns: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="two modes or more"):
        Modes(intensities, sojourns)


QUIET, WILD = 0.05, 30.0
JUMPS = Modes((QUIET, WILD), (25.0, 6.0))


def manoeuvring(rng: np.random.Generator, targets: int, scans: int) -> tuple[Floats, Floats]:
    """States (scans, 4, targets) of targets that jump between the modes each second, and the modes (scans, targets)."""
    Pi = transition(JUMPS, 1.0)
    mode = (rng.random(targets) > JUMPS.stationary()[0]).astype(int)
    state = np.concatenate([np.stack([1e5 * np.arange(targets), np.zeros(targets)]), 8 * rng.normal(size=(2, targets))])
    roots = [np.linalg.cholesky(cv(1.0, q)[1]) for q in (QUIET, WILD)]
    states, kinds = [state], [mode]
    for _ in range(scans - 1):
        mode = (rng.random(targets) > Pi[mode, 0]).astype(int)
        noise = rng.normal(size=(4, targets))
        state = cv(1.0, 0.0)[0] @ state + np.where(mode == 0, roots[0] @ noise, roots[1] @ noise)
        states.append(state)
        kinds.append(mode)
    return np.stack(states), np.stack(kinds)


def errors(tracker: LocalTracker, states: Floats, seed: int) -> tuple[Floats, Floats, Floats]:
    """NEES and squared error of position (scans, targets) after every scan, and the log density of the truth."""
    rng = np.random.default_rng(seed)
    nees, squared, score = [], [], []
    for k, state in enumerate(states):
        returns = state[:2] + SIGMA * rng.normal(size=state[:2].shape)
        sparse = np.full(returns.shape[1], 1e-12)
        births = np.full(returns.shape[1], 1e-6 if k == 0 else 1e-30)
        tracker.step(k * SECOND, returns, MODEL, sparse, births, everywhere)
        assert len(tracker.ids) == returns.shape[1]
        error = tracker.means - state
        nees.append(np.einsum("it,tij,jt->t", error, np.linalg.inv(tracker.covariances.transpose(2, 0, 1)), error))
        squared.append(np.sum(error[:2] ** 2, axis=0))
        if isinstance(tracker, ImmTracker):
            away = tracker.parts - state[:, None]
            P = tracker.spreads.transpose(2, 3, 0, 1)
            exponent = np.einsum("ict,ctij,jct->ct", away, np.linalg.inv(P), away)
            density = np.exp(-exponent / 2) / np.sqrt(np.linalg.det(2 * np.pi * P))
            score.append(np.log(np.sum(tracker.weights * density, axis=0)))
        else:
            P = tracker.covariances.transpose(2, 0, 1)
            score.append(-nees[-1] / 2 - np.log(np.linalg.det(2 * np.pi * P)) / 2)
    return np.stack(nees), np.stack(squared), np.stack(score)


def test_through_manoeuvres_its_errors_fit_its_covariances() -> None:
    """120 targets, each 60 s: an average NEES of 4 by its own standard error; one Kalman filter of the quiet
    motion is far off, one of the wild motion is worse at quiet times, and the mixture tells most of the truth."""
    states, kinds = manoeuvring(np.random.default_rng(5), 120, 60)
    settle = slice(10, None)

    def single(q: float) -> LocalTracker:
        return LocalTracker(TrackerConfig(Motion("cv", q), 1.0, 8.0, 1e3, 0.0, 0.0, 1e-6))

    config = TrackerConfig(Motion("cv", 0.0), 1.0, 8.0, 1e3, 0.0, 0.0, 1e-6)
    (imm, squared, score), quiet, wild = (
        errors(tracker, states, 6) for tracker in (ImmTracker(config, JUMPS), single(QUIET), single(WILD))
    )
    per_target = imm[settle].mean(axis=0)
    standard_error = per_target.std() / np.sqrt(len(per_target))
    # IMM approximates a mixture that grows without end: its bias is bounded at 5 % besides.
    assert abs(per_target.mean() - 4.0) < 3 * standard_error + 0.2
    assert quiet[0][settle].mean() > 8.0
    still = np.zeros_like(kinds, dtype=bool)
    still[settle] = np.all([kinds[settle.start - lag : len(kinds) - lag] == 0 for lag in range(8)], axis=0)
    moving = (kinds == 1) & (np.arange(len(kinds)) >= 10)[:, None]
    assert still.sum() > 500
    assert squared[still].mean() < 0.85 * wild[1][still].mean()
    assert squared[moving].mean() < 0.85 * quiet[1][moving].mean()
    for other in (quiet, wild):
        assert score[settle].mean() > other[2][settle].mean() + 0.1


def test_a_report_is_the_mixture_ahead_of_time() -> None:
    """Predicted 2 s on, its moments are those of one track by hand."""
    modes = Modes((0.1, 20.0), (30.0, 5.0))
    tracker = ImmTracker(CONFIG, modes)
    returns = np.array([[0.0, 500.0], [0.0, 0.0]])
    for k in range(4):
        births = np.full(2, 1e-4 if k == 0 else 1e-30)
        tracker.step(k * SECOND, returns + 6.0 * k, MODEL, np.full(2, 1e-4), births, everywhere)
    report = tracker.report(5 * SECOND)
    assert report.time == 5 * SECOND
    assert report.counts is not None
    assert report.weights is not None
    assert report.counts.tolist() == [2, 2]
    Pi = transition(modes, 2.0)
    for t in range(2):
        np.testing.assert_allclose(report.weights[2 * t : 2 * t + 2], tracker.weights[:, t] @ Pi, rtol=1e-4)
        # The mean of the whole moves as any mode's does.
        mean = report.weights[2 * t : 2 * t + 2] @ report.means[2 * t : 2 * t + 2]
        np.testing.assert_allclose(mean, cv(2.0, 0.0)[0] @ tracker.means[:, t], rtol=1e-6)
    wide = np.linalg.det(report.covariances)
    assert (wide[1::2] > wide[::2]).all(), "the wild mode is the wider one"


def test_what_a_radar_with_an_imm_says() -> None:
    events = list(world.radar_events("radar2", 3, tracker="imm"))
    header: dict[str, Any] = {"source": "radar2", "epoch": 1, "seq": 0, "sent": 1, "origin": "simulated"}
    assert schemas.decode(schemas.encode(schemas.SensorInfo(**header, **events[0].fields)))
    messages = [schemas.LocalTracks(**header, time=event.time, **event.fields) for event in events[1:]]
    assert all(schemas.decode(schemas.encode(message)) for message in messages)
    assert not any(codes.any() for codes in schemas.check_numbers(messages))
    last = messages[-1]
    assert last.counts is not None
    assert set(last.counts.tolist()) <= {1, 2}
    assert 2 in last.counts
    assert len(last.means) == last.counts.sum() > len(last.ids) > 8
    plain = list(world.radar_events("radar2", 3))
    assert plain[-1].fields.get("weights") is None
    assert plain[0].fields["motion"].q < events[0].fields["motion"].q
