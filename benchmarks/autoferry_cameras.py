"""How well the bearing-only trackers of the Autoferry cameras do, without bus or centre.

    python -m benchmarks.autoferry_cameras --data DIR

One row per scenario and camera. A track is at a vessel if its bearing lies within 0.05 rad and 18 m across of the
vessel's, the nearest counts; further ones at the same vessel are doubles, those at none are false. tracked: share of
messages in which a vessel nearer than 250 m has a track; false, double: tracks per message; range: how many vessels
were within 250 m on the average; ids: different tracks per vessel; bias, sd: of the bearing, rad; bearing: mean
squared error of bearing over its variance (1 is right); nees: of the position by the mixture's moments, over 2; 90 %:
share of true places inside the region of the mixture's highest density that holds 90 %; cpu: s per minute of data.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import densities
from fusion_service.process import data_folder
from sensor_clients.playback import autoferry
from sensor_clients.playback.cameras import CameraSensor

SCENARIOS = (2, 3, 5, 13, 16)
REACH = 250.0
Floats = NDArray[np.float64]


class Score(NamedTuple):
    tracked: float
    within: float
    false: float
    double: float
    ids: float
    bias: float
    sd: float
    bearing: float
    nees: float
    inside: float
    cpu: float


def wrap(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def inside(weights: Floats, means: Floats, covariances: Floats, place: Floats, rng: np.random.Generator) -> bool:
    """Whether the place (2,) is in the smallest region that holds 90 % of the mixture, by sampling."""
    precision = np.linalg.inv(covariances)
    scale = weights / np.sqrt(np.linalg.det(covariances))

    def density(x: Floats) -> Floats:
        away = x[:, None] - means
        return np.asarray(np.exp(-0.5 * np.einsum("kca,cab,kcb->kc", away, precision, away)) @ scale)

    chosen = rng.choice(len(weights), 400, p=weights)
    roots = np.linalg.cholesky(covariances)[chosen]
    draws = means[chosen] + np.einsum("kab,kb->ka", roots, rng.normal(size=(400, 2)))
    return bool(density(place[None])[0] >= np.quantile(density(draws), 0.1))


def score(directory: Path, number: int, sensor: CameraSensor) -> Score:
    """One camera on one scenario."""
    scans = autoferry.read_scans(directory / f"scenario{number}_detections.json", sensor.sensor_id)
    own = {scan.time: scan.own for scan in scans}
    truth = autoferry.read_truth(directory / f"scenario{number}_groundTruth.json")
    rng = np.random.default_rng(0)
    begun = time.process_time()
    events = [event for event in autoferry.sensor_events(sensor, scans) if event.kind == "tracks"]
    cpu = time.process_time() - begun
    tracked = wanted = false = double = 0
    errors: list[float] = []
    variances: list[float] = []
    nees: list[float] = []
    held: list[float] = []
    ids: dict[int, set[int]] = {target: set() for target in truth}
    for event in events:
        t, here, fields = event.time * 1e-9, own[event.time], event.fields
        weights, counts = fields["weights"], fields["counts"]
        mean, P = densities.moments(fields["means"][:, :2], fields["covariances"][:, :2, :2], weights, counts)
        sight = mean - here
        angle, r2 = np.arctan2(*sight.T), np.sum(sight**2, axis=1)
        across = np.stack([sight[:, 1], -sight[:, 0]], axis=-1) / r2[:, None]
        variance = np.einsum("ta,tab,tb->t", across, P, across)
        free = np.ones(len(mean), dtype=bool)
        first = np.cumsum(counts) - counts
        for target, (times, places) in truth.items():
            if not times[0] <= t <= times[-1]:
                continue
            place = np.array([np.interp(t, times, places[:, 0]), np.interp(t, times, places[:, 1])])
            r = float(np.hypot(*(place - here)))
            wanted += r < REACH
            gap = np.abs(wrap(angle - np.arctan2(*(place - here))))
            near = gap < 0.05 + 18.0 / r
            double += max(int((near & free).sum()) - 1, 0)
            if (near & free).any():
                best = int(np.where(near & free, gap, np.inf).argmin())
                tracked += r < REACH
                ids[target].add(int(fields["ids"][best]))
                errors.append(float(wrap(angle[[best]] - np.arctan2(*(place - here)))[0]))
                variances.append(variance[best])
                nees.append((place - mean[best]) @ np.linalg.solve(P[best], place - mean[best]) / 2)
                rows = slice(first[best], first[best] + counts[best])
                parts = fields["means"][rows, :2], fields["covariances"][rows, :2, :2]
                held.append(inside(weights[rows] / weights[rows].sum(), *parts, place, rng))
            free &= ~near
        false += int(free.sum())
    minutes, count = (scans[-1].time - scans[0].time) * 1e-9 / 60, len(events)
    with np.errstate(all="ignore"):
        e, v = np.array(errors or [np.nan]), np.array(variances or [np.nan])
        position, share = float(np.mean(nees or [np.nan])), float(np.mean(held or [np.nan]))
        row = (tracked / wanted, wanted / count, false / count, double / count, sum(map(len, ids.values())) / len(ids))
        return Score(*row, float(e.mean()), float(e.std()), float(np.mean(e**2 / v)), position, share, cpu / minutes)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="the Autoferry files, or what holds autoferry/ (default: $FUSION_DATA)")
    arguments = parser.parse_args()
    directory = data_folder("autoferry", arguments.data)
    if directory is None:
        parser.error("say --data DIR or set FUSION_DATA to the directory of the Autoferry JSON files")
    print(f"{'':9}" + "".join(f"{name:>9}" for name in Score._fields))
    for name, sensor in autoferry.SENSORS.items():
        if isinstance(sensor, CameraSensor):
            rows = [score(directory, number, sensor) for number in SCENARIOS]
            for label, row in zip((*map(str, SCENARIOS), "mean"), [*rows, np.nanmean(rows, axis=0)], strict=True):
                print(f"{name:3}{label:>6}" + "".join(f"{value:9.3f}" for value in row))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
