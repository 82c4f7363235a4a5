"""Generations of several processes of one centre, and what a process inherits from another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fusion_service.service.state import State, open_state
from fusion_service.service.tenure import terms_held
from fusion_service.service.terms import MOST_GENERATION, NODES, free_node, generation_after, node_of

NONE = np.zeros(0, dtype=np.uint64)


@given(st.lists(st.tuples(st.integers(0, NODES - 1), st.integers(0, 3), st.booleans()), max_size=40))
def test_processes_that_do_not_hear_each_other_never_take_the_same(takes: list[tuple[int, int, bool]]) -> None:
    """Each has its own node; some hear of the greatest generation before they take one, some do not."""
    last, seconds = [0] * NODES, 1000
    taken: list[int] = []
    for node, passed, hears in takes:
        seconds += passed
        last[node] = generation_after(max(last) if hears else last[node], node, seconds)
        assert node_of(last[node]) == node
        assert not hears or all(last[node] > one for one in taken)
        taken.append(last[node])
    assert len(set(taken)) == len(taken)


def test_a_node_of_its_own() -> None:
    assert free_node(0, []) == 0
    assert free_node(2, [0, 1]) == 2
    assert free_node(0, [0]) == 1
    assert free_node(1, [0, 1, 2]) == 3
    assert free_node(1, range(NODES)) == 1


def test_terms_of_tokens_are_numbers_that_can_be() -> None:
    keys = [f"a/v1/global/c/holds/{name}" for name in ("7", "12", "x", "1.5", "", str(MOST_GENERATION), "9" * 30, "٣")]
    assert terms_held(keys) == [7, 12]


def test_what_is_inherited_goes_before_the_own(tmp_path: Path) -> None:
    with open_state(str(tmp_path)) as state:
        assert not state.has_node
        own = state.new_generation()
        state.save(b"own")
        state.note_ended(np.array([1], dtype=np.uint64))
        state.keep_node(3)
        state.inherit(b"other", np.array([5], dtype=np.uint64), own + 1000, 77)
        assert state.load() == b"other"
        assert state.ended().tolist() == [5]
        assert state.load() == b"own"
        assert state.new_generation() > own + 1000
        assert state.epoch_above == 77
        state.inherit(None, NONE, 0, 0)
        assert state.load() == b"own"
        assert state.epoch_above == 77
    with open_state(str(tmp_path)) as state:
        assert state.has_node
        assert node_of(state.new_generation()) == state.node == 3


def test_without_a_folder_it_is_inherited_too() -> None:
    state = State(None)
    state.inherit(b"other", NONE, 5, 5)
    assert state.load() == b"other"
    assert len(state.ended()) == 0
    assert state.load() is None
    state.keep_node(2)
    assert node_of(state.new_generation()) == 2
    assert not state.has_node
