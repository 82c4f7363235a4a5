"""What global tracks are believed to be: Bayes over a few candidates each, by columns.

A report that says s with probability t of being right multiplies the odds of s against every other by a factor, its
gain exp(g); a candidate enters with the weight of the rest, whose evidence it shared until then. The best weight is
brought to 0 and none falls below -`DEPTH`, so that a wrong belief (a link that was wrong, an identity that changed)
needs a few reports to be turned, never as many as have made it. Several questions about one track (an identity of
each scheme) are answered apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.centre.words import NONE, Codes

__all__ = ["CANDIDATES", "DEPTH", "OPEN", "Beliefs", "learned", "no_beliefs"]

Ids = NDArray[np.uint64]
CANDIDATES = 4
OPEN = 0
"""Answers without end: all those that are no candidates weigh as one."""
DEPTH = float(np.log(1e4))


@dataclass(frozen=True, slots=True, eq=False)
class Beliefs:
    """R beliefs sorted by (track, question): track (R,) u64 global id; question (R,) i32; code (CANDIDATES, R) i32 of
    the candidates, -1 for an empty place; weight (CANDIDATES + 1, R) log weights, -inf for an empty place, the last
    one that of each other answer."""

    track: Ids
    question: Codes
    code: Codes
    weight: Floats

    def take(self, rows: Any) -> Beliefs:
        """The given rows (indices or a mask)."""
        return Beliefs(*(getattr(self, one.name)[..., rows] for one in fields(self)))

    def find(self, track: Ids, question: Codes) -> NDArray[np.intp]:
        """Row of each (track, question), -1 where there is none."""
        if not len(self.track):
            return np.full(len(track), -1, dtype=np.intp)
        low = np.searchsorted(self.track, track)
        found = np.full(len(track), -1, dtype=np.intp)
        for step in range(int(np.unique(self.track, return_counts=True)[1].max())):
            at = np.minimum(low + step, len(self.track) - 1)
            found = np.where((self.track[at] == track) & (self.question[at] == question), at, found)
        return found

    def probabilities(self, answers: int) -> Floats:
        """(CANDIDATES, R): probability of each candidate, where so many answers are possible, or `OPEN`."""
        odds = np.exp(self.weight)
        others = np.maximum(answers - (self.code != NONE).sum(axis=0), 0) if answers != OPEN else 1
        total = odds[-1] * others
        for one in odds[:-1]:
            total = total + one
        p: Floats = odds[:-1] / total
        return p

    def best(self, answers: int) -> tuple[Codes, Floats]:
        """The likeliest candidate of each belief and its probability, (R,)."""
        if not len(self.track):
            return np.zeros(0, dtype=np.int32), np.zeros(0)
        p, each = self.probabilities(answers), np.arange(len(self.track))
        top = p.argmax(axis=0)
        return self.code[top, each], p[top, each]


def no_beliefs() -> Beliefs:
    """None yet."""
    empty = np.zeros((CANDIDATES, 0), dtype=np.int32), np.zeros((CANDIDATES + 1, 0))
    return Beliefs(np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int32), *empty)


def learned(beliefs: Beliefs, track: Ids, question: Codes, code: Codes, gain: Floats) -> Beliefs:
    """After E reports, in their order: `code` is the answer to `question` about `track`, by log odds of `gain`."""
    if not len(track):
        return beliefs
    questions = np.unique(np.concatenate([beliefs.question, question]))
    tracks = np.unique(np.concatenate([beliefs.track, track]))

    def key(tracks_of: Ids, questions_of: Codes) -> NDArray[np.intp]:
        return np.searchsorted(tracks, tracks_of) * len(questions) + np.searchsorted(questions, questions_of)

    old, new = key(beliefs.track, beliefs.question), key(track, question)
    keys = np.unique(np.concatenate([old, new]))
    codes = np.full((CANDIDATES, len(keys)), NONE, dtype=np.int32)
    weights = np.full((CANDIDATES + 1, len(keys)), -np.inf)
    weights[-1] = 0.0
    at = np.searchsorted(keys, old)
    codes[:, at], weights[:, at] = beliefs.code, beliefs.weight
    row = np.searchsorted(keys, new)
    order = np.argsort(row, kind="stable")
    starts = np.flatnonzero(np.append(True, row[order][1:] != row[order][:-1]))
    sizes = np.diff(np.append(starts, len(row)))
    for rank in range(int(sizes.max())):
        event = order[starts[sizes > rank] + rank]
        _report(codes, weights, row[event], code[event], gain[event])
    return Beliefs(tracks[keys // len(questions)], questions[keys % len(questions)], codes, weights)


def _report(codes: Codes, weights: Floats, row: NDArray[np.intp], code: Codes, gain: Floats) -> None:
    """One report for each of some different rows, in place."""
    same = codes[:, row] == code
    place = np.where(same.any(axis=0), same.argmax(axis=0), weights[:-1, row].argmin(axis=0))
    fresh = ~same.any(axis=0)
    codes[place, row] = code
    weights[place[fresh], row[fresh]] = weights[-1, row[fresh]]
    weights[place, row] += gain
    some = weights[:, row]
    some = some - some.max(axis=0)
    weights[:, row] = np.where(np.isneginf(some), some, np.maximum(some, -DEPTH))
