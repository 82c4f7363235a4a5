"""How well the local trackers of the Autoferry sensors do, without bus or centre, and how much their tuning matters.

    python benchmarks/autoferry_local.py --data DIR [--perturb 20]

Scores lidar and radar alone on scenarios 2, 3, 5, 13 and 16 as `fusion-service evaluate` does (GOSPA, p = 2,
alpha = 2, c = 20 m, every second). With --perturb K, each of K times every tuned number is multiplied by a factor
of its own between 1/1.3 and 1.3 (probabilities: their odds), and the spread of the mean scores is printed: a
setting that only fits these five scenes by luck would fall apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.process import data_folder
from fusion_service.review.evaluation import METRICS, evaluate
from schemas import LocalTracks, Message, Motion, SensorInfo, Truth
from sensor_clients.events import Event
from sensor_clients.playback import autoferry
from sensor_clients.playback.harbour import LIDAR, RADAR, HarbourSensor
from sensor_clients.playback.shadow import Shade

SCENARIOS = (2, 3, 5, 13, 16)
FACTOR = 1.3
FIXED = {"period", "latency", "coverage", "coverage_detection", "initiation_delay", "offset"}


def messages(source: str, events: Iterable[Event]) -> Iterable[Message]:
    """What the events would be on the bus."""
    kinds: dict[str, type[Any]] = {"info": SensorInfo, "tracks": LocalTracks, "truth": Truth}
    for seq, event in enumerate(events):
        when = {} if event.kind == "info" else {"time": event.time}
        header = {"source": source, "epoch": 1, "seq": seq, "sent": event.time, "origin": "replay"}
        yield kinds[event.kind](**header, **when, **event.fields)


def score(directory: Path, number: int, sensors: dict[str, HarbourSensor]) -> dict[str, list[float]]:
    """The METRICS of each sensor on one scenario."""
    spoken = list(messages("truth", autoferry.load(directory, number).truth()))
    for name, sensor in sensors.items():
        scans = autoferry.read_scans(directory / f"scenario{number}_detections.json", sensor.sensor_id)
        spoken += messages(name, autoferry.sensor_events(sensor, scans))
    result = evaluate(spoken, c=20.0, every=1.0, frame=autoferry.PIREN, space=("x", "y"))
    scores = {name: one.as_json() for name, one in result.sources.items()}
    return {name: [float(one[metric] or 0.0) for metric in METRICS] for name, one in scores.items()}


def perturbed(sensor: HarbourSensor, rng: np.random.Generator) -> HarbourSensor:
    """The sensor with every tuned number changed by a factor of its own."""

    def change(value: Any) -> Any:
        factor = FACTOR ** rng.uniform(-1, 1)
        if isinstance(value, Motion):
            return replace(value, q=value.q * factor)
        if isinstance(value, Shade):
            return Shade(*(getattr(value, field.name) * FACTOR ** rng.uniform(-1, 1) for field in fields(value)))
        if isinstance(value, tuple) and isinstance(value[0], float):
            return tuple(change(one) for one in value)
        if isinstance(value, tuple):
            return tuple((distance * factor, probability) for distance, probability in value)
        if isinstance(value, float) and 0.5 < value < 1.0:
            return 1 / (1 + (1 / value - 1) * factor)
        return value * factor if isinstance(value, float) else value

    tracker = {field.name: change(getattr(sensor.tracker, field.name)) for field in fields(sensor.tracker)}
    rest = {
        field.name: change(getattr(sensor, field.name))
        for field in fields(sensor)
        if field.name not in FIXED | {"tracker"}
    }
    return replace(sensor, tracker=replace(sensor.tracker, **tracker), **rest)


def mean_scores(directory: Path, sensors: dict[str, HarbourSensor], show: bool) -> dict[str, float]:
    """Mean GOSPA of each sensor over the scenarios; the table if `show`."""
    rows: dict[str, list[list[float]]] = {name: [] for name in sensors}
    for number in SCENARIOS:
        for name, row in score(directory, number, sensors).items():
            rows[name].append(row)
    if show:
        print(f"{'':12}" + "".join(f"{metric.removeprefix('gospa_'):>19}" for metric in METRICS))
        for name, table in rows.items():
            for label, row in zip((*map(str, SCENARIOS), "mean"), [*table, list(np.mean(table, axis=0))], strict=True):
                print(f"{name:7}{label:>5}" + "".join(f"{value:19.2f}" for value in row))
    return {name: float(np.mean([row[0] for row in table])) for name, table in rows.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="the Autoferry files, or what holds autoferry/ (default: $FUSION_DATA)")
    parser.add_argument("--perturb", type=int, default=0, metavar="K", help="also score K changed settings")
    arguments = parser.parse_args()
    directory = data_folder("autoferry", arguments.data)
    if directory is None:
        parser.error("say --data DIR or set FUSION_DATA to the directory of the Autoferry JSON files")
    mean_scores(directory, {"lidar": LIDAR, "radar": RADAR}, show=True)
    rng = np.random.default_rng(0)
    trials = []
    for _ in range(arguments.perturb):
        changed = {"lidar": perturbed(LIDAR, rng), "radar": perturbed(RADAR, rng)}
        trials.append(mean_scores(directory, changed, show=False))
    for name in ("lidar", "radar") if trials else ():
        values = np.percentile([trial[name] for trial in trials], [0, 25, 50, 75, 100])
        print(f"{name}: mean GOSPA of {len(trials)} settings within a factor {FACTOR}: min, quartiles, max", end=" ")
        print(" ".join(f"{value:.2f}" for value in values))
    return 0


if __name__ == "__main__":
    sys.exit(main())
