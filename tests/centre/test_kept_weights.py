"""Weights of the last step: kept while certified, conservative always, the same after a restart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import schemas
from fusion_service.arrays import Floats, Ints
from fusion_service.centre import FusionCentre
from fusion_service.centre.kept_weights import STEPS, Ids, KeptWeights
from fusion_service.rules import fuse_last
from fusion_service.rules.ci import KEPT

SOURCES = ("a", "b", "c", "d")


def sources(N: int, size: int, seed: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(N, 4, 6, size))
    return rng.normal(size=(N, 4, size)), np.einsum("sikb,sjkb->sijb", G, G)


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize("N", [3, 5])
def test_what_is_kept_is_within_its_certificate(N: int, criterion: str) -> None:
    """The value of the criterion at the best weights is an answer of its own: by how much a kept one may be larger."""
    x, P = sources(N, 60, seed := 11)
    best = fuse_last("ci", x, P, criterion=criterion)
    rng = np.random.default_rng(seed)
    near = np.abs(best.weights + rng.normal(0.0, 0.02, best.weights.shape) * rng.integers(0, 2, 60))
    near /= near.sum(axis=0)
    near[:, ::7] = np.nan
    fused = fuse_last("ci", x, P, start=near, influence=True, criterion=criterion)
    kept = (fused.weights == near).all(axis=0)
    assert 10 < kept.sum() < 60, seed
    found, least = (value(one.covariance) for one in (fused, best) for value in [VALUES[criterion]])
    assert (found <= least * np.exp(KEPT) * (1 + 1e-12)).all()
    assert (found[~kept] <= least[~kept] * (1 + 1e-9)).all()
    np.testing.assert_array_equal(fused.covariance[:, :, ::7], best.covariance[:, :, ::7])
    given = fuse_last("ci", x[..., kept], P[..., kept], near[:, kept], influence=True)
    np.testing.assert_allclose(fused.mean[:, kept], given.mean, rtol=1e-12)
    assert fused.influence is not None
    assert given.influence is not None
    np.testing.assert_allclose(fused.influence[:, kept], given.influence, atol=1e-12)


VALUES: dict[str, Callable[[Floats], Floats]] = {
    "det": lambda P: np.asarray(np.linalg.det(np.moveaxis(P, -1, 0))),
    "trace": lambda P: np.asarray(np.trace(P)),
}


def test_weights_that_mean_nothing_are_sought_anew() -> None:
    x, P = sources(3, 8, 12)
    best = fuse_last("ci", x, P)
    for start in (np.full((3, 8), np.nan), np.array([[1.0], [0.0], [0.0]]).repeat(8, axis=1) * 0.0):
        again = fuse_last("ci", x, P, start=start)
        np.testing.assert_array_equal(again.covariance, best.covariance)


def test_an_element_does_not_depend_on_the_others() -> None:
    x, P = sources(4, 30, 13)
    start = fuse_last("ci", x, P).weights
    start[:, ::3] = 0.25
    whole = fuse_last("ci", x, P, start=start)
    for i in range(0, 30, 4):
        one = fuse_last("ci", x[..., i : i + 1], P[..., i : i + 1], start=start[:, i : i + 1])
        np.testing.assert_array_equal(one.covariance[..., 0], whole.covariance[..., i])


def ids(*numbers: int) -> Ids:
    return np.array(numbers, dtype=np.uint64)


def sources_of(*rows: int, count: int = 1) -> Ints:
    return np.array(rows, dtype=np.intp)[:, None].repeat(count, axis=1)


def test_they_are_found_by_id_and_source() -> None:
    kept = KeptWeights()
    assert kept.of(ids(1), sources_of(0, 1, 2)) is None
    kept.note(ids(7, 3), sources_of(0, 2, 5, count=2), np.array([[0.1, 0.2], [0.3, 0.4], [0.6, 0.4]]))
    kept.note(ids(5), sources_of(0, 1), np.full((2, 1), 0.5))
    kept.note(ids(8), sources_of(0, 1, 2), np.full((3, 1), np.nan))
    kept.turn()
    again = KeptWeights()
    again.restore(kept.packed())
    for one in (kept, again):
        found = one.of(ids(3, 4, 7, 8, 9), sources_of(0, 2, 5, count=5))
        assert found is not None
        np.testing.assert_array_equal(found[0], [0.2, np.nan, 0.1, np.nan, np.nan])
        assert one.of(ids(5), sources_of(0, 1)) is None


def test_a_source_that_is_away_for_a_step_finds_its_weight_again() -> None:
    kept = KeptWeights()
    weights = np.array([[0.1], [0.3], [0.4], [0.2]])
    kept.note(ids(7), sources_of(0, 2, 5, 6), weights)
    kept.turn()
    without = kept.of(ids(7), sources_of(0, 2, 5))
    assert without is not None
    np.testing.assert_allclose(without[:, 0], [0.125, 0.375, 0.5])
    kept.note(ids(7), sources_of(0, 2, 5), without)
    kept.turn()
    np.testing.assert_array_equal(kept.of(ids(7), sources_of(0, 2, 5, 6)), weights)
    other = kept.of(ids(7), sources_of(0, 2, 5, 9))
    assert other is not None
    np.testing.assert_allclose(other[:, 0], [0.125, 0.375, 0.5, 0.0])
    few = kept.of(ids(7), sources_of(0, 6, 9))
    assert few is not None
    assert np.isnan(few).all()


def test_what_is_not_used_is_forgotten() -> None:
    kept = KeptWeights()
    kept.note(ids(7), sources_of(0, 1, 2), np.full((3, 1), 1.0 / 3.0))
    for _ in range(STEPS + 1):
        kept.turn()
        assert kept.of(ids(7), sources_of(0, 1, 2)) is not None
    kept.turn()
    assert kept.of(ids(7), sources_of(0, 1, 2)) is None
    assert kept.packed() == []


def scan(source: str, number: int, P: Floats, x: Floats) -> schemas.LocalTracks:
    time = (number + 1) * 10**9
    return schemas.LocalTracks(
        source=source, epoch=1, seq=number, sent=time, time=time, complete=True, space=("x", "y", "vx", "vy"),
        frame=schemas.Enu(59.0, 10.0), ids=np.array([1], dtype=np.uint64), means=x[None], covariances=P[None],
    )  # fmt: skip


def mission(seed: int) -> list[list[schemas.LocalTracks]]:
    """Nine scans of four sources of one target, whose covariances change slowly."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(4, 4, 5)) * np.array([30.0, 30.0, 2.0, 2.0])[:, None]
    scans = []
    for number in range(9):
        G = G * (1.0 + 0.0003 * rng.normal(size=G.shape))
        P = np.einsum("sik,sjk->sij", G, G)
        x = np.array([10.0 * number, 5.0, 10.0, 0.0])
        scans.append([scan(name, number, P[s], x) for s, name in enumerate(SOURCES)])
    return scans


