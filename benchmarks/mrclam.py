"""Robots that watch each other (MR.CLAM, set 6): each alone, and fused by every rule and memory asked for.

    python -m benchmarks.mrclam --data DIR
    python -m benchmarks.mrclam --config 'memory = "tracklet"' --config 'rule = "auto"'
    python -m benchmarks.mrclam --local             the local tracks of each robot, and their consistency

The local trackers are those of `sensor-client playback mrclam:6`, the centre that of `fusion-service demo --scenario
mrclam:6`, without bus or clock; scores are those of `fusion-service evaluate`, every second with c = 1 m: GOSPA, m,
and the squares it is made of, m2; RMSE, m, and ANEES of position (over its dimension; its 95 % bounds suppose
independent errors, which those of successive seconds are not), identity switches. A robot alone: the centre hears its
two sources, the others that it sees and itself. With --fold the error of each robot's own place is told in the
covariance of each track, not as `position_covariance`: to a centre that does not take that into account.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.demo import MRCLAM
from fusion_service.errors import FusionError
from fusion_service.metrics import nees, nees_bounds
from fusion_service.process import data_folder
from fusion_service.review.evaluation import METRICS, Scores, evaluate
from schemas import LocalTracks, SensorInfo, Truth
from sensor_clients.playback import mrclam
from studies.missions import Told, fuse, told, truths

CUTOFF = 1.0
CONFIGS = (
    'rule = "auto"',
    'rule = "auto"\nrule_options = {max_correlation = {within = 1.0, between = 0.5}}',
    'rule = "ci"',
    'rule = "naive"',
    'rule = "bci"\nrule_options = {max_correlation = 0.25}',
    'rule = "bci"\nrule_options = {max_correlation = 0.5}',
    'rule = "ci"\nmemory = "recursive"',
)
HEAD = """\
| | GOSPA, m | localisation | missed | false | RMSE, m | ANEES | bounds | id switches |
|---|---|---|---|---|---|---|---|---|"""


def folded(messages: Iterable[Told]) -> Iterator[Told]:
    """The same with the error of each source's place in the covariances of its tracks."""
    shift: dict[str, Any] = {}
    for one in messages:
        if isinstance(one, SensorInfo):
            shift[one.source] = one.position_covariance
            yield replace(one, position_covariance=None)
            continue
        common = shift.get(one.source)
        if common is None:
            yield one
            continue
        covariances = one.covariances.copy()
        covariances[:, :2, :2] += common[:2, :2]
        yield replace(one, covariances=covariances)


def row(name: str, score: Scores) -> str:
    values = {metric: getattr(score, metric) for metric in METRICS}
    parts = " | ".join(f"{values[key]:.3f}" for key in METRICS[:5])
    low, high = score.bounds
    return f"| {name} | {parts} | {values['anees']:.2f} | {low:.2f} to {high:.2f} | {values['identity_switches']} |"


def fused(messages: Sequence[Told], truth: Sequence[Truth], config: dict[str, Any]) -> Scores:
    """Scores of the centre of the demo with this config above its own."""
    pictures = fuse(messages, {**tomllib.loads(MRCLAM), **config})
    return evaluate([*truth, *pictures], c=CUTOFF, every=1.0).fused


def local(messages: Iterable[Told], truth: Sequence[Truth]) -> Iterator[str]:
    """A line for each source: RMSE, m, and ANEES of position of all its tracks against the robot that they say they
    are, the error of its own place included, whatever the distance; tracks more than `CUTOFF` away, which GOSPA does
    not see, are also counted, and left out of the last two columns."""
    places = {one.time: dict(zip(one.ids.tolist(), one.means, strict=True)) for one in truth}
    found: dict[str, list[tuple[float, float]]] = {}
    for one in folded(messages):
        if not isinstance(one, LocalTracks) or one.time not in places:
            continue
        for identity, mean, covariance in zip(one.identity or (), one.means, one.covariances, strict=True):
            target = places[one.time].get(int((identity or ":0").partition(":")[2]))
            if target is not None:
                error = mean[:2] - target
                score = float(nees(error, covariance[:2, :2])) / 2
                found.setdefault(one.source, []).append((float(error @ error), score))
    for name, scores in sorted(found.items()):
        values = np.array(scores)
        near = values[values[:, 0] < CUTOFF**2]
        low, high = nees_bounds(2, len(values))
        rms, anees = np.sqrt(values[:, 0].mean()), values[:, 1].mean()
        yield (
            f"| {name} | {len(values)} | {rms:.3f} | {anees:.2f} | {low:.2f} to {high:.2f} | {len(values) - len(near)} "
            f"| {np.sqrt(near[:, 0].mean()):.3f} | {near[:, 1].mean():.2f} |"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the MR.CLAM sets, or one above (default: $FUSION_DATA)")
    parser.add_argument("--config", action="append", metavar="TOML", help="settings of the centre to run; repeatable")
    parser.add_argument("--fold", action="store_true", help="the own place's error in every covariance")
    parser.add_argument("--local", action="store_true", help="the local tracks only")
    parser.add_argument("--seconds", type=float, help="only so many of the beginning")
    args = parser.parse_args(arguments)
    folder = data_folder("mrclam", args.data)
    if folder is None or not (folder / "6" / "landmarks.csv").is_file():
        where = "--data and FUSION_DATA name no folder" if folder is None else f"no 6/landmarks.csv in {folder}"
        print(f"mrclam: skipped: {where}.")
        return 0
    scenario = mrclam.load(folder, 6)
    end = scenario.start + round((args.seconds or scenario.duration) * 1e9)
    heard = [one for one in told(scenario, 0) if one.sent <= end]
    truth = [one for one in truths(scenario) if one.time <= end]
    if args.local:
        print("| local tracks | number | RMSE, m | ANEES | bounds | beyond c | RMSE below c | ANEES below c |")
        print("|---|---|---|---|---|---|---|---|")
        print("\n".join(local(heard, truth)))
        return 0
    heard = list(folded(heard)) if args.fold else heard
    print(HEAD, flush=True)
    if not args.config:
        for n in mrclam.ROBOTS:
            own = [one for one in heard if one.source in (f"robot{n}", f"robot{n}-self")]
            print(row(f"robot {n} alone", fused(own, truth, {})), flush=True)
    for text in args.config or CONFIGS:
        try:
            print(row(f"`{text.replace(chr(10), ', ')}`", fused(heard, truth, tomllib.loads(text))), flush=True)
        except (FusionError, tomllib.TOMLDecodeError) as error:
            print(f"{text!r}: {error}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
