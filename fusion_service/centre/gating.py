"""Which linked local tracks are believed in a step, and which links new data have broken.

Every new datum is compared with what the centre itself predicted for its global track, a manoeuvre allowed for
(`manoeuvre`, an acceleration of any direction over the time since the last datum), and then with what the other
sources in the track say now. One that fails is left out of the fusion until its source says something else. Where two
disagree, the prediction decides which of them is left out; of one global track one row at a time, so that a wrong row
cannot take the right ones with it. What is found adds to the sums of `evidence`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, among, filled, finite, marked, picked, subset
from fusion_service.centre.consensus import Consensus, consensus
from fusion_service.centre.evidence import Tests
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.tracks import set_links
from schemas import messages

__all__ = ["Judgement", "Settings", "judge", "manoeuvred"]

AXES = (("x", "vx", "ax"), ("y", "vy", "ay"), ("z", "vz", "az"))


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """inside: rows that are fused in this step, in order, and `agreed`, what they say together and of each other.
    broken (B,): rows whose link was broken now, and was (B,): the global id it led to."""

    inside: Ints
    agreed: Consensus
    broken: Ints
    was: NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Settings:
    """What of a config the judgement needs."""

    tests: Tests
    space: tuple[str, ...]
    manoeuvre: float


def manoeuvred(space: tuple[str, ...], acceleration: float, seconds: Floats) -> Floats:
    """Covariance (n, n, M) of what a constant unknown acceleration (one sigma, m/s2, each axis alike) makes of a
    state in so many seconds (M,)."""
    spread = np.zeros((len(space), len(space), len(seconds)))
    _add_manoeuvre(spread, space, acceleration, seconds)
    return spread


def _add_manoeuvre(spread: Floats, space: tuple[str, ...], acceleration: float, seconds: Floats) -> None:
    """Add what `manoeuvred` gives to covariances (n, n, M)."""
    gains = (0.5 * seconds**2, seconds, np.ones_like(seconds))
    more: dict[tuple[int, int], Floats] = {}
    for axis in AXES:
        there = [(space.index(name), order) for order, name in enumerate(axis) if name in space]
        for i, one in there:
            for j, other in there:
                if (one, other) not in more:
                    more[one, other] = acceleration**2 * gains[one] * gains[other]
                spread[i, j] += more[one, other]


def judge(rows: Rows, now: Picture, forced: Ints, time: int, settings: Settings, journal: Journal) -> Judgement:
    """Judge the linked rows in the step at `time`, ns, writing their columns of links. now: the picture predicted
    to it; forced: rows whose links no evidence breaks."""
    tracks, linked, tests = rows.tracks, rows.linked(), settings.tests
    links = tracks.link[linked]
    fresh = subset(rows.fresh, linked)
    predicted, seen = _from_prediction(rows, linked, now, time, settings)
    jumped = fresh & (predicted > tests.keep[seen])
    outside = np.where(fresh, jumped, subset(tracks.outside, linked))
    some = marked(~outside if rows.out is None else ~outside & ~rows.out[linked])
    agreed = consensus(links[some], subset(tracks.mean, linked[some]), subset(tracks.covariance, linked[some]))
    distance, shared = filled(len(linked), np.nan, np.float64), np.zeros(len(linked), dtype=np.intp)
    distance[some], shared[some] = _from_others(rows, linked[some], agreed, tests)
    failed = _worst(links, fresh, distance, predicted, subset(tracks.since, linked), distance > tests.keep[shared])
    outside[failed] = True
    agreement, jump = tests.agreement(distance, shared), tests.jump(predicted, seen)
    _weigh(rows, linked, agreement, jump, jumped, agreed.groups, agreed.size, some, tests.bound)
    tracks.outside[linked] = outside
    tracks.judged[linked] = np.where(fresh, subset(tracks.updated, linked), subset(tracks.judged, linked))
    tracks.seen[linked] = np.where(fresh, time, subset(tracks.seen, linked))
    tracks.data[linked] += fresh
    may = fresh & ~among(linked, forced)
    broken, was = _break(rows, linked, links, may, distance, predicted, tests, journal)
    stays = subset(tracks.link, linked) != NO_TRACK
    shown = np.where(np.isnan(distance), np.where(outside, predicted, np.nan), distance)
    for kind, which in ((messages.KEPT, stays & ~outside), (messages.GATE_FAILED, stays & outside)):
        at = marked(which)
        if len(at):
            journal.decide(kind, rows, subset(linked, at), subset(links, at), subset(shown, at))
    inside = rows.inside()
    if len(inside) != len(some):
        agreed = _without(agreed, rows, linked[some], inside)
    return Judgement(inside, agreed, broken, was)


def _without(agreed: Consensus, rows: Rows, had: Ints, inside: Ints) -> Consensus:
    """What the rows `inside` say together, from what all of `had` said: only tracks that lost one are fused anew."""
    tracks = rows.tracks
    mark = np.zeros(len(rows.source), dtype=np.bool_)
    mark[inside] = True
    kept = marked(mark[had])
    links = tracks.link[inside]
    place = np.searchsorted(agreed.labels, links)
    count = np.bincount(place, minlength=len(agreed.labels))
    at = marked(count)
    labels = agreed.labels[at]
    mean, covariance = picked(agreed.mean, at), picked(agreed.covariance, at)
    others_mean, others_covariance = picked(agreed.others_mean, kept), picked(agreed.others_covariance, kept)
    size = agreed.size[kept]
    fewer = marked(size != count[place])
    some = inside[fewer]
    anew = consensus(links[fewer], picked(tracks.mean, some), picked(tracks.covariance, some))
    changed = np.searchsorted(labels, anew.labels)
    mean[:, changed], covariance[:, :, changed] = anew.mean, anew.covariance
    others_mean[:, fewer], others_covariance[:, :, fewer] = anew.others_mean, anew.others_covariance
    size[fewer] = anew.size
    return Consensus(labels, mean, covariance, others_mean, others_covariance, size, [])


def _from_prediction(rows: Rows, linked: Ints, now: Picture, time: int, settings: Settings) -> tuple[Floats, Ints]:
    """d2 (L,) of each linked row to the prediction of its global track, a manoeuvre allowed for, and over how many
    components that is."""
    tracks = rows.tracks
    at = now.find(tracks.link[linked])
    seconds = np.maximum(time - now.seen[at], 0) / 1e9
    spread = subset(tracks.covariance, linked) + picked(now.covariance, at)
    _add_manoeuvre(spread, settings.space, settings.manoeuvre, seconds)
    size, _ = settings.tests.unknown.common(spread)
    distance = linalg.quadratic(spread, subset(tracks.mean, linked) - picked(now.mean, at))
    return np.where(now.time[at] >= 0, np.where(np.isnan(distance), np.inf, distance), 0.0), size


def _from_others(rows: Rows, some: Ints, agreed: Consensus, tests: Tests) -> tuple[Floats, Ints]:
    """d2 (S,) of each row to the others of its track, NaN where it is alone, and over how many components."""
    distance, size = filled(len(some), np.nan, np.float64), np.zeros(len(some), dtype=np.intp)
    mean, covariance = rows.tracks.mean, rows.tracks.covariance
    for members in agreed.groups:
        if members.shape[1] < 2:
            continue
        of_two = members.shape[1] == 2  # as far from each other both ways, to the bit
        at = members[:, 0] if of_two else members.reshape(-1)
        spread = picked(covariance, some[at]) + picked(agreed.others_covariance, at)
        apart = linalg.quadratic(spread, picked(mean, some[at]) - picked(agreed.others_mean, at))
        common, _ = tests.unknown.common(spread)
        distance[members] = apart[:, None] if of_two else apart.reshape(members.shape)
        size[members] = common[:, None] if of_two else common.reshape(members.shape)
    return distance, size


def _worst(
    links: NDArray[np.uint64], fresh: Bools, distance: Floats, predicted: Floats, since: NDArray[np.int64], bad: Bools
) -> Ints:
    """Of the bad rows of each global track with new data the one to leave out: farthest from the others, then from
    the prediction, then youngest, then last in order."""
    at = marked(bad)
    if not len(at):
        return at
    at = at[among(links[at], links[fresh])]
    if not len(at):
        return at
    order = np.lexsort((-at, -since[at], -predicted[at], -distance[at], links[at]))
    first = np.append(True, links[at][order][1:] != links[at][order][:-1])
    return np.asarray(at[order][first])


def _weigh(
    rows: Rows, linked: Ints, agreement: Floats, jump: Floats, jumped: Bools, groups: list[Ints], size: Ints,
    some: Ints, bound: float,
) -> None:  # fmt: skip
    """Add to the sum of each link with a new datum. What the others say counts once per datum of theirs."""
    tracks, fresh = rows.tracks, subset(rows.fresh, linked)
    others = filled(len(linked), -1, np.int64)
    others[some] = _newest_other(groups, tracks.updated[linked[some]])
    together = np.zeros(len(linked), dtype=np.bool_)
    together[some] = size > 1
    before = subset(tracks.weighed, linked)
    weighed = fresh & together & ~jumped & (others > before)
    more = np.where(weighed, finite(agreement), 0.0)
    more = np.where(fresh & ~together & ~jumped, bound / 4, more)
    more = np.where(jumped, jump, more)
    tracks.evidence[linked] = np.minimum(np.maximum(subset(tracks.evidence, linked) + more, -bound), bound)
    tracks.weighed[linked] = np.where(weighed, others, before)


def _newest_other(groups: list[Ints], updated: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each row the newest datum of the other rows of its track, -1 without any; groups as of `Consensus`."""
    out = filled(len(updated), -1, np.int64)
    for members in groups:
        if members.shape[1] == 2:
            out[members] = updated[members[:, ::-1]]
        elif members.shape[1] > 2:
            when = updated[members]
            second, newest = np.sort(when, axis=1)[:, -2:].T
            out[members] = np.where(when == newest[:, None], second[:, None], newest[:, None])
    return out


def _break(
    rows: Rows, linked: Ints, links: NDArray[np.uint64], may: Bools, distance: Floats, predicted: Floats,
    tests: Tests, journal: Journal,
) -> tuple[Ints, NDArray[np.uint64]]:  # fmt: skip
    """Break what the sums have decided of the links that may break; of one global track only the row farthest from
    its prediction."""
    tracks = rows.tracks
    ripe = may & (subset(tracks.evidence, linked) <= -tests.bound + 1e-9)
    shown = np.where(np.isnan(distance), predicted, distance)
    worst = _worst(links, may, predicted, shown, subset(tracks.since, linked), ripe)
    if len(worst):
        journal.broke(rows, linked[worst], links[worst], shown[worst])
        again = among(links, links[worst])
        tracks.evidence[linked[again]] = np.maximum(tracks.evidence[linked[again]], 0.0)
        set_links(tracks, linked[worst], NO_TRACK, -1)
    return linked[worst], links[worst]
