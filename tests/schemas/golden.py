"""The golden messages as bytes, and changed ones."""

from __future__ import annotations

from typing import Any

import msgpack

from tests.schemas.make_vectors import VECTORS

GOLDEN = {path.stem: path.read_bytes() for path in sorted(VECTORS.glob("*.msgpack"))}


def changed(name: str, **values: Any) -> bytes:
    """A golden message with other values in some fields."""
    return bytes(msgpack.packb(msgpack.unpackb(GOLDEN[name]) | values))
