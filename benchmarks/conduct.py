"""Alarms about sound sources, and what looking for them costs: `python -m benchmarks.conduct [--seconds 3600]`.

Three radars (detection probability 0.9, one in twenty messages late and out of order, tracks of clutter that live for
two to nine seconds, ids used again) and two AIS stations (identities, ships at anchor whose fixes repeat to the bit,
places rounded to 0.2 m) watch the same 16 objects: ships under way, aircraft that turn at up to 3 g, some at anchor.
Nothing is wrong with any of them: every alarm is a false one. Then the share of a step at 20 sources of 500 tracks.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any
from unittest import mock

import numpy as np

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre
from fusion_service.centre.supervision.conduct import Conduct

SECOND = 10**9
START = 1_780_000_000 * SECOND
FRAME = schemas.Enu(59.0, 10.0)
SPACE = ("x", "y", "vx", "vy")
OBJECTS, ANCHORED, FAST = 16, 4, 4
SIGMA = np.array([20.0, 20.0, 2.0, 2.0])
FIX = np.array([5.0, 5.0, 0.3, 0.3])
RADARS = ("radar-1", "radar-2", "radar-3")
STATIONS = ("ais-1", "ais-2")


class _World:
    """Objects that turn now and then; the last `ANCHORED` do not move, the first `FAST` are aircraft."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.state = np.hstack([rng.uniform(-15_000, 15_000, (OBJECTS, 2)), np.zeros((OBJECTS, 2))])
        speed, course = np.full(OBJECTS, 8.0), rng.uniform(0, 2 * np.pi, OBJECTS)
        speed[:FAST], speed[-ANCHORED:] = 150.0, 0.0
        self.state[:, 2:] = speed[:, None] * np.stack([np.cos(course), np.sin(course)], axis=1)
        self.turn = np.zeros(OBJECTS)

    def step(self) -> None:
        """One second on."""
        new = self.rng.random(OBJECTS) < 0.05
        most = np.full(OBJECTS, 0.03)
        most[:FAST] = 0.2
        self.turn = np.where(new, self.rng.uniform(-1, 1, OBJECTS) * most * (self.rng.random(OBJECTS) < 0.5), self.turn)
        home = np.hypot(*self.state[:, :2].T) > 20_000
        inward = (self.state[:, 0] * self.state[:, 3] - self.state[:, 1] * self.state[:, 2]) > 0
        self.turn = np.where(home, np.where(inward, most, -most), self.turn)
        c, s = np.cos(self.turn), np.sin(self.turn)
        vx, vy = self.state[:, 2].copy(), self.state[:, 3].copy()
        self.state[:, :2] += self.state[:, 2:]
        self.state[:, 2], self.state[:, 3] = c * vx - s * vy, s * vx + c * vy


