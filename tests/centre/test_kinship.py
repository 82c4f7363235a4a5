"""Rows with data in common against the exact joint error of what they are made of."""

from __future__ import annotations

from time import process_time

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion_service.centre.kinship import Estimates, fuse_related
from fusion_service.centre.lineage import ANYONE, MOST_NAMES, MOST_SETS, NOBODY, Lineages, overlapping
from fusion_service.rules import fuse_last
from tests.centre.worlds import tracks

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
ATOMS = 6


def naive(means: Floats, covariances: Floats, which: list[int], some: Ints) -> Estimates:
    fused = fuse_last("naive", means, covariances, None, influence=True)
    assert fused.influence is not None
    return Estimates(fused.mean, fused.covariance, fused.influence)


def world(lineages: list[set[int]], seed: int) -> tuple[Floats, Floats]:
    """Each atom is an independent measurement of a state of n = 2; each row is the best estimate from its atoms:
    gains (k, ATOMS, 2, 2) and covariances of the atoms (ATOMS, 2, 2)."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(ATOMS, 2, 2))
    atoms = factors @ factors.swapaxes(1, 2) + 0.1 * np.eye(2)
    gains = np.zeros((len(lineages), ATOMS, 2, 2))
    for row, names in enumerate(lineages):
        information = {name: np.linalg.inv(atoms[name]) for name in names}
        whole = np.linalg.inv(sum(information.values()))
        for name, part in information.items():
            gains[row, name] = whole @ part
    return gains, atoms


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sets(st.integers(0, ATOMS - 1), min_size=1), min_size=2, max_size=5), st.integers(0, 2**32 - 1))
def test_what_is_stated_covers_the_exact_error_whatever_is_shared(lineages: list[set[int]], seed: int) -> None:
    gains, atoms = world(lineages, seed)
    covariances = np.einsum("raij,ajk,ralk->ril", gains, atoms, gains)
    meet = np.array([[bool(one & two) for two in lineages] for one in lineages])
    k = len(lineages)
    batch = 2 * k  # the fused mean is linear in the rows' means: probe it with unit vectors
    means = np.zeros((k, 2, batch))
    for row in range(k):
        for axis in range(2):
            means[row, axis, 2 * row + axis] = 1.0
    fused = fuse_related(
        means, np.repeat(covariances[..., None], batch, axis=3), np.repeat(meet[None], batch, axis=0), naive
    )
    weights = fused.mean.reshape(2, k, 2).transpose(1, 0, 2)  # (k, 2, 2)
    np.testing.assert_allclose(weights.sum(axis=0), np.eye(2), atol=1e-8)
    whole = np.einsum("rij,rajk->aik", weights, gains)
    exact = np.einsum("aij,ajk,alk->il", whole, atoms, whole)
    stated = fused.covariance[:, :, 0]
    assert np.linalg.eigvalsh(stated - exact)[0] >= -1e-7 * np.trace(stated), (lineages, seed)
    best = min(np.linalg.det(one) for one in covariances)
    assert np.linalg.det(stated) <= best * (1 + 1e-6), "no worse than the best row"
    np.testing.assert_allclose(np.trace(weights, axis1=1, axis2=2) / 2, fused.shares[:, 0], atol=0.35)
    if not (meet & ~np.eye(k, dtype=bool)).any():
        np.testing.assert_allclose(stated, exact, rtol=1e-7)


def test_groups_of_many_patterns_are_fused_as_each_alone() -> None:
    rng = np.random.default_rng(2)
    print("seed 2")
    count, k = 300, 5
    meet = rng.random((count, k, k)) < 0.3
    meet = meet | meet.swapaxes(1, 2) | np.eye(k, dtype=bool)
    factors = rng.normal(size=(k, 4, 4, count))
    covariances = np.einsum("kijb,kljb->kilb", factors, factors) + 0.1 * np.eye(4)[None, :, :, None]
    means = rng.normal(size=(k, 4, count))
    some = np.sort(rng.permutation(count)[:30])
    few = fuse_related(means[..., some], covariances[..., some], meet[some], naive)
    for place, one in enumerate(some.tolist()):
        alone = fuse_related(means[..., [one]], covariances[..., [one]], meet[[one]], naive)
        np.testing.assert_array_equal(few.mean[:, place], alone.mean[:, 0])
        np.testing.assert_array_equal(few.covariance[:, :, place], alone.covariance[:, :, 0])
    many = fuse_related(means, covariances, meet, naive)
    assert np.isfinite(many.covariance).all()
    np.testing.assert_allclose(many.shares.sum(axis=0), 1.0, atol=0.5)


def test_lineages_are_sets_of_names_whatever_their_codes() -> None:
    rng = np.random.default_rng(4)
    print("seed 4")
    table = Lineages()
    names = [f"n{k}" for k in range(150)]
    sets = [frozenset(rng.choice(names, rng.integers(1, 9)).tolist()) for _ in range(400)]
    codes = np.array([table.of(one) for one in sets], dtype=np.int32)
    assert np.array_equal(table.codes(table.masks(codes)), codes)
    groups = rng.integers(0, 400, (200, 3))
    meet = overlapping(table.masks(codes), groups)
    for group, found in zip(groups.tolist(), meet, strict=True):
        for i in range(3):
            for j in range(3):
                assert found[i, j] == bool(sets[group[i]] & sets[group[j]])
    union = table.codes(table.union(codes[groups].T.copy()))
    whole, bits = table.told(union, ["extra"], "me")
    assert whole[-1] == "me"
    assert "extra" in whole
    for group, row in zip(
        groups.tolist(), np.unpackbits(bits, axis=1, count=len(whole), bitorder="little"), strict=True
    ):
        said = {whole[k] for k in np.flatnonzero(row)}
        assert said == {"me"} | sets[group[0]] | sets[group[1]] | sets[group[2]]
    assert table.contain(codes, "n3").tolist() == ["n3" in one for one in sets]
    other = Lineages()
    other.restore(table.kept())
    assert np.array_equal(other.masks(union), table.masks(union))


def test_the_table_is_bounded_forgets_what_is_not_used_and_never_tells_too_little() -> None:
    table = Lineages()
    kept = table.of(["a", "b"])
    for k in range(MOST_SETS + 500):
        code = table.of([f"x{k % 200}", f"y{k}"])
    assert len(table) <= MOST_SETS
    assert len(table.names) <= MOST_NAMES
    masks = table.masks(np.array([code, kept, NOBODY], dtype=np.int32))
    meet = overlapping(masks, np.array([[0, 1]]))[0]
    assert meet.all(), "what does not fit overlaps with all"
    assert table.contain(np.array([code], dtype=np.int32), "never heard of").all()
    new = table.compacted([np.array([kept, ANYONE, -1], dtype=np.int32)])
    assert new is not None
    assert (len(table), len(table.names)) == (3, 3)
    assert new[-1] == -1
    assert new[ANYONE] == ANYONE
    assert new[kept] == table.of(["b", "a"])
    assert table.contain(new[[kept]], "a").all()
    assert not table.contain(new[[kept]], "x1").any()
    assert table.compacted([np.array([kept], dtype=np.int32)]) is None


def test_a_huge_lineage_costs_little() -> None:
    rng = np.random.default_rng(6)
    table, names = Lineages(), tuple(f"n{k}" for k in range(5000))
    bits = rng.integers(0, 256, (20_000, 625)).astype(np.uint8)
    begin = process_time()
    for part in (bits[:2000], bits):
        message = tracks("s", 1, np.zeros((len(part), 4)), lineage=names, track_lineage=part)
        codes = table.of_message(message)
        assert table.contain(codes, "n4999").all(), "more than is told apart: every track contains all"
        assert table.masks(codes).shape[1] == len(part)
    table.compacted([codes[:1]])
    assert process_time() - begin < 10


def test_bits_that_say_nothing_say_all_and_bits_beyond_the_names_mean_nothing() -> None:
    table = Lineages()
    message = tracks(
        "s", 1, np.zeros((3, 4)), lineage=("a", "b"), track_lineage=np.array([[0], [0xFE], [0xFF]], np.uint8)
    )
    codes = table.of_message(message)
    assert codes.tolist() == [table.of(["a", "b"]), table.of(["b"]), table.of(["a", "b"])]
    assert table.of_message(tracks("s", 1, np.zeros((2, 4)))).tolist() == [-1, -1]


def test_rows_that_all_have_data_in_common_are_fused_by_intersection() -> None:
    rng = np.random.default_rng(7)
    print("seed 7")
    factors = rng.normal(size=(3, 4, 4, 10))
    covariances = np.einsum("kijb,kljb->kilb", factors, factors)
    means = rng.normal(size=(3, 4, 10))
    fused = fuse_related(means, covariances, np.ones((10, 3, 3), dtype=bool), naive)
    plain = fuse_last("ci", means, covariances)
    np.testing.assert_allclose(fused.mean, plain.mean, rtol=1e-9)
