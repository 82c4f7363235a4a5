"""Three radars, twenty targets, heavy clutter: Sharma 6.4, through the whole fusion centre.

The world, the radars and their local trackers are those of `sensor-client simulate three-radars` (`sensor-client list`
prints every number; the coordinates, the 10 s between reports and the kind of tracker are the paper's, the noise, the
clutter, the detection probability and the speeds are chosen: its Table 2 is missing). Each run tracks anew; what the
radars then publish goes through `FusionCentre` with the demo's settings (motion of a global track: q = 10 m2/s3, "a
relatively high process noise intensity"), once for every rule and memory:

* restart: the local tracks of all radars are fused at once, every time anew.
* recursive: that result is fused with the predicted last global track, by CI whatever the rule is: their correlation is
  unknown and can be full.
* tracklet: what successive versions of each local track have added goes as measurements into a filter of the target's
  own (with the rule only where a version is no such measurement, so it is run for CI alone); with the demo's motion,
  and with that which the radars declare, q = 0.02 m2/s3.
* sequential: the paper's own way. The predicted last global track is fused with the radars' lists one after the other,
  each time by the rule itself (the association is that of the centre under CI, restart).

Confirmed and coasting global tracks are scored at every step (10 s) in position and velocity, in the plane of radar 1,
assigned to the targets by GOSPA with a cut-off of 5 km: a worse track counts as none. The first 60 s are left out: the
trackers start from nothing there. RMSE is of the position, eq. (89), pooled over the targets of a category, steps and
runs; ANEES is eq. (90) over its dimension, 4, pooled likewise: 1 is ideal, below it is conservative. "NEES too high":
of all pairs of a target and a step, the share whose mean over the runs lies above the 95 % interval of a consistent
estimate. Standard errors are over the runs; rules are compared on the same runs, so their differences are far surer
than that. Categories as the paper lists them: A (targets 4, 10, 15) seen by three radars, B (2, 5, 7, 8, 11, 12, 13,
14, 16) by two, C (3, 6, 9, 17, 20) by one; 1 and 19 are in none, and no radar sees 18. "best radar" is the local track
of the radar with the least RMSE for that target, found with the truth.

Tracklets are as good as the motion that the centre is told: with that which the radars declare they have less error
than CI in every category; with the demo's, which allows for five hundred times the noise, far more, in C more than the
radar alone. CI can afford such a motion, for it fuses nothing but the local tracks of the step.

What comes out: A has the least error and C the highest, whatever the rule and the memory, and in C the rules are all
but alike, near the local estimate (a little below it, by the memory or by a second radar at the edge of its reach).
HMD-GA has the least RMSE of the three, against ICI by little. CI does not lie at the bottom of *all* NEES plots: where
one radar is much better than the other, CI by det takes that radar's track alone, with its error and its NEES (targets
5, 13 and 16 nearly all the time). NEES is lower in A than in B, not higher as the paper has it. `naive` with memory
counts the same data twice, and shows it.
Target 12 is in reach of radar 2 only, so the paper's B is of eight targets and one of C; the table has it by itself.

`naive` and `bci` with a bound of 0.5 are not in the paper. A `--rule` goes through the centre too; a function of your
own, or one with given weights, is fused in the sequential way only. Below ten runs, some rules are left out.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fusion_service.demo import THREE_RADARS
from fusion_service.geodesy import transform
from fusion_service.metrics import nees_bounds
from fusion_service.motion import predict
from schemas import GlobalTracks, LocalTracks, Motion
from schemas.messages import TENTATIVE
from sensor_clients.scenarios.three_radars import RADARS, TARGETS, TRACKER, three_radars
from studies import missions
from studies.missions import best_source, less, mean_nees, pooled, root_mean, sums
from studies.pictures import colour
from studies.report import digits
from studies.rules import Fuser, fuser
from studies.statistics import Estimate, jackknife
from studies.study import Floats, Result, Row, Run, Study

CATEGORIES = {"A": (4, 10, 15), "B": (2, 5, 7, 8, 11, 12, 13, 14, 16), "C": (3, 6, 9, 17, 20)}
PAPERS = ("ci", "ici", "hmd-ga")
OURS = ("naive", "bci:max_correlation=0.5")
SETTINGS = {**tomllib.loads(THREE_RADARS), "motion": {"kind": "cv", "q": 10.0}}
"""Of the demo's centre, with a motion of global tracks that allows for the turns of aircraft."""
STATE = ("x", "y", "vx", "vy")
MEMORIES = ("restart", "recursive", "sequential", f"sequential q={TRACKER.motion.q:g}")
TRACKLETS = ("ci tracklet", f"ci tracklet q={TRACKER.motion.q:g}")
CUTOFF = 5000.0
WARM_UP = 60.0
PERIOD, STEPS = 10.0, 31
CHUNK = 5
"""Runs of one job: their sequential fusion is one batch."""
FEW = 10
SHOWN = (4, 10, 15, 2, 8, 12, 3)


