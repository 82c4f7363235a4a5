"""The registration error that each source states: one shift of all it reports, by its SensorInfo or by the config.

A sensor that is not sure where it stands reports every target shifted by the same unknown amount. Its SensorInfo, or
the platform of its newest tracks, states the covariance of that (`position_covariance`, in its own frame); for a source
that states none the config does (`registration_sigma`, m, the same in x, y and z), and with `override` the config's is
taken for every source.
"""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.centre.intake import Intake
from fusion_service.centre.sources import Source
from fusion_service.geodesy import FrameError, transform
from schemas import Frame

__all__ = ["shift_of", "stated_registration"]


AXES = ("x", "y", "z")
LARGEST = 1e5
"""m: no standard deviation is taken for larger."""


def stated_registration(intake: Intake, names: tuple[str, ...]) -> Floats | None:
    """Covariances (n, n, N), m2, in the picture's space and frame, of the shifts of the N sources named; None if
    nobody states one, or the frame is not known yet."""
    shifts = [shift_of(intake, intake.sources[name]) for name in names]
    if all(shift is None for shift in shifts):
        return None
    n = len(intake.config.space)
    return np.stack([np.zeros((n, n)) if shift is None else shift for shift in shifts], axis=-1)


def shift_of(intake: Intake, source: Source) -> Floats | None:
    """Covariance (n, n), m2, in the picture's space and frame, of the shift that a source states; None if none."""
    frame, space, said = intake.frame, intake.config.space, intake.declared(source)
    if not said.registration_sigma and (said.override or _stated(source) is None):
        return None
    shift = np.zeros((3, 3)) if frame is None else _shift(intake, source, frame)
    if not shift.any():
        return None
    out = np.zeros((len(space), len(space)))
    there = [axis for axis in AXES if axis in space]
    to, of = ([names.index(axis) for axis in there] for names in (space, AXES))
    out[np.ix_(to, to)] = shift[np.ix_(of, of)]
    return out


def _stated(source: Source) -> tuple[tuple[float, float, float], Floats, Frame] | None:
    """Position, covariance of it and their frame as the source states them; None if it states no covariance."""
    place, info = source.place, source.info
    if place is not None and place.platform.position_covariance is not None:
        return place.platform.position, place.platform.position_covariance, place.frame
    if info is None or info.position_covariance is None:
        return None
    return info.position, info.position_covariance, info.frame


def _shift(intake: Intake, source: Source, frame: Frame) -> Floats:
    """Covariance (3, 3) of a source's shift in `frame`, m2, semidefinite and bounded; a covariance in a frame that
    has no relation to it is not used."""
    said, stated = intake.declared(source), _stated(source)
    if said.override or stated is None:
        return np.asarray(np.eye(3) * min(said.registration_sigma, LARGEST) ** 2)
    try:
        position, given, own = stated
        covariance = np.asarray(given, dtype=np.float64).reshape(3, 3)
        _, turned = transform(np.array([position], dtype=np.float64), covariance[None], AXES, own, frame)
        values, axes = np.linalg.eigh(0.5 * turned[0] + 0.5 * turned[0].T)
    except (FrameError, ValueError, np.linalg.LinAlgError):
        return np.zeros((3, 3))
    if not np.isfinite(values).all():
        return np.zeros((3, 3))
    values = np.clip(values, 0.0, LARGEST**2)
    return np.asarray(sum(value * np.outer(axis, axis) for value, axis in zip(values, axes.T, strict=True)))
