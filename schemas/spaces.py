"""State spaces, frames, motions and coverages: the words in which tracks are said.

A state space is an ordered tuple of component names. SI units throughout: metres, seconds, radians;
only latitudes and longitudes are in degrees. Every value here is checked when it is made and raises
`ValueError` with one line that says what is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

__all__ = [
    "COMPONENTS",
    "MOTIONS",
    "UNKNOWN_SIGMA",
    "Coverage",
    "Disk",
    "Ecef",
    "Enu",
    "Frame",
    "Height",
    "Local",
    "Motion",
    "Polygon",
    "Sector",
    "check_space",
]

COMPONENTS: dict[str, str] = {
    "x": "m",
    "vx": "m/s",
    "ax": "m/s2",
    "y": "m",
    "vy": "m/s",
    "ay": "m/s2",
    "z": "m",
    "vz": "m/s",
    "az": "m/s2",
    "turn_rate": "rad/s",
}
"""Component name -> unit. In an ENU frame x is east, y north, z up; turn_rate is positive from x to y."""

UNKNOWN_SIGMA: dict[str, float] = {
    "z": 1e6,
    **dict.fromkeys(("vx", "vy", "vz", "ax", "ay", "az"), 1e4),
    "turn_rate": 100.0,
}
"""Component name -> the standard deviation from which a density says nothing of it. x and y are always said."""


def check_space(space: tuple[str, ...]) -> tuple[str, ...]:
    """Return `space` if it names one to all ten known components, each once, x and y among them.
    Raises ValueError if not."""
    unknown = [name for name in space if name not in COMPONENTS]
    if unknown:
        raise ValueError(f"unknown component {unknown[0]!r} in the state space (known: {' '.join(COMPONENTS)})")
    if len(set(space)) != len(space):
        raise ValueError("a component stands twice in the state space")
    if not {"x", "y"} <= set(space):
        raise ValueError("a state space needs at least x and y")
    return space


def _number(name: str, value: float, low: float = -math.inf, high: float = math.inf) -> None:
    if not (low <= value <= high and math.isfinite(value)):
        raise ValueError(f"{name} is {value}, not a number from {low:g} to {high:g}")


@dataclass(frozen=True, slots=True)
class Enu:
    """East, north, up about an origin on WGS84: `lat`, `lon` in degrees, `alt` in m above the ellipsoid."""

    kind: ClassVar[str] = "enu"
    lat: float
    lon: float
    alt: float = 0.0

    def __post_init__(self) -> None:
        _number("lat", self.lat, -90.0, 90.0)
        _number("lon", self.lon, -360.0, 360.0)
        _number("alt", self.alt, -1e8, 1e8)


@dataclass(frozen=True, slots=True)
class Ecef:
    """Earth-centred, earth-fixed (WGS84): x towards 0N 0E, z towards the north pole, m."""

    kind: ClassVar[str] = "ecef"


@dataclass(frozen=True, slots=True)
class Local:
    """A named frame that both sides know: tracks in it meet only tracks in the same one."""

    kind: ClassVar[str] = "local"
    name: str

    def __post_init__(self) -> None:
        if not self.name or len(self.name) > 64:
            raise ValueError("a local frame needs a name of 1 to 64 characters")


Frame: TypeAlias = Enu | Ecef | Local


@dataclass(frozen=True, slots=True)
class Height:
    """Height of what a two-dimensional source sees: `value` and `sigma`, m above the ellipsoid."""

    value: float = 0.0
    sigma: float = 0.0

    def __post_init__(self) -> None:
        _number("height value", self.value, -1e8, 1e8)
        _number("height sigma", self.sigma, 0.0, 1e8)


MOTIONS: dict[str, tuple[str, ...]] = {
    "cv": ("q", "q_turn"),
    "ct": ("q", "q_turn"),
    "ca": ("q", "sigma", "q_turn"),
    "singer": ("sigma", "tau", "q_turn"),
    "ou": ("sigma", "tau", "q_turn"),
    "still": ("q", "sigma", "q_turn"),
}
"""Kind of motion -> the numbers it takes. All must be given, but q_turn and sigma of ca, which are 0 by default."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How a source's tracks move between its messages: on each axis alike and independently.

    kind `cv`: nearly constant velocity, `q` the intensity of the white acceleration noise, m2/s3.
    kind `ct`: coordinated turn at the state's turn_rate, `q` as for cv.
    kind `ca`: nearly constant acceleration, `q` the intensity of the white jerk, m2/s5; `sigma`, m/s2, the
    standard deviation of the acceleration where the state does not have it (0: it is none).
    kind `singer`: an acceleration of standard deviation `sigma`, m/s2, that is forgotten with time constant `tau`, s.
    kind `ou`: a velocity of standard deviation `sigma`, m/s, that is forgotten with time constant `tau`, s
    (Ornstein-Uhlenbeck): what stays about its place for a while.
    kind `still`: anchored, moored or parked: the position walks at random with `q`, m2/s; a velocity is zero with
    `sigma`, m/s.

    In every kind `q_turn` is the intensity of the noise on a turn rate in the state, rad2/s3.
    """

    kind: str
    q: float = math.nan
    q_turn: float = 0.0
    sigma: float = 0.0
    tau: float = 0.0

    def __post_init__(self) -> None:
        takes = MOTIONS.get(self.kind)
        if takes is None:
            raise ValueError(f"unknown motion {self.kind!r} (known: {', '.join(MOTIONS)})")
        if math.isnan(self.q) and "q" not in takes:
            object.__setattr__(self, "q", 0.0)
        for name, most in (("q", 1e12), ("q_turn", 1e12), ("sigma", 1e6), ("tau", 1e9)):
            if name == "q" and math.isnan(self.q):
                raise ValueError(f"motion {self.kind} needs q")
            _number(name, getattr(self, name), 0.0, most)
        for name in ("q", "sigma", "tau"):
            if getattr(self, name) and name not in takes:
                raise ValueError(f"motion {self.kind} takes {', '.join(takes)}, not {name}")
        if self.kind in ("singer", "ou", "still") and not self.sigma > 0:
            raise ValueError(f"motion {self.kind} needs sigma, more than 0")
        if "tau" in takes and not self.tau >= 1e-6:
            raise ValueError(f"motion {self.kind} needs tau, at least 1e-06 s")


@dataclass(frozen=True, slots=True)
class Disk:
    """All places from `inner` to `radius` m from the sensor, on the horizontal plane of its frame."""

    kind: ClassVar[str] = "disk"
    radius: float
    inner: float = 0.0

    def __post_init__(self) -> None:
        _number("radius", self.radius, 0.0, 1e9)
        _number("inner", self.inner, 0.0, self.radius)


@dataclass(frozen=True, slots=True)
class Sector:
    """The part of a disk whose azimuth lies within `width`/2 of `azimuth` (rad, clockwise from north)."""

    kind: ClassVar[str] = "sector"
    radius: float
    azimuth: float
    width: float
    inner: float = 0.0

    def __post_init__(self) -> None:
        _number("radius", self.radius, 0.0, 1e9)
        _number("inner", self.inner, 0.0, self.radius)
        _number("azimuth", self.azimuth, -2 * math.pi, 2 * math.pi)
        _number("width", self.width, 0.0, 2 * math.pi)


@dataclass(frozen=True, slots=True)
class Polygon:
    """A simple polygon of 3 to 1,000 corners (x, y), m in the frame of the sensor's position."""

    kind: ClassVar[str] = "polygon"
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if not 3 <= len(self.points) <= 1000:
            raise ValueError("a polygon needs 3 to 1000 points")
        for x, y in self.points:
            _number("polygon x", x, -1e9, 1e9)
            _number("polygon y", y, -1e9, 1e9)


Coverage: TypeAlias = Disk | Sector | Polygon
