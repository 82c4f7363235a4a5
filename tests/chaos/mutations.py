"""Messages that are almost right: maps of every message type, changed where it hurts, and bytes changed blindly.

`mutated` draws all from one generator: the same seed gives the same bytes.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any

import msgpack

from tests.schemas.golden import GOLDEN

__all__ = ["BASES", "MUTATIONS", "mutated"]

BASES: dict[str, dict[str, Any]] = {name: msgpack.unpackb(data) for name, data in GOLDEN.items()}
"""Every golden message as a map."""
VALUES: tuple[Any, ...] = tuple({repr(one): one for base in BASES.values() for one in base.values()}.values())
"""What stands anywhere in them: of the right type, elsewhere."""

STRANGE: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 255, 65536, 2**31, 2**53, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)),
    *(0.0, -0.0, 1.5, -1.5, 1e-300, 5e-324, 1e300, -1e300, float("nan"), float("inf"), float("-inf")),
    *("", "x", "a/b", "*", "**", "$*", "@adv", "global/centre", "x" * 64, "x" * 65, "x" * 5000, "\x00", "\x1b[2J", "ü"),
    *(b"", b"\x00", b"123", bytes(8), bytes(24), b"\xff" * 80, bytes(4096)),
    *([], [None], [[[]]], [0] * 300, [[0, "gone", None]], ["x", "x"], ["x", "y", "z", "vx", "vy", "vz"]),
    *({}, {"kind": "nothing"}, {"kind": []}, {"kind": "ecef"}, {"kind": "local", "name": "x"}, {b"bytes": 1}, {"": {}}),
    *(msgpack.ExtType(5, b"abc"), msgpack.Timestamp(1, 2), {"value": -1e9, "sigma": 1e9}, {"kind": "cv", "q": 1e300}),
)
NUMBERS = (
    *(float("nan"), float("inf"), float("-inf"), 0.0, -0.0, -1.0, 1.0, 1e-300, 5e-324, -1e-9),
    *(1e9, -1e9, 1e150, 1e300, 1.7e308, -1.7e308, 2.0**53, 1e-12, 7.0),
)
WHOLE = (0, 1, 2, 255, 65535, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
TIMES = (-(2**63), -1, 0, 1, 10**9, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
SECOND = 10**9
Pairs = list[tuple[Any, Any]]
Mutation = Callable[[random.Random, Pairs], None]


def _place(rng: random.Random, pairs: Pairs) -> int:
    return int(rng.random() * len(pairs))


def _of(rng: random.Random, pairs: Pairs, kind: type | tuple[type, ...]) -> int | None:
    """The place of a value of a type."""
    places = [place for place, (_, value) in enumerate(pairs) if isinstance(value, kind)]
    return places[int(rng.random() * len(places))] if places else None


def removed(rng: random.Random, pairs: Pairs) -> None:
    """A field less."""
    del pairs[_place(rng, pairs)]


def doubled(rng: random.Random, pairs: Pairs) -> None:
    """The same key twice, the second with another value."""
    key, value = pairs[_place(rng, pairs)]
    pairs.insert(_place(rng, pairs), (key, value if rng.random() < 0.3 else rng.choice(VALUES)))


def strange(rng: random.Random, pairs: Pairs) -> None:
    """A value of another type, or far away."""
    place = _place(rng, pairs)
    pairs[place] = pairs[place][0], rng.choice(STRANGE)


def misplaced(rng: random.Random, pairs: Pairs) -> None:
    """The value of another field."""
    place = _place(rng, pairs)
    pairs[place] = pairs[place][0], rng.choice(VALUES)


def nested(rng: random.Random, pairs: Pairs) -> None:
    """A value wrapped in lists or maps."""
    place = _place(rng, pairs)
    key, value = pairs[place]
    for _ in range(rng.choice((1, 2, 3, 40, 600))):
        value = [value] if rng.random() < 0.5 else {"kind": value}
    pairs[place] = key, value


def unknown(rng: random.Random, pairs: Pairs) -> None:
    """Keys that nobody knows, sometimes many."""
    for number in range(rng.choice((1, 1, 1, 1, 2, 3, 3, 3, 3, 300))):
        pairs.append((rng.choice(("x", "", 7, b"x", None, f"k{number}")), rng.choice(STRANGE)))


def shortened(rng: random.Random, pairs: Pairs) -> None:
    """A column that is too short, too long, or odd."""
    place = _of(rng, pairs, (bytes, list, str))
    if place is None:
        return
    key, value = pairs[place]
    item = rng.choice((1, 2, 8, 8, 8, 32))
    how = rng.random()
    if how < 0.4:
        value = value[: -item or None]
    elif how < 0.8:
        value = value + value[:item]
    else:
        value = value * rng.choice((0, 2, 3, 50))
    pairs[place] = key, value


def numbers(rng: random.Random, pairs: Pairs) -> None:
    """NaN, infinite, huge, tiny or negative in a column of numbers."""
    place = _of(rng, pairs, bytes)
    if place is None or len(pairs[place][1]) < 8:
        return
    key, value = pairs[place]
    for _ in range(rng.choice((1, 1, 2, 10))):
        at = 8 * int(rng.random() * (len(value) // 8))
        number = rng.choice(NUMBERS)
        if rng.random() < 0.3:  # of the size of what is there
            number = struct.unpack_from("<d", value, at)[0] * rng.choice((-1.0, 0.0, 1e-3, 1e3, 1e6))
        value = value[:at] + struct.pack("<d", number) + value[at + 8 :]
    pairs[place] = key, value


def whole(rng: random.Random, pairs: Pairs) -> None:
    """Ids, counts and flags that are extreme, or there twice."""
    place = _of(rng, pairs, bytes)
    if place is None or len(pairs[place][1]) < 2:
        return
    key, value = pairs[place]
    size = rng.choice((2, 8) if len(value) >= 8 else (2,))
    at = size * int(rng.random() * (len(value) // size))
    extreme = rng.choice(WHOLE) & (2 ** (8 * size) - 1)
    new = value[:size] if rng.random() < 0.5 else extreme.to_bytes(size, "little")
    pairs[place] = key, value[:at] + new + value[at + size :]


def indefinite(rng: random.Random, pairs: Pairs) -> None:
    """Covariances that are none."""
    place = next((place for place, (key, _) in enumerate(pairs) if key in ("covs", "position_covariance")), None)
    if place is None or not isinstance(pairs[place][1], bytes) or len(pairs[place][1]) % 8:
        return
    key, value = pairs[place]
    items = list(struct.unpack(f"<{len(value) // 8}d", value))
    if not items:
        return
    how = int(rng.random() * 5)
    at = _place(rng, [(None, None)] * len(items))
    if how == 0:
        items[at] = -abs(items[at]) - 1.0
    elif how == 1:
        items[at] = 1e12
    elif how == 2:
        items = [0.0] * len(items)
    elif how == 3:
        items = [one * rng.choice((1e-200, 1e-12, 1e12, 1e200)) for one in items]
    else:
        items = [one * rng.choice((1.0, 1e-8, 1e8, -1.0)) for one in items]
    pairs[place] = key, struct.pack(f"<{len(items)}d", *items)


def header(rng: random.Random, pairs: Pairs) -> None:
    """Time, epoch, sequence, source, lineage: far away, repeated, another's."""
    key = rng.choice(("time", "sent", "epoch", "seq", "source", "lineage", "origin", "v", "type", "complete"))
    place = next((place for place, (name, _) in enumerate(pairs) if name == key), None)
    if place is None:
        return
    value = pairs[place][1]
    choices: tuple[Any, ...]
    if key in ("time", "sent"):
        near = value + rng.choice((-3600, -20, -3, -1, 1, 2, 3, 20, 3600)) * SECOND if isinstance(value, int) else 0
        choices = (near, near, near, rng.choice(TIMES))
    elif key in ("epoch", "seq"):
        near = value + rng.choice((-1, 1, 2, 1000)) if isinstance(value, int) else 0
        choices = (near, max(0, near) if isinstance(near, int) else 0, rng.choice(WHOLE))
    elif key == "type":
        choices = (*{base["type"]: None for base in BASES.values()}, "?")
    elif key == "lineage":
        choices = (None, [], ["r1"], ["global/centre"], ["x", "x"], [f"n{one}" for one in range(500)])
    else:
        choices = STRANGE
    pairs[place] = key, rng.choice(choices)


