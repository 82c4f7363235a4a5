"""Small worlds for tests of the centre: truth that moves, sources that see it with known errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre, StepResult

SPACE = ("x", "y", "vx", "vy")
FRAME = schemas.Enu(59.0, -55.0)
SECOND = 10**9
START = 1_700_000_000 * SECOND
SIGMA = np.array([30.0, 30.0, 2.0, 2.0])


def truth(count: int, spread: float = 20_000.0, seed: int = 5) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-spread, spread, (count, 2)), rng.normal(0, 50, (count, 2))], axis=1)


def moved(states: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    out = states.copy()
    out[:, :2] += seconds * states[:, 2:]
    return out


def info(source: str, epoch: int = 1, seq: int = 0, **changes: Any) -> schemas.SensorInfo:
    fields: dict[str, Any] = {
        "source": source,
        "epoch": epoch,
        "seq": seq,
        "sent": START,
        "frame": FRAME,
        "position": (0.0, 0.0, 0.0),
        "period": 1.0,
        "motion": schemas.Motion("cv", 1.0),
    }
    return schemas.SensorInfo(**{**fields, **changes})


def tracks(
    source: str,
    second: float,
    means: NDArray[np.float64] | Sequence[Sequence[float]],
    ids: Iterable[int] | None = None,
    *,
    seq: int | None = None,
    epoch: int = 1,
    sigma: NDArray[np.float64] = SIGMA,
    **changes: Any,
) -> schemas.LocalTracks:
    means = np.asarray(means, dtype=float).reshape(-1, len(SPACE))
    chosen = np.arange(1, len(means) + 1) if ids is None else np.array(list(ids))
    fields: dict[str, Any] = {
        "source": source,
        "epoch": epoch,
        "seq": round(second) if seq is None else seq,
        "sent": START,
        "time": START + round(second * SECOND),
        "complete": True,
        "space": SPACE,
        "frame": FRAME,
        "ids": chosen.astype(np.uint64),
        "means": means,
        "covariances": np.tile(np.diag(sigma**2), (len(means), 1, 1)),
    }
    return schemas.LocalTracks(**{**fields, **changes})


def seen(
    states: NDArray[np.float64], rng: np.random.Generator, sigma: NDArray[np.float64] = SIGMA
) -> NDArray[np.float64]:
    return states + rng.normal(size=states.shape) * sigma


def centre(sources: Sequence[str] = ("r1", "r2", "r3"), **config: Any) -> FusionCentre:
    made = FusionCentre({"lateness": 3.0, **config})
    for source in sources:
        made.handle(info(source), START)
    return made


def give(to: FusionCentre, *messages: Any) -> None:
    for message in messages:
        to.handle(message, START + 10**6 * SECOND)


def step(of: FusionCentre, second: float) -> StepResult:
    return of.step(START + round(second * SECOND))
