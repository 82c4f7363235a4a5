"""A message with columns for the page, as bytes: a header in JSON, then the columns, each at a multiple of 8.

u32 LE    length of the header, which is padded with spaces so that the columns begin at a multiple of 8
JSON      {"type": ..., "columns": [[name, "u1" | "u4" | "f4" | "f8", numbers, offset after the header], ...], ...}
columns   little-endian numbers, as JavaScript's typed arrays take them without a copy
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["packed", "text"]

ALIGN = 8


def packed(header: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Header and columns; NaN may stand in the columns, not in the header."""
    table, parts, offset = [], [], 0
    for name, column in columns.items():
        little = np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<"))
        table.append([name, little.dtype.str[1:], len(little), offset])
        data = little.tobytes()
        data += bytes(-len(data) % ALIGN)
        parts.append(data)
        offset += len(data)
    words = text({**header, "columns": table}).encode()
    words += b" " * (-(4 + len(words)) % ALIGN)
    return b"".join([len(words).to_bytes(4, "little"), words, *parts])


def text(message: Mapping[str, Any]) -> str:
    """JSON that any parser takes: numbers that are none become null, bytes and the like text."""
    try:
        return json.dumps(message, separators=(",", ":"), allow_nan=False, default=str)
    except ValueError:
        return json.dumps(_finite(message), separators=(",", ":"), allow_nan=False, default=str)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if isinstance(value, Mapping):
        return {str(key): _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, (list, tuple)) else value
