"""Many sources that say little, looked at together and each for itself: the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, converting
from fusion_service.centre.supervision import crowd
from schemas import Enu, Frame, Local, LocalTracks

SECOND = 1_000_000_000
PERIOD = SECOND // 5
SPACE = ("x", "y", "vx", "vy")
HERE = Enu(59.0, -55.0)
SOURCES, STEPS = 16, 22


def scan(
    name: str, seq: int, time: int, ids: Any, means: Any, space: tuple[str, ...] = SPACE, frame: Frame = HERE,
    **more: Any,
) -> LocalTracks:  # fmt: skip
    n = len(space)
    spread = np.diag([25.0, 25.0, 4.0, 4.0])[:n, :n]
    given: dict[str, Any] = {"complete": True} | more
    return LocalTracks(
        source=name, epoch=1, seq=seq, sent=time, time=time, space=space, frame=frame,
        ids=np.asarray(ids, dtype=np.uint64), means=np.asarray(means)[:, :n],
        covariances=np.tile(spread, (len(ids), 1, 1)), **given,
    )  # fmt: skip


def said(rng: np.random.Generator, number: int, step: int, home: Any, time: int) -> Iterator[LocalTracks]:
    """What a source says in a step: each is of another kind, and now and then of none of them."""
    name, kind = f"n{number:02d}", number % 16
    ids, velocity = np.array([1, 2, 3]), np.array([[8.0, -5.0, 8.0, -5.0]])
    means = home + velocity * (step * PERIOD / SECOND) * np.array([1.0, 1.0, 0.0, 0.0]) + rng.normal(0.0, 2.0, (3, 4))
    more: dict[str, Any] = {}
    if kind == 1:  # tracks come and go
        some = rng.random(3) < 0.7
        ids, means = ids[some], means[some]
    elif kind == 2:  # stands still to the bit, though it claims a speed, after having varied
        means = home if step > 12 else means
    elif kind == 3:  # jumps as a whole
        means = means + (5000.0 if step > 12 else 0.0)
    elif kind == 4:
        order = rng.permutation(3)
        ids, means = ids[order], means[order]
    elif kind == 5:
        more = {"identity": ("mmsi:211", "mmsi:211", None), "kind": ("ship", None, "buoy"), "kind_p": np.full(3, 0.9)}
    elif kind == 6:
        more = {"lineage": (name, "n00")}
    elif kind == 7:
        more = {"existence": np.full(3, 0.8), "updated": np.full(3, time - step % 2 * PERIOD)}
    elif kind == 8:
        more = {"frame": Enu(59.1, -55.0)}
    elif kind == 9:
        more = {"space": ("x", "y")}
    elif kind == 10:
        more = {"origin": "exercise" if step % 3 else "live"}
    elif kind == 11:
        more = {"frame": Local("deck")}
    elif kind == 12:  # one track that has no numbers, every other step
        means = means.copy()
        means[0, 0] = np.nan if step % 2 else means[0, 0]
    elif kind == 13 and step > 3:
        ids, means = ids[:0], means[:0]
    elif kind == 14 and step % 7 > 3:  # silent for a while: its tracks go stale, and are remembered
        return
    elif kind == 15:  # two scans in a step, and parts of one
        yield scan(name, 3 * step, time - PERIOD // 2, ids, means)
        yield scan(name, 3 * step + 1, time - PERIOD // 4, ids[:1], means[:1], complete=step % 2 == 0)
    yield scan(name, 3 * step + 2, time, ids, means, **more)


def flown(seed: int, **settings: Any) -> list[bytes]:
    """All that the steps of a world give."""
    rng = np.random.default_rng(seed)
    centre = FusionCentre({"period": 0.2, "frame_wait": 0.0, "stale_periods": 1.0, "lateness": 0.2, **settings})
    homes = rng.uniform(-1e5, 1e5, (SOURCES, 3, 4)) * [1.0, 1.0, 0.0, 0.0] + [0.0, 0.0, 8.0, -5.0]
    homes[6:8] = homes[0] + 3.0  # who sees the same
    out: list[bytes] = []
    for step in range(STEPS):
        time = 1000 * SECOND + step * PERIOD
        for number in range(SOURCES):
            for message in said(rng, number, step, homes[number], time):
                centre.handle(message, time + 1)
        result = centre.step(time)
        out += [schemas.encode(one) for one in (result.tracks, result.log, result.status)]
        if step % 5 == 0:
            out.append(centre.checkpoint())
    return out


@pytest.mark.parametrize(
    ("seed", "settings"),
    [
        (1, {"sources": {"n00": {"inflation": 2.0}, "n04": {"covariance_floor": 3.0, "stale": 0.3}}}),
        (2, {"memory": "restart", "supervision": "off", "registration": "off"}),
    ],
)
def test_together_and_alone_are_the_same(seed: int, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    gone_on: list[int] = []
    looked: list[int] = []
    steps, seen = converting.Conversion._steps, crowd._seen

    def counted_steps(*given: Any) -> Any:
        found = steps(*given)
        gone_on.append(len(found))
        return found

    def counted_looks(*given: Any) -> Any:
        found = [*seen(*given)]
        looked.append(len(found))
        return iter(found)

    monkeypatch.setattr(converting.Conversion, "_steps", counted_steps)
    monkeypatch.setattr(crowd, "_seen", counted_looks)
    together = flown(seed, **settings)
    assert sum(gone_on) > 5 * STEPS, "sources go on as they were, together"
    watched = settings.get("supervision") != "off"
    assert (sum(looked) > 5 * STEPS) is watched
    alarms = (b"repeat to the bit", b"jumped at once", b"twice: its tracks")
    assert all(alarm in b"".join(together) for alarm in alarms) is watched
    gone_on.clear()
    monkeypatch.setattr(converting, "SMALL", -1)
    monkeypatch.setattr(crowd, "SMALL", -1)
    alone = flown(seed, **settings)
    assert not gone_on, "each for itself"
    assert [place for place, (a, b) in enumerate(zip(together, alone, strict=True)) if a != b] == []
