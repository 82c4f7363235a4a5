"""Values of options as people write them: 500MB, 90s, 7d, 2026-01-31T12:00:00Z, a port. All raise ValueError in one
line; `fusion_service.process.argument` makes the type of an argument of one, and `positive` and `whole` stand there."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime

__all__ = ["duration", "moment", "port", "size"]

SIZES = {"b": 1} | {
    f"{prefix}{suffix}": base**power
    for suffix, base in (("b", 1000), ("", 1000), ("ib", 1024))
    for power, prefix in enumerate("kmgt", start=1)
}
SECONDS = {"s": 1.0, "": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}
TEXT = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)", re.ASCII)


def size(text: str) -> int:
    """Bytes: `500MB` is 5e8, `500MiB` 500 * 2**20, `500B` 500. Raises ValueError in one line."""
    if (bare := TEXT.fullmatch(text.strip())) and not bare[2]:
        raise ValueError(f"{text!r} has no unit: give one, as in {text.strip()}MB, or {text.strip()}B for bytes")
    value = _value(text, SIZES, "a size: give a number and B, kB, MB, GB, TB or KiB, MiB, GiB, as in 500MB")
    return math.ceil(value)


def duration(text: str) -> float:
    """Seconds: of `90s`, `15min`, `1h`, `7d`, `2w`. Raises ValueError in one line."""
    return _value(text, SECONDS, "a duration: give a number and s, min, h, d or w, as in 1h")


def moment(text: str) -> tuple[str, float]:
    """A duration from now, ("for", seconds), or a time in ISO 8601, ("until", ns UTC). Raises ValueError in one
    line."""
    try:
        return "for", duration(text)
    except ValueError:
        pass
    try:
        when = datetime.fromisoformat(text.strip())
    except ValueError:
        raise ValueError(f"{text!r} is not a time: give a duration, as in 10min, or 2026-01-31T12:00:00Z") from None
    return "until", round(when.replace(tzinfo=when.tzinfo or UTC).timestamp()) * 10**9


def port(text: str) -> int:
    """A TCP port. Raises ValueError in one line."""
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 65536):
        raise ValueError(f"{text!r} is not a port")
    return int(text)


def _value(text: str, units: dict[str, float] | dict[str, int], what: str) -> float:
    match = TEXT.fullmatch(text.strip().lower())
    factor = units.get(match[2]) if match else None
    value = float(match[1]) * factor if match and factor else 0.0
    if not 0.0 < value < math.inf:
        raise ValueError(f"{text!r} is not {what}")
    return value
