"""What reads one value of a config: a function from a value, as TOML or a caller gives it, to that of a setting.

Each raises ValueError, which says what the value is and what it must be, to be put behind the setting's name. The
docstring of one that has a `|` in it is what `example_toml` shows of the choices.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from difflib import get_close_matches
from typing import Any, TypeVar

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from schemas import ORIGINS, STATUSES, Coverage, Disk, Ecef, Enu, Frame, Local, Polygon, Sector
from schemas.values import coverage

__all__ = [
    "DURATION",
    "POSITIVE",
    "build",
    "choice",
    "endpoints",
    "flag",
    "known_statuses",
    "maybe",
    "number",
    "origins",
    "parsed",
    "read_coverage",
    "read_frame",
    "read_mixture_rule",
    "read_rule",
    "table",
    "text",
    "texts",
    "whole",
]

T = TypeVar("T")


def number(low: float, high: float, *, above: bool = False) -> Callable[[Any], float]:
    """A finite number from `low` to `high`; above: more than `low`."""

    def read(value: Any) -> float:
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not good or not (low < value if above else low <= value) or not value <= high:
            raise ValueError(f"is {value!r}, must be a number {'above' if above else 'from'} {low:g} to {high:g}")
        return float(value)

    return read


def whole(low: int, high: int) -> Callable[[Any], int]:
    """A whole number from `low` to `high`."""

    def read(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"is {value!r}, must be a whole number from {low} to {high}")
        return value

    return read


def choice(*known: str) -> Callable[[Any], str]:
    """One of the known texts."""

    def read(value: Any) -> str:
        if value not in known:
            near = get_close_matches(value, known, 1) if isinstance(value, str) else []
            meant = f": did you mean {near[0]}?" if near else ""
            raise ValueError(f"is {value!r}, must be one of: {', '.join(known)}{meant}")
        return str(value)

    read.__doc__ = " | ".join(known)
    return read


def read_rule(value: Any) -> str:
    """The name of a fusion rule, or auto."""
    from fusion_service.rules import RULES, is_own

    if isinstance(value, str) and is_own(value):
        if value in RULES:
            return value
        raise ValueError(f"is {value!r}, a rule of one's own that is not loaded: {NOT_LOADED}")
    if isinstance(value, str) and value.endswith(".py"):
        raise ValueError(f"is {value!r}: say which function of it, as in {value}:fuse")
    return choice(*RULES, "auto")(value)


def read_mixture_rule(value: Any) -> str:
    """The name of a rule for mixtures, or moments."""
    from fusion_service.rules.mixtures import MIXTURE_RULES

    return choice("moments", *MIXTURE_RULES)(value)


def flag(value: Any) -> bool:
    """true or false."""
    if type(value) is not bool:
        raise ValueError(f"is {value!r}, must be true or false")
    return value


def text(value: Any) -> str:
    """A text that is not empty."""
    if type(value) is not str or not value:
        raise ValueError(f"is {value!r}, must be a text")
    return value


def texts(value: Any) -> tuple[str, ...]:
    """A list of texts."""
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"is {value!r}, must be a list of texts")
    return tuple(text(item) for item in value)


def origins(value: Any) -> tuple[str, ...]:
    """A list of origins of data."""
    found = texts(value)
    if not found or not set(found) <= set(ORIGINS):
        raise ValueError(f"is {value!r}, must be a list of some of: {', '.join(ORIGINS)}")
    return found


def parsed(check: Callable[[Any], T], read: Callable[[Any], Any] = text) -> Callable[[Any], T]:
    """What `check` makes of what `read` gives."""
    return lambda value: check(read(value))


def table(value: Any) -> dict[str, Any]:
    """A table, as a dict of its own."""
    if not isinstance(value, Mapping):
        raise ValueError(f"is {value!r}, must be a table")
    return dict(value)


def _parts(value: Any) -> dict[str, Any]:
    return {one.name: getattr(value, one.name) for one in fields(value)}


def build(kind: type[T], value: Any) -> T:
    """A `kind`, a dataclass, from a table of its fields: one that is there is made again, and so checked."""
    given = _parts(value) if isinstance(value, kind) else table(value)
    known = {one.name: one.type for one in fields(kind)}  # type: ignore[arg-type]
    needed = {one.name for one in fields(kind) if one.default is dataclasses.MISSING}  # type: ignore[arg-type]
    if not needed <= set(given) <= set(known):
        raise ValueError(f"has the keys {', '.join(given) or 'none'}, wants: {', '.join(known)}")
    for name, one in given.items():
        if known[name] == "float":
            if not isinstance(one, (int, float)) or isinstance(one, bool):
                raise ValueError(f"{name} is {one!r}, must be a number")
            given[name] = float(one)
        if known[name] == "str" and not isinstance(one, str):
            raise ValueError(f"{name} is {one!r}, must be a text")
    return kind(**given)


def read_coverage(value: Any) -> Coverage:
    """A field of view as SensorInfo has it, or a table of its parts."""
    return value if isinstance(value, (Disk, Sector, Polygon)) else coverage(table(value))


def known_statuses(names: tuple[str, ...]) -> tuple[str, ...]:
    """`names` if each is a status of a global track, `ValueError` if not."""
    unknown = [name for name in names if name not in STATUSES]
    if unknown or not names:
        raise ValueError(f"is {list(names)!r}, must hold some of: {', '.join(STATUSES)}")
    return names


def read_frame(value: Any) -> Frame | None:
    """A frame from a table with its kind; None is none."""
    if value is None:
        return None
    given = {"kind": value.kind, **_parts(value)} if isinstance(value, (Enu, Ecef, Local)) else table(value)
    kinds: dict[str, type[Any]] = {"enu": Enu, "ecef": Ecef, "local": Local}
    kind = given.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"has kind {kind!r}, must be one of: {', '.join(kinds)}")
    found: Frame = build(kinds[kind], given)
    return found


def endpoints(value: Any) -> tuple[str, ...]:
    """At least one endpoint of a hub."""
    if not (named := texts(value)):
        raise ValueError(f"names no hub: write at least one, as in {DEFAULT_ENDPOINT}")
    return tuple(check_endpoint(one) for one in named)


def maybe(read: Callable[[Any], T]) -> Callable[[Any], T | None]:
    """None, or what `read` gives."""
    return lambda value: None if value is None else read(value)


DURATION = number(0.0, 1e6)
NOT_LOADED = "its file is read where a config file or --rule names it, else by fusion_service.rules.load_own"
POSITIVE = number(0.0, 1e6, above=True)
