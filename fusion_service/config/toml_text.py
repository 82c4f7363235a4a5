"""TOML as text: on which line a key stands, and how keys and values are written. (tomllib does neither.)"""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import fields
from typing import Any

__all__ = ["dotted", "key_lines", "line_of", "toml_value"]

_PART = r"""(?:"[^"\n]*"|'[^'\n]*'|[A-Za-z0-9_\-]+)"""
_DOTTED = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER = re.compile(rf"\s*\[\[?\s*({_DOTTED})\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(rf"\s*({_DOTTED})\s*=")


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Line of every table header and key, for messages (tomllib keeps none)."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(line):
            table = _parts(header[1])
            lines.setdefault(table, number)
        elif entry := _KEY.match(line):
            lines.setdefault((*table, *_parts(entry[1])), number)
    return lines


def _parts(written: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in re.findall(_PART, written))


def dotted(key: tuple[str, ...]) -> str:
    """The key as TOML writes it."""
    return ".".join(part if re.fullmatch(r"[A-Za-z0-9_\-]+", part) else json.dumps(part) for part in key)


def line_of(lines: dict[tuple[str, ...], int], key: tuple[str, ...]) -> int:
    """The line of a key, or of the nearest table that holds it."""
    for length in range(len(key), 0, -1):
        if key[:length] in lines:
            return lines[key[:length]]
    return 1


def toml_value(value: Any) -> str:
    """A value in TOML, on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    if dataclasses.is_dataclass(value):
        value = {one.name: getattr(value, one.name) for one in fields(value)}
    if isinstance(value, dict):
        return "{" + ", ".join(f"{dotted((str(key),))} = {toml_value(item)}" for key, item in value.items()) + "}"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
