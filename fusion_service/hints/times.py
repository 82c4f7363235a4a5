"""Times that are not nanoseconds since 1970 in UTC."""

from __future__ import annotations

__all__ = ["clock_words", "span", "unit_of_time"]

YEAR = 365.25 * 86400.0
UNITS = {"seconds": 10**9, "ms": 10**6, "us": 10**3}
WITHIN = 10 * YEAR
"""Seconds from now in which a time must lie to be taken for one in another unit."""
LEAPS = {18.0: "GPS time, which is 18 s ahead of UTC", 37.0: "TAI, which is 37 s ahead of UTC"}


def span(seconds: float) -> str:
    """A duration as people say it."""
    seconds = abs(seconds)
    for most, unit, name in (
        (1.0, 1e-3, "ms"),
        (120.0, 1.0, "s"),
        (7200.0, 60.0, "min"),
        (172800.0, 3600.0, "h"),
        (2 * YEAR, 86400.0, "days"),
    ):
        if seconds < most:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds / YEAR:.0f} years"


def unit_of_time(value: float, now: int) -> str:
    """The unit that `value` is in if it is about `now`, ns, and not in ns: seconds, ms, us; "" if none."""
    if abs(value - now) / 1e9 < WITHIN:
        return ""
    return next((name for name, factor in UNITS.items() if abs(value * factor - now) / 1e9 < WITHIN), "")


def clock_words(ahead: float) -> str:
    """What a clock may be that is so many seconds ahead (behind, if negative), and how it is set right."""
    for leap, name in LEAPS.items():
        if abs(ahead - leap) < 0.7:
            return f"is it {name}? times must be UTC"
    hours = ahead / 3600.0
    if abs(hours) > 0.4 and abs(hours) < 14.5 and abs(2 * hours - round(2 * hours)) < 0.02:
        return "is it local time? times must be UTC"
    return "set its clock by NTP or PTP"
