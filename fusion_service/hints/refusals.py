"""Why a centre refused a message that could be read, with what mends it."""

from __future__ import annotations

from collections.abc import Sequence

from fusion_service.hints.finding import Finding, cut
from fusion_service.hints.numbers import number_finding
from fusion_service.hints.times import clock_words, span, unit_of_time
from schemas import FAULTS, LocalIntensity, LocalTracks, Message

__all__ = ["refusal_finding"]

SAME = 0.5
"""Seconds by which two delays may differ and be one."""

OTHER_DAY = 7200.0
"""Seconds from which tracks that are late and sent now are those of a mission of another time."""

SAID = {
    "muted": ("", "the centre's config ignores it, or an operator has muted it: order unmute"),
    "loop": ("lineage", "it holds only what this centre has published itself: leave the centre's own picture out"),
    "repeat": ("seq", "the very same message came before: count seq up with every message"),
    "bad-info": ("position", "its sensor_info has a position or covariance that is no place: see WIRE.md, sensor_info"),
    "space": ("space", "its space lacks components of the centre's: send them, or set space under [centre]"),
    "frame": ("frame", "its frame cannot be brought into the picture's: send ENU or ECEF, or set frame under [centre]"),
    "intensity": ("type", "it sends an intensity, and this centre fuses tracks: set kind under [centre]"),
    "tracks": ("type", "it sends tracks, and this centre fuses intensities: set kind under [centre]"),
    "length": ("ids", "its columns do not fit together: see WIRE.md"),
    "too-many-components": ("counts", "it has more mixture components than the centre takes: reduce them before"),
    "too-many-tracks": ("ids", "it has more tracks than the centre has room for: send only confirmed ones"),
    "too-many-sources": ("source", "the centre has no room for another source: end those that are not needed"),
    "pending": ("", "it sends more between two steps than max_pending: send less often, or raise max_pending"),
    "queue": ("", "more came than the queue holds: send less often, or raise queue under [bus]"),
    "flow": ("", "it sends more than the limits of the service let in: send less, or raise them under [limits]"),
    "fusion": ("covs", "a fusion with it was numerically impossible, and bounded instead: are its covariances sound?"),
    "ill-conditioned": ("covs", "its density is not sound when predicted to the step: is its covariance extreme?"),
    "overtaken": ("", "the service is behind, and newer scans of it were taken instead"),
    "failed": ("", "a step failed for this message, which is a fault of the service: report it with the recording"),
}
"""Reason -> field, and what it means and asks for."""


def refusal_finding(reason: str, message: Message | None, now: int, origins: Sequence[str] = ()) -> Finding:
    """What a refusal by a centre means, `reason` as in the step log. message: the one that was refused, where it is
    known; now: when it came, ns; origins: those that the centre takes of this source."""
    if reason in FAULTS[1:] and isinstance(message, (LocalTracks, LocalIntensity)):
        return number_finding(message, reason)
    if reason in ("late", "future") and message is not None:
        return _time(reason, message, now)
    if reason == "old-epoch":
        said = (
            "its epoch is older than another of this name: do two publishers have one name, or was its clock set back? "
            "give each a name of its own"
        )
        return Finding(reason, "epoch", cut(getattr(message, "epoch", "")), said)
    if reason == "origin":
        origin = cut(getattr(message, "origin", ""))
        takes = f" (it takes {', '.join(origins)})" * bool(origins)
        said = (
            f'its origin "{origin}" is not taken{takes}: send the origin that is true, or set allowed_origins '
            f"for it under [centre.sources]"
        )
        return Finding(reason, "origin", origin, said)
    if reason == "type":
        said = f"it sends {getattr(message, 'type', 'what')}, which is no message of a source on this key"
        return Finding(reason, "type", cut(getattr(message, "type", "")), said)
    field, said = SAID.get(reason, ("", f"see {reason} in WIRE.md, Refusals"))
    return Finding(reason, field, _value(message, field), said)


def _value(message: Message | None, field: str) -> str:
    value = getattr(message, field, None) if field else None
    return "" if value is None or hasattr(value, "dtype") else cut(value)


def _time(reason: str, message: Message, now: int) -> Finding:
    """A time that is too early or too late."""
    time = getattr(message, "time", None)
    early = time is None or (reason == "future" and message.epoch > max(time, now))
    field, value = ("epoch", message.epoch) if early or time is None else ("time", int(time))
    off = (value - now) / 1e9
    what = "tracks are" if field == "time" else "the epoch is"
    if unit := unit_of_time(value, now):
        way = f"late by {span(off)}" if off < 0 else f"{span(off)} ahead"
        return Finding(reason, field, str(value), f"{what} {way}: is `{field}` in {unit}? it must be ns")
    sent = (message.sent - now) / 1e9
    if reason == "late":
        if abs(sent - off) < SAME or sent < off:
            said = f"{what} {span(off)} late and sent as late: its clock is {span(sent)} behind: {clock_words(sent)}"
        elif off < -OTHER_DAY:
            said = (
                f"{what} {span(off)} late, though sent now: if it is a mission of another time, play it at today's, or "
                f'set clock = "message" under [centre]'
            )
        else:
            said = (
                f"{what} {span(off)} late, and were sent {span(sent - off)} after they hold: send them sooner, or "
                f"raise lateness under [centre] above that"
            )
        return Finding(reason, field, str(value), said)
    said = f"{what} {span(off)} ahead of this computer's clock: its clock is ahead: {clock_words(off)}"
    return Finding(reason, field, str(value), said)