CONFIG = {"rule": "ci", "memory": "restart", "supervision": "off", "registration": "off"}


def run(weights: str, scans: list[list[schemas.LocalTracks]], restart: int = -1) -> list[schemas.GlobalTracks]:
    config = {**CONFIG, "weights": weights}
    centre, made = FusionCentre(config), []
    for number, messages in enumerate(scans):
        if number == restart:
            centre = FusionCentre(config, centre.checkpoint())
        for message in messages:
            centre.handle(message, message.time)
        made.append(centre.step(messages[0].time).tracks)
    return made


def test_a_centre_keeps_them_from_step_to_step() -> None:
    """Of slowly changing covariances: another result than the best weights give, larger by what is allowed at most."""
    scans = mission(seed := 14)
    kept, best = run("kept", scans), run("best", scans)
    sizes = [[np.linalg.det(one.covariances[0]) for one in made if len(one.ids)] for made in (kept, best)]
    ratio = np.array(sizes[0]) / np.array(sizes[1])
    assert len(ratio) == 8
    assert (ratio != 1.0).any(), seed
    assert (np.abs(np.log(ratio)) <= KEPT + 1e-9).all(), seed


def test_they_are_in_the_checkpoint() -> None:
    scans = mission(15)
    straight, restarted = run("kept", scans), run("kept", scans, restart=5)
    for one, other in zip(straight, restarted, strict=True):
        np.testing.assert_array_equal(one.covariances, other.covariances)
        np.testing.assert_array_equal(one.means, other.means)
