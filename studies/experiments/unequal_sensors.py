"""Three unequal sensors, manoeuvring targets, perfect association: what is there to gain over the best sensor?

Targets 20 km apart move in the plane with nearly constant velocity, q = 1 m2/s3. Three sensors measure the position of
each every second, with standard deviations of 10, 15 and 20 m; each has a Kalman filter that runs alone and publishes
its tracks every second. Sensors share nothing but the target's own process noise, which is in all their errors. Every
number is of the estimate at the step, each second, over 50 s after 20 s to settle; a run is one target, 400 fly in one
centre. What is not the question (the other rules, wrong q) is of 400 targets at most. Below fifty runs only 8 s count,
and only a quarter of q is tried.

* exact: steady state, by the recursion of `studies/local_tracks.py` for the joint covariance of the local tracks; what
  each rule makes of it (`studies/correlation.py`; of those that look at the means by whitened draws). "centralised" is
  the filter with all measurements; "optimal" knows all cross-covariances, and no fusion of these tracks at one time can
  be better.
* centre: the real `FusionCentre` on the messages, under every rule that a config can say and every memory, all on the
  same messages; "centralised" and "best sensor" on the same measurements. The sampled rules are left out (too slow for
  so many targets); "derived" are the cross-covariances that the centre reads off the messages.
* q: process noise is 1, but the filters have a quarter or four times of it ("filter", "both"), or the sources say so
  ("said", "both"); "both" is wrong alike; and a tenth too much is said, as if rounded. "motion set" tells the centre
  the right motion of targets in its config (motion = {kind = "cv", q = 1}), whatever sources say of their trackers.

RMSE is of the position; NEES is over its dimension, 4: 1 is honest, above it too sure. Worst eigenvalue: of the true
mean squared error relative to the mean covariance that is stated, over all directions of the state: above 1 there is a
direction in which the estimate is too sure of itself. It is the largest of several noisy numbers, so a perfectly
consistent filter shows more than 1 too; "consistent" is what the centralised filter shows of as many targets and steps
by chance, its error simulated by itself, with its spread in place of a standard error. Tracklets: the least share of
versions, over the sources, that were taken as such at the end. Innovation: what the watch sees, of the source where it
is furthest from 1: the mean normalised square of its own innovations, as the status of the centre has it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sensor_clients.filters import Position
from studies.apart import CENTRALISED, CHUNK, Flight, Scores, Task, Way, best_of, flown, told
from studies.consistency import Chance, by_chance
from studies.correlation import draws, excess, expected, largest_correlation, optimal
from studies.local_tracks import PLACE, planar, positions, steady
from studies.pictures import colour
from studies.rules import Fuser, fuser
from studies.statistics import Estimate
from studies.study import Floats, Result, Row, Run, Study
from studies.trackers import Sensor, World

SIGMAS = (10.0, 15.0, 20.0)
SENSORS = tuple(Sensor(Position(sigma, sigma)) for sigma in SIGMAS)
WORLD = World(SENSORS)
MAIN = ("ci", "naive", "bci:max_correlation=0.5", "fast-ci")
OTHERS = ("ffcc", "ici", "ei", "hmd-ga", "aa", "cu")
LEARNT: tuple[Way, ...] = (
    ("auto", {"rule": "auto"}),
    ("bar-shalom-campo:derived restart", {"rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}}),
    ("bci:derived restart", {"rule": "bci", "rule_options": {"max_correlation": "derived"}}),
)
"""What goes by what the sources declare and their messages tell."""
SAMPLED = ("hmd-s", "gmd-s")
SLOW = (*SAMPLED, "cu")
"""Rules of which fewer draws must do."""
RIGHT = {"motion": {"kind": "cv", "q": WORLD.q}}
WRONG = (0.25, 4.0)
FEW = CHUNK
ENOUGH, SHORT = 50, 28
"""Runs below which a study is only tried, and its steps then."""
TRACKLET = "#b2182b"
RMSE, NEES, WORST = "RMSE, m", "NEES / 4", "worst eigenvalue"
SHARE, SEEN = "tracklets, %", "innovation"


def way(rule: Fuser, memory: str, **more: Any) -> Way:
    """A centre's settings under its label."""
    return f"{rule.label} {memory}", {"rule": rule.rule, "rule_options": dict(rule.options), "memory": memory, **more}