def inside(rng: random.Random, pairs: Pairs) -> None:
    """One of these in a map, or a list, that stands in the message."""
    place = _of(rng, pairs, (dict, list))
    if place is None:
        return
    key, value = pairs[place]
    if isinstance(value, dict) and value:
        inner: Pairs = list(value.items())
        rng.choice((removed, strange, strange, misplaced, nested, numbers, shortened))(rng, inner)
        pairs[place] = key, {one: other for one, other in inner if one.__hash__ is not None}
    elif value:
        items = list(value)
        items[int(rng.random() * len(items))] = rng.choice(STRANGE)
        pairs[place] = key, items


MUTATIONS: tuple[Mutation, ...] = (
    *(removed, doubled, strange, misplaced, nested, unknown, shortened, numbers, whole, indefinite, header, inside),
)
OFTEN: tuple[Mutation, ...] = (*MUTATIONS, numbers, whole, indefinite, header, inside, shortened)


def _blindly(rng: random.Random, data: bytes) -> bytes:
    """Bits turned over, bytes cut off, put in, or there twice."""
    changed = bytearray(data)
    how = int(rng.random() * 4)
    at = int(rng.random() * (len(changed) or 1))
    if how == 0:
        for _ in range(rng.choice((1, 2, 8))):
            if changed:
                changed[int(rng.random() * len(changed))] ^= 1 << int(rng.random() * 8)
    elif how == 1:
        del changed[at:]
    elif how == 2:
        changed[at:at] = rng.randbytes(rng.choice((1, 2, 9)))
    else:
        changed[at:at] = changed[at : at + rng.choice((1, 8, 64))]
    return bytes(changed)


def mutated(rng: random.Random, base: dict[str, Any]) -> bytes:
    """The message `base`, changed in one place or a few; `base` stays as it is."""
    pairs: Pairs = list(base.items())
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        if pairs:
            rng.choice(OFTEN)(rng, pairs)
    packer = msgpack.Packer(strict_types=False)
    try:
        data = bytes(packer.pack_map_pairs(pairs))
    except (ValueError, OverflowError, TypeError):  # a number that MessagePack cannot hold, nested too deep
        data = bytes(msgpack.packb(base))[:-1]
    return _blindly(rng, data) if rng.random() < 0.12 else data
