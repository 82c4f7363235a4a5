"""The GM-PHD filter: one scan written out and read at points, its reduction as properties, its mass by Monte Carlo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import schemas
from fusion_service.bus import open_bus
from schemas import Motion
from sensor_clients.filters import GmPhdFilter, PhdConfig, Position
from sensor_clients.filters.gmphd import merge
from sensor_clients.filters.measurement import Floats
from sensor_clients.scenarios import three_radars as world
from tests.helpers.processes import Hub, Program, eventually

SECOND = 10**9
SIGMA, SPEED = 5.0, 6.0
MODEL = Position(SIGMA, SIGMA)


def intensity(weights: Floats, means: Floats, covariances: Floats, at: Floats) -> Floats:
    """D (K,) of components in rows at points (K, 4)."""
    parts = zip(weights, means, covariances, strict=True)
    return np.asarray(sum(w * multivariate_normal.pdf(at, m, P) for w, m, P in parts))


def test_one_scan_is_the_recursion_written_out() -> None:
    rng = np.random.default_rng(1)
    dt, q, survival, p, clutter, birth = 2.0, 0.5, 0.97, 0.8, 3e-5, 1e-5
    config = PhdConfig(Motion("cv", q), survival, SPEED, gate=1e3, prune=0.0, merge=0.0, cap=100)
    phd = GmPhdFilter(config)
    weights = np.array([0.9, 0.4, 1.7])
    means = rng.normal(size=(3, 4)) * [40, 40, 5, 5]
    root = rng.normal(size=(3, 4, 4)) * np.array([6, 6, 2, 2])[:, None]
    covariances = root @ root.transpose(0, 2, 1) + np.diag([9.0, 9, 1, 1])
    phd.time, phd.weights, phd.means, phd.covariances = (
        0,
        weights,
        means.T.copy(),
        covariances.transpose(1, 2, 0).copy(),
    )
    returns = rng.normal(size=(2, 4)) * 40
    phd.step(
        round(dt * SECOND), returns, MODEL, np.full(4, clutter), np.full(4, birth), lambda x: np.full(x.shape[1], p)
    )

    F = np.array([[1, 0, dt, 0], [0, 1, 0, dt], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    Q = q * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
    H, at = np.eye(4)[:2], rng.normal(size=(200, 4)) * [40, 40, 5, 5]
    expected = np.zeros(200)
    predicted = [
        (w * survival**dt, F @ m, F @ P @ F.T + Q) for w, m, P in zip(weights, means, covariances, strict=True)
    ]
    expected += sum((1 - p) * w * multivariate_normal.pdf(at, m, P) for w, m, P in predicted)
    mass = sum((1 - p) * w for w, _, _ in predicted)
    for z in returns.T:
        terms = [(birth, np.array([*z, 0, 0]), np.diag([SIGMA**2, SIGMA**2, SPEED**2, SPEED**2]))]
        for w, m, P in predicted:
            S = H @ P @ H.T + SIGMA**2 * np.eye(2)
            K = P @ H.T @ np.linalg.inv(S)
            joseph = (np.eye(4) - K @ H) @ P @ (np.eye(4) - K @ H).T + SIGMA**2 * K @ K.T
            terms.append((p * w * multivariate_normal.pdf(z, H @ m, S), m + K @ (z - H @ m), joseph))
        total = clutter + sum(weight for weight, _, _ in terms)
        expected += sum(w / total * multivariate_normal.pdf(at, m, P) for w, m, P in terms)
        mass += 1 - clutter / total
    got = intensity(phd.weights, phd.means.T, phd.covariances.transpose(2, 0, 1), at)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    assert phd.mass == pytest.approx(mass, rel=1e-9)
    assert len(phd.weights) == 3 + 3 * 4 + 4


def moments(weights: Floats, means: Floats, covariances: Floats) -> tuple[Any, Any, Any]:
    mass = weights.sum()
    mean = means @ weights / mass
    away = means - mean[:, None]
    return mass, mean, (covariances @ weights + (weights * away) @ away.T) / mass


def test_merging_keeps_the_moments_and_whatever_is_alone() -> None:
    rng = np.random.default_rng(2)
    C = 60
    weights, means = rng.exponential(size=C), rng.normal(size=(4, C)) * 2
    root = rng.normal(size=(C, 4, 4))
    covariances = (root @ root.transpose(0, 2, 1) + np.eye(4)).transpose(1, 2, 0)
    merged = merge(weights, means, covariances, 9.0)
    assert 1 < len(merged[0]) < C
    for before, after in zip(moments(weights, means, covariances), moments(*merged), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-9)
    order = rng.permutation(C)
    for part, again in zip(merged, merge(weights[order], means[:, order], covariances[..., order], 9.0), strict=True):
        np.testing.assert_allclose(again, part, rtol=1e-9)
    heaviest = int(weights.argmax())
    away = means - means[:, [heaviest]]
    near = np.einsum("ai,ab,bi->i", away, np.linalg.inv(covariances[..., heaviest]), away) < 9.0
    assert near.sum() > 1
    assert merged[0][0] == pytest.approx(weights[near].sum())
    alone = merge(weights, means * 1e4, covariances, 9.0)
    np.testing.assert_allclose(alone[0], np.sort(weights)[::-1])
    assert merge(weights[:0], means[:, :0], covariances[..., :0], 9.0)[0].shape == (0,)


def test_pruning_and_the_cap() -> None:
    config = PhdConfig(Motion("cv", 0.1), 1.0, SPEED, prune=0.02, merge=1.0, cap=3, report=0.4)
    phd = GmPhdFilter(config)
    phd.weights = np.array([0.1, 0.9, 0.5, 0.7, 0.01, 0.3])
    phd.means = np.concatenate([np.arange(6.0)[None] * 1e3, np.zeros((3, 6))])
    phd.covariances = np.repeat(np.eye(4)[..., None], 6, axis=2)
    none = np.zeros(0)
    phd.step(0, np.zeros((2, 0)), MODEL, none, none, lambda x: np.full(x.shape[1], 0.5))
    np.testing.assert_allclose(phd.weights, np.array([0.9, 0.7, 0.5]) * (1 - 0.5 * (1 - np.exp(-8))))
    assert phd.means[0].tolist() == [1e3, 3e3, 2e3], "the heaviest first"
    assert phd.report()["weights"].tolist() == phd.weights[:1].tolist()
    phd.step(SECOND, np.zeros((2, 0)), MODEL, none, none, lambda x: np.where(x[0] > 1.5e3, 0.5, 0.0))
    assert phd.means[0].tolist() == [3e3, 2e3], "outside the field of view it ends"
    with pytest.raises(ValueError, match="back in time"):
        phd.step(0, np.zeros((2, 0)), MODEL, none, none, lambda x: np.full(x.shape[1], 0.5))


SIDE, CLUTTER, BIRTHS, DETECTION, SURVIVAL = 1000.0, 8.0, 0.3, 0.9, 0.97


def masses(seed: int, scans: int) -> tuple[Floats, Floats, Floats]:
    """Mass, true number and heavy components after each scan of a world that is as the filter supposes it."""
    rng = np.random.default_rng(seed)
    phd = GmPhdFilter(PhdConfig(Motion("cv", 0.5), SURVIVAL, SPEED, prune=1e-5, cap=400))
    state, area = np.zeros((4, 0)), (2 * SIDE) ** 2
    out = []
    for k in range(scans):
        state = state[:, rng.random(state.shape[1]) < SURVIVAL]
        state[:2] += state[2:] + 0.2 * rng.normal(size=(2, state.shape[1]))
        state[2:] += 0.7 * rng.normal(size=(2, state.shape[1]))
        state = state[:, (np.abs(state[:2]) < SIDE).all(axis=0)]
        seen = rng.random(state.shape[1]) < DETECTION
        count = rng.poisson(BIRTHS)
        born = np.concatenate([rng.uniform(-SIDE, SIDE, (2, count)), SPEED * rng.normal(size=(2, count))])
        targets = np.concatenate([state[:2, seen], born[:2]], axis=1)
        false = rng.uniform(-SIDE, SIDE, (2, rng.poisson(CLUTTER)))
        returns = np.concatenate([targets + SIGMA * rng.normal(size=targets.shape), false], axis=1)
        state = np.concatenate([state, born], axis=1)

        def detection(place: Floats) -> Floats:
            return np.where((np.abs(place) < SIDE).all(axis=0), DETECTION, 0.0)

        per_area = np.full(returns.shape[1], 1 / area)
        phd.step(k * SECOND, returns, MODEL, CLUTTER * per_area, BIRTHS * per_area, detection)
        out.append((phd.mass, state.shape[1], int((phd.weights > 0.5).sum())))
    return tuple(np.array(out, dtype=float).T)


def test_the_mass_is_the_expected_number() -> None:
    """Its mean over runs is that of the true number within four standard errors, and where it says few or many
    there are few or many: the regression of the number on the mass has a slope of 1 or, since a PHD makes too much
    of a single miss, a little less."""
    runs = [masses(seed, 60) for seed in range(30)]
    error = np.array([(mass - number)[20:].mean() for mass, number, _ in runs])
    number = np.concatenate([number[20:] for _, number, _ in runs])
    assert number.mean() > 5
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error))
    assert error.std() < 0.1 * number.mean(), "and not by four wide errors"
    mass = np.concatenate([mass[20:] for mass, _, _ in runs])
    slope = np.cov(mass, number)[0, 1] / mass.var()
    assert 0.75 < slope < 1.05
    heavy = np.concatenate([heavy[20:] for _, _, heavy in runs])
    assert 0.75 * number.mean() < heavy.mean() < 1.05 * number.mean()


@pytest.mark.parametrize(
    "name", ["radar1", *(pytest.param(name, marks=pytest.mark.slow) for name in world.RADARS if name != "radar1")]
)
def test_the_mass_of_a_radar_is_the_number_in_its_view(name: str) -> None:
    """Within one target on the average of 2 runs after 40 s, for 5 to 15 in view among 400 false returns; nearly
    every heavy component is at a target, and so many targets have one as are seen: one miss makes a weight 1 - p."""
    gap, held, wanted, false, heavy = [], 0, 0, 0, 0
    for seed in range(2):
        events = list(world.radar_events(name, seed, tracker="gm-phd"))
        assert events[0].kind == "info"
        for event in events[5:]:
            t = np.array([(event.time - world.START) / SECOND])
            places = world._in_frame(world.true_states(t), world.RADARS[name])[0, :, :2]
            distance = np.hypot(*places.T)
            gap.append(event.fields["weights"].sum() - (distance < 300e3).sum())
            peaks = event.fields["means"][event.fields["weights"] > 0.5, :2]
            apart = np.linalg.norm(peaks[:, None] - places, axis=-1)
            false, heavy = false + int((apart.min(axis=1) > 5e3).sum()), heavy + len(peaks)
            inner = distance < 285e3
            held, wanted = held + int((apart[:, inner].min(axis=0) < 5e3).sum()), wanted + int(inner.sum())
    assert abs(np.mean(gap)) < 1.0
    assert false / heavy < 0.03
    assert held / wanted > 0.8


def test_an_intensity_reaches_the_bus(hub: Hub) -> None:
    heard: list[tuple[str, schemas.Message]] = []
    main = "import sys; from sensor_clients.cli import main; sys.exit(main(sys.argv[1:]))"
    common = ("simulate", "three-radars", "--sensor", "radar3", "--tracker", "gm-phd", "--connect", hub.endpoint)
    with open_bus([hub.endpoint], wait=60.0) as bus:
        bus.subscribe("**", lambda key, data: heard.append((key, schemas.decode(data))), history=8)
        with Program(main, *common, "--speed", "100", "--duration", "30", "--seed", "2") as radar:
            assert radar.end(20) == (0, "")
            eventually(lambda: len(heard) >= 5)
    kinds: dict[str, Any] = dict(heard)
    assert set(kinds) == {"fusion/v1/local/radar3/info", "fusion/v1/local/radar3/intensity"}
    expected = [event for event in world.radar_events("radar3", 2, tracker="gm-phd") if event.kind == "intensity"][3]
    last = kinds["fusion/v1/local/radar3/intensity"]
    assert isinstance(last, schemas.LocalIntensity)
    assert last.time == expected.time == world.START + 30 * SECOND
    np.testing.assert_array_equal(last.weights, expected.fields["weights"])
    assert not schemas.check_numbers([last])[0].any()
