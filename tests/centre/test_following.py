"""How tracks follow components: numbers by evidence, matching against taking pair by pair, lives by data."""

from __future__ import annotations

import numpy as np
import pytest

from fusion_service.centre.following import Memory, assign, carried, next_number, ranked


def numbers(weights: list[float], start: int = 1, error: float = 0.1) -> list[int]:
    number, lean = np.array([start]), np.zeros(1)
    out = []
    for weight in weights:
        number, lean = next_number(number, lean, np.array([weight]), error)
        out.append(int(number[0]))
    return out


def test_a_weight_that_wavers_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    wavering = rng.uniform(1.4, 1.6, 5000).tolist()
    assert set(numbers(wavering, 1)) == {1}
    assert set(numbers(wavering, 2)) == {2}
    assert set(numbers([1.4, 1.6] * 500, 2)) == {2}


@pytest.mark.parametrize("error", [0.01, 0.1, 0.3])
@pytest.mark.parametrize("weight", [1.7, 1.9, 1.97])
def test_a_weight_that_stays_changes_it_by_the_odds(weight: float, error: float) -> None:
    """Written out as odds: x / (1 - x), less the odds 3 : 2, multiplied until they are (1 - e) : e."""
    odds, count = 1.0, 0
    while odds < (1 - error) / error:
        odds *= (weight - 1) / (2 - weight) / 1.5
        count += 1
    assert numbers([weight] * (count + 1), 1, error) == [1] * (count - 1) + [2] * 2
    assert numbers([3 - weight] * (count + 1), 2, error) == [2] * (count - 1) + [1] * 2


def test_whole_targets_change_it_at_once_and_contrary_data_take_evidence_back() -> None:
    assert numbers([2.0]) == [2]
    assert numbers([3.5, 3.5]) == [3, 3]
    assert numbers([1.0], 2) == [1]
    assert numbers([1.7, 1.7, 0.9] * 50) == [1] * 150


def by_pairs(i: list[int], j: list[int], cost: list[float], tracks: int, room: list[int]) -> list[int]:
    place, room = [-1] * tracks, list(room)
    for _, a, b in sorted(zip(cost, i, j, strict=True)):
        if place[a] < 0 and room[b] > 0:
            place[a] = b
            room[b] -= 1
    return place


@pytest.mark.parametrize("seed", range(20))
def test_tracks_are_matched_as_by_taking_pair_by_pair(seed: int) -> None:
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    tracks, components = int(rng.integers(1, 60)), int(rng.integers(1, 25))
    chosen = np.flatnonzero(rng.random(tracks * components) < 0.3)
    i, j = chosen // components, chosen % components
    cost = rng.integers(0, 40, len(i)) / 4.0
    weight = rng.uniform(0.1, 4.0, components)
    memory = Memory.blank(np.arange(1, tracks + 1, dtype=np.uint64), 0)
    room = [max(1, int(np.floor(w + 0.5))) for w in weight]
    found = assign(i, j, cost, memory, weight).tolist()
    assert found == by_pairs(i.tolist(), j.tolist(), cost.tolist(), tracks, room)


def test_states_by_rank_are_the_heaviest_parts() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        weight = rng.uniform(0.0, 3.5, 6)
        total = int(rng.integers(0, 9))
        parts = sorted(((w - k, c) for c, w in enumerate(weight) for k in range(4) if w > k), reverse=True)[:total]
        expected = np.bincount([c for _, c in parts], minlength=6) if parts else np.zeros(6)
        np.testing.assert_array_equal(ranked(weight, np.zeros(6, dtype=np.intp), total), expected)
    assert ranked(np.array([1.4, 0.45]), np.array([2, 0]), 2).tolist() == [2, 0]
    assert ranked(np.array([1.4, 0.45]), np.array([1, 1]), 2).tolist() == [1, 1]
    assert ranked(np.array([1.6, 0.45]), np.array([2, 0]), 2).tolist() == [2, 0]


def test_who_stood_there_stays_and_of_those_the_older() -> None:
    blank = Memory.blank(np.arange(1, 5, dtype=np.uint64), 0)
    memory = Memory(
        blank.id, blank.hits, blank.supported, np.array([False, True, True, False]), blank.shared, blank.lean
    )
    place, number = np.zeros(4, dtype=np.intp), np.array([3])
    assert carried(place, number, memory).tolist() == [0, 0, 0, -1]
    assert carried(place, np.array([1]), memory).tolist() == [-1, 0, -1, -1]


def test_memory_is_kept_by_id_and_comes_back() -> None:
    blank = Memory.blank(np.array([3, 7, 2**40], dtype=np.uint64), 5)
    memory = Memory(blank.id, blank.hits + np.uint64(3), blank.supported, ~blank.held, blank.shared, blank.lean + 0.1)
    other = memory.of(np.array([1, 7, 9], dtype=np.uint64), 11)
    assert other.hits.tolist() == [0, 3, 0]
    assert other.supported.tolist() == [11, 5, 11]
    again = Memory.unpack(memory.pack())
    for name in ("id", "hits", "supported", "held", "shared", "lean"):
        assert getattr(again, name).tobytes() == getattr(memory, name).tobytes()
    with pytest.raises(ValueError, match="lengths"):
        Memory.unpack({**memory.pack(), "lean": [0.0]})
