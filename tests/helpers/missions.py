"""Messages of made-up missions, for tests: only what a test is about is given, the rest is filled in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import Enu, GlobalTracks, LocalTracks, Message, Motion, SensorInfo, Truth

Array = NDArray[np.float64]
Places = Sequence[Sequence[float]] | Array
"""Rows (T, 2) of x, y, or (T, 4) of x, vx, y, vy; m, m/s."""

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = Enu(60.0, 10.0)
SPACE = ("x", "vx", "y", "vy")
STILL = [[0.0, 0.0]]


def at(seconds: float) -> int:
    """Mission time in ns UTC."""
    return START + round(seconds * SECOND)


def states(places: Places) -> Array:
    """(x, y) or (x, vx, y, vy) rows -> (T, 4)."""
    rows = np.array(places, dtype=float).reshape(len(places), len(places[0]) if len(places) else 4)
    return rows if rows.shape[1] == 4 else np.insert(rows, [1, 2], 0.0, axis=1)


def header(source: str, seconds: float, epoch: int) -> dict[str, Any]:
    return {"source": source, "epoch": epoch, "seq": round(seconds * 1000), "sent": at(seconds)}


def info(source: str, period: float = 1.0, q: float = 0.0, epoch: int = 1, **rest: Any) -> SensorInfo:
    given: dict[str, Any] = {"frame": FRAME, "position": (0.0, 0.0, 0.0), "motion": Motion("cv", q)} | rest
    return SensorInfo(**header(source, 0.0, epoch), period=period, **given)


def truth(seconds: float, ids: Sequence[int], places: Places, **rest: Any) -> Truth:
    given: dict[str, Any] = {"space": SPACE, "frame": FRAME, "means": states(places)} | rest
    return Truth(**header("world", seconds, 1), time=at(seconds), ids=np.array(ids, dtype=np.uint64), **given)


def tracks(
    source: str,
    seconds: float,
    ids: Sequence[int],
    places: Places,
    sigma: float = 1.0,
    epoch: int = 1,
    **rest: Any,
) -> LocalTracks:
    """Local tracks; covariance sigma^2 I unless `covariances` is given."""
    means = rest.pop("means", states(places))
    covariances = sigma**2 * np.tile(np.eye(means.shape[1]), (len(means), 1, 1))
    given: dict[str, Any] = {"complete": True, "space": SPACE, "frame": FRAME, "covariances": covariances} | rest
    own = {"time": at(seconds), "ids": np.array(ids, dtype=np.uint64), "means": means}
    return LocalTracks(**header(source, seconds, epoch), **own, **given)


def picture(
    seconds: float,
    ids: Sequence[int],
    places: Places,
    sigma: float = 1.0,
    centre: str = "centre",
    **rest: Any,
) -> GlobalTracks:
    """Confirmed global tracks without contributions; covariance sigma^2 I unless `covariances` is given."""
    means, count = rest.pop("means", states(places)), len(ids)
    given: dict[str, Any] = {
        "space": SPACE,
        "frame": FRAME,
        "covariances": sigma**2 * np.tile(np.eye(means.shape[1]), (len(means), 1, 1)),
        "status": np.ones(count, dtype=np.uint8),
        "existence": np.ones(count),
        "updated": np.full(count, at(seconds)),
        "contributor_counts": np.zeros(count, dtype=np.uint16),
    } | rest
    return GlobalTracks(
        **header(centre, seconds, 1),
        time=at(seconds),
        step=round(seconds),
        rule="ci",
        ids=np.array(ids, dtype=np.uint64),
        means=means,
        sources=(),
        contributor_source=np.zeros(0, dtype=np.uint16),
        contributor_epoch=np.zeros(0, dtype=np.uint64),
        contributor_id=np.zeros(0, dtype=np.uint64),
        contributor_influence=np.zeros(0),
        **given,
    )


def still(seconds: int) -> list[Message]:
    """One object at rest at the origin, and a centre that sees it perfectly, every second."""
    times = range(seconds + 1)
    return [*(truth(t, [1], STILL) for t in times), *(picture(t, [1], STILL) for t in times)]
