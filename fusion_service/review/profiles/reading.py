"""A profile from a TOML file, or one that is shipped: every error at once, with file, line and key.

[profile]        name, source; note, cutoff_m
[[area]]         name; polygon_lat_lon_deg or polygon_x_y_m, disk_lat_lon_deg or disk_x_y_m with radius_m, height_m
[[requirement]]  kind, the keys of its kind; name, area, source, unverified, confidence, each_target
[identities]     what true objects are called, for kind identity, by id or by name: 17 = "mmsi:257000000"
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from fusion_service.config import ConfigError
from fusion_service.config.readers import POSITIVE, flag, number, text
from fusion_service.review.profiles.profile import EVERYWHERE, KINDS, Area, Profile, Requirement
from schemas import Polygon

__all__ = ["ProfileError", "load_profile", "shipped"]

FOLDER = Path(__file__).parent / "shipped"
Where = tuple[str | int, ...]
Problems = list[tuple[Where, str]]
HEADER = re.compile(r"\s*(\[\[?)\s*([A-Za-z0-9_\-]+)\s*\]\]?\s*(#.*)?$")
KEY = re.compile(r"\s*([A-Za-z0-9_\-]+|\"[^\"\n]*\")\s*=")
PLACES = number(-1e9, 1e9)
COMMON = ("kind", "name", "area", "source", "unverified", "confidence", "each_target")
PROFILE = {"name": text, "source": text, "note": text, "cutoff_m": POSITIVE}


class ProfileError(ConfigError):
    """A profile that cannot be used; `problems` has one line per error, as of a config."""

    exit_code: ClassVar[int] = 2


def shipped() -> dict[str, Path]:
    """The profiles of the package, by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}


