"""What a profile is: areas, and requirements of some kinds, each with the numbers that its kind takes.

Units are in the names of the keys. `KINDS` says of each kind what is counted and which keys it takes; how it is counted
stands in `counting`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fusion_service.config.readers import POSITIVE, choice, number, whole

__all__ = ["EVERYWHERE", "KINDS", "Area", "Key", "Kind", "Profile", "Requirement"]

EVERYWHERE = "everywhere"
SHARE = number(0.0, 1.0)
COUNTS = choice("measured", "shown")


@dataclass(frozen=True, slots=True)
class Area:
    """Where a requirement holds: inside all that is told of polygon, disk and heights.

    polygon: corners, disk: its centre, both latitude and longitude in degrees where `degrees`, else x and y in the
    picture's frame, m; radius, m; heights: from and to, m above the ellipsoid, or z in a local frame.
    """

    name: str
    polygon: tuple[tuple[float, float], ...] = ()
    disk: tuple[float, float] | None = None
    radius: float = 0.0
    heights: tuple[float, float] | None = None
    degrees: bool = False


@dataclass(frozen=True, slots=True)
class Requirement:
    """One of a kind. numbers: the keys of its kind; source: where the figure stands; unverified: why it is not sure to
    stand there, empty where it was looked up; each_target: every target alone must keep it."""

    kind: str
    name: str
    numbers: Mapping[str, Any]
    area: str = EVERYWHERE
    source: str = ""
    unverified: str = ""
    confidence: float = 0.95
    each_target: bool = False


@dataclass(frozen=True, slots=True)
class Profile:
    """cutoff: m, None where it leaves it to the evaluation; identities: of true objects, by id or by name."""

    name: str
    source: str
    note: str = ""
    cutoff: float | None = None
    areas: tuple[Area, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    identities: Mapping[int | str, str] = field(default_factory=dict)
    path: str = ""


class Key(NamedTuple):
    """What reads a value, and what is taken where it is left out; `NEEDED` for a key that must be there."""

    read: Callable[[Any], Any]
    default: Any = None
    needed: bool = False


class Kind(NamedTuple):
    """words: what is counted; keys; one_of: of each of these groups of keys exactly one must be there, a group of
    several keys whole."""

    words: str
    keys: Mapping[str, Key]
    one_of: tuple[tuple[str, ...], ...] = ()


MIN = {"share_min": Key(SHARE, needed=True)}
MAX = {"share_max": Key(SHARE, needed=True)}
POSITION = {"within_m": Key(POSITIVE), "share_min": Key(SHARE), "rms_max_m": Key(POSITIVE)}
SPEED = {"within_m_per_s": Key(POSITIVE), "share_min": Key(SHARE), "rms_max_m_per_s": Key(POSITIVE)}
DIRECTION = {"min_speed_m_per_s": Key(POSITIVE, 1.0)}
UPDATES = {"counts": Key(COUNTS, "measured")}

KINDS: Mapping[str, Kind] = {
    "detection": Kind("scored times of targets with a track", MIN),
    "update": Kind(
        "intervals of that length with an update", {"interval_s": Key(POSITIVE, needed=True), **MIN, **UPDATES}
    ),
    "update_interval": Kind(
        "times from one update to the next that are no longer",
        {"within_s": Key(POSITIVE, needed=True), **MIN, **UPDATES},
    ),
    "gap": Kind(
        "expected updates that are missing in gaps longer than that",
        {"longer_than_s": Key(POSITIVE, needed=True), "interval_s": Key(POSITIVE, needed=True), **MAX, **UPDATES},
    ),
    "position_error": Kind(
        "errors of position of tracks with a target",
        {**POSITION, **DIRECTION, "direction": Key(choice("horizontal", "along", "across", "height"), "horizontal")},
        (("within_m", "share_min"), ("rms_max_m",)),
    ),
    "velocity_error": Kind(
        "errors of velocity of tracks with a target",
        {**SPEED, **DIRECTION, "direction": Key(choice("horizontal", "along", "across"), "horizontal")},
        (("within_m_per_s", "share_min"), ("rms_max_m_per_s",)),
    ),
    "false_tracks": Kind(
        "shown tracks, at scored times, that are farther than that from every target",
        {"farther_than_m": Key(POSITIVE), **MAX},
    ),
    "multiple_tracks": Kind("shown tracks near a target that has another one", MAX),
    "identity": Kind(
        "tracks of targets of known identity whose identity is so",
        {
            "verdict": Key(choice("correct", "wrong", "none"), needed=True),
            "share_min": Key(SHARE),
            "share_max": Key(SHARE),
        },
        (("share_min",), ("share_max",)),
    ),
    "latency": Kind(
        "times from the picture's own time to its publication, or from a track's last measurement to the picture",
        {"of": Key(choice("picture", "measurement"), "picture"), "within_s": Key(POSITIVE, needed=True), **MIN},
    ),
    "continuity": Kind(
        "breaks (a target loses its track and gets one again), changes of its track's number, swaps (to one that was "
        "another target's)",
        {
            "count": Key(choice("breaks", "changes", "swaps"), needed=True),
            "per_target_hour_max": Key(number(0.0, 1e6), needed=True),
        },
    ),
    "tracked_through": Kind(
        "scored times of acquired targets, seen in so many of so many scored times, with a track",
        {"seen": Key(whole(1, 1000), 5), "of": Key(whole(1, 1000), 10), **MIN},
    ),
    "motion_after": Kind(
        "targets whose course and speed are right so long after their first track",
        {
            "after_s": Key(POSITIVE, needed=True),
            "course_within_deg": Key(POSITIVE, needed=True),
            "speed_within_m_per_s": Key(POSITIVE, needed=True),
            "or_speed_share": Key(SHARE, 0.0),
            **DIRECTION,
            **MIN,
        },
    ),
    "prediction_error": Kind(
        "places of a target so far ahead of the track's straight line",
        {"horizon_s": Key(POSITIVE, needed=True), "after_s": Key(number(0.0, 1e6), 0.0), **POSITION},
        (("within_m", "share_min"), ("rms_max_m",)),
    ),
}