class Way(NamedTuple):
    """A rule with a memory; q, m2/s3, of the motion of its global tracks."""

    rule: Fuser
    memory: str
    q: float = SETTINGS["motion"]["q"]

    @property
    def label(self) -> str:
        return f"{self.rule.label} {self.memory}" + (f" q={self.q:g}" if self.q != SETTINGS["motion"]["q"] else "")


def ways(run: Run) -> tuple[Way, ...]:
    """All that is compared; what goes through the centre first, "ci restart" before all."""
    papers, ours = [fuser(text) for text in PAPERS], [fuser(text) for text in OURS]
    plain = [rule for rule in run.rules if rule.weights is None]
    if run.runs < FEW:
        chosen, ours, quiet = [Way(papers[0], "restart"), Way(papers[2], "recursive")], [], []
    else:
        chosen = [Way(rule, "restart") for rule in (*papers, *ours)] + [Way(rule, "recursive") for rule in papers]
        quiet = [Way(rule, "sequential", TRACKER.motion.q) for rule in papers]
    chosen += [Way(papers[0], "tracklet", q) for q in (SETTINGS["motion"]["q"], TRACKER.motion.q)]
    chosen += [Way(rule, memory) for rule in plain for memory in ("restart", "recursive")]
    return (*chosen, *(Way(rule, "sequential") for rule in (*papers, *ours, *run.rules)), *quiet)


class Links(NamedTuple):
    """What the centre linked in one run, with G global tracks in all: means (K, S, n, G) and covariances
    (K, S, n, n, G) of the radars' tracks in the frame of the centre, NaN where there is none; shown (K, G): whether the
    global track is confirmed or coasting."""

    means: Floats
    covariances: Floats
    shown: np.ndarray[Any, np.dtype[np.bool_]]


def links(pictures: list[GlobalTracks], local: dict[tuple[str, int], tuple[LocalTracks, Floats, Floats]]) -> Links:
    """local: (radar, time) -> its tracks, with means and covariances in the frame of the centre."""
    column = {id_: g for g, id_ in enumerate(np.unique(np.concatenate([one.ids for one in pictures])).tolist())}
    K, S, n, G = len(pictures), len(RADARS), len(STATE), len(column)
    means, covariances = np.full((K, S, n, G), np.nan), np.full((K, S, n, n, G), np.nan)
    shown = np.zeros((K, G), dtype=np.bool_)
    for k, picture in enumerate(pictures):
        at = np.array([column[id_] for id_ in picture.ids.tolist()], dtype=np.intp)
        shown[k, at] = picture.status != TENTATIVE
        for s, name in enumerate(RADARS):
            message, x, P = local[name, picture.time]
            row = {id_: r for r, id_ in enumerate(message.ids.tolist())}
            mine = np.array([picture.sources[i] == name for i in picture.contributor_source], dtype=np.bool_)
            g = np.repeat(at, picture.contributor_counts)[mine]
            r = [row[id_] for id_ in picture.contributor_id[mine].tolist()]
            means[k, s][:, g], covariances[k, s][:, :, g] = x[r].T, np.moveaxis(P[r], 0, -1)
    return Links(means, covariances, shown)


