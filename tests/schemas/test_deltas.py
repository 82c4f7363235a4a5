"""Deltas and what they make together, against a picture kept as a plain map of tracks."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from schemas import GlobalTracks, Wholes, merged, tracks_at

SEEDS = range(12)


def drawn(rng: random.Random, ids: list[int], rich: bool, **more: Any) -> GlobalTracks:
    """A picture of these tracks, of all columns if `rich`."""
    draw = np.random.default_rng(rng.randrange(2**32))
    sources = tuple(rng.sample(["a", "b", "c", "d"], rng.randint(1, 4)))
    count, given = len(ids), draw.integers(0, 3, len(ids)).astype(np.uint16)
    total = int(given.sum())
    parts = draw.integers(1, 3, count).astype(np.uint16) if rich else np.ones(count, dtype=np.uint16)
    columns: dict[str, Any] = {}
    if rich:
        names = tuple(rng.sample(["a", "b", "c", "d", "e", "f", "g", "h", "i", "j"], 9))
        columns = {
            "counts": parts,
            "weights": np.concatenate([np.full(n, 1 / n) for n in parts.tolist()] or [np.zeros(0)]),
            "rules": ("ci", "tracklet"),
            "track_rule": draw.integers(0, 2, count).astype(np.uint8),
            "identity": tuple(rng.choice([None, "mmsi:1"]) for _ in ids),
            "kind_p": draw.uniform(size=count),
            "marks": draw.integers(0, 4, count).astype(np.uint8),
            "number": draw.integers(0, 9, count).astype(np.uint32),
            "extent": draw.uniform(1, 2, (count, 3)),
            "lineage": names,
            "track_lineage": np.packbits(draw.integers(0, 2, (count, 9)).astype(np.uint8), axis=1, bitorder="little"),
        }
    rows = int(parts.sum())
    return GlobalTracks(
        source="c", epoch=5, seq=1, sent=1, time=rng.randrange(10**9), step=1, rule="ci", space=("x", "y"),
        frame=schemas.Local("here"), ids=np.array(ids, dtype=np.uint64),
        status=draw.integers(0, 3, count).astype(np.uint8), existence=draw.uniform(size=count),
        means=draw.normal(size=(rows, 2)),
        covariances=np.tile(np.eye(2), (rows, 1, 1)) * draw.uniform(1, 2, (rows, 1, 1)),
        updated=draw.integers(0, 9, count), sources=sources, contributor_counts=given,
        contributor_source=draw.integers(0, len(sources), total).astype(np.uint16),
        contributor_epoch=draw.integers(0, 9, total).astype(np.uint64),
        contributor_id=draw.integers(0, 9, total).astype(np.uint64), contributor_influence=draw.uniform(size=total),
        **(columns | more),
    )  # fmt: skip


def said(picture: GlobalTracks) -> dict[int, tuple[Any, ...]]:
    """What a picture says of each track, independent of how it is laid out."""
    found = {}
    part = given = 0
    for row, track in enumerate(picture.ids.tolist()):
        count = 1 if picture.counts is None else int(picture.counts[row])
        some, part = slice(part, part + count), part + count
        fed, given = (
            slice(given, given + int(picture.contributor_counts[row])),
            given + int(picture.contributor_counts[row]),
        )
        names = picture.lineage or (picture.source,)
        bits = picture.track_lineage
        lineage = {name for k, name in enumerate(names) if bits is None or (int(bits[row, k // 8]) >> (k % 8)) & 1}
        found[track] = (
            int(picture.status[row]), float(picture.existence[row]), int(picture.updated[row]),
            picture.means[some].tolist(), picture.covariances[some].tolist(),
            [1.0] if picture.weights is None else picture.weights[some].tolist(),
            [picture.sources[k] for k in picture.contributor_source[fed].tolist()],
            picture.contributor_id[fed].tolist(), picture.contributor_influence[fed].tolist(),
            picture.rule if picture.rules is None else picture.rules[picture.track_rule[row]],  # type: ignore[index]
            None if picture.identity is None else picture.identity[row],
            0 if picture.marks is None else int(picture.marks[row]),
            0 if picture.number is None else int(picture.number[row]),
            None if picture.extent is None or np.isnan(picture.extent[row, 0]) else picture.extent[row].tolist(),
            frozenset(lineage),
        )  # fmt: skip
    return found


@pytest.mark.parametrize("seed", SEEDS)
def test_deltas_make_the_picture_that_a_map_of_tracks_makes(seed: int) -> None:
    print("seed", seed)
    rng = random.Random(seed)
    whole: GlobalTracks | None = drawn(rng, sorted(rng.sample(range(1, 40), 12)), rich=bool(seed % 2))
    assert whole is not None
    expected = said(whole)
    for _ in range(8):
        there = sorted(expected)
        listed = sorted({*rng.sample(there, min(4, len(there))), rng.randrange(40, 99)})
        ended = [track for track in there if track not in listed and rng.random() < 0.2]
        rows = tuple((track, "lost", None) for track in ended)
        message = drawn(rng, listed, rich=rng.random() < 0.5, delta=True, ended=rows)
        received = schemas.decode(schemas.encode(message))
        assert isinstance(received, GlobalTracks)
        assert received.delta
        whole = merged(whole, received)
        assert whole is not None
        assert not whole.delta
        assert (whole.time, whole.ended) == (message.time, message.ended)
        expected = {k: v for k, v in expected.items() if k not in ended} | said(received)
        assert whole.ids.tolist() == sorted(expected)
        assert said(whole) == expected
        assert said(schemas.decode(schemas.encode(whole))) == expected  # type: ignore[arg-type]


def test_a_delta_waits_for_a_full_picture_of_its_own_run() -> None:
    rng = random.Random(1)
    full, delta = drawn(rng, [1, 2], rich=False), drawn(rng, [2], rich=False, delta=True)
    assert merged(None, delta) is None
    assert merged(full, full) is full
    for other in ({"epoch": 6}, {"space": ("y", "x")}, {"frame": schemas.Local("there")}, {"source": "d"}):
        assert merged(replace(full, **other), delta) is None
    wholes = Wholes()
    assert wholes.of(delta) is None
    assert wholes.of(full) is full
    assert wholes.of(replace(delta, epoch=6)) is None
    found = wholes.of(delta)
    assert found is not None
    assert found.ids.tolist() == [1, 2]


def test_nothing_at_all_is_merged_and_cut() -> None:
    rng = random.Random(2)
    full = drawn(rng, [], rich=False)
    found = merged(full, drawn(rng, [], rich=False, delta=True))
    assert found is not None
    assert len(found.ids) == len(found.means) == 0
    cut = tracks_at(drawn(rng, [3, 4], rich=True), np.zeros(0, dtype=np.intp))
    assert len(cut.ids) == len(cut.means) == len(cut.contributor_id) == 0
    schemas.encode(cut)
