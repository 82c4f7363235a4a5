"""The registration errors of a source, and what they do to what it says of a target.

A source with the errors (clock, x, y, heading, range, scale, and drift, by which its clock changes in a second) says of
a target at u, seen from its own place p in the direction d = u - p,

    p + t + R(heading) d (1 + scale + range / |d|)

stamped `clock` seconds too late: what it says of time t was so at t - clock. To first order, v being the target's
velocity and J a quarter turn to the left,

    z = u + H theta,    H = [-v, e_x, e_y, J d, d / |d|, d, 0]

about its own place as its SensorInfo says it, or about the origin of the picture's frame where it says none.
"""

from __future__ import annotations

import math

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.centre.intake import Intake
from fusion_service.centre.sources import Source
from fusion_service.centre.standing import place_in, place_of
from fusion_service.centre.stated_registration import shift_of

__all__ = [
    "CLOCK",
    "DRIFT",
    "HEADING",
    "PARAMETERS",
    "RANGE",
    "SCALE",
    "UNITS",
    "X",
    "Y",
    "design",
    "is_polar",
    "prior_sigma",
    "site_of",
]

PARAMETERS = ("clock", "x", "y", "heading", "range", "scale", "drift")
"""s, m, m, rad, m, 1, s/s."""
CLOCK, X, Y, HEADING, RANGE, SCALE, DRIFT = range(7)
DRIFT_SIGMA = 3e-4
"""How fast clocks may drift."""
UNITS = ("s", "m", "m", "rad", "m", "", "s/s")
AXES = ("x", "y", "z")


def design(place: Floats, velocity: Floats, site: Floats) -> Floats:
    """H (2, 7, M) for targets at `place` (2, M), m, of `velocity` (2, M), m/s, seen from `site` (2, M)."""
    away = place - site
    far = np.hypot(away[0], away[1])
    H = np.zeros((2, len(PARAMETERS), place.shape[1]))
    H[:, CLOCK] = -velocity
    H[0, X] = H[1, Y] = 1.0
    H[0, HEADING], H[1, HEADING] = -away[1], away[0]
    H[:, RANGE] = away / np.where(far > 0.0, far, 1.0)
    H[:, SCALE] = away
    return H


def site_of(intake: Intake, source: Source) -> Floats:
    """Where a source stands (2,), m, in the picture's frame: the platform of its newest tracks, else its info says; the
    origin where there is nothing that can be used."""
    place = place_of(source)
    here = None if place is None or intake.frame is None else place_in(place, intake.frame)
    return np.zeros(2) if here is None else here[:2].copy()


def is_polar(intake: Intake, source: Source) -> bool:
    """Whether a source measures ranges and bearings: by the config, else by its own word."""
    said = intake.config.source(source.name).polar
    return (source.info is not None and bool(source.info.polar)) if said is None else said


def prior_sigma(intake: Intake, source: Source) -> Floats:
    """How large (7,) the errors of a source may be, 1 sigma; 0 is what it has not, and all of a reference."""
    config = intake.config
    if config.source(source.name).reference:
        return np.zeros(len(PARAMETERS))
    polar = is_polar(intake, source)
    place = [config.translation_sigma] * 2
    stated = shift_of(intake, source)
    if stated is not None:
        place = [math.sqrt(stated[at, at]) for at in (config.space.index("x"), config.space.index("y"))]
    heading = math.radians(config.heading_sigma)
    drift = DRIFT_SIGMA * (config.clock_sigma > 0)
    ranges = config.range_sigma * polar, config.scale_sigma * polar
    return np.array([config.clock_sigma, *place, heading, *ranges, drift], dtype=np.float64)
