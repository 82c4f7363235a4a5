"""Rows of one global track that have data in common: whose lineages overlap, or that contain this centre's own data.

What is in two rows must not be counted twice, and how much is in both nobody tells: such rows count as fully
correlated. In each connected component of overlap, rows that have nothing in common with each other are fused by the
rule first; their result and the other rows of the component are fused by covariance intersection, which is conservative
for every correlation; the rule then takes the results of the components, that have nothing in common. Rules whose
promise covers every correlation, and averages, take all rows as they are.

An echo, a row with data of this centre, overlaps with all others. It is news of its object only where it has a newer
measurement than the centre itself, and it starts a track only as long as that measurement is new: so two centres do
not keep a target alive by telling each other of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.association import by_size
from fusion_service.centre.intake import Intake
from fusion_service.centre.lineage import ANYONE, FEW, Codes, Kin, Lineages, overlapping
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import Tracks
from fusion_service.config import CentreConfig
from fusion_service.records import altered
from fusion_service.rules import fuse_last

__all__ = [
    "ANY_CORRELATION",
    "Estimates",
    "alone",
    "common",
    "fuse_related",
    "inherited",
    "is_related",
    "new_only",
    "of_rows",
    "separate",
    "stale_echo",
]

ANY_CORRELATION = ("ci", "fast-ci", "ffcc", "cu", "aa")
"""Rules that count nothing twice, whatever their sources have in common."""
MOST_PATTERNS = 64
"""Ways of overlapping that are told apart in one call; beyond, all rows of a track are fused by covariance
intersection."""


class Estimates(NamedTuple):
    """mean (n, B), covariance (n, n, B), and the shares (k, B) of the rows that were fused."""

    mean: Floats
    covariance: Floats
    shares: Floats


ByRule = Callable[[Floats, Floats, list[int], Ints], Estimates]
"""Fuses means (k, n, B) and covariances (k, n, n, B) by the configured rule; the list: which of the group's rows they
are, or stand for; the indices (B,): which groups."""


def of_rows(intake: Intake, tracks: Tracks, source: Ints) -> Kin:
    """Whose data is in the rows of sources (M,), indices into the sorted names."""
    lineages = intake.lineages
    own = np.array([lineages.of((name,)) for name in intake.names()], dtype=np.int32)
    told = tracks.lineage >= 0
    if len(own) and not told.any():
        return Kin(lineages, own[source], lineages.contain(own, intake.config.name)[source])
    codes = np.where(told, tracks.lineage, own[source] if len(own) else ANYONE).astype(np.int32)
    return Kin(lineages, codes, lineages.contain(codes, intake.config.name))


def alone(intake: Intake, rows: Rows) -> Bools:
    """Which rows (M,) hold data of their own source and nobody else's."""
    if rows.kin is None:
        return np.ones(len(rows.source), dtype=np.bool_)
    own = np.array([intake.lineages.of((name,)) for name in intake.names()] or [ANYONE], dtype=np.int32)
    return np.asarray((rows.kin.code == own[rows.source]) & ~rows.echo)


def stale_echo(tracks: Tracks, echo: Bools, time: int, config: CentreConfig) -> Bools:
    """Which rows (M,) are echoes without a measurement in the last interval between reports and a step."""
    return echo & (time - tracks.updated > tracks.interval + round(config.period * 1e9))


def new_only(rows: Rows, updated: Ints, at: Ints, inside: Ints) -> Rows:
    """The rows, an echo fresh only where its measurement is newer than `updated` (G,) of its track, and without a word
    on existence: that is this centre's own. at: places in the picture of the rows `inside`."""
    if not rows.echo.any():
        return rows
    fresh, existence = rows.fresh.copy(), np.where(rows.echo, np.nan, rows.tracks.existence)
    fresh[inside] &= ~rows.echo[inside] | (rows.tracks.updated[inside] > updated[at])
    return altered(rows, fresh=fresh, tracks=altered(rows.tracks, existence=existence))


def separate(rows: Rows, some: Ints) -> Bools:
    """Which of the rows `some` count as sources of their own: of those of one track that have data in common only the
    first, those of the fewest sources before others."""
    counts = np.ones(len(some), dtype=np.bool_)
    if not _may_overlap(rows, some):
        return counts
    for _, groups in by_size(rows.tracks.link[some]):
        if groups.shape[1] > 1:
            meet = common(rows, some[groups])
            counts[groups] = _apart(meet, meet.sum(axis=2))
    return counts


def common(rows: Rows, members: Ints) -> Bools:
    """Which rows of each group (B, k) have data in common (B, k, k); an echo has with all."""
    if rows.kin is None:
        return np.broadcast_to(np.eye(members.shape[1], dtype=np.bool_), (*members.shape, members.shape[1]))
    codes, which = np.unique(rows.kin.code[members], return_inverse=True)
    meet = overlapping(rows.kin.table.masks(codes), which.reshape(members.shape))
    echo = rows.echo[members]
    return np.asarray(meet | echo[:, :, None] | echo[:, None, :])


def is_related(rows: Rows, members: Ints) -> Bools:
    """Which groups (B, k) hold rows that have data in common."""
    if members.shape[1] < 2 or not _may_overlap(rows, members):
        return np.zeros(len(members), dtype=np.bool_)
    meet = common(rows, members)
    return np.asarray(meet.sum(axis=(1, 2)) > members.shape[1])


