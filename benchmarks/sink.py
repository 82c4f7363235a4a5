"""Who listens to a service under load and looks at its pictures: part of `benchmarks.service`."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque

import numpy as np

import schemas
from benchmarks.load import Load, World

__all__ = ["LOOKED", "Sink"]

LOOKED = 2.0
"""Pictures a second that are looked at, target by target."""


class Sink:
    """Pictures and logs as they come. Threads of the bus only append; one of its own looks at them."""

    def __init__(self, load: Load, seconds: float, warm: float) -> None:
        self._seconds, self._warm, self._world = seconds, warm, load.world()
        self._queue: deque[tuple[int, bytes]] = deque()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._looked = 0
        self.start = 2**62
        self.arrived: dict[int, int] = {}
        self.sizes: list[tuple[int, int, int]] = []
        """Of each full picture when it came, its bytes, its tracks."""
        self.taken: list[tuple[int, str, int]] = []
        self.lost: Counter[str] = Counter()
        self.statuses: list[schemas.Status] = []
        self.looked = self.missing = self.doubled = self.mixed = self.uneven = 0

    def note(self, _key: str, data: bytes) -> None:
        """A callback of the bus."""
        self._queue.append((time.time_ns(), data))

    def __enter__(self) -> Sink:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._done.wait(0.01) or self._queue:
            while self._queue:
                at, data = self._queue.popleft()
                message = schemas.decode(data)
                if isinstance(message, schemas.GlobalTracks):
                    self._picture(at, len(data), message)
                elif isinstance(message, schemas.StepLog):
                    self.taken += [(message.time, entry.source, entry.seq) for entry in message.taken]
                    for entry in (*message.refused, *message.dropped):
                        self.lost[entry.reason] += max(entry.count, 1)
                elif isinstance(message, schemas.Status):
                    self.statuses.append(message)

    def _picture(self, at: int, size: int, picture: schemas.GlobalTracks) -> None:
        self.arrived[picture.time] = at
        begin = self.start + round(self._warm * 1e9)
        if getattr(picture, "delta", False):
            return
        self.sizes.append((at, size, len(picture.ids)))
        if not begin <= picture.time <= self.start + round(self._seconds * 1e9):
            return
        self.uneven += len(picture.ids) != self._world.load.targets
        if (picture.time - begin) / 1e9 * LOOKED >= self._looked:
            self._looked += 1
            missing, doubled, mixed = _compared(picture, self._world, self.start)
            self.looked, self.missing, self.doubled = self.looked + 1, self.missing + missing, self.doubled + doubled
            self.mixed += mixed


def _compared(picture: schemas.GlobalTracks, world: World, start: int) -> tuple[int, int, int]:
    """Targets that a picture does not have; tracks beyond the first of a target; tracks of more targets than one, or
    half the spacing of targets away from theirs."""
    count = world.load.targets
    track = np.repeat(np.arange(len(picture.ids)), picture.contributor_counts)
    target = picture.contributor_id.astype(np.intp) - 1
    first = np.full(len(picture.ids), -1)
    first[track[::-1]] = target[::-1]
    mixed = np.zeros(len(picture.ids), dtype=np.bool_)
    mixed[track[first[track] != target]] = True
    there = first >= 0
    held = np.bincount(first[there], minlength=count)
    away = world.truth(picture.time - start)[first, :2] - picture.means[:, :2]
    mixed |= there & (np.hypot(*away.T) > 0.5 * world.load.spacing)
    return int((held == 0).sum()), int(np.maximum(held - 1, 0).sum() + (~there).sum()), int(mixed.sum())
