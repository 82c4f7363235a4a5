"""A synthetic mission: three radars, five targets and a centre, as the messages that they would publish.

The estimates are the truth with noise of exactly the covariance they state, so that what a recording shows of
their consistency is known beforehand.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from schemas import (
    Decisions,
    Disk,
    Entry,
    Enu,
    GlobalTracks,
    LocalTracks,
    Message,
    Motion,
    Sector,
    SensorInfo,
    Status,
    StepLog,
    Truth,
    encode,
    global_key,
    local_key,
    truth_key,
)

START = 1_790_000_000 * 10**9
SPACE = ("x", "vx", "y", "vy")
CENTRE = Enu(59.0, 10.5)
RADARS = {"radar1": Enu(59.00, 10.30), "radar2": Enu(58.93, 10.55), "radar3": Enu(59.04, 10.52)}
LOST = ("radar2", 60, 90)
"""A source that is silent between these steps."""
TARGETS = 5
SIGMA = 15.0
GENERATION = 1 << 32


class Sent(NamedTuple):
    key: str
    message: Message
    received: int

    @property
    def data(self) -> bytes:
        return encode(self.message)


def positions(time: float) -> NDArray[np.float64]:
    """States (5, 4) of the targets, `time` seconds after the start, in the centre's frame: slow circles."""
    k = np.arange(TARGETS)
    radius, rate, phase = 3000.0 + 700.0 * k, 0.004 - 0.0005 * k, 1.3 * k
    angle = phase + rate * time
    x, y = -4000 + 2200 * k + radius * np.cos(angle), 1500 * (k - 2) + radius * np.sin(angle)
    return np.stack([x, -radius * rate * np.sin(angle), y, radius * rate * np.cos(angle)], axis=1)


def mission(steps: int = 120, seed: int = 7) -> Iterator[Sent]:
    """One step a second, `received` 50 ms after its time."""
    rng = np.random.default_rng(seed)
    sequence: dict[str, int] = {}

    def head(key: str, name: str, sent: int) -> dict[str, Any]:
        number = sequence[key] = sequence.get(key, -1) + 1
        return {"source": name, "epoch": START, "seq": number, "sent": sent, "origin": "simulated"}

    def sent(key: str, name: str, kind: type, at: int, **fields: Any) -> Sent:
        return Sent(key, kind(**head(key, name, at), **fields), at + 50_000_000)

    for number, (name, frame) in enumerate(RADARS.items()):
        coverage = Disk(9000.0, 300.0) if number else Sector(12000.0, 1.2, 2.0, 500.0)
        yield sent(
            local_key(name, "info"), name, SensorInfo, START, frame=frame, position=(0.0, 0.0, 0.0), period=1.0,
            motion=Motion("cv", 0.1), coverage=coverage, detection_probability=0.9,
        )  # fmt: skip
    for step in range(steps):
        time = START + step * 10**9
        states = positions(float(step))
        yield sent(
            truth_key("circles"), "circles", Truth, time, time=time, space=SPACE, frame=CENTRE,
            ids=np.arange(1, TARGETS + 1, dtype=np.uint64), means=states,
        )  # fmt: skip
        for name, frame in RADARS.items():
            if name == LOST[0] and LOST[1] <= step < LOST[2]:
                continue
            yield sent(local_key(name, "tracks"), name, LocalTracks, time, **_local(states, time, frame, rng))
        yield sent(global_key("main", "tracks"), "main", GlobalTracks, time, **_global(states, time, step, rng))
        refused = (Entry("radar3", START, step, 1, "not-finite", 2),) if step % 40 == 39 else ()
        yield sent(
            global_key("main", "log"), "main", StepLog, time, step=step, time=time, config_hash="0" * 16,
            version="0.1.0", taken=(), refused=refused, dropped=(), sources=tuple(RADARS),
            events=({"kind": "start", "epoch": START},) if not step else (), decisions=_nothing_decided(),
        )  # fmt: skip
        yield sent(global_key("main", "status"), "main", Status, time, **_status(time, step))


