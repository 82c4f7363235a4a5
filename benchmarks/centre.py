"""A step of the centre beside its parts, side by side in one run: `python -m benchmarks.centre`.

    python -m benchmarks.centre --scene 4x5000x2 --set rule=ci --set supervision=off

Sources with unequal covariances (`benchmarks.load`), links standing: CPU of reading the messages, of a step and its
parts, of a checkpoint and of packing what is published; beside the floor: unpack the same bytes, fuse as many tracks in
one batch by `naive`, pack. Then mixtures beside Gaussians; and every memory and `auto`, of trackers that are Kalman
filters: the part of a step that fuses, and its ratio to that of `ci`; goal: `memory = "tracklet"` within 2 at 10,000
targets.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

import schemas
from benchmarks.load import FRAME, SPACE, Load, floor
from benchmarks.service import setting
from fusion_service.centre import FusionCentre
from fusion_service.centre import centre as centre_module
from fusion_service.centre.intake import Intake
from fusion_service.centre.linking import Linker
from fusion_service.centre.memory import Memory
from fusion_service.centre.motions import Motions
from fusion_service.centre.supervision import Supervisor
from fusion_service.compiled import use

SECOND = 10**9
SIGMA = np.array([30.0, 30.0, 2.0, 2.0])
WAYS: dict[str, dict[str, Any]] = {
    "ci": {"rule": "ci"},
    "ci, recursive": {"rule": "ci", "memory": "recursive"},
    "tracklet": {"memory": "tracklet"},
    "auto": {"rule": "auto"},
    "bar-shalom-campo, derived": {"rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}},
    "bci, derived": {"rule": "bci", "rule_options": {"max_correlation": "derived"}},
}


PARTS: dict[str, tuple[Any, str]] = {
    "take in": (Intake, "admit"),
    "predict local": (centre_module, "usable_rows"),
    "predict global": (Motions, "predicted"),
    "associate": (Linker, "link"),
    "supervise": (Supervisor, "observe"),
    "fuse": (Memory, "fuse"),
    "publish": (centre_module, "picture_message"),
}
"""What of a step is timed apart: of which class or module, and its name there."""


@contextmanager
def parts(times: dict[str, float]) -> Iterator[None]:
    """Within it, the CPU seconds of each of `PARTS` are added up."""

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def done(*args: Any, **more: Any) -> Any:
            begin = time.process_time()
            try:
                return call(*args, **more)
            finally:
                times[name] = times.get(name, 0.0) + time.process_time() - begin

        return done

    before = {name: getattr(owner, attribute) for name, (owner, attribute) in PARTS.items()}
    for name, (owner, attribute) in PARTS.items():
        setattr(owner, attribute, timed(name, before[name]))
    try:
        yield
    finally:
        for name, (owner, attribute) in PARTS.items():
            setattr(owner, attribute, before[name])


def run(load: Load, settings: dict[str, Any], count: int = 24, warm: int = 12) -> str:
    """A line: the median step after `warm`, when memory has settled, its parts, reading, saving and packing, and the
    ratio to the floor."""
    world, period = load.world(), 1.0 / load.rate
    sources = {f"load-{s + 1:02d}": {"override": True, "period": period} for s in range(load.sources)}
    frame = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
    centre = FusionCentre({"period": period, "frame": frame, "sources": sources, **settings})
    steps, split = [], dict.fromkeys(PARTS, 0.0)
    for scan in range(count):
        data = [schemas.encode(world.message(s, scan, SECOND)) for s in range(load.sources)]
        told: dict[str, float] = {}
        marks = [time.process_time()]
        for one in data:
            centre.handle(schemas.decode(one), 10**18)
        marks.append(time.process_time())
        with parts(told):
            result = centre.step(SECOND + round(scan * period * 1e9))
        marks.append(time.process_time())
        centre.checkpoint()
        marks.append(time.process_time())
        schemas.encode(result.tracks), schemas.encode(result.log)
        marks.append(time.process_time())
        if scan >= warm:
            steps.append(np.diff(marks))
            for name in PARTS:
                split[name] += told.get(name, 0.0) / (count - warm)
    read, step, save, pack = 1e3 * np.median(steps, axis=0)
    whole = sum((read, step, save, pack))
    found = len(result.tracks.ids)
    fine = "" if found == load.targets else f"  ({found} tracks of {load.targets} targets)"
    least, each = 1e3 * floor(data, load.overlap), 1e3 * whole / (load.sources * load.tracks)
    return (
        f"{load.sources:3d} x {load.tracks:6,d} by {load.overlap:2d} {read:7.1f} {step:8.1f} "
        + " ".join(f"{1e3 * split[name]:7.1f}" for name in PARTS)
        + f" {save:7.1f} {pack:6.1f} {whole:8.1f} {whole / least:7.1f} {each:7.2f}{fine}"
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


def run_mixtures(rule: str, components: int) -> float:
    """CPU seconds of a step of 1,000 targets of 3 sources, so many components a track, links standing."""
    rng, load = np.random.default_rng(1), Load(3, 1000, 3, rate=1.0)
    world = load.world()
    sources = {f"load-{s + 1:02d}": {"override": True} for s in range(3)}
    centre = FusionCentre({"sources": sources, "mixture_rule": rule, "max_components": 4})
    steps = []
    for scan in range(6):
        for message in mixtures([world.message(s, scan, SECOND) for s in range(3)], components, rng):
            centre.handle(message, 10**18)
        begin = time.process_time()
        centre.step(SECOND + scan * SECOND)
        steps.append(time.process_time() - begin)
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


SCENES = (Load(3, 20, 3), Load(3, 1000, 3), Load(4, 5000, 2), Load(3, 10_000, 3), Load(20, 1000, 20))


def main() -> None:
    """Read the options, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", type=setting, action="append", default=[], help="KEY=VALUE under [centre]")
    parser.add_argument("--scene", action="append", default=[], help="SOURCESxTRACKSxOVERLAP, and no other table")
    given = parser.parse_args()
    scenes = [Load(*map(int, one.split("x"))) for one in given.scene] or SCENES
    how = f"{dict(given.set) or 'defaults'}; small matrices by {use('auto')}"
    print(f"CPU ms a step; {how}; load of the machine {os.getloadavg()[0]:.2f}")
    heads = " ".join(f"{name.split()[-1][:7]:>7}" for name in PARTS)
    print(f"{'scene':<19} {'read':>4} {'step':>8} {heads} {'save':>7} {'pack':>6} {'all':>8} x floor us each")
    for load in scenes:
        print(run(load, dict(given.set)), flush=True)
    if given.scene:
        return
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
