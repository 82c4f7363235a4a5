"""Sources that never share a track for a constant offset between them."""

from __future__ import annotations

import numpy as np

from fusion_service.hints.offsets import offset_doubts
from schemas import GlobalTracks, Local


def picture(shift: tuple[float, float], count: int = 12, seed: int = 16, same: bool = True) -> GlobalTracks:
    """Source a sees `count` objects, source b the same ones from a place that is off by `shift`, as tracks of their
    own."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([rng.uniform(-2e4, 2e4, (count, 2)), rng.uniform(-15, 15, (count, 2))], axis=1)
    other = truth if same else np.concatenate([rng.uniform(-2e4, 2e4, (count, 2)), rng.uniform(-15, 15, (count, 2))], 1)
    noise = rng.normal(0.0, 1.0, (2 * count, 4)) * [20.0, 20.0, 1.0, 1.0]
    means = np.concatenate([truth, other + np.array([*shift, 0.0, 0.0])]) + noise
    n = 2 * count
    return GlobalTracks(
        source="centre", epoch=1, seq=0, sent=0, time=0, step=0, rule="ci", space=("x", "y", "vx", "vy"),
        frame=Local("h"), ids=np.arange(1, n + 1, dtype=np.uint64), status=np.ones(n, np.uint8), existence=np.ones(n),
        means=means, covariances=np.tile(np.diag([400.0, 400.0, 1.0, 1.0]), (n, 1, 1)), updated=np.zeros(n, np.int64),
        sources=("a", "b"), contributor_counts=np.ones(n, np.uint16),
        contributor_source=np.repeat([0, 1], count).astype(np.uint16), contributor_epoch=np.ones(n, np.uint64),
        contributor_id=np.arange(n, dtype=np.uint64), contributor_influence=np.ones(n), ended=(), split_from=(),
    )  # fmt: skip


def test_the_offset_that_would_make_them_one_is_told() -> None:
    (said,) = offset_doubts(picture((3000.0, -1500.0)))
    assert said.startswith("a and b share no track, and would share 1")
    east, north = (int(word) for word in said.split() if word[0] in "+-" and word[1:].isdigit())
    assert abs(east + 3000) < 40
    assert abs(north - 1500) < 40


def test_sources_of_other_objects_are_told_nothing_of() -> None:
    assert [said for seed in range(30) for said in offset_doubts(picture((0.0, 0.0), seed=seed, same=False))] == []


def test_an_empty_picture_is_told_nothing_of() -> None:
    assert offset_doubts(picture((0.0, 0.0), count=0)) == []
