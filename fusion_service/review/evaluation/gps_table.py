"""Truth from a plain table, as a GPS logger or a spreadsheet writes it: a CSV with a row for each fix.

    time            ns or s since 1970 (UTC), or ISO 8601 (UTC unless it says another zone); all rows the same
    id              whole numbers, or names, which are then numbered in the order of the alphabet
    lat, lon, alt   degrees, WGS84; alt in m above the ellipsoid, 0 where there is no such column
    x, y, z         instead: m, in the frame of the picture (of ENU: east, north, up)
    vx, vy, vz      m/s along the same axes, all or none; with x, y only

The columns may stand in any order, apart by commas, semicolons or tabs (`csv_text` opens what spreadsheets make of
that); others are left alone. Of rows that say the same twice one counts. Where no velocities are given each is the
slope of a straight line through five fixes, the one in the middle and two on either side (fewer at an end and at a gap;
of a fix alone there is none): smoothed over four intervals, and so behind in a turn.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.errors import ReviewError
from fusion_service.geodesy import FrameError, geodetic_to_ecef, transform
from fusion_service.review.evaluation.csv_text import Heading, decimal, in_degrees, open_table
from schemas import Ecef, Frame, Truth

__all__ = ["GpsTable", "is_gps_table", "read_gps"]

OTHER_NAMES = {
    "latitude": "lat",
    "lng": "lon",
    "long": "lon",
    "longitude": "lon",
    "altitude": "alt",
    "height": "alt",
    "timestamp": "time",
    "utc": "time",
    "target": "id",
    "name": "id",
}
NEEDED = "a row for each fix needs time, id, and lat, lon[, alt] (degrees, m) or x, y[, z] (m)"
EARLIEST_NS, LATEST_S = 10**16, 10**11
"""Since 1970: fewer ns, or more s, are another unit."""
SIDE = 2
"""Fixes on either side of the one whose velocity is sought."""
GAP, LEAST_GAP = 3.0, 5.0
"""Median intervals beyond which no line is drawn, and, s, no place is known."""

LONGEST_ID = 200
EXAMPLE = "2026-01-31T12:00:00Z"
MIDDLE = "slopes of straight lines through five fixes"


@dataclass(frozen=True, slots=True, eq=False)
class GpsTable:
    """R fixes, by object and time: times (R,) ns, ids (R,), places (R, 3) of latitude, longitude (degrees) and
    altitude, m, or x, y, z, m (d of them: (R, d)); velocities (R, d), m/s, None where the table has none; names by id,
    none where ids are numbers; note: what was made of it, in words."""

    path: Path
    geodetic: bool
    times: NDArray[np.int64]
    ids: NDArray[np.uint64]
    places: Floats
    velocities: Floats | None
    names: dict[int, str]
    note: str

    def messages(self, frame: Frame) -> list[Truth]:
        """As truth in `frame`, in the order of time. `ReviewError` where that has no place on Earth."""
        d = self.places.shape[1]
        axes = ("x", "y", "z")[:d]
        space = tuple(name for axis in axes for name in (axis, f"v{axis}"))
        places = np.stack(geodetic_to_ecef(*self.places.T), axis=-1) if self.geodetic else self.places
        velocities = self.velocities if self.velocities is not None else self._slopes(places)
        states = np.stack([places, velocities], axis=2).reshape(len(places), 2 * d)
        if self.geodetic:
            known = np.isfinite(states)
            try:
                states, _ = transform(np.where(known, states, 0.0), np.zeros((len(states), 6, 6)), space, Ecef(), frame)
            except FrameError as error:
                raise ReviewError(f"{self.path}: degrees do not go with this mission: {error}") from None
            states = np.where(known, states, np.nan)
        order = np.lexsort((self.ids, self.times))
        times, ids, states = self.times[order], self.ids[order], states[order]
        edges = [0, *(np.flatnonzero(np.diff(times)) + 1).tolist(), len(times)]
        return [
            Truth(
                source=self.path.stem,
                epoch=0,
                seq=number,
                sent=int(times[begin]),
                time=int(times[begin]),
                space=space,
                frame=frame,
                ids=ids[begin:end],
                means=states[begin:end],
            )
            for number, (begin, end) in enumerate(pairwise(edges))
        ]

    def _slopes(self, places: Floats) -> Floats:
        """Velocities (R, d), m/s, NaN of a fix alone."""
        found = np.full(places.shape, np.nan)
        for one in np.split(np.arange(len(self.ids)), np.flatnonzero(np.diff(self.ids)) + 1):
            found[one] = slopes(self.times[one], places[one])
        return found


def slopes(times: NDArray[np.int64], places: Floats) -> Floats:
    """Slopes (M, d), per s, of the least-squares lines through each of `places` (M, d) and `SIDE` neighbours on either
    side, at `times` (M,) ns, ascending; none through a gap; NaN of one alone."""
    seconds = (times - times[0]) / 1e9
    steps = np.diff(seconds)
    broken = steps > GAP * np.median(steps) if len(steps) else np.zeros(0, dtype=np.bool_)
    run = np.concatenate([[0], np.cumsum(broken)])
    n, S = np.zeros(len(times)), np.zeros((len(times), 2))
    sums = np.zeros((2, *places.shape))
    for shift in range(-SIDE, SIDE + 1):
        rows = np.arange(max(0, -shift), len(times) - max(0, shift))
        rows = rows[run[rows] == run[rows + shift]]
        t = seconds[rows + shift] - seconds[rows]
        n[rows] += 1
        S[rows] += np.stack([t, t * t], axis=1)
        sums[0, rows] += places[rows + shift] - places[rows]
        sums[1, rows] += t[:, None] * (places[rows + shift] - places[rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        below = n * S[:, 1] - S[:, 0] ** 2
        found: Floats = (n[:, None] * sums[1] - S[:, :1] * sums[0]) / below[:, None]
    return np.where((n > 1)[:, None], found, np.nan)


def is_gps_table(path: Path) -> bool:
    """Whether a table in text is such a one, and none of tracks (`schemas.flat`)."""
    with open_table(path) as (_, heading):
        return "track_id" not in heading.names and not any(name.startswith("cov_") for name in heading.names)


def read_gps(path: Path) -> GpsTable:
    """Read the table `path`. `ReviewError` says what is wrong, in which line."""
    with open_table(path) as (file, heading):
        if not any(heading.names):
            raise ReviewError(f"{path} is empty: {NEEDED}")
        heading = heading._replace(names=[OTHER_NAMES.get(name, name) for name in heading.names])
        axes, geodetic = _axes(path, heading)
        speeds = tuple(f"v{axis}" for axis in axes) if not geodetic else ()
        given = [name for name in speeds if name in heading.names]
        if given and len(given) < len(speeds):
            raise ReviewError(
                f"{path}: line {heading.line}: {given[0]} alone: give {', '.join(speeds)}, or none of them"
            )
        reader = csv.reader(file, delimiter=heading.delimiter)
        rows = list(_rows(path, reader, heading, (*axes, *given), geodetic))
    if not rows:
        raise ReviewError(f"{path} holds no fix: {NEEDED}")
    numbers, called = _ids([row[2] for row in rows])
    numbered = np.array([numbers[row[2]] for row in rows], dtype=np.uint64)
    times, unit = _times(path, [(row[0], row[1]) for row in rows])
    values = np.array([row[3] for row in rows], dtype=np.float64)
    order = np.lexsort((times, numbered))
    order, repeated = _once(path, order, numbered, times, values, [row[0] for row in rows])
    places = values[:, : len(axes)]
    low = geodetic and len(axes) == 2
    if low:
        places = np.column_stack([places, np.zeros(len(places))])
    note = f"{plural(len(order), 'fix', 'fixes')} of {plural(len(numbers), 'object')}, time in {unit}; "
    flat = ", no alt: 0 m above the ellipsoid" if low else ""
    note += f"degrees (WGS84){flat}" if geodetic else "m in the picture's frame"
    note += f"; velocities: {'as given' if given else MIDDLE}"
    note += f"; {plural(repeated, 'row')} that said the same twice left out" if repeated else ""
    note += _gaps(times[order], numbered[order])
    velocities = values[order, len(axes) :] if given else None
    return GpsTable(path, geodetic, times[order], numbered[order], places[order], velocities, called, note)


def plural(count: int, one: str, more: str = "") -> str:
    """`count` of them, in words."""
    return f"{count} {one if count == 1 else more or one + 's'}"


def _once(
    path: Path,
    order: NDArray[np.intp],
    ids: NDArray[np.uint64],
    times: NDArray[np.int64],
    values: Floats,
    lines: Sequence[int],
) -> tuple[NDArray[np.intp], int]:
    """`order` (R,), by object and time, without rows that repeat the one before, and how many these were."""
    same = (np.diff(ids[order]) == 0) & (np.diff(times[order]) == 0)
    equal = (values[order[1:]] == values[order[:-1]]).all(axis=1)
    twice = np.flatnonzero(same & ~equal)
    if len(twice):
        one, two = sorted(lines[order[twice[0] + k]] for k in (0, 1))
        raise ReviewError(
            f"{path}: line {two}: the same id at the same time as in line {one}, elsewhere: keep one of them"
        )
    return order[np.append(True, ~same)], int(same.sum())


def _gaps(times: NDArray[np.int64], ids: NDArray[np.uint64]) -> str:
    """Which objects have gaps in which nothing is known of them, in words; empty where none has."""
    longest = []
    for one in np.split(times, np.flatnonzero(np.diff(ids)) + 1):
        steps = np.diff(one) / 1e9
        wide = steps[steps > max(LEAST_GAP, GAP * float(np.median(steps)))] if len(steps) else steps
        longest += [float(wide.max())] if len(wide) else []
    if not longest:
        return ""
    have = "has a gap" if len(longest) == 1 else "have gaps"
    return (
        f"; {plural(len(longest), 'object')} {have} of up to {max(longest):.4g} s, in which nobody knows where they "
        "were: their tracks count as false then, unless all have the gap, when nothing is scored"
    )


def _axes(path: Path, heading: Heading) -> tuple[tuple[str, ...], bool]:
    """The columns of the place, and whether it is geodetic."""
    where, names = f"{path}: line {heading.line}", heading.names
    for name in ("time", "id"):
        if names.count(name) != 1:
            what = "twice" if name in names else f"missing (there are: {', '.join(names)[:200]})"
            raise ReviewError(f"{where}: column {name} is {what}: {NEEDED}")
    for pair, third, geodetic in ((("lat", "lon"), "alt", True), (("x", "y"), "z", False)):
        if all(name in names for name in pair):
            axes = (*pair, third) if third in names else pair
            if doubled := [name for name in axes if names.count(name) > 1]:
                raise ReviewError(f"{where}: column {doubled[0]} stands twice")
            return axes, geodetic
    raise ReviewError(f"{where}: no place: {NEEDED} (there are: {', '.join(names)[:200]})")


def _rows(
    path: Path, reader: Iterator[list[str]], heading: Heading, wanted: Sequence[str], geodetic: bool
) -> Iterator[tuple[int, str, str, list[float]]]:
    """Line, time, id and numbers of each row; empty lines are passed over."""
    line, delimiter, names = heading
    at = {name: names.index(name) for name in ("time", "id", *wanted)}
    first = line
    try:
        for row in reader:
            line += 1
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(names):
                raise ReviewError(f"{path}: line {line} has {len(row)} fields, line {first} has {len(names)}")
            values = [_number(path, line, name, decimal(row[at[name]].strip(), delimiter)) for name in wanted]
            if geodetic:
                _check_degrees(path, line, values[0], values[1])
            if not (who := row[at["id"]].strip()):
                raise ReviewError(f"{path}: line {line}: id is empty")
            if len(who) > LONGEST_ID or not who.isprintable():
                what = f"{who[:40]!r}...: it must be text in one line, of {LONGEST_ID} characters at most"
                raise ReviewError(f"{path}: line {line}: id is {what}")
            yield line, decimal(row[at["time"]].strip(), delimiter), who, values
    except csv.Error as error:
        raise ReviewError(f"{path}: line {line + 1}: {error}") from None


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        degrees = in_degrees(text[:40]) if name in ("lat", "lon") else None
        hint = f": write degrees with decimals, as in {degrees:.6f}" if degrees is not None else ""
        hint = hint if text else ": leave the row out where there is no fix"
        raise ReviewError(f"{path}: line {line}: {name} is {text[:40]!r}, no number{hint}") from None
    if not np.isfinite(value):
        raise ReviewError(f"{path}: line {line}: {name} is {text[:40]!r}: leave the row out where there is no fix")
    return value


def _check_degrees(path: Path, line: int, lat: float, lon: float) -> None:
    if abs(lat) > 90 or not -180 <= lon <= 360:
        hint = ": are lat and lon swapped?" if abs(lat) <= 360 and abs(lon) <= 90 else ""
        if abs(lat) > 360 or abs(lon) > 360:
            hint = ": metres of a map? Convert them to degrees, WGS84"
            if abs(lat) % 100 < 60 and abs(lon) % 100 < 60 and abs(lat) < 9060 and abs(lon) < 18060:
                one, other = (math.copysign(abs(a) // 100 + abs(a) % 100 / 60, a) for a in (lat, lon))
                hint = f": degrees and minutes in one, as NMEA writes them? Then it is {one:.6f}, {other:.6f}"
        raise ReviewError(f"{path}: line {line}: lat {lat:.10g}, lon {lon:.10g} is no place in degrees{hint}")


def _ids(texts: Sequence[str]) -> tuple[Mapping[str, int], dict[int, str]]:
    """A number for each text; and names by number, unless the texts are numbers."""
    some = sorted(set(texts))
    if all(text.isascii() and text.isdigit() and int(text) < 2**64 for text in some):
        return {text: int(text) for text in some}, {}
    return {text: k for k, text in enumerate(some, 1)}, dict(enumerate(some, 1))


def _times(path: Path, rows: Sequence[tuple[int, str]]) -> tuple[NDArray[np.int64], str]:
    """Times, ns, of (line, text), and their unit; all of one kind."""
    line, first = rows[0]
    read, unit = _reader(path, line, first)
    found: list[int] = []
    for line, text in rows:
        try:
            value = read(text)
        except (ValueError, InvalidOperation, OverflowError):
            value = 2**62
        if not (abs(value) < 2**62 and (unit != "ns" or abs(value) >= EARLIEST_NS)):
            what = f"in {unit} as in line {rows[0][0]}" if found else f"as in {EXAMPLE}, nor s or ns since 1970"
            raise ReviewError(f"{path}: line {line}: time is {text[:40]!r}, no time {what}")
        found.append(value)
    return np.array(found, dtype=np.int64), unit


def _reader(path: Path, line: int, text: str) -> tuple[Callable[[str], int], str]:
    """How times are read, by the first of them, and their unit."""
    try:
        value = abs(Decimal(text))
    except InvalidOperation:
        return _iso, "ISO 8601"
    if not value.is_finite():
        return _iso, "ISO 8601"
    if value >= EARLIEST_NS:
        return int, "ns"
    if value <= LATEST_S:
        return (lambda one: round(Decimal(one) * 10**9)), "s"
    wrong = "ms" if value < 10**14 else "us"
    raise ReviewError(f"{path}: line {line}: time is {text[:40]!r}: that looks like {wrong}; give ns, s or ISO 8601")


def _iso(text: str) -> int:
    when = datetime.fromisoformat(text)
    when = when if when.tzinfo is not None else when.replace(tzinfo=UTC)
    since = when - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
