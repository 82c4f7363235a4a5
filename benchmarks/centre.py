"""A step of the centre beside its parts, side by side in one run: `python -m benchmarks.centre`.

T targets seen by three sources each, links standing, det-CI. The ratio is to the time of the bare fusion of the
same T x 3 tracks by `fuse_last`; "first" is the step that links everything from nothing. Then the same under every
memory and under `auto`, of trackers that are Kalman filters: the part of a step that fuses, and its ratio to that of
`ci`; goal: `memory = "tracklet"` within 2 at 10,000 targets.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.memory import Memory
from fusion_service.rules import fuse_last

SECOND = 10**9
SPACE = ("x", "y", "vx", "vy")
FRAME = schemas.Enu(59.0, -55.0)
SIGMA = np.array([30.0, 30.0, 2.0, 2.0])
WAYS: dict[str, dict[str, Any]] = {
    "ci": {"rule": "ci"},
    "ci, recursive": {"rule": "ci", "memory": "recursive"},
    "tracklet": {"memory": "tracklet"},
    "auto": {"rule": "auto"},
    "bar-shalom-campo, derived": {"rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}},
    "bci, derived": {"rule": "bci", "rule_options": {"max_correlation": "derived"}},
}


def messages(states: np.ndarray, second: int, rng: np.random.Generator) -> list[schemas.LocalTracks]:
    now = states.copy()
    now[:, :2] += second * states[:, 2:]
    return [
        schemas.LocalTracks(
            source=source, epoch=1, seq=second, sent=0, time=second * SECOND, complete=True, space=SPACE, frame=FRAME,
            ids=np.arange(1, len(states) + 1, dtype=np.uint64),
            means=now + rng.normal(size=now.shape) * SIGMA,
            covariances=np.tile(np.diag(SIGMA**2), (len(states), 1, 1)),
        )
        for source in ("r1", "r2", "r3")
    ]  # fmt: skip


def best(call: Callable[[], object], repeat: int = 5) -> float:
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def run(targets: int) -> str:
    rng = np.random.default_rng(1)
    side = 2000.0 * np.sqrt(targets)
    states = np.concatenate([rng.uniform(-side, side, (targets, 2)), rng.normal(0, 50, (targets, 2))], axis=1)
    centre = FusionCentre({"sources": {name: {"override": True} for name in ("r1", "r2", "r3")}})
    steps = []
    for second in range(1, 8):
        batch = messages(states, second, rng)
        for message in batch:
            centre.handle(message, 10**18)
        begin = time.perf_counter()
        centre.step(second * SECOND)
        steps.append(time.perf_counter() - begin)
    means = np.ascontiguousarray(np.stack([m.means.T for m in batch]))
    covariances = np.ascontiguousarray(np.stack([np.moveaxis(m.covariances, 0, 2) for m in batch]))
    fusing = best(lambda: fuse_last("ci", means, covariances, criterion="det", influence=True))
    data = [schemas.encode(message) for message in batch]
    reading = best(lambda: schemas.check_numbers([schemas.decode(one) for one in data]))  # type: ignore[misc]
    saving = best(centre.checkpoint)
    step = min(steps[1:])
    return (
        f"{targets:7d} {1e3 * steps[0]:10.2f} {1e3 * step:10.2f} {step / fusing:12.1f} "
        f"{1e3 * reading:12.2f} {1e3 * saving:12.2f} {1e6 * step / targets:14.1f}"
    )


def mixtures(batch: list[schemas.LocalTracks], components: int, rng: np.random.Generator) -> list[schemas.LocalTracks]:
    """The same tracks with so many components each."""
    if components == 1:
        return batch
    out = []
    for message in batch:
        count = len(message.ids)
        means = np.repeat(message.means, components, axis=0)
        out.append(
            dataclasses.replace(
                message,
                means=means + rng.normal(size=means.shape) * SIGMA,
                covariances=np.repeat(message.covariances, components, axis=0),
                counts=np.full(count, components, dtype=np.uint16),
                weights=np.full(count * components, 1.0 / components),
            )
        )
    return out


def run_mixtures(rule: str, components: int, targets: int = 1000) -> float:
    """Seconds of a step with so many components per track, links standing."""
    rng = np.random.default_rng(1)
    side = 2000.0 * np.sqrt(targets)
    states = np.concatenate([rng.uniform(-side, side, (targets, 2)), rng.normal(0, 50, (targets, 2))], axis=1)
    sources = {name: {"override": True} for name in ("r1", "r2", "r3")}
    centre = FusionCentre({"sources": sources, "mixture_rule": rule, "max_components": 4})
    steps = []
    for second in range(1, 5):
        for message in mixtures(messages(states, second, rng), components, rng):
            centre.handle(message, 10**18)
        begin = time.perf_counter()
        centre.step(second * SECOND)
        steps.append(time.perf_counter() - begin)
    return min(steps[1:])


class TimedMemory(Memory):
    """Says how long each fusing took, s."""

    def fuse(self, *args: Any) -> Any:
        begin = time.perf_counter()
        done = super().fuse(*args)
        self.times = [*getattr(self, "times", []), time.perf_counter() - begin]
        return done


class TimedCentre(FusionCentre):
    """A centre whose fusing is timed."""

    def _begin(self) -> None:
        super()._begin()
        self._memory: TimedMemory = TimedMemory(self._intake)


def filtered(targets: int, seconds: int) -> Iterator[list[schemas.LocalTracks]]:
    """What three Kalman filters of position, sigma 10, 15 and 20 m, say of targets that wander with q = 1 m2/s3."""
    rng = np.random.default_rng(1)
    noise = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    F, Q, H = np.eye(4) + np.eye(4, k=2), np.kron(noise, np.eye(2)), np.eye(4)[:2]
    side = int(np.ceil(np.sqrt(targets)))
    places = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:targets] * 2000.0
    x = np.concatenate([places, rng.normal(0, 20, (targets, 2))], axis=1)
    states = {f"r{k}": (x + rng.normal(size=x.shape) * SIGMA, np.diag(SIGMA**2)) for k in (1, 2, 3)}
    for second in range(1, seconds + 1):
        x = x @ F.T + rng.multivariate_normal(np.zeros(4), Q, targets)
        out = []
        for (source, (m, P)), sigma in zip(list(states.items()), (10.0, 15.0, 20.0), strict=True):
            m, P = m @ F.T, F @ P @ F.T + Q
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + sigma**2 * np.eye(2))
            m = m + (x[:, :2] + rng.normal(size=(targets, 2)) * sigma - m @ H.T) @ K.T
            P = (np.eye(4) - K @ H) @ P
            states[source] = m, 0.5 * (P + P.T)
            out.append(
                schemas.LocalTracks(
                    source=source, epoch=1, seq=second, sent=0, time=second * SECOND, complete=True, space=SPACE,
                    frame=FRAME, ids=np.arange(1, targets + 1, dtype=np.uint64), means=m,
                    covariances=np.tile(states[source][1], (targets, 1, 1)),
                )
            )  # fmt: skip
        yield out


def run_memory(targets: int, settings: dict[str, Any], rounds: int = 8) -> tuple[float, float]:
    """Seconds of fusing, and of a whole step, links standing."""
    said = {"override": True, "motion": {"kind": "cv", "q": 1.0}}
    centre = TimedCentre({"sources": dict.fromkeys(("r1", "r2", "r3"), said), **settings})
    steps = []
    for second, batch in enumerate(filtered(targets, rounds), 1):
        for message in batch:
            centre.handle(message, 10**18)
        begin = time.perf_counter()
        centre.step(second * SECOND)
        steps.append(time.perf_counter() - begin)
    return min(centre._memory.times[3:]), min(steps[3:])


def main() -> None:
    print("targets   first ms    step ms  step/fusion   reading ms    saving ms  us per target")
    for targets in (20, 200, 1000, 5000):
        print(run(targets), flush=True)
    one = run_mixtures("moments", 1)
    print(f"\n1000 targets of 3 sources, Gaussian: {1e3 * one:.1f} ms; with 4 components each, capped at 4:")
    for rule in ("moments", "aa", "gm-ga"):
        several = run_mixtures(rule, 4)
        print(f"  {rule:<10} {1e3 * several:8.1f} ms  {several / one:6.1f} times", flush=True)
    for targets in (1000, 10_000):
        print(f"\n{targets} targets of 3 sources, Kalman filters:  fusing ms  / ci   step ms")
        least = 0.0
        for label, settings in WAYS.items():
            fusing, step = run_memory(targets, settings)
            least = least or fusing
            print(f"  {label:<40} {1e3 * fusing:9.1f} {fusing / least:5.2f} {1e3 * step:9.1f}", flush=True)


if __name__ == "__main__":
    main()
