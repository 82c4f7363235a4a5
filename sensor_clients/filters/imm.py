"""The interacting multiple model tracker (Blom and Bar-Shalom 1988), its modes kept as a mixture.

Each track is a Markov jump system: in mode m it moves with nearly constant velocity of noise intensity q_m, for
a time of mean tau_m, then jumps to one of the other modes, each as likely. Over dt the mode changes by

    Pi = expm(G dt),   G_mm = -1 / tau_m,   G_ml = 1 / (tau_m (M - 1)),

whose stationary probabilities are proportional to tau. Prediction mixes, then moves each mode by its own model:

    c_l = sum_m Pi_ml mu_m,   x0_l = sum_m mu_m|l x_m,   P0_l = sum_m mu_m|l [P_m + (x_m - x0_l)(x_m - x0_l)'],
    mu_m|l = Pi_ml mu_m / c_l

The update and the new mode probabilities are those of `mixture`. Modes are published as the mixture they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from fusion_service import linalg, motion
from schemas import Motion
from sensor_clients.filters.measurement import STATE, Floats, MeasurementModel
from sensor_clients.filters.mixture import MixtureTracker, moments
from sensor_clients.filters.tracker import TrackerConfig

__all__ = ["ImmTracker", "Modes", "mix"]


@dataclass(frozen=True, slots=True)
class Modes:
    """intensities q_m, m2/s3, and mean sojourn times tau_m, s, of two modes or more. ValueError if not so."""

    intensities: tuple[float, ...]
    sojourns: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.intensities) == len(self.sojourns) > 1 or min(self.sojourns) <= 0:
            raise ValueError("an IMM needs two modes or more, each with an intensity and a sojourn time above 0")

    def stationary(self) -> Floats:
        """The probability (M,) of each mode, nothing else known."""
        return np.array(self.sojourns) / sum(self.sojourns)

    def transition(self, dt: float) -> Floats:
        """Pi (M, M) over `dt` s: row from, column to."""
        M = len(self.sojourns)
        jumps = (np.ones((M, M)) - M * np.eye(M)) / (np.array(self.sojourns)[:, None] * (M - 1))
        return np.asarray(expm(jumps * dt))

    def motion(self) -> Motion:
        """One motion for all modes: that of the mean intensity."""
        return Motion("cv", float(self.stationary() @ self.intensities))


def mix(weights: Floats, means: Floats, covariances: Floats, transition: Floats) -> tuple[Floats, Floats, Floats]:
    """Interaction: weights c (M, T), means (n, M, T) and covariances (n, n, M, T) of the modes after `transition`."""
    joint = transition[..., None] * weights[:, None]
    after = joint.sum(axis=0)
    given = joint / np.maximum(after, 1e-300)
    mixed = [moments(given[:, to], means, covariances) for to in range(len(weights))]
    return after, np.stack([m for m, _ in mixed], axis=1), np.stack([P for _, P in mixed], axis=2)


class ImmTracker(MixtureTracker):
    """A `LocalTracker` with an IMM for each track. `config.motion` is not used: `modes` say how targets move."""

    def __init__(self, config: TrackerConfig, modes: Modes) -> None:
        super().__init__(config, len(modes.sojourns))
        self.modes = modes

    def _moved(self, dt: float) -> tuple[Floats, Floats, Floats]:
        if dt == 0:
            return self.weights, self.parts, self.spreads
        weights, parts, spreads = mix(self.weights, self.parts, self.spreads, self.modes.transition(dt))
        step = np.full(weights.shape[1], dt)
        for m, q in enumerate(self.modes.intensities):
            parts[:, m], spreads[:, :, m] = motion.predict(
                Motion("cv", q), STATE, np.ascontiguousarray(parts[:, m]), np.ascontiguousarray(spreads[:, :, m]), step
            )
        return weights, parts, linalg.symmetrise(spreads)

    def _components(self, returns: Floats, model: MeasurementModel) -> tuple[Floats, Floats, Floats]:
        means, covariances = self._still(*model.locate(returns))
        M = len(self.modes.sojourns)
        weights = np.repeat(self.modes.stationary()[:, None], means.shape[1], axis=1)
        return weights, np.repeat(means[:, None], M, axis=1), np.repeat(covariances[:, :, None], M, axis=2)