def sequential(way: Way, linked: Links) -> tuple[Floats, Floats]:
    """Means (K, n, G) and covariances (K, n, n, G) of a centre that fuses its predicted last result with one radar's
    tracks after the other's, each time by the rule."""
    K, S, n, G = linked.means.shape
    means, covariances = np.full((K, n, G), np.nan), np.full((K, n, n, G), np.nan)
    x, P = means[0].copy(), covariances[0].copy()
    for k in range(K):
        x, P = predict(Motion("cv", way.q), STATE, x, P, np.full(G, PERIOD))
        for s in range(S):
            there = np.isfinite(linked.means[k, s, 0])
            first, again = there & np.isnan(x[0]), np.flatnonzero(there & np.isfinite(x[0]))
            x[:, first], P[:, :, first] = linked.means[k, s][:, first], linked.covariances[k, s][:, :, first]
            if len(again):
                fused = way.rule(
                    np.stack([x[:, again], linked.means[k, s][:, again]]),
                    np.stack([P[:, :, again], linked.covariances[k, s][:, :, again]]),
                )
                x[:, again], P[:, :, again] = fused.mean, fused.covariance
        means[k], covariances[k] = x, P
    return means, covariances


def fly(seeds: tuple[int, ...], chosen: tuple[Way, ...], seed: int) -> Floats:
    """Squared error of position and NEES over its dimension (2, W + S, K, T, M) of every way and every radar."""
    scenario = three_radars()
    truth = {one.time: one.means[:, [one.space.index(name) for name in STATE]] for one in missions.truths(scenario)}
    scores = np.full((2, len(chosen) + len(RADARS), STEPS, len(TARGETS), len(seeds)), np.nan)
    runs: list[Links] = []
    for m, number in enumerate(seeds):
        told = missions.told(scenario, seed * 1_000_003 + number)
        local: dict[tuple[str, int], tuple[LocalTracks, Floats, Floats]] = {}
        for one in told:
            if isinstance(one, LocalTracks):
                moved = transform(one.means, one.covariances, STATE, one.frame, RADARS["radar1"], one.height)
                local[one.source, one.time] = one, *moved
        for w, way in enumerate(chosen):
            if way.memory == "sequential":
                continue
            rule = {"rule": way.rule.rule, "rule_options": dict(way.rule.options), "memory": way.memory}
            rule |= {"motion": {"kind": "cv", "q": way.q}}
            pictures = missions.fuse(told, {**SETTINGS, **rule})
            if not w:
                runs.append(links(pictures, local))
            for k, picture in enumerate(pictures):
                shown = picture.status != TENTATIVE
                found = picture.means[shown], picture.covariances[shown]
                scores[:, w, k, :, m] = missions.follow(truth[picture.time], *found, CUTOFF)
        times = sorted({time for _, time in local})
        for (name, time), (_, x, P) in local.items():
            s = len(chosen) + list(RADARS).index(name)
            scores[:, s, times.index(time), :, m] = missions.follow(truth[time], x, P, CUTOFF)
    joined = Links(*(np.concatenate(column, axis=-1) for column in zip(*runs, strict=True)))
    run_of = np.repeat(np.arange(len(seeds)), [one.shown.shape[1] for one in runs])
    for w, way in enumerate(chosen):
        if way.memory == "sequential":
            means, covariances = sequential(way, joined)
            for k, m in np.ndindex(STEPS, len(seeds)):
                shown = joined.shown[k] & (run_of == m)
                found = means[k][:, shown].T, np.moveaxis(covariances[k][:, :, shown], -1, 0)
                scores[:, w, k, :, m] = missions.follow(truth[times[k]], *found, CUTOFF)
    return scores


def run(run: Run) -> Result:
    chosen = ways(run)
    if any(way.rule.own for way in chosen):
        run = replace(run, jobs=1)
    chunks = [tuple(range(first, min(first + CHUNK, run.runs))) for first in range(0, run.runs, CHUNK)]
    scores = np.concatenate(run.map(partial(fly, chosen=chosen, seed=run.seed), chunks, "runs"), axis=-1)
    scores = scores[:, :, round(WARM_UP / PERIOD) :]
    best = scores[:, : len(chosen)], best_source(scores[:, len(chosen) :])
    scores = np.concatenate([best[0], best[1][:, None]], axis=1)
    by = dict(zip([*(way.label for way in chosen), "best radar"], scores.swapaxes(0, 1), strict=True))
    rows: list[Row] = []
    for category, targets in CATEGORIES.items():
        rows += [row for label, one in by.items() for row in table(f"{category}: {label}", of(one, targets))]
    told = "hmd-ga sequential"
    for target in range(1, len(TARGETS) + 1):
        if np.isfinite(one := of(by[told], (target,))).any():
            rows += table(f"target {target}: {told}", one)
    return Result(tuple(rows), tuple(notes(by)), partial(draw, by=by), (16.0, 6.0))


