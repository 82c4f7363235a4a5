"""Numeric checks: what is sound passes, what is not gets its fault, and one bad track spoils no other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import schemas

SPACES = {
    2: ("x", "y"),
    3: ("x", "y", "z"),
    4: ("x", "vx", "y", "vy"),
    6: ("x", "vx", "y", "vy", "z", "vz"),
    9: ("x", "vx", "ax", "y", "vy", "ay", "z", "vz", "az"),
}
HEAD: dict[str, Any] = {"source": "s", "epoch": 1, "seq": 0, "sent": 0, "time": 0, "frame": schemas.Local("here")}


def covariances(random: np.random.Generator, count: int, n: int) -> NDArray[np.float64]:
    """Positive definite, with deviations from 1e-3 to 1e3."""
    factors = random.normal(size=(count, n, n))
    scale = 10.0 ** random.uniform(-3, 3, size=(count, n))
    matrices = (factors @ factors.swapaxes(1, 2) + np.eye(n)) * scale[:, :, None] * scale[:, None, :]
    return (matrices + matrices.swapaxes(1, 2)) / 2


def tracks(seed: int, count: int = 5, n: int = 4, mixtures: bool = False) -> schemas.LocalTracks:
    random = np.random.default_rng(seed)
    counts = random.integers(1, 4, size=count).astype(np.uint16) if mixtures else None
    components = count if counts is None else int(counts.sum())
    weights = None
    if counts is not None:
        owner = np.repeat(np.arange(count), counts)
        raw = random.uniform(0.1, 1.0, size=components)
        weights = raw / np.bincount(owner, raw, minlength=count)[owner]
    return schemas.LocalTracks(
        **HEAD,
        complete=True,
        space=SPACES[n],
        ids=np.arange(count, dtype=np.uint64),
        means=random.normal(scale=1e4, size=(components, n)),
        covariances=covariances(random, components, n),
        counts=counts,
        weights=weights,
        existence=random.uniform(size=count),
    )


def faults(*messages: Any) -> list[list[str]]:
    return [[schemas.FAULTS[code] for code in codes] for codes in schemas.check_numbers(messages)]


def with_value(array: NDArray[np.float64], at: tuple[int, ...], value: float) -> NDArray[np.float64]:
    changed = array.copy()
    changed[at] = value
    if len(at) == 3:
        changed[at[0], at[2], at[1]] = value
    return changed


def with_matrix(message: schemas.LocalTracks, track: int, matrix: Any) -> schemas.LocalTracks:
    changed = message.covariances.copy()
    changed[track] = matrix
    return replace(message, covariances=changed)


@pytest.mark.parametrize("n", SPACES)
@pytest.mark.parametrize("mixtures", [False, True])
def test_sound_tracks(n: int, mixtures: bool) -> None:
    for codes in schemas.check_numbers([tracks(seed, 50, n, mixtures) for seed in range(20)]):
        assert codes.shape == (50,)
        assert codes.dtype == np.uint8
        assert not codes.any()


def test_nothing_is_nothing() -> None:
    assert schemas.check_numbers([]) == []
    empty = tracks(0, 0)
    assert faults(empty, tracks(1, 2), empty) == [[], ["", ""], []]
    none = np.zeros(0)
    assert faults(replace(empty, counts=none.astype(np.uint16), weights=none), tracks(1, 1, mixtures=True)) == [
        [],
        [""],
    ]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_anywhere_spoils_its_track_only(value: float) -> None:
    message = tracks(3)
    expected = ["", "", "not-finite", "", ""]
    for i in range(4):
        assert faults(replace(message, means=with_value(message.means, (2, i), value))) == [expected]
        for j in range(i + 1):
            assert faults(replace(message, covariances=with_value(message.covariances, (2, i, j), value))) == [expected]


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.zeros((4, 4)), "not-positive-definite"),
        (-np.eye(4), "not-positive-definite"),
        (np.diag([1.0, 1.0, 0.0, 1.0]), "not-positive-definite"),
        (np.diag([1.0, 1.0, 1.0, -1e-9]), "not-positive-definite"),
        (np.ones((4, 4)), "not-positive-definite"),
        (np.eye(4) + 1.1 * (np.ones((4, 4)) - np.eye(4)), "not-positive-definite"),
        (np.diag([1.0, 1.0, 1.0, 1.1e24]), "out-of-range"),
        (np.diag([1.0, 1.0, 1.0, 1e300]), "out-of-range"),
        (np.diag([1.0, 1.0, 1.0, 0.9e-20]), "out-of-range"),
        (np.diag([1e-20, 1e24, 1.0, 1.0]), ""),
        (np.eye(4) + 0.999 * (np.ones((4, 4)) - np.eye(4)), ""),
    ],
)
def test_covariances(matrix: NDArray[np.float64], fault: str) -> None:
    assert faults(with_matrix(tracks(4), 1, matrix)) == [["", fault, "", "", ""]]
    assert faults(with_matrix(tracks(4, 1), 0, matrix)) == [[fault]]


@pytest.mark.parametrize(("pivot", "fault"), [(5e-14, ""), (5e-15, "not-positive-definite")])
def test_smallest_pivot(pivot: float, fault: str) -> None:
    """Two components of equal variance with correlation r: the second pivot is 1 - r^2 of it."""
    correlation = np.sqrt(1 - pivot)
    matrix = 1e6 * np.array([[1.0, correlation], [correlation, 1.0]])
    assert faults(with_matrix(tracks(12, 2, 2), 1, matrix)) == [["", fault]]


def test_means_out_of_range() -> None:
    message = tracks(5)
    assert faults(replace(message, means=with_value(message.means, (0, 3), -1.01e12))) == [["out-of-range", *[""] * 4]]
    assert faults(replace(message, means=with_value(message.means, (0, 3), -1e12))) == [[""] * 5]


@pytest.mark.parametrize("n", SPACES)
def test_condition_of_1e12_passes_and_its_indefinite_twin_does_not(n: int) -> None:
    """Random axes, eigenvalues from 1 to 1e-12; with the least one turned negative it is indefinite."""
    random = np.random.default_rng(6)
    message = tracks(6, 200, n)
    axes = np.linalg.qr(random.normal(size=(200, n, n)))[0]
    for least, fault in ((1e-12, ""), (-1e-12, "not-positive-definite")):
        values = np.geomspace(1.0, 1e-12, n)
        values[-1] = least
        matrices = np.einsum("bij,j,bkj->bik", axes, values, axes)
        message = replace(message, covariances=(matrices + matrices.swapaxes(1, 2)) / 2)
        assert set(faults(message)[0]) == {fault}


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(SPACES)))
@settings(max_examples=50, deadline=None)
def test_definite_is_what_the_eigenvalues_say(seed: int, n: int) -> None:
    """Clearly definite or clearly indefinite correlation matrices, however the components are scaled."""
    random = np.random.default_rng(seed)
    raw = random.normal(size=(100, n, n))
    matrices = raw + raw.swapaxes(1, 2) + 2 * np.eye(n) * random.uniform(0, n, size=(100, 1, 1))
    diagonal = np.einsum("bii->bi", matrices)
    diagonal[...] = np.abs(diagonal) + 0.1
    deviation = np.sqrt(diagonal)
    least = np.linalg.eigvalsh(matrices / deviation[:, :, None] / deviation[:, None, :])[:, 0]
    clear = np.abs(least) > 1e-6
    scale = 10.0 ** random.uniform(-4, 4, size=(100, n))
    message = replace(tracks(seed, 100, n), covariances=matrices * scale[:, :, None] * scale[:, None, :])
    sound = schemas.check_numbers([message])[0] == 0
    assert np.array_equal(sound[clear], least[clear] > 0)


@pytest.mark.parametrize(
    ("values", "sound"),
    [
        ((0.5, 0.5), True),
        ((1.0, 0.0), True),
        ((0.5, 0.5000005), True),
        ((0.5, 0.51), False),
        ((0.5, 0.4), False),
        ((1.5, -0.5), False),
        ((np.nan, 1.0), False),
        ((np.inf, 0.5), False),
        ((0.0, 0.0), False),
    ],
)
def test_weights(values: tuple[float, float], sound: bool) -> None:
    message = tracks(7, 4)
    message = replace(
        message,
        ids=message.ids[:3],
        existence=None,
        counts=np.array([1, 2, 1], np.uint16),
        weights=np.array([1.0, *values, 1]),
    )
    assert faults(message) == [["", "" if sound else "weights", ""]]


def test_weights_without_counts() -> None:
    assert faults(replace(tracks(8, 3), weights=np.array([1.0, 0.5, 1.0]))) == [["", "weights", ""]]


@pytest.mark.parametrize("value", [-1e-9, 1.0000001, np.nan, np.inf, -np.inf])
def test_existence(value: float) -> None:
    message = tracks(9, 3)
    assert faults(replace(message, existence=np.array([0.0, value, 1.0]))) == [["", "existence", ""]]


def test_a_bad_component_marks_its_track_only() -> None:
    message = tracks(10, 4)
    message = replace(
        message, ids=message.ids[:2], existence=None, counts=np.array([2, 2], np.uint16), weights=np.full(4, 0.5)
    )
    assert faults(with_matrix(message, 3, -np.eye(4))) == [["", "not-positive-definite"]]
    assert faults(with_matrix(message, 1, np.full((4, 4), np.nan))) == [["not-finite", ""]]


def test_intensity_weights_are_a_mass() -> None:
    random = np.random.default_rng(11)
    weights = np.array([0.0, 3.5, -0.1, np.nan, np.inf, 1.0])
    message = schemas.LocalIntensity(
        **HEAD, space=SPACES[4], weights=weights, means=np.zeros((6, 4)), covariances=covariances(random, 6, 4)
    )
    assert faults(message) == [["", "", "weights", "weights", "weights", ""]]


def broken(seed: int) -> schemas.LocalTracks:
    """A message in which about half of the numbers' owners have some fault."""
    random = np.random.default_rng(seed)
    n = int(random.choice(list(SPACES)))
    message = tracks(seed, int(random.integers(0, 30)), n, mixtures=bool(random.integers(2)))
    means, matrices = message.means.copy(), message.covariances.copy()
    existence = np.array(message.existence)
    for component in range(len(means)):
        kind = random.integers(10)
        if kind == 0:
            means[component, random.integers(n)] = random.choice([np.nan, np.inf, 1e13])
        elif kind == 1:
            matrices[component, 0, 0] *= -1
        elif kind == 2:
            matrices[component] = np.ones((n, n))
        elif kind == 3:
            matrices[component, -1, 0] = matrices[component, 0, -1] = np.nan
    for track in range(len(existence)):
        existence[track] = random.choice([0.5, 0.5, 0.5, 1.5, np.nan])
    extent = random.choice([0.5, 1.0, np.nan, -1.0], (len(existence), 3)) if random.integers(2) else None
    return replace(message, means=means, covariances=matrices, existence=existence, extent=extent)


def test_a_message_has_the_same_faults_alone_and_among_others() -> None:
    messages = [broken(seed) for seed in range(200)]
    alone = [faults(message)[0] for message in messages]
    assert {fault for codes in alone for fault in codes} == {*schemas.FAULTS} - {"weights"}
    assert faults(*messages) == alone
    assert faults(*messages[::-1]) == alone[::-1]
    assert faults(messages[7], messages[7]) == [alone[7]] * 2


@pytest.mark.parametrize("block", [1, 2, 3, 100])
def test_blocks_do_not_show(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [broken(seed) for seed in range(50)]
    whole = faults(*messages)
    monkeypatch.setattr("schemas.numeric.BLOCK", block)
    assert faults(*messages) == whole


def test_messages_are_left_as_they_are() -> None:
    for message in (tracks(13, 1), tracks(13, 1, 2), broken(14)):
        before = message.means.copy(), message.covariances.copy()
        schemas.check_numbers([message])
        assert np.array_equal(message.means, before[0], equal_nan=True)
        assert np.array_equal(message.covariances, before[1], equal_nan=True)
