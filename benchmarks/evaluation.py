"""How long it takes to score a long mission: `python -m benchmarks.evaluation [--minutes 60] [--targets 1000]`.

A made-up mission at 1 Hz: targets on straight ways over 200 x 200 km, three sources that see nine in ten of them with a
little clutter, and a centre that shows them all. Prints the seconds of each part and the memory.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import resource
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from fusion_service.evaluation import evaluate, format_table
from schemas import Enu, GlobalTracks, LocalTracks, Message, Motion, SensorInfo, Truth

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = Enu(60.0, 10.0)
SPACE = ("x", "vx", "y", "vy")
SOURCES = ("a", "b", "c")


def mission(seconds: int, targets: int, seed: int = 1) -> Iterator[Message]:
    """Its messages in the order of time."""
    rng = np.random.default_rng(seed)
    start = np.stack([rng.uniform(-1e5, 1e5, targets), rng.normal(0, 50, targets)] * 2, axis=1)
    start[:, 2:] = rng.permutation(start[:, 2:])
    ids = np.arange(1, targets + 1, dtype=np.uint64)
    P = np.diag([400.0, 4.0, 400.0, 4.0])
    for name in SOURCES:
        yield SensorInfo(
            source=name, epoch=1, seq=0, sent=START, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
            motion=Motion("cv", 0.1),
        )  # fmt: skip
    for k in range(seconds):
        now = START + k * SECOND
        states = start + np.stack([start[:, 1] * k, 0 * ids, start[:, 3] * k, 0 * ids], axis=1)
        head: dict[str, Any] = {"epoch": 1, "seq": k, "sent": now, "time": now, "space": SPACE, "frame": FRAME}
        yield Truth(source="world", ids=ids, means=states, **head)
        for name in SOURCES:
            seen = np.flatnonzero(rng.random(targets) < 0.9)
            noise = rng.standard_normal((len(seen), 4)) * np.sqrt(np.diag(P))
            yield LocalTracks(
                source=name, complete=True, ids=ids[seen] + 7, means=states[seen] + noise,
                covariances=np.tile(P, (len(seen), 1, 1)), **head,
            )  # fmt: skip
        noise = rng.standard_normal((targets, 4)) * np.sqrt(np.diag(P / 3))
        yield GlobalTracks(
            source="centre", step=k, rule="ci", ids=ids, status=np.ones(targets, dtype=np.uint8),
            existence=np.ones(targets), means=states + noise, covariances=np.tile(P / 3, (targets, 1, 1)),
            updated=np.full(targets, now), sources=SOURCES, contributor_counts=np.zeros(targets, dtype=np.uint16),
            contributor_source=np.zeros(0, dtype=np.uint16), contributor_epoch=np.zeros(0, dtype=np.uint64),
            contributor_id=np.zeros(0, dtype=np.uint64), contributor_influence=np.zeros(0), **head,
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--targets", type=int, default=1000)
    parser.add_argument("--profile", action="store_true")
    args = parser.parse_args()
    messages = list(mission(round(60 * args.minutes), args.targets))
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    profile = cProfile.Profile()
    began = time.perf_counter()
    if args.profile:
        profile.enable()
    scores = evaluate(messages, c=200.0, every=1.0)
    profile.disable()
    took = time.perf_counter() - began
    print(format_table(scores))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{args.minutes:g} min, {args.targets} targets: {took:.1f} s; {held:.2f} GiB of messages, {peak:.2f} at most")
    if args.profile:
        pstats.Stats(profile).sort_stats("cumulative").print_stats(18)


if __name__ == "__main__":
    main()
