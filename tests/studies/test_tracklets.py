"""Local trackers and real centres far apart (`studies/trackers.py`, `studies/apart.py`), and the two studies of them:
`unequal-sensors` and `tracklets`."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from sensor_clients.filters import Modes, Position, RangeAzimuth
from studies.apart import CENTRALISED, Flight, Task, best_of, flown, told
from studies.consistency import by_chance
from studies.experiments import tracklets, unequal_sensors
from studies.experiments.unequal_sensors import SENSORS, SIGMAS, WORLD
from studies.rules import fuser
from studies.study import Floats, Run
from studies.trackers import Bank, Central, Sensor, World, nanoseconds, targets, times

SEED = 7
TARGETS = 60
CI: tuple[str, dict[str, str]] = ("ci", {"rule": "ci"})
OURS: tuple[str, dict[str, str]] = ("tracklet", {"rule": "ci", "memory": "tracklet"})


def F_and_Q(T: float, q: float) -> tuple[Floats, Floats]:
    """Nearly constant velocity of x, y, vx, vy."""
    F = np.eye(4) + T * np.eye(4, k=2)
    return F, q * np.kron(np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]), np.eye(2))


@cache
def flights(names: tuple[str, ...]) -> dict[str, Flight]:
    """Worlds of `tracklets`, shorter, under the rule and with tracklets."""
    known = tracklets.worlds()
    tasks = {name: Task(replace(known[name], steps=40), (CI, OURS), 5) for name in names}
    print(f"seed {SEED}")
    return flown(Run(TARGETS, SEED), tasks)


def test_exact_values_are_those_of_independent_derivations() -> None:
    found = {
        label: (mse, said) for label, mse, said in unequal_sensors.exact((fuser("naive"),), np.random.default_rng(1), 1)
    }
    F = np.kron(np.eye(2), np.array([[1.0, 1.0], [0.0, 1.0]]))
    Q = np.kron(np.eye(2), np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    H = np.eye(4)[[0, 2]]

    def alone(sigmas: tuple[float, ...]) -> Floats:
        stacked, R = np.tile(H, (len(sigmas), 1)), np.kron(np.diag(np.square(sigmas)), np.eye(2))
        before = solve_discrete_are(F.T, stacked.T, Q, R)
        return np.asarray(np.linalg.inv(np.linalg.inv(before) + stacked.T @ np.linalg.solve(R, stacked)))

    np.testing.assert_allclose(found[CENTRALISED][0], alone(SIGMAS), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found["best sensor"][1], alone(SIGMAS[:1]), rtol=1e-6, atol=1e-9)
    together = np.linalg.inv(sum(np.linalg.inv(alone((sigma,))) for sigma in SIGMAS))
    np.testing.assert_allclose(found["naive"][1], together, rtol=1e-6, atol=1e-9)
    optimum = found["optimal"][0]
    for mse, _ in (found["naive"], found["best sensor"]):
        assert np.linalg.eigvalsh(mse - optimum).min() > -1e-9
    assert np.linalg.eigvalsh(optimum - found[CENTRALISED][0]).min() > 0


def test_chance_is_that_of_the_theory_in_one_dimension() -> None:
    """The mean of M first-order autoregressive squares has the variance 2 (1 + 2 sum (1 - k/K) a^2k) / (M K)."""
    a, K, M = 0.8, 40, 30
    found = by_chance(np.array([[a]]), np.array([[2.5]]), K, M, np.random.default_rng(SEED), times=3000)
    k = np.arange(1, K)
    worth = K / (1 + 2 * np.sum((1 - k / K) * a ** (2 * k)))
    assert found.worth == pytest.approx(worth, rel=1e-9)
    spread = np.sqrt(2 / (M * worth))
    assert abs(found.excess.mean() - 1) < 4 * spread / np.sqrt(3000)
    assert found.excess.std() == pytest.approx(spread, rel=0.06)


def test_targets_move_as_they_are_said_to() -> None:
    world = World(SENSORS, q=2.0, steps=3)
    path = list(targets(world, 20_000, np.random.default_rng(SEED)))
    F, Q = F_and_Q(1.0, 2.0)
    shocks = path[1] - F @ path[0]
    np.testing.assert_allclose(shocks @ shocks.T / 20_000, Q, atol=0.08)
    still = list(targets(replace(world, q=0.0, turn=0.1, steps=41), 300, np.random.default_rng(SEED)))
    speeds = np.array([np.hypot(*x[2:]) for x in still])
    np.testing.assert_allclose(speeds, np.broadcast_to(speeds[0], speeds.shape), rtol=1e-9)
    headings = np.unwrap([np.arctan2(x[3], x[2]) for x in still], axis=0)
    np.testing.assert_allclose(np.ptp(headings, axis=0), 1.0, atol=0.11)  # 10 s of 0.1 rad/s; starts between steps
    chords = np.array([np.hypot(*(b[:2] - a[:2])) for a, b in pairwise(still)])
    turned = np.abs(np.diff(headings, axis=0))
    steady = np.isclose(turned, 0.1)
    assert steady.any()
    expected = 2 * np.sin(0.05) / 0.1 * np.broadcast_to(speeds[0], chords.shape)
    np.testing.assert_allclose(chords[steady], expected[steady], rtol=1e-9)


def test_a_bank_is_a_kalman_filter_and_the_central_one_has_what_has_arrived() -> None:
    rng = np.random.default_rng(SEED)
    late = SENSORS[1]._replace(late=1.5, phase=0.4)
    world = World((SENSORS[0], late), steps=6)
    central = Central(world)
    seen: list[tuple[int, Sensor, Floats]] = []
    for time, sensors in times(world).items():
        for i in sensors:
            z = rng.normal(0, 100, (2, 3))
            seen.append((time, world.sensors[i], z))
            central.add(time, world.sensors[i], z)
        if time % nanoseconds(1.0):
            continue
        mean, P, last = np.zeros((4, 3)), np.zeros((4, 4)), -1
        for then, sensor, z in seen:
            if then + nanoseconds(sensor.late) > time:
                continue
            R = np.eye(2) * sensor.model.noise(np.zeros((2, 1)))[0, 0, 0]
            if last < 0:
                mean, P = np.concatenate([z, 0 * z]), np.diag([R[0, 0], R[0, 0], 400.0, 400.0])
            else:
                F, Q = F_and_Q((then - last) / 1e9, 1.0)
                mean, P = F @ mean, F @ P @ F.T + Q
                K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
                mean, P = mean + K @ (z - mean[:2]), P - K @ P[:2]
            last = then
        F, Q = F_and_Q((time - last) / 1e9, 1.0)
        ours = central.at(time)
        np.testing.assert_allclose(ours[0], F @ mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours[1][..., 0], F @ P @ F.T + Q, rtol=1e-9, atol=1e-9)


def test_an_imm_whose_modes_are_alike_is_one_filter() -> None:
    one = Bank(World(SENSORS))
    two = Bank(World(SENSORS, modes=Modes((1.0, 1.0), (10.0, 5.0))))
    radar = Sensor(RangeAzimuth(100.0, 3e-3), origin=(-50e3, 0.0))
    rng = np.random.default_rng(SEED)
    for k in range(1, 6):
        z = radar.model.observe(np.array([[50e3, 40e3], [20e3, -30e3]]) + rng.normal(0, 100, (2, 2)))
        for bank in (one, two):
            bank.update(nanoseconds(k), radar, z)
    for a, b in zip(one.at(nanoseconds(7)), two.at(nanoseconds(7)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_tracklets_are_the_centralised_filter_and_the_rule_is_the_best_sensor() -> None:
    world = replace(WORLD, steps=45)
    ways = (*unequal_sensors.ways(), ("other", {"rule": "naive", "memory": "tracklet"}))
    print(f"seed {SEED}")
    flight = flown(Run(TARGETS, SEED), {"": Task(world, ways, 1)})[""]
    ours, share, seen = told("ci tracklet", flight)
    whole, best = flight.scores[CENTRALISED], best_of(flight)
    np.testing.assert_allclose(ours.squared, whole.squared, rtol=0.02, atol=0.02)
    assert ours.rmse().value == pytest.approx(whole.rmse().value, rel=1e-3)
    assert flight.scores["other"].rmse().value == pytest.approx(whole.rmse().value, rel=1e-3)
    assert abs(ours.rmse().value - 6.868) < 4 * ours.rmse().stderr
    assert abs(ours.mean_nees().value - 1) < 4 * ours.mean_nees().stderr < 0.2
    luck = unequal_sensors.chance(Run(TARGETS, SEED))
    assert ours.worst().value < luck.excess.mean() + 5 * luck.excess.std()
    assert share > 99.9
    assert abs(seen - 1) < 0.15
    assert flight.scores["ci restart"].rmse().value == pytest.approx(best.rmse().value, rel=1e-3)
    assert flight.scores["auto"].rmse().value == pytest.approx(whole.rmse().value, rel=1e-3)
    assert best.rmse().value > 1.15 * ours.rmse().value
    naive = flight.scores["naive restart"].worst()
    assert abs(naive.value - 2.631) < 5 * naive.stderr
    assert naive.value - 5 * naive.stderr > 1


def test_the_promise_holds_whatever_the_periods_and_the_lateness() -> None:
    names = ("periods 1, 2 and 5 s", "phases 0.2, 0.5 and 0.8 s", "late first", "radars")
    for name, flight in flights(names).items():
        ours, share, _ = told("tracklet", flight)
        whole = flight.scores[CENTRALISED]
        assert ours.rmse().value == pytest.approx(whole.rmse().value, rel=2e-3), name
        assert ours.mean_nees().value == pytest.approx(whole.mean_nees().value, rel=5e-3), name
        assert ours.rmse().value < min(best_of(flight).rmse().value, flight.scores["ci"].rmse().value), name
        assert share > 99, name


def test_loss_costs_the_messages_and_not_the_honesty() -> None:
    flight = flights(("loss 30 %",))["loss 30 %"]
    ours, _, _ = told("tracklet", flight)
    whole = flight.scores[CENTRALISED]
    assert whole.rmse().value < ours.rmse().value < 0.9 * flight.scores["ci"].rmse().value
    assert ours.mean_nees().value - whole.mean_nees().value < 0.05
    assert ours.worst().value - whole.worst().value < 0.05 + 2 * ours.worst().stderr


def test_declared_feedback_keeps_the_promise_of_the_rule() -> None:
    task = Task(replace(WORLD, steps=35), (OURS,), 8, None, (0, 1, 2), True)
    print(f"seed {SEED}")
    flight = flown(Run(TARGETS, SEED), {"": task})[""]
    nees = flight.scores["tracklet"].mean_nees()
    assert abs(nees.value - 1) < 4 * nees.stderr
    assert set(flight.failing["tracklet"]) == {f"sensor-{i}: feedback" for i in (1, 2, 3)}
    assert flight.scores["sensor 3"].rmse().value < 0.8 * 14.7  # it goes on from the others' results


def test_who_is_wrong_about_q_loses_the_gain_but_not_more() -> None:
    """Declaration and filter alike: with the motion of targets set, the centralised filter; said only: the rule."""
    worlds = unequal_sensors.wrong()
    chosen = {name: replace(worlds[name], steps=45) for name in ("q x 4, both", "q x 0.25, said", "q x 4, said")}
    print(f"seed {SEED}")
    found = flown(
        Run(TARGETS, SEED), {name: Task(world, unequal_sensors.ways_wrong(), 2) for name, world in chosen.items()}
    )
    right = found["q x 4, said"].scores[CENTRALISED].rmse().value
    fixed = found["q x 4, both"].scores["tracklet, motion set"]
    assert fixed.rmse().value == pytest.approx(right, rel=5e-3)
    assert abs(fixed.mean_nees().value - 1) < 4 * fixed.mean_nees().stderr
    for name in ("q x 0.25, said", "q x 4, said"):
        ours, _, _ = told("ci tracklet", found[name])
        assert ours.rmse().value < best_of(found[name]).rmse().value * 1.01
        assert ours.mean_nees().value - 1 < 4 * ours.mean_nees().stderr


def test_the_number_of_processes_does_not_matter() -> None:
    world = World((Sensor(Position(10.0, 10.0), loss=0.2),), steps=5, warm=2)
    tasks = {name: Task(world, (OURS,), key) for key, name in enumerate("ab")}
    alone, two = (flown(Run(5, SEED, jobs=jobs), tasks) for jobs in (1, 2))
    for name in tasks:
        np.testing.assert_array_equal(alone[name].scores["tracklet"].squared, two[name].scores["tracklet"].squared)
    assert not np.array_equal(alone["a"].scores["tracklet"].squared, alone["b"].scores["tracklet"].squared)
