"""One thing that is wrong: where, with which value, and what to do."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Finding", "cut"]

LONGEST = 60


class Finding(NamedTuple):
    """reason: one of the words by which refusals are counted; field and value as far as it is one field's; said: a
    sentence with the remedy."""

    reason: str
    field: str
    value: str
    said: str


def cut(value: object) -> str:
    """A value as it may be shown: in one short line."""
    if isinstance(value, (bytes, bytearray)):
        return f"{len(value)} bytes"
    try:
        text = repr(value) if not isinstance(value, str) else value
    except (ValueError, RecursionError):
        text = type(value).__name__
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
