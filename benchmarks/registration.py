"""Errors of clocks and places put into sources, and what the centre finds: `python -m benchmarks.registration WHAT`.

clock       .5 s in one of three sources, 25 targets at 200 m/s: when it is found, and when nothing is double any more
nees        NEES of the estimates over many runs with drawn errors: white errors, lasting ones, Kalman filters,
            sigmas that are a third of what they should be
honest      sound sources for an hour: what is corrected though nothing is wrong
drift       a clock that runs 1 ms/s wrong
radars      the three radars with 200 m, 0.3 degrees and 0.5 s put in, beside none
cost        of a step at 20 sources x 500 shared tracks
autoferry   lag of the radar behind the lidar, nothing compensated (needs --data)
radar-v2x   the offset along the road (needs --data)
"""

from __future__ import annotations

import argparse
import math
import os
import time
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import schemas
from benchmarks.offset_sources import Offset, World
from fusion_service.centre import FusionCentre, MessageClock, StepResult
from fusion_service.demo import AUTOFERRY, THREE_RADARS
from fusion_service.metrics import nees_bounds
from fusion_service.review.evaluation import evaluate
from schemas import LocalTracks, SensorInfo
from sensor_clients.events import Event
from sensor_clients.playback import autoferry as ferry
from sensor_clients.playback import radar_v2x
from sensor_clients.scenarios.three_radars import three_radars
from studies import missions

SECOND = 10**9
RULED: dict[str, Any] = {"memory": "restart", "rule": "ci"}
BY_A: dict[str, Any] = {"sources": {"a": {"reference": True}}}
KINDS: dict[str, dict[str, Any]] = {
    "white": {},
    "AR(1), 0.8": {"lasting": 0.8},
    "Kalman filters": {"tracker": True},
    "sigma a third": {"claims": 1 / 3},
}


def told(result: StepResult, name: str) -> str:
    """What the status says of a source, in a line."""
    said = result.status.sources[name].get("bias", {})
    parts = []
    for key, one in said.items():
        more = "" if one["observable"] else f" (not observable: {one['why']})"
        parts.append(f"{key} {one['value']:.4g} +- {one['sigma']:.2g}{more}")
    return ", ".join(parts) or "nothing"


def clock(runs: int) -> None:
    for seed in range(runs):
        sound = Offset(sigma=(10.0, 2.0))
        offsets = {"a": sound, "b": replace(sound, clock=0.5), "c": sound}
        world = World(offsets, seed=seed, registration="correct", **RULED)
        found = single = math.nan
        for _ in range(60):
            result = world.step()
            one = result.status.sources["b"].get("bias", {}).get("clock")
            if math.isnan(found) and one and abs(one["value"] - 0.5) < 0.1 and one["sigma"] < 0.1:
                found = world.second
            many = int((result.tracks.status == schemas.messages.CONFIRMED).sum())
            single = single if not math.isnan(single) and many == 25 else (world.second if many == 25 else math.nan)
        said = f"found to 0.1 s after {found} s, 25 tracks from {single} s on; {told(result, 'b')}"
        print(f"seed {seed}: {said}", flush=True)


def nees(runs: int, seconds: int = 40) -> None:
    print("| errors | NEES/4, mean | 95 % of the mean | share above 95 % of one | ratio found |\n|---|---|---|---|---|")
    for label, how in KINDS.items():
        values, ratios = [], []
        for seed in range(runs):
            x = np.random.default_rng([17, seed]).normal(size=4) * [0.1, 20.0, 20.0, math.radians(0.1)]
            clock, east, north, heading = x.tolist()
            b = Offset((10e3, 5e3), clock, east, north, heading, sigma=(40.0, 3.0), **how)
            a = Offset((-20e3, -10e3), **how)
            world = World({"a": a, "b": b}, 15, seed=seed, **RULED, **BY_A)
            world.run(seconds)
            registration = world.centre._supervisor.registration
            mean, covariance = registration.estimate("b")
            e = mean[:4] - x
            values.append(float(e @ np.linalg.solve(covariance[:4, :4], e)) / 4)
            ratios.append(float(registration.lasts("b")))
        low, high = nees_bounds(4, runs)
        above = float(np.mean(np.array(values) > nees_bounds(4, 1)[1]))
        cells = f"{np.mean(values):.2f} | {low:.2f} to {high:.2f} | {above:.3f} | {np.mean(ratios):.1f}"
        print(f"| {label} | {cells} |", flush=True)


