"""WIRE.md and the code say the same."""

from __future__ import annotations

import hashlib
import json
import re

import msgpack
import numpy as np
import pytest

import schemas
from schemas.codec import MAX_ITEMS
from schemas.messages import NO_SOURCE
from schemas.tables import CLASSES, FIELDS
from schemas.values import pack_column, pack_covariances
from tests.schemas.make_vectors import VECTORS, dump, forms, message_forms, pack, page, sections

PAGE = page()
SECTIONS = sections(PAGE)


def test_every_message_has_its_section() -> None:
    messages = {heading for heading in SECTIONS if re.fullmatch(r"[a-z]+_?[a-z]*", heading)}
    assert messages == set(CLASSES)


@pytest.mark.parametrize("kind", CLASSES)
def test_fields_are_those_of_the_codec(kind: str) -> None:
    told = message_forms(kind, PAGE)
    fields = FIELDS[CLASSES[kind]]
    assert list(told) == ["v", "type", *(field.key for field in fields)]
    assert len(forms(SECTIONS["Header"])) + len(forms(SECTIONS[kind])) == len(told), "a field stands twice"
    for field in fields:
        assert told[field.key].optional == field.optional, field.key


@pytest.mark.parametrize("kind", CLASSES)
def test_columns_have_the_type_that_the_page_says(kind: str) -> None:
    for field in FIELDS[CLASSES[kind]]:
        form = message_forms(kind, PAGE)[field.key]
        pack_function = getattr(field.pack, "func", None)
        assert bool(form.letter) == (pack_function in (pack_column, pack_covariances)), field.key
        assert form.triangle == (pack_function is pack_covariances), field.key
        if form.letter:
            assert field.unpack(bytes(8)).dtype == np.dtype("<" + form.letter), field.key


def words(section: str) -> list[str]:
    return re.findall(r"^\| `([^`]+)` \|", SECTIONS[section], flags=re.M)


def test_words_are_those_of_the_code() -> None:
    assert words("Refusals") == [*schemas.REASONS, *schemas.FAULTS[1:]]
    units = {
        component: unit
        for names, unit in re.findall(r"^\| ((?:`\w+` ?)+) \| (\S+) \|", SECTIONS["State spaces"], flags=re.M)
        for component in re.findall(r"\w+", names)
    }
    assert units == schemas.COMPONENTS
    for numbered, found in ((schemas.STATUSES, "status"), (schemas.DECISIONS, "decision_kind")):
        assert any(
            f"| `{found}` |" in line and ", ".join(f"{k} {word}" for k, word in enumerate(numbered)) in line
            for line in PAGE.splitlines()
        )
    assert all(f"`{origin}`" in SECTIONS["Header"] for origin in schemas.ORIGINS)
    kinds = set(re.findall(r'^\| `\{"kind": "(\w+)"', PAGE, flags=re.M))
    assert kinds == {"enu", "ecef", "local", "disk", "sector", "polygon", *schemas.MOTIONS}


def test_numbers_are_those_of_the_code() -> None:
    assert f"{schemas.MAX_BYTES:,} bytes" in PAGE
    assert f"{MAX_ITEMS:,} items" in PAGE
    assert str(NO_SOURCE) in SECTIONS["step_log"]
    assert f"`{schemas.REALM}` unless configured" in SECTIONS["Keys"]


def test_keys_are_those_that_parse() -> None:
    names = {"realm": "a/b", "source": "s", "centre": "c", "scenario": "t", "term": 7, "step": 8, "name": "n"}
    names |= {"operator": "o", "recorder": "r"}
    told = [key.format_map(names) for key in re.findall(r"^\| `(\{realm\}[^`]+)` \|", SECTIONS["Keys"], flags=re.M)]
    built = [schemas.local_key("s", what, "a/b") for what in ("tracks", "intensity", "info", "alive")]
    built += [
        schemas.global_key("c", what, "a/b") for what in ("tracks", "log", "status", "alive", "picture", "orders")
    ]
    built += [schemas.order_key("c", "o", "a/b"), schemas.global_key("c", "state", "a/b")]
    tokens = ("holds", "7"), ("yields", "7.8"), ("standby", "n")
    built += [schemas.token_key("c", what, name, "a/b") for what, name in tokens]
    built += [schemas.record_key("r", what, "a/b") for what in ("alive", "state")]
    assert told == [*built, schemas.truth_key("t", "a/b")]


def test_the_worked_example_is_the_golden_message() -> None:
    shown = re.search(r"```\n(.+?)\n```", SECTIONS["A worked example"], flags=re.S)
    assert shown is not None
    meaning = json.loads((VECTORS / "local_tracks_small.json").read_text(encoding="utf-8"))
    assert shown[1] == dump(meaning, pack(meaning, PAGE))
    code = "".join(line for line in shown[1].splitlines() if not line.startswith(" "))
    assert bytes.fromhex(code) == (VECTORS / "local_tracks_small.msgpack").read_bytes()


def test_digest_is_what_the_page_says() -> None:
    for path in VECTORS.glob("*.msgpack"):
        data = path.read_bytes()
        told = int.from_bytes(hashlib.sha256(data).digest()[:8], "little")
        assert schemas.digest(schemas.decode(data)) == told
        raw = msgpack.unpackb(data)
        other_order = {key: raw[key] for key in reversed(raw)} | {"unknown": [1, 2]}
        assert schemas.digest(schemas.decode(msgpack.packb(other_order))) == told, "another writer's bytes"


def test_digest_of_maps_is_the_same_with_defaults_left_out_and_integers_for_floats() -> None:
    raw = msgpack.unpackb((VECTORS / "sensor_info_minimal.msgpack").read_bytes())
    told = schemas.digest(schemas.decode(msgpack.packb(raw)))
    raw["motion"] = {"q": 0, "kind": "cv"}
    raw["position"], raw["period"] = [1, 2, 3], 1
    assert schemas.digest(schemas.decode(msgpack.packb(raw))) == told
    raw["period"] = 2
    assert schemas.digest(schemas.decode(msgpack.packb(raw))) != told
