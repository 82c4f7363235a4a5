"""The golden messages: what the codec reads is what their JSON says, and it writes the same bytes."""

from __future__ import annotations

import json
import math
import struct
from itertools import islice
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from tests.schemas.make_vectors import VECTORS, message_forms, page

NAMES = sorted(path.stem for path in VECTORS.glob("*.json"))
ATTRIBUTES = {"covs": "covariances", "reference_covs": "reference_covariances"}


def golden(name: str) -> tuple[bytes, dict[str, Any]]:
    path = Path(VECTORS / name)
    meaning: dict[str, Any] = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    return path.with_suffix(".msgpack").read_bytes(), meaning


def plain(value: Any) -> Any:
    """What was decoded, as JSON would say it."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    if isinstance(value, schemas.Entry):
        return [value.source, value.epoch, value.seq, value.hash, value.reason, value.count]
    if isinstance(value, schemas.Motion):
        return {"kind": value.kind} | {name: plain(getattr(value, name)) for name in schemas.MOTIONS[value.kind]}
    if isinstance(value, schemas.Platform):
        said = {name: plain(getattr(value, name)) for name in value.__slots__}
        return {name: one for name, one in said.items() if one is not None}
    if hasattr(value, "__slots__"):
        kind = {} if isinstance(value, schemas.Height) else {"kind": value.kind}
        return kind | {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def exactly(left: Any, right: Any) -> bool:
    """Equal, and of the same types all the way down: 1 is not 1.0, and -0.0 not 0.0."""
    return repr(left) == repr(right)


@pytest.mark.parametrize("name", NAMES)
def test_decodes_to_its_meaning(name: str) -> None:
    data, meaning = golden(name)
    message = schemas.decode(data)
    assert message.type == meaning["type"]
    for key in message_forms(meaning["type"], page()):
        if key in ("v", "type"):
            continue
        if key.startswith("decision_") and isinstance(message, schemas.StepLog):
            value = getattr(message.decisions, key.removeprefix("decision_"))
        else:
            value = getattr(message, ATTRIBUTES.get(key, key))
        assert exactly(plain(value), meaning.get(key)), key


@pytest.mark.parametrize("name", NAMES)
def test_encodes_to_the_same_bytes(name: str) -> None:
    data, _ = golden(name)
    assert schemas.encode(schemas.decode(data)) == data


def test_every_message_and_every_optional_field_with_and_without() -> None:
    meanings = [golden(name)[1] for name in NAMES]
    for kind in ("local_tracks", "local_intensity", "sensor_info", "global_tracks", "step_log", "status", "truth"):
        mine = [meaning for meaning in meanings if meaning["type"] == kind]
        for key, form in message_forms(kind, page()).items():
            assert any(key in meaning for meaning in (meanings if key == "lineage" else mine)), (kind, key)
            if form.optional:
                assert any(key not in meaning for meaning in mine), (kind, key)


def test_numbers_of_all_are_sound() -> None:
    read = [schemas.decode(golden(name)[0]) for name in NAMES]
    densities = [m for m in read if isinstance(m, (schemas.LocalTracks, schemas.LocalIntensity, schemas.GlobalTracks))]
    assert len(densities) >= 11
    for faults in schemas.check_numbers(densities):
        assert not faults.any()


def tracks_by_the_page(data: bytes) -> list[dict[str, Any]]:
    """Local or global tracks one by one, read as WIRE.md says with struct and nothing of ours."""
    raw = msgpack.unpackb(data)
    assert raw["v"] == 1

    def column(key: str, letter: str) -> list[Any]:
        return list(struct.unpack(f"<{len(raw[key]) // struct.calcsize('<' + letter)}{letter}", raw[key]))

    ids = column("ids", "Q")
    n = len(raw["space"])
    counts = column("counts", "H") if "counts" in raw else [1] * len(ids)
    weights = iter(column("weights", "d") if "weights" in raw else [1.0] * len(ids))
    means, covariances = iter(column("means", "d")), iter(column("covs", "d"))
    tracks = []
    for index, track in enumerate(ids):
        components = []
        for _ in range(counts[index]):
            mean = list(islice(means, n))
            matrix = [[0.0] * n for _ in range(n)]
            for i in range(n):
                for j in range(i + 1):
                    matrix[i][j] = matrix[j][i] = next(covariances)
            components.append((next(weights), mean, matrix))
        tracks.append({"id": track, "components": components})
        for key, letter in (("existence", "d"), ("updated", "q")):
            if key in raw:
                tracks[-1][key] = column(key, letter)[index]
    assert next(means, None) is next(covariances, None) is next(weights, None) is None
    if raw["type"] == "global_tracks":
        each = zip(
            (raw["sources"][k] for k in column("contributor_source", "H")),
            column("contributor_epoch", "Q"),
            column("contributor_id", "Q"),
            column("contributor_influence", "d"),
            strict=True,
        )
        for track, count, status in zip(tracks, column("contributor_counts", "H"), raw["status"], strict=True):
            track["contributors"] = list(islice(each, count))
            track["status"] = ("tentative", "confirmed", "coasting")[status]
        assert next(each, None) is None
    return tracks


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(("local_tracks", "global_tracks"))])
def test_a_reader_made_from_the_page_sees_the_same_tracks(name: str) -> None:
    data, meaning = golden(name)
    tracks = tracks_by_the_page(data)
    assert [track["id"] for track in tracks] == meaning["ids"]
    components = [component for track in tracks for component in track["components"]]
    assert [mean for _, mean, _ in components] == meaning["means"]
    assert [matrix for _, _, matrix in components] == meaning["covs"]
    message = schemas.decode(data)
    assert isinstance(message, (schemas.LocalTracks, schemas.GlobalTracks))
    assert np.array_equal(message.means, np.array([mean for _, mean, _ in components]).reshape(message.means.shape))
    if message.weights is not None:
        assert message.weights.tolist() == [weight for weight, _, _ in components]
    for key in {"existence", "updated"} & set(meaning):
        assert [track[key] for track in tracks] == meaning[key]


def test_contributions_of_the_golden_picture() -> None:
    """The meaning of the contributor columns, told by hand."""
    first, second, third = tracks_by_the_page(golden("global_tracks")[0])
    assert first["contributors"] == [("radar-2", 1779999999999999993, 2**64 - 1, 1.0)]
    assert second["contributors"] == [
        ("radar-1", 1779999999999999991, 0, 0.40625),
        ("radar-2", 1779999999999999993, 12, 0.59375),
    ]
    assert third["contributors"] == []
    assert [track["status"] for track in (first, second, third)] == ["tentative", "confirmed", "coasting"]


def test_a_reader_of_before_sees_the_same_picture() -> None:
    """What came to `global_tracks` later is left out, as a reader does that does not know it."""
    later = ("identity", "identity_p", "kind", "kind_p", "track_origin", "marks", "number", "callsign")
    raw = msgpack.unpackb(golden("global_tracks_identified")[0])
    known = {key: value for key, value in raw.items() if key not in later}
    assert len(raw) == len(known) + len(later)
    assert msgpack.packb(known | {"seq": 41}) == golden("global_tracks")[0]
    message = schemas.decode(msgpack.packb(known))
    assert isinstance(message, schemas.GlobalTracks)
    assert all(getattr(message, name) is None for name in later)


@pytest.mark.parametrize(("field", "value"), [("track_origin", [0, 1, 4]), ("track_origin", [0, 1]), ("marks", [])])
def test_columns_of_a_picture_that_do_not_fit_are_refused(field: str, value: list[int]) -> None:
    raw = msgpack.unpackb(golden("global_tracks_identified")[0])
    with pytest.raises(schemas.MessageError, match=field):
        schemas.decode(msgpack.packb(raw | {field: bytes(value)}))