class _Radar:
    """Tracks of what it sees, with errors that go together in time, and of clutter."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.error = rng.normal(size=(OBJECTS, 4)) * SIGMA
        self.clutter: dict[int, tuple[int, Floats]] = {}

    def tracks(self, state: Floats) -> tuple[list[int], Floats]:
        """Ids and states of a scan."""
        rng = self.rng
        self.error = 0.6 * self.error + 0.8 * rng.normal(size=(OBJECTS, 4)) * SIGMA
        seen = np.flatnonzero(rng.random(OBJECTS) < 0.9)
        self.clutter = {one: (left - 1, x) for one, (left, x) in self.clutter.items() if left > 0}
        if rng.random() < 0.2:
            free = next(number for number in range(100, 200) if number not in self.clutter)
            self.clutter[free] = int(rng.integers(2, 10)), np.array([*rng.uniform(-15_000, 15_000, 2), 0.0, 0.0])
        noise = {one: x + rng.normal(size=4) * SIGMA for one, (_, x) in self.clutter.items()}
        return [*(seen + 1).tolist(), *noise], np.vstack([(state + self.error)[seen], *noise.values()])


def false_alarms(seconds: int, seed: int) -> Counter[str]:
    """How many alarms there are in so many seconds, by what they say."""
    rng = np.random.default_rng(seed)
    world, radars = _World(rng), {name: _Radar(rng) for name in RADARS}
    centre = FusionCentre({"frame": {"kind": "enu", "lat": 59.0, "lon": 10.0}})
    told: Counter[str] = Counter()
    seq: Counter[str] = Counter()
    late: list[schemas.LocalTracks] = []
    held = {name: world.state.copy() for name in STATIONS}
    for name in (*RADARS, *STATIONS):
        seen = {"coverage": schemas.Disk(40_000.0), "detection_probability": 0.9} if name in RADARS else {}
        info: dict[str, Any] = {
            "frame": FRAME,
            "position": (0.0, 0.0, 0.0),
            "period": 1.0,
            "motion": schemas.Motion("cv", 4.0),
        }
        centre.handle(schemas.SensorInfo(source=name, epoch=1, seq=0, sent=START, **{**info, **seen}), START)
    for t in range(1, seconds + 1):
        world.step()
        now, coming, late = START + t * SECOND, late, []
        for name in (*RADARS, *STATIONS):
            if name in RADARS:
                ids, means, sigma, more = *radars[name].tracks(world.state), SIGMA, {}
            else:
                moving = np.arange(OBJECTS) < OBJECTS - ANCHORED
                fixes = np.round((world.state + rng.normal(size=world.state.shape) * FIX) * 5.0) / 5.0
                held[name] = np.where(moving[:, None], fixes, held[name])
                ids, means, sigma = list(range(1, OBJECTS + 1)), held[name], FIX
                more = {"identity": tuple(f"mmsi:{one}" for one in ids)}
            message = _message(name, seq[name], now, ids, means, sigma, more)
            seq[name] += 1
            (late if name in RADARS and rng.random() < 0.05 else coming).append(message)
        for message in coming:
            centre.handle(message, now + SECOND // 10)
        for event in centre.step(now).log.events:
            if event["kind"] in ("alarm", "copy"):
                told[f"{event['kind']} {event.get('what', '')}"] += 1
                print(f"at {t} s, {event['source']}: {event['why']}")
    return told


def _message(
    name: str, seq: int, now: int, ids: list[int], means: Floats, sigma: Floats, more: dict[str, Any]
) -> schemas.LocalTracks:
    parts: dict[str, Any] = {"source": name, "epoch": 1, "seq": seq, "sent": now, "time": now, "complete": True, **more}
    parts |= {"space": SPACE, "frame": FRAME, "ids": np.array(ids, dtype=np.uint64), "means": means}
    return schemas.LocalTracks(**parts, covariances=np.tile(np.diag(sigma**2), (len(ids), 1, 1)))


def share(sources: int = 20, tracks: int = 500, steps: int = 12, seed: int = 1) -> tuple[float, float]:
    """Median seconds of a step, and of looking at conduct in it."""
    rng, spent, took = np.random.default_rng(seed), [0.0], []
    observe = Conduct.observe

    def timed(self: Conduct, *arguments: Any) -> None:
        begin = time.process_time()
        observe(self, *arguments)
        spent[-1] += time.process_time() - begin

    with mock.patch.object(Conduct, "observe", timed):
        centre = FusionCentre({"frame": {"kind": "enu", "lat": 59.0, "lon": 10.0}})
        state = np.hstack([rng.uniform(-1e5, 1e5, (tracks, 2)), rng.normal(size=(tracks, 2)) * 50])
        for t in range(1, steps + 1):
            state[:, :2] += state[:, 2:]
            for number in range(sources):
                noisy = state + rng.normal(size=state.shape) * SIGMA
                message = _message(f"s{number:02}", t, START + t * SECOND, list(range(tracks)), noisy, SIGMA, {})
                centre.handle(message, START + t * SECOND)
            begin = time.process_time()
            centre.step(START + t * SECOND)
            took.append(time.process_time() - begin)
            spent.append(0.0)
    return float(np.median(took[3:])), float(np.median(spent[3:-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description="False alarms about sound sources, and what looking costs.")
    parser.add_argument("--seconds", type=int, default=3600, help="of the world, each of five sources")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    told = false_alarms(args.seconds, args.seed)
    hours = args.seconds / 3600 * (len(RADARS) + len(STATIONS))
    print(f"{hours:g} source hours, seed {args.seed}: {sum(told.values())} alarms and copies {dict(told)}")
    step, looking = share()
    print(f"20 sources x 500 tracks: {1e3 * looking:.1f} ms of a step of {1e3 * step:.0f} ms ({looking / step:.1%})")


if __name__ == "__main__":
    main()
