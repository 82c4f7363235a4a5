"""Tracks that a Gaussian cannot carry: kept, predicted, fused and published as the mixtures they are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.densities import Mixture
from fusion_service.rules import fuse, fuse_mixtures
from tests.centre.worlds import SPACE, centre, give, moved, step, tracks, truth

SOURCES = ("r1", "r2")


def mixed(source: str, second: float, mixtures: list[Mixture], **changes: Any) -> schemas.LocalTracks:
    """A message of one mixture per track."""
    return dataclasses.replace(
        tracks(source, second, np.zeros((len(mixtures), 4)), **changes),
        means=np.concatenate([one.means for one in mixtures]),
        covariances=np.concatenate([one.covariances for one in mixtures]),
        weights=np.concatenate([one.weights for one in mixtures]),
        counts=np.array([len(one.weights) for one in mixtures], dtype=np.uint16),
    )


def some(count: int, components: int, seed: int, centre_at: np.ndarray | None = None) -> list[Mixture]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        root = rng.normal(size=(components, 4, 4)) * [30, 30, 2, 2]
        weights = rng.uniform(0.2, 1, components)
        at = np.zeros(4) if centre_at is None else centre_at[k]
        spread = rng.normal(size=(components, 4)) * [60, 60, 3, 3]
        covariances = root @ root.transpose(0, 2, 1) + np.diag([100.0, 100.0, 1.0, 1.0])
        out.append(Mixture(weights / weights.sum(), at + spread, covariances))
    return out


def published(picture: schemas.GlobalTracks, row: int = 0) -> Mixture:
    counts = np.ones(len(picture.ids), dtype=int) if picture.counts is None else picture.counts.astype(int)
    start = int(counts[:row].sum())
    part = slice(start, start + counts[row])
    weights = np.ones(counts[row]) if picture.weights is None else picture.weights[part]
    return Mixture(weights, picture.means[part], picture.covariances[part])


def same_density(one: Mixture, other: Mixture, rtol: float = 1e-9) -> None:
    points = one.draw(50, seed=1)
    np.testing.assert_allclose(one.log_pdf(points), other.log_pdf(points), rtol=rtol, atol=1e-9)


def test_one_source_alone_keeps_its_components_and_predicts_each() -> None:
    [mixture] = some(1, 3, 1)
    made = centre(("r1",))
    give(made, mixed("r1", 1, [mixture]))
    picture = step(made, 3).tracks
    transition = np.eye(4) + 2.0 * np.eye(4, k=2)
    noise = np.kron([[8 / 3, 2], [2, 2]], np.eye(2))
    expected = Mixture(
        mixture.weights, mixture.means @ transition.T, transition @ mixture.covariances @ transition.T + noise
    )
    same_density(published(picture), expected)
    assert picture.counts is not None
    assert picture.counts.tolist() == [3]


@pytest.mark.parametrize("rule", ["aa", "gm-ga", "cu-modes", "hmd-s"])
def test_several_sources_are_fused_as_the_rule_fuses_their_mixtures(rule: str) -> None:
    options: dict[str, Any] = {"samples": 500, "seed": 3} if rule == "hmd-s" else {}
    mixtures = [some(1, 2, 1)[0], some(1, 3, 2)[0]]
    made = centre(SOURCES, mixture_rule=rule, mixture_options=options, max_components=20)
    for name, mixture in zip(SOURCES, mixtures, strict=True):
        give(made, mixed(name, 1, [mixture]))
    picture = step(made, 1).tracks
    assert picture.contributor_counts.tolist() == [2]
    same_density(published(picture), fuse_mixtures(rule, mixtures, max_components=20, **options))


def test_by_moments_the_result_is_the_rules_own() -> None:
    mixtures = [some(1, 2, 1)[0], some(1, 3, 2)[0]]
    made = centre(SOURCES, rule="ci")
    for name, mixture in zip(SOURCES, mixtures, strict=True):
        give(made, mixed(name, 1, [mixture]))
    picture = step(made, 1).tracks
    means, covariances = zip(*(one.moments() for one in mixtures), strict=True)
    expected = fuse("ci", np.stack(means), np.stack(covariances))
    np.testing.assert_allclose(picture.means[0], expected.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(picture.covariances[0], expected.covariance, rtol=1e-9)


def test_gaussians_and_mixtures_meet_and_the_cap_holds() -> None:
    states = truth(5)
    made = centre((*SOURCES, "r3"), mixture_rule="aa", max_components=4)
    give(made, tracks("r1", 1, states))
    give(made, mixed("r2", 1, some(5, 6, 3, states)), mixed("r3", 1, some(5, 2, 4, states)))
    picture = step(made, 1).tracks
    assert picture.counts is not None
    assert picture.contributor_counts.tolist() == [3] * 5
    assert picture.counts.max() <= 4
    assert picture.counts.min() >= 2
    assert (schemas.check_numbers([picture])[0] == 0).all()


def test_the_point_that_is_published_may_be_the_heaviest_mode() -> None:
    [mixture] = some(1, 3, 7)
    heaviest = int(mixture.weights.argmax())
    for publish, expected in (("mode", mixture.means[heaviest]), ("mean", mixture.moments()[0])):
        made = centre(("r1",), publish=publish)
        give(made, mixed("r1", 1, [mixture]))
        picture = step(made, 1).tracks
        assert picture.counts is None
        np.testing.assert_allclose(picture.means[0], expected, rtol=1e-9)


def test_a_space_with_more_components_is_marginalised_mode_by_mode() -> None:
    [mixture] = some(1, 3, 5)
    space = ("x", "vx", "turn_rate", "y", "vy")
    order = [0, 2, None, 1, 3]
    means = np.stack([np.zeros(3) if k is None else mixture.means[:, k] for k in order], axis=1)
    covariances = np.tile(np.eye(5), (3, 1, 1))
    known = [k for k, name in enumerate(space) if name != "turn_rate"]
    into = [SPACE.index(space[k]) for k in known]
    covariances[np.ix_(range(3), known, known)] = mixture.covariances[np.ix_(range(3), into, into)]
    made = centre(("r1",))
    give(made, dataclasses.replace(mixed("r1", 1, [mixture]), space=space, means=means, covariances=covariances))
    same_density(published(step(made, 1).tracks), mixture)


def test_modes_meet_where_means_would_not() -> None:
    """A bearing-only source sees one of two ranges; a sharp track stands at the farther one."""
    spread = np.diag([25.0, 25.0, 1.0, 1.0])
    modes = Mixture([0.5, 0.5], [[-500.0, 0, 0, 0], [500.0, 0, 0, 0]], [spread, spread])
    between = np.zeros((1, 4))
    for at, meets in (([500.0, 0, 0, 0], True), (between[0], False)):
        made = centre(SOURCES, mixture_rule="aa")
        give(made, mixed("r1", 1, [modes]), tracks("r2", 1, [at], sigma=np.array([5.0, 5.0, 1.0, 1.0])))
        assert int(step(made, 1).tracks.contributor_counts.max()) == (2 if meets else 1)


def test_overlap_is_the_integral_of_the_product() -> None:
    from fusion_service.centre.association import overlap
    from fusion_service.densities import Mixtures

    [one], [other] = some(1, 3, 11), some(1, 2, 12)
    distance, rest = overlap(Mixtures.of([one]), Mixtures.of([other]))
    points = one.draw(200_000, seed=5)
    values = np.exp(other.log_pdf(points))
    expected = -2 * (np.log(values.mean()) + 2 * np.log(2 * np.pi))
    error = 2 * values.std() / np.sqrt(len(values)) / values.mean()
    assert float((distance + rest)[0]) == pytest.approx(expected, abs=4 * error)


def test_an_average_weighs_each_source_by_the_existence_it_reports() -> None:
    mixtures = [some(1, 2, 1)[0], some(1, 3, 2)[0]]
    made = centre(SOURCES, mixture_rule="aa", max_components=20)
    for name, mixture, r in zip(SOURCES, mixtures, (0.9, 0.3), strict=True):
        give(made, mixed(name, 1, [mixture], existence=np.array([r])))
    expected = fuse_mixtures("aa", mixtures, weights=[0.75, 0.25], max_components=20)
    same_density(published(step(made, 1).tracks), expected)


@pytest.mark.parametrize("rule", ["aa", "gm-ga"])
def test_many_sources_of_many_modes_are_fused_too(rule: str) -> None:
    for count in (6, 14, 70):
        names = [f"r{k:02}" for k in range(count)]
        made = centre(names, mixture_rule=rule, existence="geometric")
        for k, name in enumerate(names):
            give(made, mixed(name, 1, some(1, 3, k), existence=np.array([0.8])))
        picture = step(made, 1).tracks
        assert picture.contributor_counts.max() > count / 2
        assert (schemas.check_numbers([picture])[0] == 0).all()


def run(shuffle: int | None, cut: int | None, **config: Any) -> list[bytes]:
    made = FusionCentre({"max_components": 6, "lateness": 3.0, **config})
    states = truth(6)
    out = []
    for second in range(1, 7):
        now = moved(states, second)
        batch: list[Any] = [
            mixed("r1", second, some(6, 3, second, now)),
            mixed("r2", second, some(4, 2, 50 + second, now[:4])),
            tracks("r3", second, now),
        ]
        if shuffle is not None:
            batch = [batch[k] for k in np.random.default_rng(shuffle + second).permutation(3)]
        give(made, *batch)
        out.append(schemas.encode(dataclasses.replace(step(made, second).tracks, seq=0)))
        if second == cut:
            blob = made.checkpoint()
            made = FusionCentre(made.config, blob)
            assert made.checkpoint() == blob
    return out


@pytest.mark.parametrize("memory", ["restart", "recursive"])
@pytest.mark.parametrize("rule", ["moments", "aa", "gm-ga"])
def test_same_bytes_in_any_order_and_from_a_checkpoint(rule: str, memory: str) -> None:
    first = run(None, None, mixture_rule=rule, memory=memory)
    assert run(7, None, mixture_rule=rule, memory=memory) == first
    assert run(None, 3, mixture_rule=rule, memory=memory) == first
