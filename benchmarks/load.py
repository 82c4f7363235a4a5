"""Tracks of many targets by several sources, with unequal covariances, as messages: the load of `benchmarks.centre` and
`benchmarks.service`.

Targets lie on a grid of cells of `spacing` m, a place at random in each, and fly straight, all nearly alike, so that
none meets another in half an hour. Of S sources with about T tracks each, the targets are as many as let `overlap`
sources see each, S T / overlap: a target is seen by that many sources in a row, the first of which goes from target to
target in turn. A track has the number of its target for an id. Every track says a covariance of its own (sigmas of .5
to 2 times the source's, turned by any angle), and its error is drawn from that anew for every scan.
"""

from __future__ import annotations

import time as clock
from dataclasses import dataclass

import numpy as np

import schemas
from fusion_service.arrays import Floats
from fusion_service.rules import fuse_last

__all__ = ["FRAME", "SPACE", "Load", "floor", "scans"]

SPACE = ("x", "y", "vx", "vy")
FRAME = schemas.Enu(59.0, -55.0)
KEPT = 8
"""Errors of so many scans are drawn; later ones are the same again."""


@dataclass(frozen=True, slots=True)
class Load:
    """S `sources` of T `tracks` each, each target by `overlap` of them, scans `rate` times a second."""

    sources: int
    tracks: int
    overlap: int
    rate: float = 10.0
    spacing: float = 2000.0
    seed: int = 1

    @property
    def targets(self) -> int:
        """How many there are."""
        return -(-self.sources * self.tracks // self.overlap)

    @property
    def updates(self) -> float:
        """Local tracks a second."""
        return self.sources * self.tracks * self.rate

    def world(self) -> World:
        """The targets, and what is said of them."""
        return World(self)


class World:
    """What each source says at each scan."""

    def __init__(self, load: Load) -> None:
        self.load = load
        rng = np.random.default_rng(load.seed)
        count = load.targets
        side = int(np.ceil(np.sqrt(count)))
        cell = np.stack(np.divmod(np.arange(count), side)) - 0.5 * side
        self._place = ((cell + rng.uniform(0.3, 0.7, (2, count))) * load.spacing).T
        self._velocity = np.array([20.0, 10.0]) + rng.normal(0.0, 0.3, (count, 2))
        first = np.arange(count) % load.sources
        self._whose = [np.flatnonzero((number - first) % load.sources < load.overlap) for number in range(load.sources)]
        self._covariances = [self._drawn(len(whose), rng) for whose in self._whose]
        roots = [np.linalg.cholesky(one) for one in self._covariances]
        self._errors = [
            [np.einsum("bij,bj->bi", root, rng.normal(size=(len(root), 4))) for root in roots] for _ in range(KEPT)
        ]

    def _drawn(self, count: int, rng: np.random.Generator) -> Floats:
        """Covariances (count, 4, 4) of x, y, vx, vy."""
        angle, sigma = rng.uniform(0.0, np.pi, count), rng.uniform(0.5, 2.0, (count, 2))
        c, s = np.cos(angle), np.sin(angle)
        turn = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0) * sigma[:, None, :]
        block = turn @ turn.swapaxes(1, 2)
        shape = np.array([[20.0**2, 0.3 * 20.0 * 2.0], [0.3 * 20.0 * 2.0, 2.0**2]])
        return np.asarray(np.einsum("ab,tij->taibj", shape, block).reshape(count, 4, 4))

    def truth(self, time: int) -> Floats:
        """States (targets, 4) at a time, ns since the start."""
        return np.concatenate([self._place + time / 1e9 * self._velocity, self._velocity], axis=1)

    def message(self, source: int, scan: int, start: int = 0) -> schemas.LocalTracks:
        """What a source says in its scan of that number; `start`: the time of the scan 0, ns."""
        return self.at(source, scan, start + round(scan / self.load.rate * 1e9), start)

    def at(self, source: int, scan: int, time: int, start: int) -> schemas.LocalTracks:
        """The same of a scan at any `time`, ns; `start`: when the truth begins."""
        return schemas.LocalTracks(
            source=f"load-{source + 1:02d}", epoch=max(start, 1), seq=scan, sent=time, time=time, complete=True,
            space=SPACE, frame=FRAME, ids=(self._whose[source] + 1).astype(np.uint64),
            means=self.truth(time - start)[self._whose[source]] + self._errors[scan % KEPT][source],
            covariances=self._covariances[source],
        )  # fmt: skip


def scans(load: Load) -> list[bytes]:
    """The first scan of every source, as it is sent."""
    world = load.world()
    return [schemas.encode(world.message(source, 0)) for source in range(load.sources)]


def floor(data: list[bytes], overlap: int, repeat: int = 5) -> float:
    """CPU seconds to unpack a scan of every source, fuse as many tracks in batches by `naive`, and pack a scan: the
    least of `repeat` times."""

    def once() -> float:
        begin = clock.process_time()
        messages = [one for one in map(schemas.decode, data) if isinstance(one, schemas.LocalTracks)]
        few = min(len(one.ids) for one in messages)
        means = np.ascontiguousarray(np.stack([one.means[:few].T for one in messages[:overlap]]))
        spreads = [np.moveaxis(one.covariances[:few], 0, -1) for one in messages[:overlap]]
        for _ in range(max(len(data) // overlap, 1)):
            fuse_last("naive", means, np.ascontiguousarray(np.stack(spreads)))
        schemas.encode(messages[0])
        return clock.process_time() - begin

    return min(once() for _ in range(repeat))
