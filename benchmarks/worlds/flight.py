"""A world through the centre by `handle` and `step` alone, and through the assignment that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from benchmarks.worlds.floor import Ear, fresh_errors, known_assignment
from benchmarks.worlds.measures import Picture, impure
from benchmarks.worlds.world import FALSE, World
from fusion_service.centre import FusionCentre, SourceFound
from schemas import GlobalTracks, LocalTracks, SensorInfo
from schemas.messages import CONFIRMED

__all__ = ["Flight", "confirmed", "fly"]

SECOND = 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """For each step: the confirmed tracks of the centre, those of the floor (None where nobody knows what the tracks
    are tracks of), global tracks of mixed contributors, wrong pairs of a fresh assignment; and ms of a step (S,)."""

    pictures: list[Picture]
    floor: list[Picture] | None
    wrong: list[int]
    fresh: list[int]
    milliseconds: list[float]


def confirmed(tracks: GlobalTracks) -> Picture:
    """The confirmed tracks of a picture of Gaussians, in the horizontal plane."""
    axes = np.array([tracks.space.index("x"), tracks.space.index("y")])
    rows = np.flatnonzero(tracks.status == CONFIRMED)
    return Picture(tracks.ids[rows], tracks.means[np.ix_(rows, axes)], tracks.covariances[np.ix_(rows, axes, axes)])


def fly(world: World) -> Flight:
    """All steps of a world: each at t with all that was received up to t and the delay, as the running service does."""
    centre = FusionCentre({"rule": "ci", **world.config})  # of the floor too, which knows no other road
    for name in world.sources:
        centre.handle(SourceFound(name), int(world.times[0]) - SECOND)
    targets = world.truth.shape[1]
    known = all(one.target is not None for one in world.told if isinstance(one.message, LocalTracks))
    ears: dict[str, Ear] = {}
    origin: dict[tuple[str, int], tuple[int, int]] = {}
    waiting: list[tuple[LocalTracks, np.ndarray]] = []
    out = Flight([], [] if known else None, [], [], [])
    at = 0
    for time in world.times.tolist():
        while at < len(world.told) and world.told[at].received <= time + round(world.delay * SECOND):
            received, message, target = world.told[at]
            centre.handle(message, received)
            if isinstance(message, SensorInfo):
                ears.setdefault(message.source, Ear.of(message.motion, targets))
            elif target is not None:
                ears.setdefault(message.source, Ear.of(centre.config.source(message.source).motion, targets))
                waiting.append((message, target))
            at += 1
        begin = perf_counter()
        tracks = centre.step(time).tracks
        out.milliseconds.append(1e3 * (perf_counter() - begin))
        out.pictures.append(confirmed(tracks))
        if out.floor is None:
            continue
        for message, target in waiting:
            if message.time <= time:
                ears[message.source].hear(message, target)
                _note(origin, message, target)
        waiting = [one for one in waiting if one[0].time > time]
        out.floor.append(known_assignment(list(ears.values()), time, centre.config.rule))
        out.wrong.append(impure(_contributors(tracks, origin)))
        if world.fresh:
            first, second = ears.values()
            out.fresh.append(fresh_errors(first, second, time))
    return out


def _note(origin: dict[tuple[str, int], tuple[int, int]], message: LocalTracks, target: np.ndarray) -> None:
    for one, of in zip(message.ids.tolist(), target.tolist(), strict=True):
        when, _ = origin.get((message.source, one), (-1, FALSE))
        if message.time > when:
            origin[message.source, one] = (message.time, of)


def _contributors(tracks: GlobalTracks, origin: dict[tuple[str, int], tuple[int, int]]) -> list[list[int]]:
    """The targets of the contributors of each global track; every false track is a target of its own."""
    names = [tracks.sources[s] for s in tracks.contributor_source.tolist()]
    known = []
    for k, key in enumerate(zip(names, tracks.contributor_id.tolist(), strict=True)):
        target = origin[key][1] if key in origin else FALSE
        known.append(-2 - k if target == FALSE else target)
    ends = np.cumsum(tracks.contributor_counts, dtype=int).tolist()
    return [known[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]