def honest(hours: int, count: int = 20) -> None:
    found: list[str] = []
    for hour in range(hours):
        offsets = {f"s{k:02d}": Offset(lasting=0.7) for k in range(count)}
        world = World(offsets, 20, seed=hour, speed=100.0, registration="correct", **RULED)
        for _ in range(3600):
            for event in world.step().log.events:
                if event["kind"] == "registration":
                    found.append(f"hour {hour}, {world.second} s, {event['source']}: {event['why']}")
    print(f"{count} sound sources, {hours} h: {len(found)} false", *found, sep="\n", flush=True)


def drift(seconds: int = 600) -> None:
    for memory in (600.0, 60.0):
        how: dict[str, Any] = {"registration": "correct", "registration_memory": memory, **RULED, **BY_A}
        world = World({"a": Offset(), "b": Offset(drift=1e-3)}, **how)
        for _ in range(seconds // 100):
            result = world.run(100)
            true = f"memory {memory:g} s, {world.second} s: clock {1e-3 * world.second:.3f} s"
            print(f"{true}; {told(result, 'b')}", flush=True)


Errors = dict[str, tuple[float, float, float, float]]
PUT_IN: dict[str, Errors] = {
    "one each": {"radar2": (0.5, 200.0, 0.0, 0.0), "radar3": (0.0, 0.0, 0.0, math.radians(0.3))},
    "all in one": {"radar2": (0.5, 140.0, 140.0, math.radians(0.3))},
}


def spoiled(message: Any, errors: Errors) -> Any:
    """A message with (clock, x, y, heading) put in, in the radar's own plane."""
    if message.source not in errors or not isinstance(message, LocalTracks):
        return message
    late, x, y, heading = errors[message.source]
    c, s = math.cos(heading), math.sin(heading)
    F = np.eye(len(message.space))
    for pair in (("x", "y"), ("vx", "vy")):
        at = [message.space.index(name) for name in pair]
        F[np.ix_(at, at)] = [[c, -s], [s, c]]
    means, covariances = message.means @ F.T, F @ message.covariances @ F.T
    means[:, [message.space.index("x"), message.space.index("y")]] += [x, y]
    shift = round(late * SECOND)
    return replace(
        message, means=means, covariances=(covariances + covariances.transpose(0, 2, 1)) / 2,
        time=message.time + shift, updated=None if message.updated is None else message.updated + shift,
    )  # fmt: skip


def flown(messages: Iterable[Any], config: dict[str, Any]) -> list[StepResult]:
    """All steps of a centre by the message clock."""
    centre = FusionCentre({"clock": "message", **config})
    ticks, out = MessageClock(centre.config), []
    ordered = sorted(messages, key=lambda one: getattr(one, "time", one.sent))
    for source in sorted({one.source for one in ordered}):
        ticks.presence(source, True)
    for message in ordered:
        centre.handle(message, max(message.sent, getattr(message, "time", 0)))
        if isinstance(message, LocalTracks):
            ticks.observe(message.source, message.epoch, message.time)
            while (due := ticks.due()) is not None:
                out.append(centre.step(due))
    for source in sorted({one.source for one in ordered}):
        ticks.presence(source, False)
    while (due := ticks.due()) is not None:
        out.append(centre.step(due))
    return out


def radars(runs: int) -> None:
    scenario = three_radars()
    truth = missions.truths(scenario)
    half = scenario.start + 150 * SECOND
    print("| run | put in | registration | GOSPA, m | RMSE, m | ANEES | second half: GOSPA | RMSE | ANEES |")
    print("|---|---|---|---|---|---|---|---|---|")
    for seed in range(1, runs + 1):
        heard = missions.told(scenario, seed)
        usual = {**tomllib.loads(THREE_RADARS), "lateness": 15.0, "memory": "tracklet"}
        usual["sources"] = {"radar1": {"reference": True}}
        for label, errors in ({"none": Errors()} | PUT_IN).items():
            for how in ("off", "correct"):
                results = flown([spoiled(one, errors) for one in heard], {**usual, "registration": how})
                pictures = [one.tracks for one in results]
                cells = []
                for begin in (0, half):
                    some = [one for one in (*heard, *truth, *pictures) if getattr(one, "time", half) >= begin]
                    scores = evaluate(some, c=5000.0, every=None).fused
                    cells.append(f"{scores.gospa:.0f} | {scores.rmse_position:.0f} | {scores.anees:.2f}")
                print(f"| {seed} | {label} | {how} | {' | '.join(cells)} |", flush=True)
            for name in ("radar2", "radar3"):
                print(f"  {name}: {told(results[-1], name)}")


def timed(call: Callable[..., Any], into: list[float]) -> Callable[..., Any]:
    """The same, writing down how long it takes, s."""

    def watched(*arguments: Any) -> Any:
        begin = time.perf_counter()
        result = call(*arguments)
        into.append(time.perf_counter() - begin)
        return result

    return watched


def cost() -> None:
    for how in ("off", "estimate", "correct"):
        offsets = {f"s{k:02d}": Offset((1000.0 * k, 0.0), x=100.0 * (k == 3)) for k in range(20)}
        world = World(offsets, 500, spread=150_000.0, registration=how, **RULED)
        spent: list[float] = []
        steps: list[float] = []
        registration = world.centre._supervisor.registration
        watched = mock.patch.object(registration, "observe", timed(registration.observe, spent))
        with watched, mock.patch.object(world.centre, "step", timed(world.centre.step, steps)):
            world.run(15)
        part, all_ = (float(np.median(one[5:])) * 1e3 for one in (spent, steps))
        load = os.getloadavg()[0]
        print(f"{how}: {part:.1f} ms of {all_:.1f} ms a step, {100 * part / all_:.1f} % (load {load:.1f})", flush=True)


def autoferry(data: Path) -> None:
    for name in ("lidar", "radar"):
        ferry.SENSORS[name] = replace(ferry.SENSORS[name], latency=0.0)
    priors = {"clock alone": (0.0, 0.0), "with a shift": (10.0, 0.0), "with shift and heading": (10.0, 3.0)}
    for number in (2, 3, 5, 13, 16):
        heard = missions.told(ferry.load(data / "autoferry", number), 0, ("lidar", "radar"))
        for label, (shift, heading) in priors.items():
            config = {**tomllib.loads(AUTOFERRY), "sources": {"lidar": {"reference": True}}, "clock_sigma": 3.0}
            config |= {"translation_sigma": shift, "heading_sigma": heading}
            print(f"{number}, {label}: {told(flown(heard, config)[-1], 'radar')}", flush=True)


def of_events(name: str, events: Iterable[Event]) -> list[Any]:
    """Events of a source as messages."""
    out: list[Any] = []
    for seq, event in enumerate(events):
        header: dict[str, Any] = {"source": name, "epoch": 1, "seq": seq, "sent": event.time, "origin": "replay"}
        if event.kind == "info":
            out.append(SensorInfo(**header, **event.fields))
        else:
            fields: dict[str, Any] = {"complete": False} | dict(event.fields)
            out.append(LocalTracks(**header, time=event.time, **fields))
    return out


def road(data: Path) -> None:
    scenario = radar_v2x.load(radar_v2x.find(data))
    heard = [one for name in radar_v2x.SENSORS for one in of_events(name, scenario.sensors[name](0))]
    frame = {"kind": "enu", "lat": radar_v2x.FRAME.lat, "lon": radar_v2x.FRAME.lon}
    last = max(one.time for one in heard if one.source == "vehicle1" and isinstance(one, LocalTracks))
    heard = [one for one in heard if getattr(one, "time", 0) <= last]
    sources = {"vehicle1": {"reference": True}, "radar": {"registration_sigma": 10.0}}
    usual: dict[str, Any] = {"frame": frame, "sources": sources, "period": 0.2, "registration_memory": 1e5}
    for clock_sigma in (1.0, 0.3, 0.0):
        results = flown(heard, {**usual, "clock_sigma": clock_sigma, "heading_sigma": 0.0})
        print(f"clock known to {clock_sigma} s: {told(results[-1], 'radar')}", flush=True)


EACH = ("clock", "nees", "honest", "drift", "radars", "cost", "autoferry", "radar-v2x")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="WHAT", help=", ".join(EACH))
    parser.add_argument("--runs", type=int, default=0, help="runs or hours (default: 3; nees: 200; honest: 1)")
    parser.add_argument("--data", type=Path, default=os.environ.get("FUSION_DATA"), help="folder of recordings")
    given = parser.parse_args(arguments)
    if unknown := set(given.what) - set(EACH):
        parser.error(f"no {', '.join(sorted(unknown))}: known are {', '.join(EACH)}")
    for what in given.what or EACH:
        if what in ("autoferry", "radar-v2x"):
            if given.data is None:
                parser.error(f"{what} needs --data DIR or FUSION_DATA")
            (autoferry if what == "autoferry" else road)(Path(given.data))
        elif what == "nees":
            nees(given.runs or 200)
        elif what == "honest":
            honest(given.runs or 1)
        elif what in ("clock", "radars"):
            (clock if what == "clock" else radars)(given.runs or 3)
        else:
            (drift if what == "drift" else cost)()


if __name__ == "__main__":
    main()
