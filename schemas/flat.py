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

and, which older tables lack:

label           what it is called on pictures: "track 7" or "track 2.7", the source and its number, "target 3"
track_hex       `track_id` as 0x and 16 digits: a text, for spreadsheets and JavaScript keep 53 bits of a number
number          that an operator gave it;  callsign, identity, class: texts
sigma           m: root of the mean variance of the position along its axes
extent_length, extent_width, extent_heading     of the object: m, and degrees clockwise from north (+y of the frame)

A callsign, identity or class that begins with = + - @ or a control character is written with ' before it in a CSV:
spreadsheets take it for a formula.
"""

from __future__ import annotations

from itertools import pairwise

from schemas.spaces import Ecef, Enu, Frame, Local

__all__ = ["KINDS", "MORE", "frame_of", "frame_text", "lower", "safe_text", "space_of", "track_columns"]

KINDS = ("global", "local", "truth")
HEAD = ("time", "time_ns", "source", "kind", "track_id", "epoch", "status", "existence", "updated_ns")
TAIL = ("latitude", "longitude", "altitude", "sources", "lineage", "frame")
MORE = (
    "label",
    "track_hex",
    "number",
    "callsign",
    "identity",
    "class",
    "sigma",
    "extent_length",
    "extent_width",
    "extent_heading",
)
FORMULA = ("=", "+", "-", "@", *map(chr, range(32)))


def safe_text(text: str) -> str:
    """A text as a cell that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(FORMULA) else text


def lower(space: tuple[str, ...]) -> list[tuple[int, int]]:
    """The entries (i, j), i >= j, of a packed lower triangle, in its order."""
    return [(i, j) for i in range(len(space)) for j in range(i + 1)]


def track_columns(space: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the columns, in their order, of tracks in `space`."""
    return (*_needed(space), *MORE)


def _needed(space: tuple[str, ...]) -> tuple[str, ...]:
    return (*HEAD, *space, *(f"cov_{space[i]}_{space[j]}" for i, j in lower(space)), *TAIL)


def space_of(columns: tuple[str, ...]) -> tuple[str, ...]:
    """The state space of a table with these columns. ValueError where they are none of ours."""
    try:
        first, last = columns.index(HEAD[-1]) + 1, next(k for k, name in enumerate(columns) if name.startswith("cov_"))
    except (ValueError, StopIteration):
        raise ValueError("not a table of tracks: it lacks updated_ns or cov_...") from None
    space = columns[first:last]
    missing = sorted(set(_needed(space)) - set(columns))
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