def _local(states: NDArray[np.float64], time: int, frame: Enu, rng: np.random.Generator) -> dict[str, Any]:
    """Tracks with an error that grows with the range, across the line of sight."""
    nothing = np.zeros((len(states), 4, 4))
    own, _ = geodesy.transform(states, nothing, SPACE, CENTRE, frame)
    reach = np.hypot(own[:, 0], own[:, 2])
    seen = np.flatnonzero(reach < 9000.0)
    sight = np.stack([own[seen, 0], own[seen, 2]], axis=1) / reach[seen, None]
    across = np.stack([-sight[:, 1], sight[:, 0]], axis=1)
    spread = np.zeros((len(seen), 4, 4))
    position = 20.0**2 * sight[:, :, None] * sight[:, None, :]
    position += (0.015 * reach[seen])[:, None, None] ** 2 * across[:, :, None] * across[:, None, :]
    spread[:, ::2, ::2] = position
    spread[:, 1, 1] = spread[:, 3, 3] = 4.0
    noise = np.einsum("bij,bj->bi", np.linalg.cholesky(spread), rng.standard_normal((len(seen), 4)))
    ids = (seen + 10).astype(np.uint64)
    return {
        "time": time, "complete": True, "space": SPACE, "frame": frame, "ids": ids,
        "means": own[seen] + noise, "covariances": spread,
    }  # fmt: skip


def _global(states: NDArray[np.float64], time: int, step: int, rng: np.random.Generator) -> dict[str, Any]:
    """Tentative for three steps; the last target coasts between steps 40 and 60, and is replaced at 100."""
    rho = 0.6
    one = np.array([[SIGMA**2, 0, rho * SIGMA**2, 0], [0, 1, 0, 0], [rho * SIGMA**2, 0, SIGMA**2, 0], [0, 0, 0, 1]])
    covariances = np.repeat(one[None], TARGETS, axis=0)
    noise = rng.standard_normal((TARGETS, 4)) @ np.linalg.cholesky(one).T
    status = np.full(TARGETS, 0 if step < 3 else 1, dtype=np.uint8)
    if 40 <= step < 60:
        status[-1] = 2
    ids = GENERATION + np.arange(1, TARGETS + 1, dtype=np.uint64)
    if step >= 100:
        ids[-1] = GENERATION + 9
    return {
        "time": time, "step": step, "rule": "ci", "space": SPACE, "frame": CENTRE, "ids": ids, "status": status,
        "existence": np.full(TARGETS, 0.95), "means": states + noise, "covariances": covariances,
        "updated": np.full(TARGETS, time), "sources": tuple(RADARS),
        "contributor_counts": np.full(TARGETS, 3, dtype=np.uint16),
        "contributor_source": np.tile(np.arange(3, dtype=np.uint16), TARGETS),
        "contributor_epoch": np.full(3 * TARGETS, START, dtype=np.uint64),
        "contributor_id": np.repeat(np.arange(TARGETS, dtype=np.uint64) + 10, 3),
        "contributor_influence": np.tile([0.5, 0.3, 0.2], TARGETS),
        "ended": ((GENERATION + 5, "merged", GENERATION + 9),) if step == 100 else (),
        "split_from": ((GENERATION + 9, GENERATION + 4),) if step == 110 else (),
    }  # fmt: skip


def _status(time: int, step: int) -> dict[str, Any]:
    sources = {}
    for name in RADARS:
        silent = name == LOST[0] and LOST[1] <= step < LOST[2]
        sources[name] = {
            "alive": not (silent and step >= LOST[1] + 6), "stale": silent and step >= LOST[1] + 3,
            "messages": step, "tracks": TARGETS, "offset": 0.05, "gaps": 0, "repeats": 0, "last": time,
        }  # fmt: skip
    return {
        "time": time, "step": step, "uptime": float(step), "rates": {"messages": 3.0}, "queue": {"pending": 0},
        "refused": {"not-finite": 2 * ((step + 1) // 40)}, "dropped": {}, "sources": sources,
        "tracks": {"tentative": 0, "confirmed": TARGETS, "coasting": 0}, "step_time": {"mean": 0.002},
        "memory": 80 * 2**20,
    }  # fmt: skip


def _nothing_decided() -> Decisions:
    kinds = {"kind": "u1", "track": "u8", "source": "u2", "epoch": "u8", "id": "u8", "other": "u8", "value": "f8"}
    return Decisions(**{name: np.zeros(0, dtype=dtype) for name, dtype in kinds.items()})
