"""Where the records of a recording are."""

from __future__ import annotations

import struct

__all__ = ["spans"]

HEADER, RECORD = 12, struct.Struct("<QQ")


def spans(data: bytes | bytearray) -> list[tuple[int, int]]:
    """Begin and end of each record before the index."""
    found, at = [], HEADER
    while at + RECORD.size <= len(data):
        kind, length = RECORD.unpack_from(data, at)
        if kind == 0:
            break
        found.append((at, at + RECORD.size + length))
        at += RECORD.size + length
    return found
