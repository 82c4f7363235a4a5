"""How far the verdict of a smoothed reference is from that of truth, where truth is known.

    python -m benchmarks.smoothed_reference [--data DIR] [--seeds 2]

Missions: the simulated three radars (twenty targets, one that turns, coverage limited), and the five Autoferry scenes
(lidar and radar, two vessels, satellite positions as truth). Each is fused once by a centre of the demo's settings;
then it is scored as `evaluate` does, every step, by truth, by the reference smoothed from all sources, and each source
by the reference without it. The reference itself is scored against truth as if it were a source. Nothing is tuned: the
motion of the smoother is what the sources declare, and an object is what the centre confirmed in ten pictures.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_service.demo.missions import AUTOFERRY, THREE_RADARS
from fusion_service.errors import ReviewError
from fusion_service.process import data_folder
from fusion_service.review.evaluation import Scores, assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.smoothing import smoothed_truth
from schemas import LocalTracks, Message, Truth
from sensor_clients.scenarios.three_radars import three_radars
from studies import missions
from studies.experiments.autoferry import SCENARIOS, heard

__all__ = ["Mission", "Verdicts", "judged"]


class Mission(NamedTuple):
    """What was said, truth included, and the cut-off, m."""

    name: str
    messages: list[Message]
    c: float


class Verdicts(NamedTuple):
    """Scores by truth, by the reference of all, and of each source by that of all others; the reference's own."""

    truth: dict[str, Scores]
    smoothed: dict[str, Scores]
    without: dict[str, Scores]
    reference: Scores


def as_tracks(truths: Sequence[Truth]) -> Iterator[LocalTracks]:
    """The reference as what a source says; its covariances mean nothing."""
    for one in truths:
        n = len(one.space)
        yield LocalTracks(
            source="smoothed", epoch=1, seq=one.seq, sent=one.time, time=one.time, complete=True, space=one.space,
            frame=one.frame, ids=one.ids, means=one.means, covariances=np.tile(np.eye(n), (len(one.ids), 1, 1)),
        )  # fmt: skip


def scores(messages: Sequence[Message], c: float, truths: Sequence[Truth] = ()) -> dict[str, Scores]:
    """Of each source, and of "fused"."""
    (one,) = assess(Logbook(messages), c=c, truths=truths).evaluations.values()
    return {**one.sources, "fused": one.fused}


def judged(mission: Mission) -> Verdicts:
    """All verdicts about a mission."""
    book = Logbook(mission.messages)
    untold = [message for message in mission.messages if not isinstance(message, Truth)]
    whole = smoothed_truth(book)
    without = {}
    for name in book.sources:
        try:
            without[name] = scores(untold, mission.c, smoothed_truth(book, left_out=name))[name]
        except ReviewError as error:
            print(f"{mission.name}: without {name}: {error}")
    found = scores([*mission.messages, *as_tracks(whole)], mission.c)
    reference = found.pop("smoothed")
    return Verdicts(found, scores(untold, mission.c, whole), without, reference)


def flown(data: Path | None, seeds: int) -> Iterator[Mission]:
    """The missions there are."""
    for seed in range(1, seeds + 1):
        scenario = three_radars()
        said = missions.told(scenario, seed)
        pictures = missions.fuse(said, tomllib.loads(THREE_RADARS))
        yield Mission(f"three radars {seed}", [*said, *missions.truths(scenario), *pictures], 5000.0)
    for number in SCENARIOS if data else ():
        assert data is not None
        told, truth = heard(data, number)
        yield Mission(f"autoferry {number}", [*told, *truth, *missions.fuse(told, tomllib.loads(AUTOFERRY))], 20.0)


def line(name: str, of: str, values: Sequence[Any]) -> str:
    return f"{name:<16}{of:<12}" + "".join(
        f"{value:>12.3g}" if isinstance(value, float) else f"{value:>12}" for value in values
    )


def main() -> None:
    """Print one line for each source, and for the fused tracks, of each mission."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="the Autoferry files, or what holds autoferry/ (default: $FUSION_DATA)")
    parser.add_argument("--seeds", type=int, default=2, help="runs of the simulated radars (default %(default)s)")
    args = parser.parse_args()
    print(line("mission", "of", ["RMSE truth", "smoothed", "without", "GOSPA truth", "smoothed", "without"]))
    ratios: dict[str, list[float]] = {}
    for mission in flown(data_folder("autoferry", args.data), args.seeds):
        found = judged(mission)
        own = found.reference
        print(line(mission.name, "reference", [own.rmse_position, "", "", own.gospa, "", ""]), flush=True)
        for name, by_truth in found.truth.items():
            smoothed, without = found.smoothed[name], found.without.get(name)
            more = [without.rmse_position if without else "-", without.gospa if without else "-"]
            values = [by_truth.rmse_position, smoothed.rmse_position, more[0], by_truth.gospa, smoothed.gospa, more[1]]
            print(line(mission.name, name, values), flush=True)
            kind = mission.name.rsplit(" ", 1)[0]
            ratios.setdefault(f"{kind}, {'fused' if name == 'fused' else 'sources'}, smoothed", []).append(
                smoothed.rmse_position / by_truth.rmse_position
            )
            if without:
                ratios.setdefault(f"{kind}, sources, without", []).append(
                    without.rmse_position / by_truth.rmse_position
                )
    print("\nRMSE by the reference over RMSE by truth: median, smallest, largest")
    for what, some in ratios.items():
        print(f"{what:<36}{np.median(some):>8.2f}{min(some):>8.2f}{max(some):>8.2f}")


if __name__ == "__main__":
    main()
