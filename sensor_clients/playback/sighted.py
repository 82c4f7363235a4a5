"""The other robots as one robot sees them: a Kalman filter for each, in the frame of the map.

Who is seen is known (barcodes), so there is no association. The filters take the own pose for certain; what its error
does to them is kept apart and added to what is reported. It has two parts (`Pose`): the place given the heading shifts
all that is seen alike, and is told in the SensorInfo (`position_covariance`); what the heading turns grows with range,
and is in the covariance of each track. Both together are the whole effect of the pose. A track keeps that of the pose
it was last seen from, so one seen while the place was worse known than now has the difference in its own covariance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg, motion
from fusion_service.metrics import chi2_quantile
from sensor_clients.filters.association import update
from sensor_clients.filters.measurement import STATE, Floats, Prediction, predict_measurement
from sensor_clients.playback.own_place import Pose
from sensor_clients.playback.robot import Robot, Sight

__all__ = ["Others", "Seen"]

SECOND = 1e-9


class Seen(NamedTuple):
    """Tracks of other robots: ids (T,), subjects (T,), means (T, 4), covariances (T, 4, 4) without what is common to
    all, updated (T,) ns."""

    ids: NDArray[np.uint64]
    subjects: list[int]
    means: Floats
    covariances: Floats
    updated: NDArray[np.int64]


class _Track:
    """One of them. pose: what the own pose's error does to its place (2, 2), when it was last seen."""

    __slots__ = ("covariance", "id", "mean", "pose", "sightings", "strikes", "time", "updated")

    def __init__(self, id: int, time: int, mean: Floats, covariance: Floats, pose: Floats) -> None:
        self.id, self.time, self.updated = id, time, time
        self.mean, self.covariance, self.pose = mean, covariance, pose
        self.sightings, self.strikes = 1, 0


class Others:
    """The tracks of one robot, by subject, sighting by sighting in the order of time."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.refused = 0
        self._gate = chi2_quantile(robot.gate, 2)
        self._tracks: dict[int, _Track] = {}
        self._next = 1

    def forget(self) -> None:
        """End all tracks: the own place is not known."""
        self._tracks.clear()

    def see(self, time: int, subject: int, distance: float, bearing: float, pose: Pose) -> None:
        """Robot `subject` at `distance`, m, and `bearing`, rad, seen from `pose` at `time`, ns."""
        track = self._tracks.get(subject)
        returns = np.array([[distance], [bearing]])
        x, y, heading = pose.mean.tolist()
        once = Sight(self.robot, (x, y), heading)
        if track is None:
            self._start(time, subject, returns, once, pose)
            return
        self._predict(track, time)
        effect = pose.common + pose.turning(track.mean[:2, 0])
        loose = track.covariance.copy()
        loose[:2, :2, 0] += effect
        wide = predict_measurement(once, track.mean, loose, returns, cubature=False)
        if not linalg.quadratic(wide.covariance, wide.innovations[:, :, 0])[0] <= self._gate:
            self._strike(track, time, subject, returns, once, pose)
            return
        track.sightings, track.strikes = track.sightings + 1, 0
        many = Sight(self.robot, (x, y), heading, self.robot.repeated((time - track.updated) * SECOND))
        self._update(track, predict_measurement(many, track.mean, track.covariance, returns, cubature=False))
        track.updated, track.pose = time, pose.common + pose.turning(track.mean[:2, 0])

    def report(self, time: int, common: Floats) -> Seen:
        """All tracks predicted to `time`, ns, beside a `common` shift of covariance (2, 2), told elsewhere. Those that
        are too vague end."""
        for subject, track in list(self._tracks.items()):
            self._predict(track, time)
            if np.linalg.eigvalsh(track.covariance[:2, :2, 0])[-1] > self.robot.vague**2:
                del self._tracks[subject]
        subjects = sorted(one for one, track in self._tracks.items() if track.sightings >= self.robot.confirm)
        tracks = [self._tracks[subject] for subject in subjects]
        covariances = np.zeros((len(tracks), 4, 4))
        for covariance, track in zip(covariances, tracks, strict=True):
            covariance[:] = track.covariance[..., 0]
            covariance[:2, :2] += _positive(track.pose - common)
        return Seen(
            np.array([track.id for track in tracks], dtype=np.uint64),
            subjects,
            np.array([track.mean[:, 0] for track in tracks]).reshape(-1, 4),
            covariances,
            np.array([track.updated for track in tracks], dtype=np.int64),
        )

    def _start(self, time: int, subject: int, returns: Floats, sight: Sight, pose: Pose) -> None:
        place, spread = sight.locate(returns)
        covariance = np.zeros((4, 4, 1))
        covariance[:2, :2] = spread
        covariance[2, 2] = covariance[3, 3] = self.robot.speed**2 / 2
        mean = np.concatenate([place, np.zeros((2, 1))])
        effect = pose.common + pose.turning(place[:, 0])
        self._tracks[subject] = _Track(self._next, time, mean, covariance, effect)
        self._next += 1

    def _strike(self, track: _Track, time: int, subject: int, returns: Floats, sight: Sight, pose: Pose) -> None:
        """A sighting outside the gate is left out, unless there were too many in a row: then the track was wrong."""
        self.refused += 1
        track.strikes += 1
        if track.strikes >= self.robot.strikes:
            self._start(time, subject, returns, sight, pose)

    def _predict(self, track: _Track, time: int) -> None:
        dt = np.full(1, max(0, time - track.time) * SECOND)
        track.mean, track.covariance = motion.predict(self.robot.motion, STATE, track.mean, track.covariance, dt)
        track.time = max(time, track.time)

    def _update(self, track: _Track, prediction: Prediction) -> None:
        track.mean, track.covariance = update(track.mean, track.covariance, prediction, np.ones((1, 1)), np.zeros(1))


def _positive(matrix: Floats) -> Floats:
    """The least symmetric matrix (2, 2) that is no less than this one, and positive semidefinite."""
    values, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