def of(scores: Floats, targets: tuple[int, ...]) -> Floats:
    """The columns (2, K, T, M) of these targets."""
    return scores[:, :, [target - 1 for target in targets]]


def table(name: str, scores: Floats) -> list[Row]:
    one = pooled(scores, len(STATE))
    return [
        Row(name, "RMSE, m", None, *one.rmse),
        Row(name, "ANEES", None, *one.anees),
        Row(name, "steps with a track, %", None, 100 * one.there.value, 100 * one.there.stderr),
        Row(name, "NEES too high, %", None, 100 * one.high),
    ]


def notes(by: Mapping[str, Floats]) -> Iterator[str]:
    """The paper's claims, each with what came out for every memory."""
    memories = [memory for memory in MEMORIES if all(f"{rule} {memory}" in by for rule in PAPERS)]

    def each(tell: Callable[[Floats, Floats, Floats], str], categories: str) -> str:
        """What is told of CI, ICI and HMD-GA in these categories, under each memory."""
        said = []
        for memory in memories:
            scores = [[of(by[f"{rule} {memory}"], CATEGORIES[one]) for rule in PAPERS] for one in categories]
            said.append(
                f"{memory} " + ", ".join(f"{one} {tell(*it)}" for one, it in zip(categories, scores, strict=True))
            )
        return "; ".join(said)

    yield (
        'Claimed: "Category A has the least error", C "the highest". RMSE of HMD-GA, m: '
        + each(lambda ci, ici, hmd: _pm(jackknife(root_mean, sums(hmd))), "ABC")
        + "."
    )
    yield (
        "Claimed: NEES is higher in A than in B. ANEES of HMD-GA: "
        + each(lambda ci, ici, hmd: _pm(jackknife(mean_nees, sums(hmd))), "AB")
        + ". All lie below 1, those of the single radars too: the local trackers publish covariances that are too "
        "large, and a rule that allows for correlation where there is none makes them larger, the more the more radars."
    )
    yield (
        'Claimed: CI "lies at the bottom of all NEES plots". Share of the pairs of a target and a step on which its '
        "NEES is the least of the three: " + each(lambda ci, ici, hmd: _least(1, ci, ici, hmd), "AB") + "."
    )
    yield (
        'Claimed: NEES "for ICI and HMD-GA show no difference". ANEES of HMD-GA less that of ICI: '
        + each(lambda ci, ici, hmd: _pm(less(mean_nees, hmd, ici)), "AB")
        + "."
    )
    yield (
        'Claimed: HMD-GA has "the least estimation error for most of the sample time". Share of the pairs on which its '
        "squared error is the least of the three, and its RMSE less that of ICI, m: "
        + each(lambda ci, ici, hmd: f"{_least(0, hmd, ci, ici)}, {_pm(less(root_mean, hmd, ici))}", "AB")
        + "."
    )
    alone = of(by["best radar"], CATEGORIES["C"])
    yield (
        'Claimed: in category C all rules give nearly the same, "almost equal to the local estimate". ANEES of HMD-GA '
        "less that of CI, and RMSE of CI and HMD-GA less that of the best radar, m: "
        + each(
            lambda ci, ici, hmd: ", ".join(
                [_pm(less(mean_nees, hmd, ci)), *(_pm(less(root_mean, one, alone)) for one in (ci, hmd))]
            ),
            "C",
        )
        + "."
    )
    if "recursive" in memories:
        change = ", ".join(
            f"{category} {_pm(less(root_mean, of(by['ci recursive'], targets), of(by['ci restart'], targets)))}"
            for category, targets in CATEGORIES.items()
        )
        yield (
            f"Recursive memory changes the RMSE of CI by (m) {change}: after ten seconds of q = "
            f"{SETTINGS['motion']['q']:g} m2/s3 the last result is less certain than the new nearly everywhere, and "
            "CI then gives it no weight."
        )
    yield from beside_tracklets(by)
    rmse = {target: root_mean(sums(of(by["hmd-ga sequential"], (target,)))) for target in CATEGORIES["A"]}
    order = ", ".join(f"{target} ({value:.1f} m)" for target, value in sorted(rmse.items(), key=lambda it: it[1]))
    yield f"Claimed: in A target 10 has the least RMSE and target 4 the highest. HMD-GA, sequential: {order}."