def ways() -> tuple[Way, ...]:
    """Those that are compared with all targets: what is to be judged by these numbers is added here."""
    return (*(way(fuser(rule), "restart") for rule in MAIN), way(fuser("ci"), "tracklet"), *LEARNT)


def ways_few(own: tuple[Fuser, ...]) -> tuple[Way, ...]:
    """All others."""
    found = [way(fuser(rule), "recursive") for rule in MAIN] + [way(fuser("naive"), "tracklet")]
    rules = [*map(fuser, OTHERS), *own]
    return (*found, *(way(rule, memory) for rule in rules for memory in ("restart", "recursive")))


def ways_wrong() -> tuple[Way, ...]:
    """Those compared where q is wrong."""
    ci = fuser("ci")
    fixed = "tracklet, motion set", way(ci, "tracklet", **RIGHT)[1]
    return way(ci, "restart"), way(ci, "tracklet"), fixed, *LEARNT


def exact(rules: tuple[Fuser, ...], rng: np.random.Generator, runs: int) -> Iterator[tuple[str, Floats, Floats]]:
    """Label, true MSE and what is said of it, (4, 4) of x, vx, y, vy, in steady state."""
    tracks = steady(positions(1.0, WORLD.q, SIGMAS))
    together = steady(positions(1.0, WORLD.q, (float(np.sum(1.0 / np.square(SIGMAS)) ** -0.5),)))
    yield CENTRALISED, together.J[0], together.P[0, 0]
    best = optimal(tracks.J, 4)[0]
    yield "optimal", best, best
    yield "best sensor", tracks.J[0, :4, :4], tracks.P[0, 0]
    for rule in rules:
        count = min(runs, 200) if rule.rule in SLOW else max(runs, 200)
        found = expected(rule, tracks.P, tracks.J, draws(rng, 8, count))
        yield rule.label, found.mse[0], found.reported[0]


def chance(run: Run) -> Chance:
    """What the centralised filter shows by chance of as many targets."""
    F, Q = planar(1.0, WORLD.q)
    R = np.eye(2) / np.sum(1.0 / np.square(SIGMAS))
    P = steady(positions(1.0, WORLD.q, (float(R[0, 0] ** 0.5),))).P[0, 0]
    before = F @ P @ F.T + Q
    K = before @ PLACE.T @ np.linalg.inv(PLACE @ before @ PLACE.T + R)
    return by_chance((np.eye(4) - K @ PLACE) @ F, P, shortened(WORLD, run).steps - WORLD.warm, run.runs, run.rng(1))


def three(label: str, scores: Scores) -> list[Row]:
    """The numbers of an estimate."""
    return [
        Row(label, RMSE, None, *scores.rmse()),
        Row(label, NEES, None, *scores.mean_nees()),
        Row(label, WORST, None, *scores.worst()),
    ]


def rows_of(head: str, flight: Flight, beside: bool = True) -> Iterator[Row]:
    """Of all ways of a flight, and of what stands beside them."""
    if beside:
        yield from three(f"{head}: {CENTRALISED}", flight.scores[CENTRALISED])
        yield from three(f"{head}: best sensor", best_of(flight))
    for label in flight.watch:
        scores, share, seen = told(label, flight)
        yield from three(f"{head}: {label}", scores)
        if np.isfinite(share):
            yield Row(f"{head}: {label}", SHARE, None, share)
        if np.isfinite(seen):
            yield Row(f"{head}: {label}", SEEN, None, seen)


def shortened(world: World, run: Run) -> World:
    """The world, or less of it."""
    return world if run.runs >= ENOUGH else replace(world, steps=min(world.steps, SHORT))


