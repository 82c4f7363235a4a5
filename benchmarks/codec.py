"""What the codec costs beside bare MessagePack: `python -m benchmarks.codec`.

Each row is one `LocalTracks` of T tracks with four components, existence and times. The yardstick is
`msgpack.unpackb` of the same bytes, measured in turns with the rest; the figures are the best of many rounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import msgpack
import numpy as np

import schemas

ROUNDS = 25
BATCH = 50


def message(tracks: int, seed: int = 1) -> schemas.LocalTracks:
    """T tracks with random positive definite covariances."""
    random = np.random.default_rng(seed)
    factors = random.normal(size=(tracks, 4, 4))
    covariances = factors @ factors.swapaxes(1, 2) + np.eye(4)
    now = 1_780_000_000_000_000_000
    return schemas.LocalTracks(
        source="radar-1",
        epoch=now,
        seq=7,
        sent=now,
        time=now,
        complete=True,
        space=("x", "vx", "y", "vy"),
        frame=schemas.Enu(63.4, 10.4, 40.0),
        ids=np.arange(tracks, dtype=np.uint64),
        means=random.normal(scale=1e3, size=(tracks, 4)),
        covariances=(covariances + covariances.swapaxes(1, 2)) / 2,
        existence=random.uniform(size=tracks),
        updated=np.full(tracks, now, dtype=np.int64),
    )


def measure(tasks: dict[str, Callable[[], object]], target: float = 0.002) -> dict[str, float]:
    """Seconds per call of each task, the best of `ROUNDS` rounds that take the tasks in turns."""
    best = dict.fromkeys(tasks, float("inf"))
    repeats = {}
    for name, task in tasks.items():
        start = time.perf_counter()
        task()
        repeats[name] = max(1, int(target / (time.perf_counter() - start)))
    for _ in range(ROUNDS):
        for name, task in tasks.items():
            start = time.perf_counter()
            for _ in range(repeats[name]):
                task()
            best[name] = min(best[name], (time.perf_counter() - start) / repeats[name])
    return best


def main() -> None:
    print("us per message (times bare unpackb)")
    print(
        f"{'tracks':>6} {'bytes':>7} {'unpackb':>8} "
        + "".join(f"{n:>16}" for n in ("decode", "encode", "digest", "check"))
    )
    for tracks in (0, 20, 200, 2000):
        made = message(tracks)
        data = schemas.encode(made)
        read = schemas.decode(data)
        batch = [schemas.decode(schemas.encode(message(tracks, seed))) for seed in range(BATCH if tracks < 2000 else 2)]
        local = [one for one in batch if isinstance(one, schemas.LocalTracks)]
        times = measure(
            {
                "unpackb": partial(msgpack.unpackb, data),
                "decode": partial(schemas.decode, data),
                "encode": partial(schemas.encode, made),
                "digest": partial(schemas.digest, read),
                "check": partial(schemas.check_numbers, local),
            }
        )
        times["check"] /= len(local)
        bare = times.pop("unpackb")
        row = "".join(f"{value * 1e6:9.1f} ({value / bare:4.1f})" for value in times.values())
        print(f"{tracks:6d} {len(data):7d} {bare * 1e6:8.2f} {row}")
    print(f"check: numeric checks, {BATCH} messages at once (2 of 2000 tracks)")


if __name__ == "__main__":
    main()
