"""Writes `schemas/vectors/*.msgpack` from the `*.json` beside them: `python -m tests.schemas.make_vectors`.

The JSON files are written by hand and are the truth. This encoder knows only what WIRE.md says: the form of each
field is read from its tables, numbers are packed by `struct`; nothing of the codec is used.
`--dump NAME` prints a message key by key.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import msgpack

SCHEMAS = Path(__file__).parents[2] / "schemas"
VECTORS = SCHEMAS / "vectors"
LETTERS = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "i64": "q", "f64": "d"}
ROW = re.compile(r"\| `(\w+)` \| ([^|]+?) \|")


class Form(NamedTuple):
    """What WIRE.md says of a field; `letter` is the struct letter of a column, "" for the rest."""

    letter: str
    triangle: bool
    optional: bool


def page() -> str:
    """WIRE.md."""
    return (SCHEMAS / "WIRE.md").read_text(encoding="utf-8")


def sections(text: str) -> dict[str, str]:
    """Heading -> the text below it, up to the next heading."""
    parts = re.split(r"^#+ (.+)$", text, flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def forms(section: str) -> dict[str, Form]:
    """Field -> form, in the order of a section's table."""
    found = {}
    for key, form in ROW.findall(section):
        column = re.match(r"bin (\w+)\[(.+?)\]", form)
        triangle = column is not None and key.endswith(("covs", "covariance"))
        found[key] = Form(LETTERS[column[1]] if column else "", triangle, "optional" in form)
    return found


def message_forms(kind: str, text: str) -> dict[str, Form]:
    """All fields of a message, the header's first."""
    parts = sections(text)
    return {**forms(parts["Header"]), **forms(parts[kind])}


def _flat(value: Any) -> list[Any]:
    return [leaf for item in value for leaf in _flat(item)] if isinstance(value, list) else [value]


def _column(form: Form, value: list[Any]) -> bytes:
    if form.triangle:
        matrices = value if value and isinstance(value[0][0], list) else [value] if value else []
        value = [[matrix[i][: i + 1] for i in range(len(matrix))] for matrix in matrices]
    numbers = [math.nan if number is None else number for number in _flat(value)]
    return struct.pack(f"<{len(numbers)}{form.letter}", *numbers)


def pack(meaning: dict[str, Any], text: str) -> dict[str, Any]:
    """The map that goes on the wire for the meaning in a JSON file."""
    known = message_forms(meaning["type"], text)
    order = list(known)
    assert sorted(meaning, key=order.index) == list(meaning), "keys in another order than WIRE.md's"
    return {
        key: _column(known[key], value) if known[key].letter else _platform(value, text) if key == "platform" else value
        for key, value in meaning.items()
    }


def _platform(value: dict[str, Any], text: str) -> dict[str, Any]:
    known = forms(sections(text)["Platform"])
    return {key: _column(known[key], one) if known[key].letter else one for key, one in value.items()}


def dump(meaning: dict[str, Any], wire: dict[str, Any]) -> str:
    """The bytes of a message in hexadecimal, one key with its value a line, and what they mean below."""
    lines = [msgpack.Packer().pack_map_header(len(wire)).hex(), f"    a map of {len(wire)}"]
    for key, value in wire.items():
        lines.append(f"{msgpack.packb(key).hex()} {msgpack.packb(value).hex()}")
        lines.append(f"    {key}: {json.dumps(meaning[key])}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the golden messages from their meaning.")
    parser.add_argument("--dump", metavar="NAME", help="print one message in hexadecimal instead")
    name = parser.parse_args().dump
    text = page()
    for path in [VECTORS / f"{name}.json"] if name else sorted(VECTORS.glob("*.json")):
        meaning = json.loads(path.read_text(encoding="utf-8"))
        wire = pack(meaning, text)
        if name:
            print(dump(meaning, wire))
        else:
            path.with_suffix(".msgpack").write_bytes(msgpack.packb(wire))
            print(path.stem)


if __name__ == "__main__":
    main()