def _may_overlap(rows: Rows, some: Ints) -> bool:
    """Quick: no two rows of one track overlap where each is of its source alone."""
    return bool((rows.tracks.lineage[some] >= 0).any())


def inherited(rows: Rows, members: Ints, before: Codes, *, memory: bool) -> Codes:
    """The lineage (B,) of what groups (B, k) are fused to. before: what it was; memory: that is in the result too."""
    if rows.kin is None:
        return before
    table, codes = rows.kin.table, rows.kin.code[members]
    if codes.size > FEW:
        return _inherited(table, codes, before, memory)
    key = "inherited", codes.shape, codes.tobytes(), before.tobytes(), memory
    return table.recalled(key, lambda: _inherited(table, codes, before, memory))


def _inherited(table: Lineages, members: Codes, before: Codes, memory: bool) -> Codes:
    union, had = table.union(np.ascontiguousarray(members.T)), table.masks(before)
    if memory:
        union = union | had
    changed = (union != had).any(axis=0)
    codes = before.copy()
    codes[changed] = table.codes(union[:, changed])
    return codes


def fuse_related(means: Floats, covariances: Floats, meet: Bools, by_rule: ByRule) -> Estimates:
    """Groups of k estimates, means (k, n, B), covariances (k, n, n, B), of which those that `meet` (B, k, k) have data
    in common. Shares: products of those in the stages."""
    k, n, count = means.shape
    out = Estimates(np.empty((n, count)), np.empty((n, n, count)), np.empty((k, count)))
    flat = np.packbits(meet.reshape(count, k * k), axis=1)
    patterns, which = np.unique(flat, axis=0, return_inverse=True)
    for number in range(min(len(patterns), MOST_PATTERNS)):
        some = np.flatnonzero(which.reshape(-1) == number)
        one = _fuse_pattern(means[:, :, some], covariances[..., some], meet[some[0]], by_rule, some)
        out.mean[:, some], out.covariance[:, :, some], out.shares[:, some] = one
    rest = np.flatnonzero(which.reshape(-1) >= MOST_PATTERNS)
    if len(rest):
        one = _intersect(means[:, :, rest], covariances[..., rest])
        out.mean[:, rest], out.covariance[:, :, rest], out.shares[:, rest] = one
    return out


def _fuse_pattern(means: Floats, covariances: Floats, meet: Bools, by_rule: ByRule, some: Ints) -> Estimates:
    """Groups that all overlap alike: `meet` (k, k); some (B,): which groups they are."""
    core = _apart(meet[None], meet.sum(axis=1)[None])[0]
    shares = np.zeros((len(means), means.shape[2]))
    parts: list[tuple[Floats, Floats]] = []
    whole = _components(meet)
    heads = sorted(set(whole))
    for head in heads:
        mine = [j for j, one in enumerate(whole) if one == head]
        first = [j for j in mine if core[j]]
        others = [j for j in mine if not core[j]]
        mean, covariance, part = _by_rule(means[first], covariances[first], first, by_rule, some)
        shares[first] = part
        if others:
            mean, covariance, part = _intersect(
                np.concatenate([mean[None], means[others]]), np.concatenate([covariance[None], covariances[others]])
            )
            shares[first] *= part[0]
            shares[others] = part[1:]
        parts.append((mean, covariance))
    stacked = np.stack([one for one, _ in parts]), np.stack([one for _, one in parts])
    mean, covariance, part = _by_rule(*stacked, heads, by_rule, some)
    for place, head in enumerate(heads):
        shares[[j for j, one in enumerate(whole) if one == head]] *= part[place]
    return Estimates(mean, covariance, shares)


def _by_rule(means: Floats, covariances: Floats, which: list[int], by_rule: ByRule, some: Ints) -> Estimates:
    if len(which) == 1:
        return Estimates(means[0], covariances[0], np.ones((1, means.shape[2])))
    return by_rule(np.ascontiguousarray(means), np.ascontiguousarray(covariances), which, some)


def _intersect(means: Floats, covariances: Floats) -> Estimates:
    fused = fuse_last("ci", np.ascontiguousarray(means), np.ascontiguousarray(covariances), influence=True)
    assert fused.influence is not None
    return Estimates(fused.mean, fused.covariance, np.nan_to_num(fused.influence))


def _apart(meet: Bools, degree: Ints) -> Bools:
    """Of each group (B, k, k) rows of which no two meet, greedily: those that meet the fewest first, in order."""
    count, k, _ = meet.shape
    order = np.argsort(degree, axis=1, kind="stable")
    chosen, groups = np.zeros((count, k), dtype=np.bool_), np.arange(count)
    for place in range(k):
        row = order[:, place]
        chosen[groups, row] = ~(meet[groups, row] & chosen).any(axis=1)
    return chosen


def _components(meet: Bools) -> list[int]:
    """For each of k rows the first row of its connected component."""
    heads = np.arange(len(meet))
    for _ in range(len(meet)):
        new = np.where(meet, heads[None, :], len(meet)).min(axis=1)
        new = np.minimum(new, heads)
        if np.array_equal(new, heads):
            break
        heads = new
    return [int(head) for head in heads]
