"""Two tracks of one target, whatever made them two, become one again: as soon as an exchange leaves one of them empty.
And a centre that is behind, in a world of many targets, loses none and doubles none at any step."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre, Refused, Skipped
from fusion_service.centre.emptied import emptied
from fusion_service.centre.lifecycle import newborn
from fusion_service.compiled import road, use
from schemas.messages import CONFIRMED, EXCHANGED, MERGED
from tests.centre.worlds import FRAME, SECOND, SIGMA, START, tracks

NOW = START + 100 * SECOND
CALM = 14


def centre_of(*names: str, **settings: object) -> FusionCentre:
    sources = {name: {"override": True, "period": 0.1} for name in names}
    frame = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
    return FusionCentre({"period": 0.1, "rule": "ci", "frame": frame, "sources": sources, **settings})


def fed_by(picture: schemas.GlobalTracks) -> list[list[tuple[str, int]]]:
    """The local tracks of each global one."""
    ends = np.cumsum(picture.contributor_counts).tolist()
    rows = [
        (picture.sources[source], number)
        for source, number in zip(picture.contributor_source.tolist(), picture.contributor_id.tolist(), strict=True)
    ]
    return [rows[end - count : end] for end, count in zip(ends, picture.contributor_counts.tolist(), strict=True)]


@pytest.mark.parametrize("memory", ["restart", "recursive", "tracklet"])
def test_what_an_exchange_leaves_empty_is_one_with_the_track_that_took_its_rows(memory: str) -> None:
    """The first report of b lies outside the gate of a's track; then one of a lies nearer to b's track than its own."""
    centre = centre_of("a", "b", memory=memory)
    places: dict[str, list[float | None]] = {
        "a": [0.0, 0.0, 190.0, 100.0, 100.0],
        "b": [None, 200.0, 180.0, 100.0, 100.0],
    }
    results = []
    for k in range(5):
        for name, at in places.items():
            if (x := at[k]) is not None:
                centre.handle(tracks(name, 0.1 * (k + 1), [[x, 0, 0, 0]], seq=k + 1), NOW)
        results.append(centre.step(START + (k + 1) * SECOND // 10))
    fed = [fed_by(one.tracks) for one in results]
    assert fed[:2] == [[[("a", 1)]], [[("a", 1)], [("b", 1)]]]
    first, second = results[1].tracks.ids.tolist()
    for result, rows in zip(results[2:], fed[2:], strict=True):
        assert rows == [[("a", 1), ("b", 1)]]
        assert result.tracks.ids.tolist() == [first]
        assert result.tracks.status.tolist() == [CONFIRMED]
    assert [tuple(one) for one in results[2].tracks.ended] == [(second, "merged", first)]
    kinds = results[2].log.decisions.kind
    assert (kinds == EXCHANGED).sum() == (kinds == MERGED).sum() == 1


@pytest.mark.parametrize(
    ("source", "before", "link", "found"),
    [
        ([0, 1], [5, 7], [7, 7], [(5, 7)]),
        ([0, 1], [7, 5], [5, 5], [(5, 7)]),
        ([0, 1, 2], [5, 5, 7], [7, 7, 7], [(5, 7)]),
        ([0, 1, 2, 3], [5, 7, 8, 9], [7, 7, 9, 9], [(5, 7), (8, 9)]),
        ([0, 1], [5, 7], [7, 5], []),  # an exchange
        ([0, 1, 2], [5, 5, 7], [7, 5, 7], []),  # one is left
        ([0, 1, 2, 0], [5, 5, 7, 8], [7, 8, 7, 8], []),  # to two
        ([0, 1, 2], [5, 5, 7], [7, 0, 7], []),  # one was lost
        ([0, 1, 0], [5, 7, 7], [7, 7, 0], []),  # the source had told them apart
        ([0, 1], [5, 9], [9, 9], []),  # not near
        ([0, 1], [0, 7], [7, 7], []),  # it comes from nowhere
        ([], [], [], []),
    ],
)
def test_which_tracks_an_exchange_empties(
    source: list[int], before: list[int], link: list[int], found: list[tuple[int, int]]
) -> None:
    ids = np.array([5, 7, 8, 9], dtype=np.uint64)
    standing, now = np.array(before, dtype=np.uint64), newborn(ids, 4, 0)
    rows: Any = SimpleNamespace(
        source=np.array(source, dtype=np.intp), tracks=SimpleNamespace(link=np.array(link, dtype=np.uint64))
    )
    near: Any = SimpleNamespace(first=np.array([0, 1, 2]), second=np.array([1, 2, 3]))
    assert emptied(rows, standing, standing > 0, now, near) == found
    if found:
        assert emptied(rows, standing, np.zeros(len(before), dtype=np.bool_), now, near) == []


class Behind:
    """Targets seen by two of three sources each. From the step `CALM` on scans come up to three at a time, of which the
    newest is left, or not at all, and every third step is skipped. The sources begin one after the other, and the first
    reports are worse than they say: many targets are two at first."""

    def __init__(self, targets: int, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        side = int(np.ceil(np.sqrt(targets)))
        place = np.stack(np.divmod(np.arange(targets), side)).T * 2000.0
        self.start = np.concatenate([place, np.array([20.0, 10.0]) + self.rng.normal(0.0, 0.3, (targets, 2))], axis=1)
        self.names = ("a", "b", "c")
        self.whose = [np.flatnonzero((number - np.arange(targets)) % 3 < 2) for number in range(3)]
        self.seq = [0, 0, 0]

    def scan(self, number: int, at: float, worse: float = 1.0) -> schemas.LocalTracks:
        """What a source says at `at`, s."""
        mine, self.seq[number] = self.whose[number], self.seq[number] + 1
        errors = self.rng.normal(size=(len(mine), 4)) * SIGMA * worse
        there: Floats = self.start[mine] + errors
        there[:, :2] += at * self.start[mine, 2:]
        return tracks(self.names[number], at, there, mine + 1, seq=self.seq[number])

    def step(self, centre: FusionCentre, k: int, skipped: int) -> schemas.GlobalTracks:
        """The step `k`, `skipped` before it having been skipped."""
        if skipped:
            centre.handle(Skipped(skipped), NOW)
        for number, name in enumerate(self.names):
            if k < 1 + 3 * number:
                continue
            overtaken = int(self.rng.integers(0, 3)) if k > CALM else 0
            self.seq[number] += overtaken
            if overtaken:
                centre.handle(Refused(name, "overtaken", overtaken, dropped=True), NOW)
            if k <= CALM or self.rng.random() < 0.9:
                age = 0.1 * self.rng.random()
                centre.handle(self.scan(number, 0.1 * k - age, 1.7 if k == 1 + 3 * number else 1.0), NOW)
            elif not overtaken:
                centre.handle(Refused(name, "queue", 1, dropped=True), NOW)
        return centre.step(START + k * SECOND // 10).tracks


@pytest.fixture
def compiled(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "on":
        pytest.importorskip("numba")
    before = road()
    yield use(request.param)
    use("off" if before == "plain" else "on")


@pytest.mark.parametrize(
    ("memory", "compiled"),
    [("restart", "off"), ("recursive", "off"), pytest.param("restart", "on", marks=pytest.mark.slow)],
    indirect=["compiled"],
)
def test_a_centre_that_is_behind_loses_and_doubles_no_target(memory: str, compiled: str) -> None:
    assert compiled
    world, targets = Behind(240, seed=7), 240
    centre = centre_of(*world.names, memory=memory)
    ids: list[int] = []
    k, doubled, steps = 0, 0, 0
    while k < 150:
        skipped = int(world.rng.integers(0, 4)) if k > CALM and world.rng.random() < 0.33 else 0
        k += 1 + skipped
        picture = world.step(centre, k, skipped)
        steps += 1
        if k <= CALM:
            doubled = max(doubled, len(picture.ids) - targets)
            ids = picture.ids.tolist()
            continue
        assert picture.ids.tolist() == ids
        assert (picture.status == CONFIRMED).all()
        counts, whose = picture.contributor_counts.astype(np.intp), picture.contributor_id
        assert counts.min() > 0
        first = whose[np.cumsum(counts) - counts]
        assert np.sort(first).tolist() == list(range(1, targets + 1))
        assert (np.repeat(first, counts) == whose).all()
    assert doubled > 3
    assert steps > 70
    assert len(ids) == targets
