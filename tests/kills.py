"""A service that is killed at random moments while tracks are young: which ids change, and is any given twice?

    python -m tests.kills --times 100

Real processes on loopback: a hub, two sources whose targets come and go all the time, the service, and an observer
that keeps every picture. The service is killed with kill -9 again and again, after five pictures and a time between
nothing and a second and a half, and started again on its state folder. Every target has a place of its own, so that the
ids under which it was published are known. An id changed where a target has another one than it was first published
under; ids must have one target each.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from schemas.messages import CONFIRMED, GlobalTracks
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened

__all__ = ["Tally", "killed"]

# Targets k at (1000 k, 0), each for a while, one more every so often; argv: endpoint, name, seconds between births.
SENSOR = """
import sys, time
import numpy as np
from schemas import Enu, Motion
from sensor_clients.publisher import TrackPublisher
endpoint, name, every = sys.argv[1], sys.argv[2], float(sys.argv[3])
frame, space = Enu(59.0, -55.0), ("x", "y", "vx", "vy")
rng = np.random.default_rng(len(name))
with TrackPublisher(name, connect=endpoint) as publisher:
    publisher.info(frame=frame, position=(0, 0, 0), period=0.2, motion=Motion("cv", 1.0))
    print("up", flush=True)
    while True:
        newest = int(time.time() / every)
        targets = np.arange(newest - 39, newest + 1)
        means = np.zeros((len(targets), 4))
        means[:, 0] = 1000.0 * (targets % 100_000)
        means += rng.normal(size=means.shape)
        publisher.tracks(time=time.time_ns(), space=space, frame=frame, ids=targets.astype(np.uint64), means=means,
                         covariances=np.tile(np.diag([25.0, 25.0, 4.0, 4.0]), (len(targets), 1, 1)))
        time.sleep(0.2)
"""
EVERY = 0.3
CENTRES = (
    "confirm_hits = 3\nconfirm_within = 4\nconfirm_sources = 3",
    "confirm_hits = 60\nconfirm_within = 60\nconfirm_sources = 3",
)
"""In turn: tracks are tentative for a short while, and end soon without data; they are tentative for long, so that
nothing is saved for their sake."""
WAIT = 90.0


@dataclass
class Tally:
    """What was seen. times: kills; targets, and those of them that were younger than a checkpoint at a kill; changed:
    {target: its ids} of those with several; twice: {id: its targets} of those with several; back: ids that ended and
    were there again."""

    times: int = 0
    targets: int = 0
    young: int = 0
    pictures: int = 0
    changed: dict[int, list[int]] = field(default_factory=dict)
    twice: dict[int, list[int]] = field(default_factory=dict)
    back: list[int] = field(default_factory=list)


@contextmanager
def _scene() -> Iterator[Scene]:
    hub = Hub().start()
    try:
        with tempfile.TemporaryDirectory() as folder, opened(hub, Path(folder)) as scene:
            yield scene
    finally:
        hub.kill()


def killed(times: int, seed: int = 1) -> Tally:
    """Kill the service so often, and look at every picture that it published."""
    rng, tally = random.Random(seed), Tally()
    with _scene() as scene:
        for name in ("r1", "r2"):
            assert scene.start(SENSOR, scene.endpoint, name, str(EVERY)).line() == "up"
        for number in range(times):
            count = len(scene.seen.pictures)
            service = scene.service(CENTRES[number % 2])
            eventually(lambda count=count: len(scene.seen.pictures) > count + 5, WAIT)  # type: ignore[misc]
            time.sleep(rng.uniform(0.0, 1.5))
            service.kill()
            tally.times += 1
            tally.young += int((scene.seen.pictures[-1].status != CONFIRMED).sum())
        scene.service(CENTRES[0])
        count = len(scene.seen.pictures)
        eventually(lambda: len(scene.seen.pictures) > count + 10, WAIT)
        pictures = list(scene.seen.pictures)
    return _judged(pictures, tally)


def _judged(pictures: list[GlobalTracks], tally: Tally) -> Tally:
    tally.pictures = len(pictures)
    ids: dict[int, dict[int, None]] = {}
    ended: set[int] = set()
    for picture in pictures:
        ended |= {track for track, _, _ in picture.ended}
        tally.back += [one for one in picture.ids.tolist() if one in ended]
        for target, track in zip(np.rint(picture.means[:, 0] / 1000).tolist(), picture.ids.tolist(), strict=True):
            ids.setdefault(int(target), {})[track] = None
    of: dict[int, list[int]] = {}
    for target, tracks in ids.items():
        for track in tracks:
            of.setdefault(track, []).append(target)
    tally.targets = len(ids)
    tally.changed = {target: [*tracks] for target, tracks in ids.items() if len(tracks) > 1}
    tally.twice = {track: targets for track, targets in of.items() if len(targets) > 1}
    return tally


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100, help="kills (default 100)")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    given = parser.parse_args()
    begin = time.monotonic()
    tally = killed(given.times, given.seed)
    print(f"{tally.times} kills in {time.monotonic() - begin:.0f} s, seed {given.seed}: {tally.pictures} pictures,")
    print(f"{tally.targets} targets, {tally.young} tracks tentative or coasting in the last pictures before them")
    print(f"ids that changed: {len(tally.changed)} {tally.changed or ''}")
    print(f"ids of two targets: {len(tally.twice)} {tally.twice or ''}")
    print(f"ids that ended and were there again: {len(set(tally.back))} {sorted(set(tally.back)) or ''}")
    raise SystemExit(1 if tally.changed or tally.twice or tally.back else 0)


if __name__ == "__main__":
    main()
