"""Whole missions without bus or clock: a scenario's events as messages, through `FusionCentre`, to pictures.

It is the way of the running service: messages go through the codec, as off the bus, in the order of their time; steps
are those of the message clock, and end when the last message has been heard. Then what many runs of them score.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre, MessageClock
from fusion_service.metrics import gospa, nees, nees_bounds
from schemas import GlobalTracks, LocalTracks, SensorInfo, Truth
from sensor_clients.events import Event, Scenario
from studies.statistics import Estimate, jackknife

__all__ = [
    "Pooled",
    "Told",
    "as_messages",
    "best_source",
    "follow",
    "fuse",
    "less",
    "mean_nees",
    "pooled",
    "root_mean",
    "sums",
    "told",
    "truths",
]

Floats = NDArray[np.float64]

Told: TypeAlias = SensorInfo | LocalTracks
KINDS: dict[str, type[Any]] = {"info": SensorInfo, "tracks": LocalTracks, "truth": Truth}


def as_messages(source: str, events: Iterable[Event], origin: str) -> Iterator[Any]:
    """What a client publishes of its events, as it comes off the bus."""
    for seq, event in enumerate(events):
        when = {} if event.kind == "info" else {"time": event.time}
        header = {"source": source, "epoch": 1, "seq": seq, "sent": event.time, "origin": origin}
        yield schemas.decode(schemas.encode(KINDS[event.kind](**header, **when, **event.fields)))


def told(scenario: Scenario, seed: int, sensors: Sequence[str] | None = None) -> list[Told]:
    """All that the sensors of a scenario (by default all of them) say, in the order of time."""
    names = scenario.sensors if sensors is None else sensors
    each = [as_messages(name, scenario.sensors[name](seed), scenario.origin) for name in names]
    return list(heapq.merge(*each, key=attrgetter("sent")))


def truths(scenario: Scenario) -> list[Truth]:
    """The truth of a scenario."""
    return list(as_messages(scenario.name.replace(":", "-"), scenario.truth(), scenario.origin))


def fuse(messages: Sequence[Told], config: Mapping[str, Any]) -> list[GlobalTracks]:
    """The pictures of a centre of this config that hears `messages`, which come in the order of time, of sources that
    are there from the beginning."""
    centre = FusionCentre({"clock": "message", **config})
    clock = MessageClock(centre.config)
    pictures: list[GlobalTracks] = []

    def steps() -> None:
        while (time := clock.due()) is not None:
            pictures.append(centre.step(time).tracks)

    sources = {message.source for message in messages}
    for source in sources:
        clock.presence(source, True)
    for message in messages:
        centre.handle(message, message.sent)
        if isinstance(message, LocalTracks):
            clock.observe(message.source, message.epoch, message.time)
            steps()
    for source in sources:
        clock.presence(source, False)
    steps()
    return pictures


def follow(truth: Floats, means: Floats, covariances: Floats, c: float) -> Floats:
    """How well tracks, means (G, n) and covariances (G, n, n), follow targets at `truth` (T, n), x and y first, m:
    (2, T), squared error of position, m2, and NEES over n; NaN for a target that GOSPA, cut off at `c` m, gives none.
    """
    n = truth.shape[1]
    track = gospa(truth[:, :2], means[:, :2], c).assignment
    seen = track >= 0
    error = means[track[seen]] - truth[seen]
    scores = np.full((2, len(truth)), np.nan)
    scores[:, seen] = (error[:, :2] ** 2).sum(axis=1), nees(error, covariances[track[seen]]) / n
    return scores


class Pooled(NamedTuple):
    """RMSE, m, and ANEES over its dimension, of pairs of a target and a step in all runs, with errors over the runs;
    there: share of pairs with a track; high: share of pairs whose NEES over the runs is above its 95 % interval."""

    rmse: Estimate
    anees: Estimate
    there: Estimate
    high: float


def sums(scores: Floats) -> Floats:
    """Scores (2, K, T, M) as sums over pairs for each run, (4, M): squared error, NEES, number, pairs."""
    there = np.isfinite(scores[0])
    total = np.where(there, scores, 0.0).sum(axis=(1, 2))
    return np.concatenate([total, there.sum(axis=(0, 1))[None], np.full((1, there.shape[-1]), there[..., 0].size)])


def root_mean(part: Floats) -> float:
    """RMSE, m, of `sums`."""
    return float(np.sqrt(part[0].sum() / max(part[2].sum(), 1)))


def mean_nees(part: Floats) -> float:
    """ANEES of `sums`."""
    return float(part[1].sum() / max(part[2].sum(), 1))


def pooled(scores: Floats, n: int) -> Pooled:
    """Scores (2, K, T, M) of `follow` for states of n components, over all pairs and runs."""
    part = sums(scores)
    count = np.isfinite(scores[1]).sum(axis=-1)
    known = count > 0
    mean = np.where(np.isfinite(scores[1]), scores[1], 0.0).sum(axis=-1)[known] / count[known]
    upper = {number: nees_bounds(n, number)[1] for number in np.unique(count[known]).tolist()}
    high = np.mean([one > upper[number] for one, number in zip(mean.tolist(), count[known].tolist(), strict=True)])
    there = jackknife(lambda some: float(some[2].sum() / some[3].sum()), part)
    return Pooled(jackknife(root_mean, part), jackknife(mean_nees, part), there, float(high))


def less(statistic: Callable[[Floats], float], one: Floats, other: Floats) -> Estimate:
    """The statistic of `sums` of scores `one` less that of `other`, on the same runs."""
    both = np.concatenate([sums(one), sums(other)])
    return jackknife(lambda some: statistic(some[:4]) - statistic(some[4:]), both)


def best_source(scores: Floats) -> Floats:
    """Of scores (2, S, K, T, M) for each target those of the source that has the least mean squared error, of those
    that track it at least half as often as any of them does."""
    count = np.isfinite(scores[0]).sum(axis=(1, 3))
    mean = np.where(np.isfinite(scores[0]), scores[0], 0.0).sum(axis=(1, 3)) / np.maximum(count, 1)
    source = np.argmin(np.where((count > 0) & (2 * count >= count.max(axis=0)), mean, np.inf), axis=0)
    return np.stack([scores[:, s, :, t] for t, s in enumerate(source)], axis=2)
