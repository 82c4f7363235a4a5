"""Kalman filters of one target that measure at times of their own, and the joint covariance of all their errors,
carried along densely: the truth beside which what is derived of it stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from fusion_service.arrays import Floats, Ints
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import empty_tracks, unlinked

SECOND = 10**9
SPACE = ("x", "vx", "y", "vy")
PLACE = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])


def moved(q: float, dt: float) -> tuple[Floats, Floats]:
    """F and Q of nearly constant velocity, by its textbook formula."""
    F, Q = np.array([[1.0, dt], [0.0, 1.0]]), q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.asarray(np.kron(np.eye(2), F)), np.asarray(np.kron(np.eye(2), Q))


@dataclass(frozen=True)
class Heard:
    """The versions of one step."""

    row: Ints
    time: Ints
    before: Ints
    predicted_covariance: Floats
    covariance: Floats


@dataclass
class Filters:
    """N filters of each of T targets. sigma (N, T): of their measurements of position. q: what they allow for; true:
    what there is. P (N, T, 4, 4) at `version` (N,) s; J (T, 4 N, 4 N) at `now` s. lost: chance that a measurement is
    missed, by the filter itself; unheard: that its message is not heard."""

    sigma: Floats
    periods: tuple[float, ...]
    offsets: tuple[float, ...]
    q: float = 0.5
    true: float | None = None
    lost: float = 0.0
    unheard: float = 0.0
    seed: int = 3
    now: float = 0.0
    P: Floats = field(init=False)
    J: Floats = field(init=False)
    version: list[float] = field(init=False)
    told: list[tuple[float, Floats]] = field(init=False)
    due: list[float] = field(init=False)

    def __post_init__(self) -> None:
        N, T = self.sigma.shape
        start = np.diag([400.0, 25.0, 400.0, 25.0])
        self.P = np.broadcast_to(start, (N, T, 4, 4)).copy()
        self.J = np.broadcast_to(np.tile(start, (N, N)), (T, 4 * N, 4 * N)).copy()  # one and the same start
        self.version, self.due = [0.0] * N, list(self.offsets)
        self.told = [(0.0, self.P[i].copy()) for i in range(N)]
        self.rng = np.random.default_rng(self.seed)

    def until(self, time: float) -> Heard:
        """Go on to `time`, s: the versions that came, rows being (source, target)."""
        T = self.sigma.shape[1]
        heard: list[tuple[float, int, float, Floats, Floats]] = []
        while (i := int(np.argmin(self.due))) is not None and self.due[i] <= time + 1e-9:
            t, self.due[i] = self.due[i], self.due[i] + self.periods[i]
            if self.rng.random() < self.lost:
                continue
            self._measure(i, t)
            if self.rng.random() >= self.unheard:
                before, old = self.told[i]
                F, Q = moved(self.q, t - before)
                heard.append((t, i, before, F @ old @ F.T + Q, self.P[i].copy()))
                self.told[i] = (t, self.P[i].copy())
        self._predict(time)
        heard.sort(key=lambda one: one[:2])

        def ns(seconds: float) -> Ints:
            return np.full(T, round(seconds * SECOND))

        if not heard:
            none = np.zeros(0, dtype=np.int64)
            return Heard(none, none, none, np.zeros((4, 4, 0)), np.zeros((4, 4, 0)))
        return Heard(
            np.concatenate([i * T + np.arange(T) for _, i, *_ in heard]),
            np.concatenate([ns(t) for t, *_ in heard]),
            np.concatenate([ns(one[2]) for one in heard]),
            np.concatenate([np.moveaxis(one[3], 0, 2) for one in heard], axis=2),
            np.concatenate([np.moveaxis(one[4], 0, 2) for one in heard], axis=2),
        )

    def _predict(self, t: float) -> None:
        F, Q = moved(self.q if self.true is None else self.true, t - self.now)
        N = len(self.sigma)
        whole = np.kron(np.eye(N), F)
        self.J, self.now = whole @ self.J @ whole.T + np.tile(Q, (N, N)), t

    def _measure(self, i: int, t: float) -> None:
        self._predict(t)
        F, Q = moved(self.q, t - self.version[i])
        P = F @ self.P[i] @ F.T + Q
        R = self.sigma[i][:, None, None] ** 2 * np.eye(2)
        K = P @ PLACE.T @ np.linalg.inv(PLACE @ P @ PLACE.T + R)
        B = np.eye(4) - K @ PLACE
        self.P[i], self.version[i] = B @ P @ B.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2), t
        A = np.broadcast_to(np.eye(self.J.shape[1]), self.J.shape).copy()
        part = slice(4 * i, 4 * i + 4)
        A[:, part, part] = B
        self.J = A @ self.J @ A.swapaxes(1, 2)
        self.J[:, part, part] += K @ R @ K.swapaxes(1, 2)

    def rows(self, links: Ints | None = None) -> Rows:
        """The tracks as heard, predicted to `now`; all of a target are linked to its global track, or to `links`."""
        N, T = self.sigma.shape
        P = []
        for before, old in self.told:
            F, Q = moved(self.q, self.now - before)
            P.append(np.moveaxis(F @ old @ F.T + Q, 0, 2))
        count = N * T
        columns = unlinked(count)
        columns["link"] = np.tile(np.arange(1, T + 1), N).astype(np.uint64) if links is None else links
        zeros = np.zeros(count)
        tracks = replace(
            empty_tracks(4),
            id=np.tile(np.arange(T), N).astype(np.uint64) + np.uint64(7),
            time=np.repeat([round(before * SECOND) for before, _ in self.told], T),
            mean=np.zeros((4, count)),
            covariance=np.concatenate(P, axis=2),
            log_weight=np.zeros((0, count)),
            part_mean=np.zeros((4, 0, count)),
            part_covariance=np.zeros((4, 4, 0, count)),
            existence=zeros,
            updated=np.zeros(count, dtype=np.int64),
            interval=np.zeros(count, dtype=np.int64),
            **columns,
        )
        return Rows(
            source=np.repeat(np.arange(N), T),
            epoch=np.full(count, 5, dtype=np.uint64),
            tracks=tracks,
            may_start=np.ones(count, dtype=np.bool_),
            interval=np.zeros(count, dtype=np.int64),
            lost=np.zeros(count, dtype=np.bool_),
            gate=zeros,
            fresh=np.ones(count, dtype=np.bool_),
            kept={f"s{i}": T for i in range(N)},
        )

    def members(self) -> Ints:
        """Rows (T, N) of each target."""
        N, T = self.sigma.shape
        return np.arange(N * T).reshape(N, T).T

    def blocks(self) -> Floats:
        """The true cross-covariances (N, N, 4, 4, T) now."""
        N, T = self.sigma.shape
        return np.asarray(self.J.reshape(T, N, 4, N, 4).transpose(1, 3, 2, 4, 0))


def steps(filters: Filters, seconds: int) -> Iterator[tuple[int, Heard]]:
    """Steps at every second: its time, ns, and what came."""
    for k in range(1, seconds + 1):
        yield k * SECOND, filters.until(float(k))
