"""How long it takes to score a long mission: `python -m benchmarks.evaluation [--minutes 60] [--targets 1000]`.

A made-up mission at 1 Hz: targets on straight ways over 200 x 200 km, three sources that see nine in ten of them, and a
centre that shows them all, with links and step logs. It is written with the recorder (not drawn), then scored from the
file by another process, which prints the seconds of its parts and its memory.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.recording import Recorder
from fusion_service.review.evaluation import assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.results import text
from schemas import (
    Decisions,
    Entry,
    Enu,
    GlobalTracks,
    LocalTracks,
    Message,
    Motion,
    SensorInfo,
    StepLog,
    Truth,
    encode,
    global_key,
    local_key,
    truth_key,
)
from schemas.messages import KEPT

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = Enu(60.0, 10.0)
SPACE = ("x", "vx", "y", "vy")
SOURCES = ("a", "b", "c")
CUTOFF = 200.0


def mission(seconds: int, targets: int, seed: int = 1) -> Iterator[tuple[str, Message]]:
    """Its messages with their keys, in the order of time."""
    rng = np.random.default_rng(seed)
    start = np.stack([rng.uniform(-1e5, 1e5, targets), rng.normal(0, 50, targets)] * 2, axis=1)
    start[:, 2:] = rng.permutation(start[:, 2:])
    ids = np.arange(1, targets + 1, dtype=np.uint64)
    P = np.diag([400.0, 4.0, 400.0, 4.0])
    for name in SOURCES:
        yield local_key(name, "info"), SensorInfo(
            source=name, epoch=1, seq=0, sent=START, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
            motion=Motion("cv", 0.1),
        )  # fmt: skip
    for k in range(seconds):
        now = START + k * SECOND
        states = start + np.stack([start[:, 1] * k, 0 * ids, start[:, 3] * k, 0 * ids], axis=1)
        head: dict[str, Any] = {"epoch": 1, "seq": k, "sent": now, "time": now}
        where: dict[str, Any] = {"space": SPACE, "frame": FRAME}
        yield truth_key("world"), Truth(source="world", ids=ids, means=states, **head, **where)
        saw = rng.random((len(SOURCES), targets)) < 0.9
        for name, mine in zip(SOURCES, saw, strict=True):
            seen = np.flatnonzero(mine)
            noise = rng.standard_normal((len(seen), 4)) * np.sqrt(np.diag(P))
            yield local_key(name, "tracks"), LocalTracks(
                source=name, complete=True, ids=ids[seen] + 7, means=states[seen] + noise,
                covariances=np.tile(P, (len(seen), 1, 1)), **head, **where,
            )  # fmt: skip
        noise = rng.standard_normal((targets, 4)) * np.sqrt(np.diag(P / 3))
        owner, index = np.nonzero(saw.T)
        source = index.astype(np.uint16)
        epochs = np.ones(len(owner), dtype=np.uint64)
        yield global_key("centre", "tracks"), GlobalTracks(
            source="centre", step=k, rule="ci", ids=ids, status=np.ones(targets, dtype=np.uint8),
            existence=np.ones(targets), means=states + noise, covariances=np.tile(P / 3, (targets, 1, 1)),
            updated=np.full(targets, now), sources=SOURCES, contributor_counts=saw.sum(axis=0).astype(np.uint16),
            contributor_source=source, contributor_epoch=epochs, contributor_id=ids[owner] + 7,
            contributor_influence=np.full(len(owner), 1 / 3), **head, **where,
        )  # fmt: skip
        kept = Decisions(
            np.full(len(owner), KEPT, dtype=np.uint8), ids[owner], source, epochs, ids[owner] + 7,
            np.zeros(len(owner), dtype=np.uint64), rng.chisquare(4, len(owner)),
        )  # fmt: skip
        yield global_key("centre", "log"), StepLog(
            source="centre", step=k, config_hash="0" * 16, version="0.1.0",
            taken=tuple(Entry(name, 1, k, 0) for name in SOURCES), refused=(), dropped=(), events=(),
            sources=SOURCES, decisions=kept, **head,
        )  # fmt: skip


def write(path: Path, seconds: int, targets: int) -> None:
    """The mission as a recording."""
    with Recorder(path, draw=False) as recorder:
        for count, (key, message) in enumerate(mission(seconds, targets)):
            recorder.handle(key, encode(message), message.sent + 50_000_000)
            if count % 60 == 0:
                recorder.tick()


def score(path: Path, profiled: bool) -> None:
    """Score it, and print how long each part took, and the memory."""
    from fusion_service.review.evaluation.report import report

    profile = cProfile.Profile()
    if profiled:
        profile.enable()
    marks = [(time.perf_counter(), time.process_time())]
    book = Logbook.read(path)
    marks.append((time.perf_counter(), time.process_time()))
    scores = assess(book, c=CUTOFF, rows=20_000)
    marks.append((time.perf_counter(), time.process_time()))
    said = text([scores])
    page = report([scores])
    marks.append((time.perf_counter(), time.process_time()))
    profile.disable()
    print(said)
    for name, (wall, busy), (later, busier) in zip(("first reading", "scores", "page"), marks, marks[1:], strict=False):
        print(f"{name}: {later - wall:.1f} s, of which the processor worked {busier - busy:.1f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    size, tracks = path.stat().st_size / 2**30, sum(one.tracks for one in book.traffic.values())
    print(
        f"{tracks} tracks, a recording of {size:.2f} GiB; {peak:.2f} GiB of memory at most; page {len(page) >> 10} KiB"
    )
    if profiled:
        pstats.Stats(profile).sort_stats("tottime").print_stats(16)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--targets", type=int, default=1000)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--score", metavar="FILE", help="score this recording of it, which is kept")
    args = parser.parse_args()
    if args.score:
        score(Path(args.score), args.profile)
        return
    with tempfile.TemporaryDirectory(prefix="evaluation-") as folder:
        path = Path(folder) / "mission.rrd"
        write(path, round(60 * args.minutes), args.targets)
        command = [sys.executable, "-m", "benchmarks.evaluation", "--score", str(path)]
        subprocess.run([*command, *(["--profile"] if args.profile else [])], check=True)


if __name__ == "__main__":
    main()
