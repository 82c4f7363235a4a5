"""Two sensors, a filter each, and a fused result that both go on from: the loop of Li-AA section IV.

All Monte Carlo runs, and for the Gaussian filters all fusion rules, are one batch, the last axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion_service.rules.face import Fused
from sensor_clients.filters import particles
from sensor_clients.filters.kalman import Estimate
from studies.study import Floats

__all__ = ["Fuse", "Model", "Record", "Scene", "alone", "gaussian", "join", "simulate", "sir", "sir_fused"]

FLOOR = 1e-6
"""Of the prior covariance, added to that of particles: a set that has collapsed to one of them stays a Gaussian."""

Fuse = Callable[[Floats, Floats], Fused]
"""Means (2, n, B) and covariances (2, n, n, B) of the sensors to the fused Gaussians: a `Fuser`, or a function."""


@dataclass(frozen=True, slots=True)
class Model:
    """A target and the two sensors that see it.

    mean (n,), covariance (n, n): of the state at k = 0. move: one step of states (n, ..., B) with process noise;
    observe: what sensor 0 or 1 sees of them without noise, (d, ..., B); sigma (2, d): its noise; difference: of two
    measurements. predict, update: of the Gaussian filter, the latter by a sensor and its z (d, B).
    errors: the name of an error with its unit, the components of which it is the norm, the unit in those of the state.
    """

    mean: Floats
    covariance: Floats
    move: Callable[[np.random.Generator, Floats], Floats]
    observe: Callable[[int, Floats], Floats]
    sigma: Floats
    difference: Callable[[Floats, Floats], Floats]
    predict: Callable[[Estimate], Estimate]
    update: Callable[[Estimate, int, Floats], Estimate]
    errors: tuple[tuple[str, tuple[int, ...], float], ...]
    particles: int
    steps: int = 100

    def prior(self, runs: int) -> Estimate:
        """The Gaussian at k = 0, as often as there are runs."""
        return Estimate(
            np.repeat(self.mean[:, None], runs, axis=1), np.repeat(self.covariance[..., None], runs, axis=2)
        )

    def squared(self, mean: Floats, truth: Floats) -> Floats:
        """Squared errors (q, M), in the units of `errors`."""
        away = (mean - truth) ** 2
        return np.stack([away[list(rows)].sum(axis=0) / unit**2 for _, rows, unit in self.errors])


class Scene(NamedTuple):
    """truth (K, n, M) and measurements (K, 2, d, M)."""

    truth: Floats
    measurements: Floats


class Record(NamedTuple):
    """squared errors (q, K, M) and the weight of sensor 1 (K, M), NaN where there is none."""

    squared: Floats
    weight: Floats


Log = list[tuple[Floats, Floats]]
"""Of each step: squared errors (q, M), weight of sensor 1 (M,)."""


def _record(log: Log) -> Record:
    squared, weight = zip(*log, strict=True)
    return Record(np.stack(squared, axis=1), np.array(weight))


def join(parts: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """The runs of all, side by side."""
    first, second = zip(*parts, strict=True)
    return np.concatenate(first, axis=-1), np.concatenate(second, axis=-1)


def simulate(model: Model, rng: np.random.Generator, runs: int, exact: bool) -> Scene:
    """`exact`: every truth starts at the mean of the prior, else at random from it."""
    start = model.prior(runs)
    x = start.mean if exact else particles.draw(rng, start, 1)[:, 0]
    truth, measurements = [], []
    for _ in range(model.steps):
        x = model.move(rng, x)
        seen = np.stack([model.observe(sensor, x) for sensor in (0, 1)])
        truth.append(x)
        measurements.append(seen + model.sigma[..., None] * rng.standard_normal(seen.shape))
    return Scene(np.array(truth), np.array(measurements))


def alone(means: Floats, covariances: Floats) -> Fused:
    """No fusion: sensor 1 as it is."""
    return Fused(means[0], covariances[0], np.full(means[:, 0].shape, np.nan), None)


def gaussian(model: Model, scene: Scene, rules: Mapping[str, Fuse | None], feedback: bool = True) -> dict[str, Record]:
    """The Gaussian filter under each of the rules; None: the iterated corrector, sensor 2 after sensor 1.

    Without `feedback` each of the two filters goes on from what it has itself.
    """
    M = scene.truth.shape[-1]
    copies = len(rules) if feedback else 1
    states = [model.prior(copies * M)] * 2
    logs: dict[str, Log] = {name: [] for name in rules}
    for truth, z in zip(scene.truth, scene.measurements, strict=True):
        first = model.predict(states[0])
        predicted = (first, first if feedback else model.predict(states[1]))
        local = [model.update(predicted[s], s, np.tile(z[s], copies)) for s in (0, 1)]
        means, covariances = (np.stack(both) for both in zip(*local, strict=True))
        after = []
        for number, (name, rule) in enumerate(rules.items()):
            part = slice(number * M, (number + 1) * M) if feedback else slice(None)
            x, P = means[..., part], covariances[..., part]
            fused = (rule or alone)(x, P)
            state = Estimate(fused.mean, fused.covariance)
            if rule is None:
                state = model.update(state, 1, z[1])
            logs[name].append((model.squared(state.mean, truth), fused.weights[0]))
            after.append(state)
        states = [Estimate(*join(after))] * 2 if feedback else local
    return {name: _record(log) for name, log in logs.items()}


def sir(model: Model, scene: Scene, rng: np.random.Generator, joint: bool, systematic: bool = True) -> Record:
    """One SIR filter: of sensor 1, or with the `joint` likelihood of both (46)."""
    M, log = scene.truth.shape[-1], []
    x = particles.draw(rng, model.prior(M), model.particles)
    for truth, z in zip(scene.truth, scene.measurements, strict=True):
        x = model.move(rng, x)
        score = _log_likelihood(model, 0, x, z[0])
        if joint:
            score += _log_likelihood(model, 1, x, z[1])
        W = particles.weigh(score)
        log.append((model.squared(np.einsum("isb,sb->ib", x, W), truth), np.full(M, np.nan)))
        x = particles.resample(rng, x, W, systematic=systematic)
    return _record(log)


def sir_fused(model: Model, scene: Scene, rng: np.random.Generator, rule: Fuse, union: bool = False) -> Record:
    """Two SIR filters, their particles taken as Gaussians and fused by the rule; each draws its particles anew from
    the fused one, or, for an arithmetic average kept as such, from the `union` of both with the rule's weights."""
    M, Np, log = scene.truth.shape[-1], model.particles, []
    pair = [particles.draw(rng, model.prior(M), Np) for _ in range(2)]
    floor = FLOOR * model.covariance[..., None]
    for truth, z in zip(scene.truth, scene.measurements, strict=True):
        pair = [model.move(rng, x) for x in pair]
        W = [particles.weigh(_log_likelihood(model, s, pair[s], z[s])) for s in (0, 1)]
        means, covariances = (np.stack(both) for both in zip(*map(particles.moments, pair, W), strict=True))
        fused = rule(means, covariances + floor)
        log.append((model.squared(fused.mean, truth), fused.weights[0]))
        if union:
            both = particles.union(pair, W, fused.weights)
            pair = [particles.resample(rng, *both, count=Np) for _ in range(2)]
        else:
            pair = [particles.draw(rng, Estimate(fused.mean, fused.covariance), Np) for _ in range(2)]
    return _record(log)


def _log_likelihood(model: Model, sensor: int, x: Floats, z: Floats) -> Floats:
    """log p(z | x), to a constant, (Np, B), of particles (n, Np, B)."""
    away = model.difference(z[:, None], model.observe(sensor, x)) / model.sigma[sensor][:, None, None]
    return np.asarray(-0.5 * (away * away).sum(axis=0))
