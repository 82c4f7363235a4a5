"""`memory = "tracklet"` where less and less of what it rests on holds: loss, mixed periods, lateness, feedback, models.

The world of `unequal-sensors` (10, 15 and 20 m, every second, q = 1 m2/s3, speeds at first of 20 m/s on each axis),
changed in one thing:

* loss: of each message so many tracks are missing, each by chance; "centralised" loses no measurement.
* periods, phases: sensors of other periods; at other times than one another and the centre's steps.
* late: a sensor's messages arrive 1.5 s after their measurements; the centralised filter has what has arrived, too.
* q both: filters and declarations have a quarter or four times of the true q (the other cases: `unequal-sensors`).
* feedback: after each step the tracker of the third sensor, or all, go on from the fused result instead of their own;
  they say so ("declared") or do not ("hidden"). "Best sensor" is that beside `ci`.
* IMM: targets jump between q = 0.1 and 10 m2/s3 (20 s and 5 s in the mean); all trackers, and the centralised filter,
  are IMMs of these modes, which declare cv of the mean q and send one Gaussian, or the mixture of their modes.
* radars: range and azimuth of 100 m and 3 mrad, as in `sharma-three-radars`, every 5 s, from corners 260 km apart;
  extended Kalman filters; q = 0.25 m2/s3, on one plane.
* turns: targets without process noise that turn by 3 or 6 degrees a second, half of the time; filters have cv, q = 1.

Beside it: `ci` with memory restart (the default) and recursive, `rule = "auto"`, the best sensor alone (for each target
the one that states the least variance of position, as it is heard: its last track that has arrived, predicted), and the
filter of the same kind that has all measurements (centralised). Numbers as in `unequal-sensors`; a run is one target,
50 steps after 20 of a second each count (25 after 20 of the radars); but for loss 400 targets at most. Below fifty runs
8 steps count, and some worlds are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sensor_clients.filters import Modes, Position, RangeAzimuth
from studies.apart import CENTRALISED, CHUNK, Flight, Scores, Task, Way, best_of, flown, told
from studies.experiments.unequal_sensors import ENOUGH, SENSORS, TRACKLET, WORLD, chance, shortened
from studies.pictures import colour
from studies.study import Result, Row, Run, Study
from studies.trackers import Sensor, World

WAYS: tuple[Way, ...] = (
    ("ci restart", {"rule": "ci"}),
    ("ci recursive", {"rule": "ci", "memory": "recursive"}),
    ("auto", {"rule": "auto"}),
    ("tracklet", {"rule": "ci", "memory": "tracklet"}),
)
"""What is compared: more are added here."""
BEST, OURS = "best sensor", "tracklet"
BURSTS = Modes((0.1, 10.0), (20.0, 5.0))
CORNERS = ((0.0, 150e3), (-130e3, -75e3), (130e3, -75e3))
HEADS = ("RMSE, m", "NEES / 4", "worst eigenvalue")
SOME = (
    *("loss 0 %", "loss 30 %", "phases 0.2, 0.5 and 0.8 s", "late third", "q x 0.25, both", "IMM as one Gaussian"),
    *("radars", "turns, 6 deg/s", "feedback to all, declared", "feedback to all, hidden"),
)
LOSSES = (0.0, 0.1, 0.3, 0.5)


def worlds() -> dict[str, World]:
    """By name; without feedback."""
    one, two, three = SENSORS
    imm = World(SENSORS, bursts=BURSTS, modes=BURSTS)
    radar = RangeAzimuth(100.0, 3e-3)
    radars = tuple(Sensor(radar, period=5.0, origin=corner) for corner in CORNERS)
    turning = {f"turns, {rate} deg/s": World(SENSORS, q=0.0, turn=np.radians(rate), filter_q=1.0) for rate in (3, 6)}
    found = {f"loss {100 * loss:.0f} %": World(tuple(s._replace(loss=loss) for s in SENSORS)) for loss in LOSSES}
    return found | {
        "periods 1, 2 and 5 s": World((one, two._replace(period=2.0), three._replace(period=5.0))),
        "periods 1 s, and 0.1 s of 30 m": World((one, Sensor(Position(30.0, 30.0), period=0.1))),
        "phases 0.2, 0.5 and 0.8 s": World(tuple(s._replace(phase=0.2 + 0.3 * k) for k, s in enumerate(SENSORS))),
        "late third": World((one, two, three._replace(late=1.5))),
        "late first": World((one._replace(late=1.5), two, three)),
        "q x 0.25, both": World(SENSORS, filter_q=0.25),
        "q x 4, both": World(SENSORS, filter_q=4.0),
        "IMM as one Gaussian": imm,
        "IMM as mixtures": replace(imm, mixtures=True),
        "radars": World(radars, q=0.25, period=5.0, steps=45),
        **turning,
    }


def fed_back() -> dict[str, tuple[tuple[int, ...], bool]]:
    """Which trackers go on from the fused result, and whether they say so, by name."""
    return {
        f"feedback to {who}, {'declared' if said else 'hidden'}": (fed, said)
        for who, fed in (("the third", (2,)), ("all", (0, 1, 2)))
        for said in (True, False)
    }


def tried(run: Run) -> tuple[str, ...]:
    """The names of what is run: all, or a few."""
    names = (*worlds(), *fed_back())
    return names if run.runs >= ENOUGH else tuple(name for name in names if name in SOME)


def tasks() -> dict[str, Task]:
    """Of all worlds; those with feedback one for each way. Variants of one world have its targets and measurements."""
    found: dict[str, Task] = {}
    kinds: dict[str, int] = {}
    for name, world in worlds().items():
        kind = name.split(" ")[0]
        found[name] = Task(world, WAYS, kinds.setdefault(kind, len(kinds) + 1), None if kind == "loss" else CHUNK)
    for name, (fed, said) in fed_back().items():
        for way in WAYS:
            found[f"{name}: {way[0]}"] = Task(WORLD, (way,), 0, CHUNK, fed, said)
    return found


def gathered(flights: Mapping[str, Flight], names: tuple[str, ...]) -> dict[str, Flight]:
    """One flight a world: those with feedback put together."""
    found = {name: flights[name] for name in names if name in flights}
    for name in names:
        if name in found:
            continue
        parts = {label: flights[f"{name}: {label}"] for label, _ in WAYS}
        first = parts[WAYS[0][0]]
        found[name] = Flight(
            first.scores | {label: part.scores[label] for label, part in parts.items()},
            {label: part.watch[label] for label, part in parts.items()},
            {label: part.failing[label] for label, part in parts.items()},
        )
    return found


def estimates(flight: Flight) -> dict[str, Scores]:
    """All that is scored, in the order of the tables."""
    ours = {label: flight.scores[label] for label, _ in WAYS}
    return {BEST: best_of(flight), **ours, CENTRALISED: flight.scores[CENTRALISED]}


def rows_of(found: Mapping[str, Flight]) -> Iterator[Row]:
    """A table each of RMSE, NEES, worst eigenvalue, and of the tracklets."""
    for head, number in zip(HEADS, (Scores.rmse, Scores.mean_nees, Scores.worst), strict=True):
        for name, flight in found.items():
            for label, scores in estimates(flight).items():
                yield Row(name, f"{head}: {label}", None, *number(scores))
    for name, flight in found.items():
        _, share, seen = told(OURS, flight)
        yield Row(name, "tracklets: least share of a source, %", None, share if np.isfinite(share) else 0.0)
        if np.isfinite(seen):
            yield Row(name, "tracklets: innovation furthest from 1", None, seen)


def run(run: Run) -> Result:
    names = tried(run)
    wanted = {name: task for name, task in tasks().items() if name.partition(": ")[0] in names}
    wanted = {name: task._replace(world=shortened(task.world, run)) for name, task in wanted.items()}
    found = gathered(flown(run, wanted), names)
    rows = tuple(rows_of(found))
    luck = chance(run)
    value = {(row.name, row.quantity): row for row in rows}
    limits = (
        f"By chance: of {run.runs:,} targets a consistent filter shows a worst eigenvalue of {luck.excess.mean():.3f}, "
        f"less than {np.quantile(luck.excess, 0.975):.3f} in 39 cases of 40; its steps are worth {luck.worth:.1f} "
        "independent ones a target. Beside each number stands the centralised filter's, on the same measurements."
    )
    return Result(rows, (limits, *notes(value, found)), partial(draw, value=value, names=tuple(found)), (13.0, 7.0))


def notes(value: Mapping[tuple[str, str], Row], found: Mapping[str, Flight]) -> Iterator[str]:
    """What is promised and what not, with what came out."""

    def of(name: str, head: str, label: str = OURS, error: bool = False) -> str:
        row = value[name, f"{head}: {label}"]
        return f"{row.ours:.2f}" + (f" ± {row.stderr:.2f}" if error and row.stderr else "")

    def beside(name: str) -> str:
        rmse, nees, worst = (of(name, head) for head in HEADS)
        return (
            f"{name}: RMSE {rmse} m (ci {of(name, HEADS[0], 'ci restart')}, best sensor {of(name, HEADS[0], BEST)}, "
            f"centralised {of(name, HEADS[0], CENTRALISED)}), NEES {nees} ({of(name, HEADS[1], 'ci restart')}, "
            f"{of(name, HEADS[1], BEST)}, {of(name, HEADS[1], CENTRALISED)}), worst {worst}"
        )

    same = [name for name in found if name.startswith(("periods", "phases", "late", "loss 0"))]
    ratios = (value[name, f"{HEADS[0]}: {OURS}"].ours / value[name, f"{HEADS[0]}: {CENTRALISED}"].ours for name in same)
    off = max(abs(ratio - 1.0) for ratio in ratios)
    yield (
        "Promised: every version heard, of linear-Gaussian trackers with the motion they declare: the centralised "
        f"filter's result, whatever the periods, the phases and the lateness. RMSE is within {100 * off:.2g} % of it "
        f"in {', '.join(same)}."
    )
    yield (
        "Near it: loss (what several measurements have added comes as one, with the process noise between them in it, "
        "which the others know too), and extended Kalman filters. "
        + "; ".join(beside(name) for name in found if name.startswith(("loss 3", "loss 5", "radars")))
        + "."
    )
    yield (
        "As good as its models: where filters and declarations are wrong alike, so is the centralised filter, and the "
        "watch can only tell. Innovations that are too large are answered by inflated increments, and beyond twice by "
        "the rule, though with targets that turn it is not the measurements that are worse than said: "
        + "; ".join(beside(name) for name in found if name.startswith(("q x", "turns")))
        + "."
    )
    yield (
        "By the rule, with its promise and no more: trackers that declare feedback, send mixtures, or whose "
        "covariances do not go by what they declare (IMM). "
        + "; ".join(beside(name) for name in found if "declared" in name or name.startswith("IMM"))
        + "."
    )
    hidden = [name for name in found if "hidden" in name]
    seen = "; ".join(
        f"{name}: innovation {told(OURS, found[name])[2]:.2f}, share {told(OURS, found[name])[1]:.0f} %, "
        + (", ".join(sorted(found[name].failing[OURS])) or "no source taken out")
        for name in hidden
    )
    yield (
        "Not promised: feedback that is not declared. The increments then hold what the fused result held before, and "
        f"it is counted again each time: {'; '.join(beside(name) for name in hidden)}. The watch ({seen}) sees the "
        "tracker's own innovations, which say little of what is counted twice: declare it."
    )


def draw(figure: Any, value: Mapping[tuple[str, str], Row], names: tuple[str, ...]) -> None:
    """RMSE relative to the centralised filter, NEES and worst eigenvalue, of every world."""
    panels = figure.subplots(1, 3, sharey=True)
    look = {
        BEST: ("0.6", "o", 9), "ci restart": (colour("ci"), "s", 6), "ci recursive": ("#56b4e9", "D", 4),
        "auto": ("#1b7837", "x", 6), OURS: (TRACKLET, "*", 12), CENTRALISED: ("k", "|", 14),
    }  # fmt: skip
    for axes, head in zip(panels, HEADS, strict=True):
        for label, (tint, marker, size) in look.items():
            x = np.array([value[name, f"{head}: {label}"].ours for name in names])
            if head == HEADS[0]:
                x = x / [value[name, f"{head}: {CENTRALISED}"].ours for name in names]
            axes.plot(x, range(len(names)), marker, color=tint, ls="none", ms=size, mew=1.5, label=label)
        axes.axvline(1.0, color="0.8", zorder=0)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        ticks = [one for one in (0.5, 1, 1.5, 2, 3, 5, 10, 20) if low < one < high]
        axes.set_xticks(ticks, [f"{one:g}" for one in ticks])
        axes.minorticks_off()
        axes.grid(axis="y", color="0.93")
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    for axes, title in zip(panels, ("RMSE / the centralised filter's", "NEES / 4", "worst eigenvalue"), strict=True):
        axes.set_xlabel(title)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle("Tracklets: the centralised filter's result as long as trackers are what they declare")


STUDIES = (
    Study(
        name="tracklets",
        title="Tracklets under loss, mixed periods, lateness, feedback and wrong models",
        source="ours",
        about=__doc__ or "",
        run=run,
        runs=800,
        quick=12,
        seconds=100.0,
    ),
)
