"""Tracks as a flat table, a row for each track at each time: the columns of an export, and frames as text.

time            ISO 8601, UTC, to the microsecond       time_ns   the same, exact, int ns
source, kind    who says it, and as what: global, local or truth
track_id        of the track                            epoch     of the source's run
status          tentative, confirmed, coasting; else empty
existence       probability, empty where not said       updated_ns   time of the last data in it, empty likewise
x, vx, ...      the state, SI units, in `frame`         cov_x_x, cov_vx_x, ...   lower triangle of its covariance
latitude, longitude, altitude                           degrees and m (WGS84), where the frame has a place on Earth
sources         names of those that contribute, apart by spaces;  lineage: of all whose data the message contains
frame           "enu LAT LON ALT", "ecef", or "local NAME"
"""

from __future__ import annotations

from itertools import pairwise

from schemas.spaces import Ecef, Enu, Frame, Local

__all__ = ["KINDS", "frame_of", "frame_text", "lower", "space_of", "track_columns"]

KINDS = ("global", "local", "truth")
HEAD = ("time", "time_ns", "source", "kind", "track_id", "epoch", "status", "existence", "updated_ns")
TAIL = ("latitude", "longitude", "altitude", "sources", "lineage", "frame")


def lower(space: tuple[str, ...]) -> list[tuple[int, int]]:
    """The entries (i, j), i >= j, of a packed lower triangle, in its order."""
    return [(i, j) for i in range(len(space)) for j in range(i + 1)]


def track_columns(space: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the columns, in their order, of tracks in `space`."""
    return (*HEAD, *space, *(f"cov_{space[i]}_{space[j]}" for i, j in lower(space)), *TAIL)


def space_of(columns: tuple[str, ...]) -> tuple[str, ...]:
    """The state space of a table with these columns. ValueError where they are none of ours."""
    try:
        first, last = columns.index(HEAD[-1]) + 1, next(k for k, name in enumerate(columns) if name.startswith("cov_"))
    except (ValueError, StopIteration):
        raise ValueError("not a table of tracks: it lacks updated_ns or cov_...") from None
    space = columns[first:last]
    missing = sorted(set(track_columns(space)) - set(columns))
    if missing or any(a == b for a, b in pairwise(sorted(columns))):
        raise ValueError(f"not a table of tracks: column {missing[0] if missing else 'twice'!r} is missing or repeated")
    return space


def frame_text(frame: Frame) -> str:
    """A frame in one field."""
    if isinstance(frame, Enu):
        return f"enu {frame.lat!r} {frame.lon!r} {frame.alt!r}"
    return f"local {frame.name}" if isinstance(frame, Local) else "ecef"


def frame_of(text: str) -> Frame:
    """The frame that `frame_text` wrote. ValueError for another text."""
    kind, _, rest = text.partition(" ")
    if kind == "enu":
        numbers = [float(part) for part in rest.split()]
        if len(numbers) == 3:
            return Enu(*numbers)
    elif kind == "local":
        return Local(rest)
    elif text == "ecef":
        return Ecef()
    raise ValueError(f'{text!r} is no frame: "enu LAT LON ALT", "ecef" or "local NAME"')
