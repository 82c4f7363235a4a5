"""Whether the fused picture of the Autoferry scenes is as good as its sensors, and whether that hangs on the tuning.

    python -m benchmarks.autoferry_robustness --data DIR [--perturb 20] [--without NAME ...] [--latencies 0 0]

Scenarios 2, 3, 5, 13 and 16 by the local trackers of `sensor-client playback autoferry:N` and the centre of the demo,
rule `auto`, scored as `fusion-service evaluate` does (GOSPA, c = 20 m, every second), lidar and radar alone beside it:

* the table of each scenario, and how much the fused picture is above its best single sensor;
* with --without, the same without a part of the model (`PARTS`), one after the other: what each brings. Each scenario
  left out in turn, parts are chosen by the mean of the others (the model with or without each one part, whichever is
  best there) and judged on the one left out;
* with --perturb K, every tuned number of both trackers times a factor of its own between 1/1.3 and 1.3, K times
  (`autoferry_local`): median and worst of the means and of each scenario, and in each scenario the distance to the
  best single sensor of the same setting;
* with --latencies, the sensors' latencies, s, instead of those fitted to the truth; with --set, another setting of the
  centre, as registration=correct.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.autoferry_local import FACTOR, SCENARIOS, messages, perturbed
from fusion_service.config.settings import change, merge
from fusion_service.demo import AUTOFERRY
from fusion_service.process import data_folder
from fusion_service.review.evaluation import METRICS, evaluate
from schemas import Message
from sensor_clients.playback import autoferry
from sensor_clients.playback.harbour import LIDAR, RADAR, HarbourSensor
from studies import missions

Floats = NDArray[np.float64]
Pair: TypeAlias = tuple[HarbourSensor, HarbourSensor]
NAMES = ("lidar", "radar", "fused")


@lru_cache
def scans_of(directory: Path, number: int, sensor_id: int) -> list[autoferry.Scan]:
    return autoferry.read_scans(directory / f"scenario{number}_detections.json", sensor_id)


@lru_cache
def truth_of(directory: Path, number: int) -> tuple[Message, ...]:
    return tuple(messages("truth", autoferry.load(directory, number).truth()))


def spoken(directory: Path, number: int, sensors: Pair) -> list[Message]:
    """What the sensors say in a scenario, in the order of time."""
    said: list[Message] = []
    for sensor in sensors:
        scans = scans_of(directory, number, sensor.sensor_id)
        said += messages(sensor.name, autoferry.sensor_events(sensor, scans))
    return sorted(said, key=lambda message: message.sent)


def scores(directory: Path, sensors: Pair, note: str = "", settings: Mapping[str, Any] | None = None) -> Floats:
    """METRICS (5, 3, 7) of lidar, radar and fused in every scenario."""
    rows = []
    for number in SCENARIOS:
        print(f"\r{note} scenario {number}   ", end="", file=sys.stderr, flush=True)
        said = spoken(directory, number, sensors)
        config = {**tomllib.loads(AUTOFERRY), "rule": "auto", **(settings or {})}
        pictures = missions.fuse(said, config)  # type: ignore[arg-type]
        result = evaluate([*said, *truth_of(directory, number), *pictures], c=20.0, every=1.0)
        found = [*(result.sources[name] for name in NAMES[:2]), result.fused]
        rows.append([[float(getattr(one, metric) or 0.0) for metric in METRICS] for one in found])
    print("\r" + " " * 60 + "\r", end="", file=sys.stderr)
    return np.array(rows)


def above_best(gospa: Floats) -> Floats:
    """GOSPA (..., 3) of the fused picture less that of the better sensor."""
    return np.asarray(gospa[..., 2] - gospa[..., :2].min(axis=-1))


def show(found: Floats) -> None:
    """The table of `scores`."""
    labels = [*map(str, SCENARIOS), "mean"]
    print("| | " + " | ".join(labels) + " |\n" + "|---" * (len(labels) + 1) + "|")
    for k, name in enumerate(NAMES):
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in with_mean(found[:, k, 0])) + " |")
    print("| above the best sensor | " + " | ".join(f"{x:+.2f}" for x in with_mean(above_best(found[..., 0]))) + " |")
    for at, metric in enumerate(METRICS[1:], 1):
        values = with_mean(found[:, 2, at])
        print(f"| fused, {metric.removeprefix('gospa_')} | " + " | ".join(f"{value:.2f}" for value in values) + " |")


def with_mean(values: Floats) -> list[float]:
    return [*values.tolist(), float(values.mean())]


def no_shade(sensor: HarbourSensor) -> HarbourSensor:
    """Nothing is hidden, nor is anything part of another vessel."""
    return replace(sensor, shade=replace(sensor.shade, length=1e-9, beam=1e-9, wake=0.0, width=0.0, seen=1.0))


def no_wake(sensor: HarbourSensor) -> HarbourSensor:
    return replace(sensor, shade=replace(sensor.shade, wake=0.0))


def blamed(sensor: HarbourSensor) -> HarbourSensor:
    """What is hidden is missed as if it were not."""
    return replace(sensor, shade=replace(sensor.shade, seen=1.0))


def circle(sensor: HarbourSensor) -> HarbourSensor:
    """Two tracks are one within a circle."""
    return replace(sensor, tracker=replace(sensor.tracker, hull=None, extent=12.5, merge=3.0))


def points(sensor: HarbourSensor) -> HarbourSensor:
    """No length is learned."""
    return replace(sensor, resolves=False)


def cautious(sensor: HarbourSensor) -> HarbourSensor:
    """All errors are noise, and none of them lasts, but for a metre."""
    noise = {name: getattr(sensor, name) / 0.6 for name in ("sigma_range", "sigma_cross", "sigma_azimuth")}
    return replace(sensor, reference=1.0 if sensor.name == "lidar" else 1.5, **noise)


def near(sensor: HarbourSensor) -> HarbourSensor:
    """Nothing beyond 300 m is looked at."""
    return replace(sensor, reach=min(sensor.reach, 300.0))


PARTS = {
    "shadows": no_shade,
    "wakes": no_wake,
    "occlusion": blamed,
    "hull": circle,
    "lengths": points,
    "noise": cautious,
    "reach": near,
}
"""What the model may be scored without."""


def ablate(directory: Path, whole: Floats, names: Iterable[str]) -> None:
    """What each part brings, and what comes of choosing by scenarios the one that is left out not among them."""
    ways = {"all": whole}
    print("\n| without | GOSPA fused | " + " | ".join(map(str, SCENARIOS)) + " | missed | false |")
    print("|---" * (len(SCENARIOS) + 4) + "|")
    for name in names:
        change = PARTS[name]
        ways[name] = found = scores(directory, (change(LIDAR), change(RADAR)), f"without {name}")
        parts = [found[:, 2, 0].mean(), *found[:, 2, 0], found[:, 2, 2].mean(), found[:, 2, 3].mean()]
        print(f"| {name} | " + " | ".join(f"{part:.2f}" for part in parts) + " |", flush=True)
    gospa = {name: found[:, 2, 0] for name, found in ways.items()}
    left, chosen = [], []
    for out in range(len(SCENARIOS)):
        best = min(gospa, key=lambda name: float(np.delete(gospa[name], out).mean()))
        chosen.append(best)
        left.append([gospa[best][out], above_best(ways[best][out, :, 0])])
    print(
        f"\nscenario left out: {', '.join(f'{x:.2f}' for x, _ in left)}, mean {np.mean(left, axis=0)[0]:.2f};", end=" "
    )
    print(f"above its best sensor: {', '.join(f'{x:+.2f}' for _, x in left)}; chosen without: {', '.join(chosen)}")


def robust(directory: Path, sensors: Pair, count: int) -> None:
    """The spread of `count` perturbed settings."""
    rng = np.random.default_rng(0)
    trials = np.zeros((count, len(SCENARIOS), len(NAMES)))
    for k in range(count):
        changed = perturbed(sensors[0], rng), perturbed(sensors[1], rng)
        trials[k] = scores(directory, changed, f"setting {k + 1} of {count}")[..., 0]
        print(f"\rsetting {k + 1}: fused {trials[k, :, 2].mean():.2f}", file=sys.stderr, flush=True)
    print(f"\nmean GOSPA of {count} settings within a factor {FACTOR}, min, quartiles, max:")
    for name, values in zip(NAMES, trials.mean(axis=1).T, strict=True):
        print(f"  {name:6}" + " ".join(f"{x:.2f}" for x in np.percentile(values, [0, 25, 50, 75, 100])))
    for number, one in zip(SCENARIOS, trials.transpose(1, 0, 2), strict=True):
        gap = above_best(one)
        print(
            f"  scenario {number}: fused median {np.median(one[:, 2]):.2f}, worst {one[:, 2].max():.2f}; above the "
            f"best sensor: median {np.median(gap):+.2f}, worst {gap.max():+.2f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="the Autoferry files, or what holds autoferry/ (default: $FUSION_DATA)")
    parser.add_argument("--perturb", type=int, default=0, metavar="K", help="also score K changed settings")
    parser.add_argument("--without", nargs="*", choices=[*PARTS, "each"], default=[], help="parts of the model")
    parser.add_argument("--latencies", nargs=2, type=float, metavar=("LIDAR", "RADAR"), help="s, instead of the fitted")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the centre")
    arguments = parser.parse_args()
    directory = data_folder("autoferry", arguments.data)
    if directory is None:
        parser.error("say --data DIR or set FUSION_DATA to the directory of the Autoferry JSON files")
    sensors = LIDAR, RADAR
    if arguments.latencies:
        sensors = (
            replace(LIDAR, latency=arguments.latencies[0]),
            replace(RADAR, latency=arguments.latencies[1]),
        )
    settings: dict[str, Any] = {}
    for text in arguments.set:
        merge(settings, change(text))
    whole = scores(directory, sensors, settings=settings)
    show(whole)
    if arguments.without:
        ablate(directory, whole, PARTS if "each" in arguments.without else arguments.without)
    if arguments.perturb:
        robust(directory, sensors, arguments.perturb)
    return 0


if __name__ == "__main__":
    sys.exit(main())
