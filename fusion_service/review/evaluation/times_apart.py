"""What to say of truth and pictures that are not of the same time."""

from __future__ import annotations

from fusion_service.labels import utc

__all__ = ["apart_in_time"]

HALF_HOUR, MOST_HALVES = 1800 * 10**9, 28
LOGGED_NS = 3 * 10**17
"""Since 1970, ns: what is before (1979) is no time of a fix."""


def apart_in_time(truth: tuple[int, int], pictures: tuple[int, int]) -> str:
    """What to say of spans, ns, of truth and of pictures that have no scored time in common."""
    said = f"truth is from {utc(truth[0])} to {utc(truth[1])}, pictures from {utc(pictures[0])} to {utc(pictures[1])}"
    if truth[1] < LOGGED_NS:
        return f"{said}: is its time since the begin of something, or a spreadsheet's number of days?"
    best, most = 0, 0.5 * min(truth[1] - truth[0], pictures[1] - pictures[0])
    for halves in range(-MOST_HALVES, MOST_HALVES + 1):
        shift = halves * HALF_HOUR
        common = min(truth[1] + shift, pictures[1]) - max(truth[0] + shift, pictures[0])
        if common >= most and (not best or abs(halves) < abs(best)):
            best = halves
    if best:
        return f"{said}: {abs(best) / 2:g} h {'earlier' if best < 0 else 'later'} it would fit: is it in local time?"
    return said