def beside_tracklets(by: Mapping[str, Floats]) -> Iterator[str]:
    """What tracklets give, beside the best radar and what is fused anew in every step."""
    told = []
    for label in TRACKLETS:
        for category, targets in CATEGORIES.items():
            one, alone, restart = (of(by[name], targets) for name in (label, "best radar", "ci restart"))
            told.append(
                f"{label}, {category}: {_pm(jackknife(root_mean, sums(one)))} ({_pm(less(root_mean, one, alone))}, "
                f"{_pm(less(root_mean, one, restart))}), ANEES {_pm(jackknife(mean_nees, sums(one)))}"
            )
    yield f"Tracklets, RMSE in m (less that of the best radar, less that of CI restart): {'; '.join(told)}."


def _pm(value: Estimate) -> str:
    """Value and error."""
    return f"{digits(value.value, value.stderr)} ± {digits(value.stderr, value.stderr)}"


def _least(which: int, one: Floats, *others: Floats) -> str:
    """Share of the pairs of a target and a step at which `one` has strictly the least squared error or NEES over the
    runs."""
    means = []
    for scores in (one, *others):
        there = np.isfinite(scores[which])
        means.append(np.where(there, scores[which], 0.0).sum(axis=-1) / np.maximum(there.sum(axis=-1), 1))
    return f"{100 * np.mean(means[0] < np.min(means[1:], axis=0)):.0f} %"


def draw(figure: Any, by: Mapping[str, Floats]) -> None:
    """RMSE and NEES over time of some targets under the paper's rules and memory."""
    panels = figure.subplots(2, len(SHOWN), sharex=True)
    M = next(iter(by.values())).shape[-1]
    t = WARM_UP + PERIOD * np.arange(next(iter(by.values())).shape[1])
    for column, target in zip(panels.T, SHOWN, strict=True):
        for label in [*(f"{rule} sequential" for rule in PAPERS), "best radar"]:
            scores = of(by[label], (target,))[:, :, 0]
            there = np.isfinite(scores[0])
            with np.errstate(invalid="ignore"):
                mse, nees = np.where(there, scores, 0.0).sum(axis=-1) / there.sum(axis=-1)
            ours = label != "best radar"
            style = {"color": colour(label) if ours else "0.45", "lw": 1.4, "ls": "-" if ours else ":"}
            column[0].plot(t, np.sqrt(mse), label=label.removesuffix(" sequential"), **style)
            column[1].plot(t, nees, **style)
        low, high = nees_bounds(len(STATE), M)
        column[1].axhspan(low, high, color="0.88", zorder=0)
        category = next(name for name, targets in CATEGORIES.items() if target in targets)
        column[0].set_title(f"target {target} ({category})")
        column[0].set_ylim(bottom=0)
        column[1].set_ylim(bottom=0)
        column[1].set_xlabel("time, s")
    panels[0, 0].set_ylabel("RMSE of position, m")
    panels[1, 0].set_ylabel("NEES / 4 (grey: 95 % interval)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"Three radars, sequential memory, {M} runs: the more radars, the less error and the lower NEES")


STUDIES = (
    Study(
        name="sharma-three-radars",
        title="Three radars, twenty targets, the whole fusion centre",
        source="Sharma 6.4",
        about=__doc__ or "",
        run=run,
        runs=200,
        quick=2,
        seconds=950.0,
        takes_rules=True,
    ),
)
