"""What is left out of a step that would cost too much: the pairs of components that a reduction compares.

A mixture of more than `max_components` is reduced by merging, which compares its components pair by pair. A step
compares `component_pairs` at most: where its messages have more, the tracks of those with most pairs are taken by their
moments, as Gaussians, until the rest fits. Of two with as many it is the first in canonical order. So what is left out
follows from the messages alone, and no track is lost, nor is its covariance too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion_service.centre.batches import Checked
from fusion_service.centre.journal import Journal
from fusion_service.config import CentreConfig
from schemas import LocalTracks

__all__ = ["affordable", "by_moments", "pairs_of", "too_costly"]


def affordable(checked: list[Checked], config: CentreConfig, journal: Journal) -> list[Checked]:
    """A step's messages, in canonical order, those that cost too much by their moments, which the journal is told."""
    chosen = too_costly([one for (_, one, _), _ in checked], config)
    checked = list(checked) if chosen else checked
    for index in chosen:
        (source, one, entry), faults = checked[index]
        checked[index] = (source, by_moments(one), entry), faults
        journal.event({"kind": "moments", "source": source.name, "tracks": len(one.ids)})
    return checked


def pairs_of(message: LocalTracks, most: int) -> int:
    """Pairs that are compared where its tracks are reduced to `most` components."""
    largest = 1 if message.counts is None else int(message.counts.max(initial=1))
    return len(message.ids) * largest**2 if largest > most else 0


def too_costly(messages: Sequence[LocalTracks], config: CentreConfig) -> list[int]:
    """Which of a step's messages, in canonical order, are taken by their moments."""
    pairs = [pairs_of(message, config.max_components) for message in messages]
    total = sum(pairs)
    chosen: list[int] = []
    for index in sorted(range(len(pairs)), key=lambda one: -pairs[one]):
        if total <= config.component_pairs:
            break
        chosen.append(index)
        total -= pairs[index]
    return sorted(chosen)


def by_moments(message: LocalTracks) -> LocalTracks:
    """The same with one component a track, of the mean and covariance of its mixture."""
    if message.counts is None or message.weights is None or not len(message.ids):
        return message
    counts = message.counts.astype(np.intp)
    starts = np.cumsum(counts) - counts
    with np.errstate(all="ignore"):  # what is not sound is refused by itself
        weights = message.weights / np.repeat(np.add.reduceat(message.weights, starts), counts)
        means = np.add.reduceat(weights[:, None] * message.means, starts)
        d = message.means - np.repeat(means, counts, axis=0)
        spread = message.covariances + d[:, :, None] * d[:, None, :]
        covariances = np.add.reduceat(weights[:, None, None] * spread, starts)
    return replace(message, counts=None, weights=None, means=means, covariances=covariances)