def load_profile(name: str) -> Profile:
    """The profile in a file, or a shipped one by its name. Raises `ProfileError`."""
    known = shipped()
    path = Path(name)
    if name in known:
        path = known[name]
    elif not path.is_file():
        near = difflib.get_close_matches(name[:64], known, 1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ProfileError([f"no profile {name}{meant}: give a TOML file, or one of {', '.join(known)}"])
    try:
        written = path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
        raw = tomllib.loads(written)
    except (OSError, UnicodeDecodeError) as error:
        raise ProfileError([f"{path}: cannot be read: {error}"]) from None
    except (ValueError, RecursionError) as error:
        raise ProfileError([f"{path}: not TOML: {error}"]) from None
    problems: Problems = []
    profile = _profile(raw, str(path), problems)
    if problems:
        lines = _lines(written)
        raise ProfileError([f"{path}:{_line(lines, where)}: {_dotted(where)}: {what}" for where, what in problems])
    return profile


def _lines(written: str) -> dict[Where, int]:
    """Line of every table and key; tables of an array by their number."""
    found: dict[Where, int] = {}
    table: Where = ()
    count: dict[str, int] = {}
    for line, one in enumerate(written.split("\n"), start=1):
        if header := HEADER.match(one):
            name = header[2]
            table = (name,)
            if header[1] == "[[":
                table = (name, count.get(name, 0))
                count[name] = count.get(name, 0) + 1
            found.setdefault(table, line)
        elif key := KEY.match(one):
            found.setdefault((*table, key[1].strip('"')), line)
    return found


def _line(lines: Mapping[Where, int], where: Where) -> int:
    return next((lines[where[:n]] for n in range(len(where), 0, -1) if where[:n] in lines), 1)


def _dotted(where: Where) -> str:
    words = [f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in where]
    return "".join(words).lstrip(".")


def _unknown(key: str, known: Iterable[str]) -> str:
    names = list(known)
    near = difflib.get_close_matches(key[:64], names, 1)
    return f"unknown key{f': did you mean {near[0]}?' if near else ''} (known: {', '.join(names)})"


def _read(
    table: Any, where: Where, readers: Mapping[str, Callable[[Any], Any]], needed: Iterable[str], problems: Problems
) -> dict[str, Any]:
    """The values of a table of known keys."""
    if not isinstance(table, Mapping):
        problems.append((where, f"is {table!r}, must be a table"))
        return {}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in readers:
            problems.append(((*where, key), _unknown(key, readers)))
            continue
        try:
            values[key] = readers[key](value)
        except ValueError as error:
            problems.append(((*where, key), str(error)))
    for key in needed:
        if key not in table:
            problems.append((where, f"needs {key}"))
    return values


def _profile(raw: Mapping[str, Any], path: str, problems: Problems) -> Profile:
    tables = ("profile", "area", "requirement", "identities")
    for key in raw:
        if key not in tables:
            problems.append(((key,), _unknown(key, tables)))
    head = _read(raw.get("profile", {}), ("profile",), PROFILE, ("name", "source"), problems)
    areas = [_area(one, ("area", k), problems) for k, one in enumerate(_list(raw, "area", problems))]
    names = [area.name for area in areas]
    for k, name in enumerate(names):
        if name == EVERYWHERE or name in names[:k]:
            problems.append((("area", k, "name"), f"is {name!r}, a name that is taken"))
    wanted = _list(raw, "requirement", problems)
    found = [_requirement(one, ("requirement", k), [*names, EVERYWHERE], problems) for k, one in enumerate(wanted)]
    if not wanted:
        problems.append((("requirement",), "is not there: a profile needs at least one [[requirement]]"))
    return Profile(
        name=head.get("name", ""),
        source=head.get("source", ""),
        note=head.get("note", ""),
        cutoff=head.get("cutoff_m"),
        areas=tuple(areas),
        requirements=tuple(one for one in found if one is not None),
        identities=_identities(raw.get("identities", {}), problems),
        path=path,
    )


def _list(raw: Mapping[str, Any], name: str, problems: Problems) -> list[Any]:
    value = raw.get(name, [])
    if isinstance(value, list):
        return value
    problems.append(((name,), f"must be written [[{name}]], one for each"))
    return []


def _identities(table: Any, problems: Problems) -> dict[int | str, str]:
    found: dict[int | str, str] = {}
    if not isinstance(table, Mapping):
        problems.append((("identities",), f"is {table!r}, must be a table"))
        return found
    for key, value in table.items():
        if not isinstance(value, str) or not value:
            problems.append((("identities", key), f"is {value!r}, must be an identity, as in 'mmsi:257000000'"))
        else:
            found[int(key) if re.fullmatch(r"\d{1,20}", key) else key] = value
    return found


def _pair(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"is {value!r}, must be two numbers")
    return PLACES(value[0]), PLACES(value[1])


def _corners(value: Any) -> tuple[tuple[float, float], ...]:
    if not isinstance(value, list) or len(value) < 3:
        raise ValueError(f"is {value!r}, must be three corners or more, each two numbers")
    return tuple(_pair(one) for one in value)


def _rising(value: Any) -> tuple[float, float]:
    low, high = _pair(value)
    if not low < high:
        raise ValueError(f"is {value!r}, must be from the lower to the higher")
    return low, high


AREA: Mapping[str, Callable[[Any], Any]] = {
    "name": text,
    "polygon_lat_lon_deg": _corners,
    "polygon_x_y_m": _corners,
    "disk_lat_lon_deg": _pair,
    "disk_x_y_m": _pair,
    "radius_m": POSITIVE,
    "height_m": _rising,
}


def _area(table: Any, where: Where, problems: Problems) -> Area:
    values = _read(table, where, AREA, ("name",), problems)
    degrees = [key for key in values if key.endswith("_lat_lon_deg")]
    metres = [key for key in values if key.endswith("_x_y_m")]
    disk = values.get("disk_lat_lon_deg", values.get("disk_x_y_m"))
    if degrees and metres:
        problems.append(((*where, metres[0]), f"does not go with {degrees[0]}: degrees or m, not both"))
    if (disk is None) != ("radius_m" not in values):
        problems.append((where, "needs a disk and its radius_m, or neither"))
    for key in degrees:
        corners = values[key] if key.startswith("polygon") else [values[key]]
        if any(not abs(lat) <= 90 or not abs(lon) <= 180 for lat, lon in corners):
            problems.append(((*where, key), "has a latitude beyond 90 or a longitude beyond 180 degrees: swapped?"))
    for key in ("polygon_x_y_m", "polygon_lat_lon_deg"):
        if key in values:
            try:
                Polygon(values[key])
            except ValueError as error:
                problems.append(((*where, key), f"is no polygon: {error}"))
    if len(values) < 2 and isinstance(table, Mapping):
        problems.append((where, "needs a polygon, a disk or height_m"))
    return Area(
        values.get("name", ""),
        values.get("polygon_lat_lon_deg", values.get("polygon_x_y_m", ())),
        disk,
        values.get("radius_m", 0.0),
        values.get("height_m"),
        bool(degrees),
    )


def _requirement(table: Any, where: Where, areas: list[str], problems: Problems) -> Requirement | None:
    if not isinstance(table, Mapping):
        problems.append((where, f"is {table!r}, must be a table"))
        return None
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        near = difflib.get_close_matches(str(kind)[:64], KINDS, 1)
        meant = f": did you mean {near[0]}?" if near else ""
        problems.append(((*where, "kind"), f"is {kind!r}{meant} (known: {', '.join(KINDS)})"))
        return None
    keys, groups = KINDS[kind].keys, KINDS[kind].one_of
    readers: dict[str, Callable[[Any], Any]] = {
        **dict.fromkeys(COMMON[:5], text),
        "confidence": number(0.0, 1 - 1e-9),
        "each_target": flag,
        **{key: one.read for key, one in keys.items()},
    }
    needed = [key for key, one in keys.items() if one.needed]
    values = _read(table, where, readers, needed, problems)
    there = [group for group in groups if any(key in table for key in group)]
    if groups and (len(there) != 1 or not all(key in table for key in there[0])):
        ways = ", or ".join(" and ".join(group) for group in groups)
        problems.append((where, f"needs {ways}"))
    area = values.get("area", EVERYWHERE)
    if area not in areas:
        near = difflib.get_close_matches(area[:64], areas, 1)
        meant = f": did you mean {near[0]}?" if near else ""
        problems.append(((*where, "area"), f"is {area!r}, no area of this profile{meant} (known: {', '.join(areas)})"))
    numbers = {key: values.get(key, one.default) for key, one in keys.items()}
    return Requirement(
        kind=kind,
        name=values.get("name", kind.replace("_", " ")),
        numbers=numbers,
        area=area,
        source=values.get("source", ""),
        unverified=values.get("unverified", ""),
        confidence=values.get("confidence", 0.95),
        each_target=values.get("each_target", False),
    )