def wrong() -> dict[str, World]:
    """Worlds in which somebody has the wrong q."""
    found = {}
    for factor in WRONG:
        found[f"q x {factor:g}, both"] = World(SENSORS, filter_q=factor)
        found[f"q x {factor:g}, said"] = World(SENSORS, declared=factor)
        found[f"q x {factor:g}, filter"] = World(SENSORS, filter_q=factor, declared=WORLD.q)
    return found | {"q x 1.1, said": World(SENSORS, declared=1.1)}


def run(run: Run) -> Result:
    own = tuple(rule for rule in run.rules if rule.weights is None)
    rows: list[Row] = []
    known = map(fuser, (*MAIN, *OTHERS, *SAMPLED))
    for label, mse, said in exact((*known, *run.rules), run.rng(0), run.runs):
        nees = float(np.trace(np.linalg.solve(said, mse))) / 4.0
        rows += [Row(f"exact: {label}", RMSE, None, float(np.sqrt(mse[0, 0] + mse[2, 2])))]
        rows += [
            Row(f"exact: {label}", NEES, None, nees),
            Row(f"exact: {label}", WORST, None, float(excess(mse, said))),
        ]
    tasks = {"centre": Task(WORLD, ways(), 1), "others": Task(WORLD, ways_few(own), 1, FEW)}
    for name, world in list(wrong().items())[: None if run.runs >= ENOUGH else 3]:
        tasks[name] = Task(world, ways_wrong(), 2, FEW)
    flights = flown(run, {name: task._replace(world=shortened(task.world, run)) for name, task in tasks.items()})
    luck = chance(run)
    rows.append(Row("centre: consistent", WORST, None, float(luck.excess.mean()), float(luck.excess.std(ddof=1))))
    centre, others = flights.pop("centre"), flights.pop("others")
    rows += [*rows_of("centre", centre), *rows_of("centre", others, beside=False)]
    rows += [row for head, flight in flights.items() for row in rows_of(head, flight)]
    notes = (_limits(centre, luck, run), *_notes(centre, flights))
    return Result(tuple(rows), notes, partial(draw, rows=tuple(rows)), (12.0, 6.0))


def _limits(flight: Flight, luck: Chance, run: Run) -> str:
    steps = shortened(WORLD, run).steps - WORLD.warm
    one, whole = flight.scores["ci tracklet"], flight.scores[CENTRALISED]
    return (
        f"{run.runs:,} targets of {steps} steps. The errors of a target are correlated over time: its "
        f"steps are worth {luck.worth:.1f} independent ones, all together {run.runs * luck.worth:,.0f}. A consistent "
        f"filter then shows a worst eigenvalue of {luck.excess.mean():.3f}, and less than "
        f"{np.quantile(luck.excess, 0.975):.3f} in 39 cases of 40. Tracklets: {_pm(one.worst())}, the centralised "
        f"filter on the same measurements {_pm(whole.worst())}; RMSE {_pm(one.rmse())} and {_pm(whole.rmse())} m."
    )


def _notes(centre: Flight, wrong: Mapping[str, Flight]) -> Iterator[str]:
    tracks = steady(positions(1.0, WORLD.q, SIGMAS))
    rho = float(largest_correlation(tracks.J, tracks.P)[0])
    yield (
        "Promised: with linear-Gaussian trackers that declare the motion they have, heard at every update, tracklets "
        f"are the centralised filter ({centre.scores['ci tracklet'].rmse().value:.3f} m), whatever the rule is. No "
        "fusion of the tracks of one time alone is (optimal). `ci` by det takes the best sensor's track here and "
        f"nothing of the others. `naive`, and `bci` under a bound that does not hold (the largest correlation is "
        f"{rho:.2f}), have nearly the error of the optimum and are too sure of it; `fast-ci` and `ffcc` have it too, "
        "and state more than it."
    )
    said = []
    for head, flight in wrong.items():
        scores, share, seen = told("ci tracklet", flight)
        fixed, _, _ = told("tracklet, motion set", flight)
        said.append(
            f"{head}: {share:.0f} % tracklets, innovation {_or_none(seen)}, RMSE {scores.rmse().value:.2f} m and NEES "
            f"{scores.mean_nees().value:.2f} (best sensor {best_of(flight).rmse().value:.2f} and "
            f"{best_of(flight).mean_nees().value:.2f}; motion set {fixed.rmse().value:.2f} and "
            f"{fixed.mean_nees().value:.2f})"
        )
    yield (
        "Not promised: anything where the declaration is not that of the filter. Wrong q, and what the watch sees "
        f"(within 0.85 to 1.15 it says nothing): {'; '.join(said)}."
    )
    yield (
        "Filter and declaration wrong alike: the increments hold nothing but measurements, and with the motion set in "
        "the config the result is the centralised filter's again, but for what the increments are inflated where the "
        "watch finds innovations too large: it cannot tell a target that moves more from a measurement that is worse. "
        "Without the motion set all filters, the centralised one and every sensor's too, are as wrong as their q. One "
        "of both wrong: the increments hold what no measurement has said, the watch takes none of them, and what is "
        "lost is the gain."
    )


def _or_none(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "none"


def _pm(value: Estimate) -> str:
    return f"{value.value:.3f} ± {value.stderr:.3f}"


def draw(figure: Any, rows: tuple[Row, ...]) -> None:
    """RMSE against the worst eigenvalue of each way; and what wrong q does."""
    left, right = figure.subplots(1, 2)
    value = {(row.name, row.quantity): row.ours for row in rows}
    for name in dict.fromkeys(name for name, _ in value if name.startswith("centre: ")):
        rule, _, memory = name.removeprefix("centre: ").rpartition(" ")
        if (name, RMSE) in value and (memory in ("restart", "recursive") or name == "centre: ci tracklet"):
            x, y, mine = value[name, WORST], value[name, RMSE], memory == "tracklet"
            look = {"color": TRACKLET if mine else colour(rule), "ms": 15 if mine else 7}
            open_ = {"mfc": "none", "ms": 12} if memory == "recursive" else {"label": "tracklet" if mine else rule}
            left.plot(x, y, "*" if mine else "o", ls="none", **{**look, **open_})
    for name, line in ((CENTRALISED, "-"), ("best sensor", ":")):
        left.axhline(value[f"centre: {name}", RMSE], color="0.4", lw=1, ls=line, label=name, zorder=0)
    left.axvline(1.0, color="0.8", zorder=0)
    left.set(xlabel="worst eigenvalue of true over stated (right of 1: too sure)", ylabel="RMSE of position, m")
    left.set_title("memory restart; in rings: recursive, of fewer targets", fontsize=10)
    heads = [head for head in wrong() if (f"{head}: {CENTRALISED}", RMSE) in value]
    shown = {
        CENTRALISED: ("k", "|"), "best sensor": ("0.6", "o"), "ci restart": (colour("ci"), "s"),
        "ci tracklet": (TRACKLET, "*"), "tracklet, motion set": ("#1b7837", "D"),
    }  # fmt: skip
    size = {"|": 18, "o": 12, "s": 8, "*": 12, "D": 4}
    for label, (tint, marker) in shown.items():
        places = [value[f"{head}: {label}", RMSE] for head in heads]
        right.plot(places, range(len(heads)), marker, color=tint, ls="none", label=label, ms=size[marker], mew=1.5)
    for number, head in enumerate(heads):
        name = f"{head}: ci tracklet"
        seen = f"{value[name, SEEN]:.2f}" if (name, SEEN) in value else "-"
        text = f"tracklets {value[name, SHARE]:.0f} %, innovation {seen}, NEES {value[name, NEES]:.2f}"
        right.annotate(text, (0.02, number + 0.28), xycoords=("axes fraction", "data"), fontsize=8)
    right.set_yticks(range(len(heads)), heads)
    right.set(ylim=(-0.5, len(heads) - 0.3), xlabel="RMSE of position, m")
    right.set_title("wrong q, and who has it", fontsize=10)
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    figure.suptitle("Sensors of 10, 15 and 20 m: tracklets are the centralised filter, no rule of one time is")


STUDIES = (
    Study(
        name="unequal-sensors",
        title="Better than the best of three unequal sensors, and honest",
        source="ours",
        about=__doc__ or "",
        run=run,
        runs=1600,
        quick=12,
        seconds=110.0,
        takes_rules=True,
    ),
)
