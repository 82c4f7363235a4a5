"""Intensities (PHDs) averaged: Figs. 7 and 8, remarks 9 and 10, and the claim of Li-2nd 5.2 that more sensors make the
geometric average (GA) worse.

Fig. 7: two scalar Gaussian mixtures whose numbers the paper gives. Fig. 8: five targets at 20, 40, 70, 110, 200; a
sensor reports each with probability 0.9, and Poisson(1) false alarms uniform on [0, 200]. The paper shows one trial of
six sensors; here are many, of 1 to 8. It does not say where a report lies and how sure it is. Ours: a report of target
x is w N(m, P), P uniform on (20, 40), m drawn from N(x, P), w uniform on (0.8, 1), so that a sensor expects 4.95
targets; false alarms have the same P and w. (In Fig. 8 the target at 70 is lost beside that at 40, so P must be well
below that of Fig. 7.) A second reading takes P and w as in Fig. 7, P uniform on (100, 200), w on (0.5, 0.9); a third
is ours without misses and false alarms.

The rules, weights 1/N each:

* AA: the mean of the intensities. GA exact: prod f_i^(1/N). GA (49): every power of a sum as the sum of the powers.
* hybrid: GA (49) scaled to the mass of AA, as Li-2nd 5.1 and 5.2 have it.
* cells AA, GA, hybrid: the product's rules (`centre.cells`), which match components first and average within
  a match: a target that one sensor does not report has no GA at all there, and keeps its share of the mass in hybrid.

The first four are evaluated on a grid of step 0.25; a peak is a maximum of the fused intensity with the mass between
its two minima. The cells are components. States are read from either by the two rules of section 5.2: rank, the
round(mass) heaviest; threshold, those of mass above 0.5. GOSPA has p = 2, c = 20, alpha = 2: a missed target or false
state costs 200 of its square. Sensors are nested: those of N are among those of N + 1, the same for every rule.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from fusion_service.centre.cells import Components, find_cells, fuse_cells
from fusion_service.metrics import gospa
from studies.experiments.li_densities import FIG7
from studies.pictures import colour
from studies.statistics import jackknife, mean, pooled_rms
from studies.study import Floats, Result, Row, Run, Study

TARGETS = np.array([20.0, 40.0, 70.0, 110.0, 200.0])
DETECTION, FALSE_ALARMS, REGION = 0.9, 1.0, 200.0
READINGS = {
    "ours": ((20.0, 40.0), (0.8, 1.0), DETECTION, FALSE_ALARMS),
    "as Fig. 7": ((100.0, 200.0), (0.5, 0.9), DETECTION, FALSE_ALARMS),
    "all seen": ((20.0, 40.0), (0.8, 1.0), 1.0, 0.0),
}
"""Ranges of the variance and of the weight of a report, probability of detection, mean number of false alarms."""
SENSORS = (1, 2, 4, 6, 8)
FIG8 = 6
GRID = np.arange(-60.0, 260.25, 0.25)
CUTOFF = 20.0
THRESHOLD = 0.5
CHUNK = 25
GATE = float(chi2.ppf(0.999, 1))
ON_GRID = ("AA", "GA exact", "GA (49)", "hybrid")
CELLS = ("cells AA", "cells GA", "cells hybrid")
RULES = ON_GRID + CELLS
READ = ("rank", "threshold")
Item = tuple[str, tuple[int, ...], int, tuple[int, ...]]
"""Reading, numbers of sensors, number of trials, key of their random numbers."""
MEASURES = ("GOSPA", "missed", "false", "|number - 5|", "mass - 5", "squared error")


class Reports(NamedTuple):
    """What eight sensors report in T trials: weight (0 for none), mean, variance, each (T, 8, C)."""

    weight: Floats
    mean: Floats
    variance: Floats


def reports(rng: np.random.Generator, trials: int, reading: str = "ours") -> Reports:
    """The five targets come first, then the false alarms."""
    sensors, most = max(SENSORS), 8
    shape = (trials, sensors, len(TARGETS) + most)
    (low, high), (light, heavy), detection, alarms_mean = READINGS[reading]
    variance = rng.uniform(low, high, shape)
    centre = np.concatenate(
        [np.broadcast_to(TARGETS, (*shape[:2], len(TARGETS))), rng.uniform(0, REGION, (*shape[:2], most))], axis=2
    )
    spread = np.sqrt(variance) * rng.standard_normal(shape)
    spread[..., len(TARGETS) :] = 0.0
    seen = rng.random((*shape[:2], len(TARGETS))) < detection
    alarms = np.arange(most) < np.minimum(rng.poisson(alarms_mean, shape[:2]), most)[..., None]
    there = np.concatenate([seen, alarms], axis=2)
    return Reports(np.where(there, rng.uniform(light, heavy, shape), 0.0), centre + spread, variance)


def on_grid(given: Reports, N: int, grid: Floats = GRID) -> Floats:
    """AA, GA exact, GA (49) and hybrid of the first N sensors, (4, T, X)."""
    w, m, P = (part[:, :N, :, None] for part in given)
    with np.errstate(divide="ignore"):
        logs = np.log(w) - 0.5 * np.log(2 * np.pi * P) - (grid - m) ** 2 / (2 * P)
        parts = np.exp(logs)
        f = parts.sum(axis=2)
        aa = f.mean(axis=1)
        exact = np.exp(np.log(f).mean(axis=1))
        dropped = np.exp(np.log(np.exp(logs / N).sum(axis=2)).sum(axis=1))
    mass = dropped.sum(axis=-1, keepdims=True)
    hybrid = np.divide(dropped * aa.sum(axis=-1, keepdims=True), mass, out=np.zeros_like(dropped), where=mass > 0)
    return np.stack([aa, exact, dropped, hybrid])


def peaks(f: Floats, grid: Floats = GRID) -> tuple[Floats, Floats]:
    """Mass and place of the peaks of an intensity (X,), heaviest first."""
    inner = f[1:-1]
    top = 1 + np.flatnonzero((inner > f[:-2]) & (inner >= f[2:]) & (inner > 1e-9))
    if not len(top):
        return np.zeros(0), np.zeros(0)
    valleys: list[int] = [int(a + np.argmin(f[a:b])) for a, b in pairwise(top)]
    mass = np.add.reduceat(f, [0, *valleys]) * (grid[1] - grid[0])
    order = np.argsort(-mass, kind="stable")
    return mass[order], grid[top[order]]


def in_cells(given: Reports, trial: int, N: int) -> list[tuple[Floats, Floats]]:
    """Mass and place of the components of the product's AA, GA and hybrid, heaviest first."""
    source, c = np.nonzero(given.weight[trial, :N] > 0)
    w, m, P = (part[trial, source, c] for part in given)
    parts = Components(w, m[None], P[None, None], np.eye(N)[:, source])
    cell = find_cells(parts, source, [0], GATE)
    out = []
    for rule in ("aa", "ga", "hybrid"):
        fused = fuse_cells(rule, "average", parts, source, cell, lambda mean: np.ones((N, mean.shape[1]), np.bool_))
        order = np.argsort(-fused.weight, kind="stable")
        out.append((fused.weight[order], fused.mean[0, order]))
    return out


def states(mass: Floats, place: Floats) -> tuple[Floats, Floats]:
    """The places read by rank and by threshold."""
    return place[: int(np.floor(mass.sum() + 0.5))], place[mass > THRESHOLD]


def measured(found: Floats, mass: float) -> tuple[float, ...]:
    """`MEASURES` of the places of the states; the last is the sum over the targets found."""
    result = gospa(TARGETS[:, None], found[:, None], CUTOFF)
    unit = CUTOFF**2 / 2
    off = abs(len(found) - len(TARGETS))
    missed, false = result.missed / unit, result.false / unit
    return result.distance, missed, false, float(off), mass - len(TARGETS), result.localisation


def trials(item: Item) -> Floats:
    """Measures (numbers of sensors, rules, ways of reading, measures, trials)."""
    reading, sensors, count, key = item
    given = reports(np.random.default_rng(key), count, reading)
    out = np.zeros((len(sensors), len(RULES), len(READ), len(MEASURES), count))
    for s, N in enumerate(sensors):
        fused = on_grid(given, N)
        for t in range(count):
            found = [peaks(f) for f in fused[:, t]] + in_cells(given, t, N)
            for r, (mass, place) in enumerate(found):
                for e, chosen in enumerate(states(mass, place)):
                    out[s, r, e, :, t] = measured(chosen, float(mass.sum()))
    return out


def fig7() -> tuple[Floats, Floats, list[tuple[Floats, Floats]]]:
    """The grid, the intensities of `ON_GRID` on it (4, X), and what `in_cells` gives."""
    w, m, P = np.zeros((3, 1, 2, 3))
    P += 1.0
    for i, parts in enumerate(FIG7):
        for c, part in enumerate(parts):
            w[0, i, c], m[0, i, c], P[0, i, c] = part
    grid = np.arange(-100.0, 220.0, 0.05)
    given = Reports(w, m, P)
    return grid, on_grid(given, 2, grid)[:, 0], in_cells(given, 0, 2)


def rows_of_fig7() -> list[Row]:
    grid, curves, cells = fig7()
    step = grid[1] - grid[0]
    printed = {"GA exact": 1.5634, "GA (49)": 1.8964}
    rows: list[Row] = []
    for name, f in zip(ON_GRID, curves, strict=True):
        label, total, peak = f"Fig. 7: {name}", float(f.sum() * step), float(f.max())
        rows += [
            Row(label, "mass", printed.get(name), total, decimals=4),
            Row(label, "highest peak", None, peak),
            Row(label, "the same, at AA's mass", None, peak * 1.75 / total),
            Row(label, "mass below -15 or above 75", None, float(f[(grid < -15) | (grid > 75)].sum() * step)),
            Row(label, "mass above 75 (isolated)", None, float(f[grid > 75].sum() * step)),
        ]
    for name, (mass, place) in zip(CELLS, cells, strict=True):
        rows += [
            Row(f"Fig. 7: {name}", "mass", None, float(mass.sum())),
            Row(f"Fig. 7: {name}", "mass above 75 (isolated)", None, float(mass[place > 75].sum())),
        ]
    return rows


def run(run: Run) -> Result:
    counts = [min(CHUNK, run.runs - at) for at in range(0, run.runs, CHUNK)]
    items: list[Item] = [("ours", SENSORS, count, (run.seed, 1, part)) for part, count in enumerate(counts)]
    for reading, key in (("as Fig. 7", 2), ("all seen", 3)):
        items += [(reading, (FIG8,), count, (run.seed, key, part)) for part, count in enumerate(counts)]
    answers, parts = run.map(trials, items, "trials"), len(counts)
    ours, wide, seen = (np.concatenate(answers[i * parts : (i + 1) * parts], axis=-1) for i in range(3))
    six, two, last = SENSORS.index(FIG8), SENSORS.index(2), len(SENSORS) - 1
    rows = rows_of_fig7()
    for label, table, e in (
        ("Fig. 8, rank", ours[six], 0),
        ("Fig. 8, threshold", ours[six], 1),
        ("Fig. 8 with P and w of Fig. 7, rank", wide[0], 0),
        ("Fig. 8 with all targets seen, no false alarm, rank", seen[0], 0),
    ):
        for r, rule in enumerate(RULES):
            one = table[r, e]
            name = f"{label}: {rule}"
            rows += [Row(name, measure, None, *mean(one[k])) for k, measure in enumerate(MEASURES[:-1])]
            rows.append(
                Row(name, "RMS error of those found", None, *jackknife(pooled_rms, np.stack([one[5], 5 - one[1]])))
            )
    for e, way in enumerate(READ):
        for r, rule in enumerate(RULES):
            name = f"GOSPA against sensors, {way}: {rule}"
            rows += [Row(name, f"N = {N}", None, *mean(ours[s, r, e, 0])) for s, N in enumerate(SENSORS)]
            rows.append(Row(name, "8 less 2", None, *mean(ours[last, r, e, 0] - ours[two, r, e, 0])))
    at = {rule: r for r, rule in enumerate(RULES)}
    for e, way in enumerate(READ):
        for rule in ("GA exact", "GA (49)", "hybrid", "cells GA"):
            a, b = ours[six, at["cells AA" if "cells" in rule else "AA"], e], ours[six, at[rule], e]
            name = f"Fig. 8, {way}, share of trials: {rule}"
            rows += [
                Row(name, "GOSPA above AA's", None, *mean((b[0] > a[0]).astype(float))),
                Row(name, "misses more than AA", None, *mean((b[1] > a[1]).astype(float))),
            ]
        a, b = ours[six, at["GA exact"], e], ours[six, at["GA (49)"], e]
        differs = (a[2] - a[1] != b[2] - b[1]).astype(float)
        rows.append(Row(f"Fig. 8, {way}, share of trials: GA (49)", "another number than exact", None, *mean(differs)))
    return Result(tuple(rows), _notes(rows), lambda figure: _draw(figure, run.seed, ours), (13.0, 8.5))


def _notes(rows: list[Row]) -> tuple[str, ...]:
    x = {(row.name, row.quantity): row for row in rows}

    def value(name: str, quantity: str) -> str:
        row = x[name, quantity]
        return f"{row.ours:.4f}" if row.stderr is None else f"{row.ours:.2f} +- {row.stderr:.2f}"

    def holds(what: bool) -> str:
        return "holds" if what else "fails"

    def sweep(rule: str, way: str) -> str:
        row = x[f"GOSPA against sensors, {way}: {rule}", "8 less 2"]
        return f"{rule} {row.ours:+.1f} +- {row.stderr:.1f}"

    def worse(way: str) -> str:
        return ", ".join(sweep(rule, way) for rule in RULES)

    seen = "Fig. 8 with all targets seen, no false alarm, rank: GA exact"
    tail, peak, share = "mass below -15 or above 75", "highest peak", "misses more than AA"
    lighter = x["Fig. 7: GA exact", tail].ours < x["Fig. 7: AA", tail].ours
    exact_peak, aa_peak = x["Fig. 7: GA exact", peak].ours, x["Fig. 7: AA", peak].ours
    false = [x[f"Fig. 8, rank: {rule}", "false"].ours for rule in ("GA exact", "AA")]
    grows = all(
        x[f"GOSPA against sensors, {way}: {rule}", "8 less 2"].ours
        > 3 * (x[f"GOSPA against sensors, {way}: {rule}", "8 less 2"].stderr or 0)
        for way in READ
        for rule in ("GA exact", "GA (49)", "cells GA")
    )
    return (
        f"Remark 9, lighter tails: {holds(lighter)} ({value('Fig. 7: GA exact', tail)} of the exact GA against "
        f"{value('Fig. 7: AA', tail)}). More significant peaks: {holds(exact_peak > aa_peak)} of the intensities "
        "themselves, since a geometric mean is nowhere above the arithmetic one: highest peak "
        f"{exact_peak:.4f} against {aa_peak:.4f}. The {value('Fig. 7: GA (49)', peak)} that (49) gives, by which the "
        "paper averages, is of the dropped cross terms. The remark is right of densities: scaled to AA's mass the "
        f"exact GA's peak is {value('Fig. 7: GA exact', 'the same, at AA' + chr(39) + 's mass')}.",
        f"Remark 10 {holds(false[0] < false[1])}: of the isolated component AA keeps half, the exact GA "
        f"{value('Fig. 7: GA exact', 'mass above 75 (isolated)')} above 75 against "
        f"{value('Fig. 7: AA', 'mass above 75 (isolated)')}; in Fig. 8 the exact GA has {false[0]:.2f} false states a "
        f"trial by rank, AA {false[1]:.2f}, and {value('Fig. 8, rank: GA exact', 'missed')} missed targets against "
        f"{value('Fig. 8, rank: AA', 'missed')}. Of six sensors' trials the GA of (49) misses more than AA in a share "
        f"of {value('Fig. 8, rank, share of trials: GA (49)', share)} by rank, "
        f"{value('Fig. 8, threshold, share of trials: GA (49)', share)} by threshold: the trial shown is typical.",
        f"More sensors make GA worse: {holds(grows)} for every GA. GOSPA of 8 sensors less that of 2, by rank: "
        f"{worse('rank')}; by threshold: {worse('threshold')}.",
        "The text has it that one silent sensor ends a target in GA, however many see it. Of the exact GA of "
        "Gaussians that is not so: as N grows, it tends to exp(E log f), a fixed remnant, which the tails of the "
        "neighbours give; hence its curve flattens. In the product's cells, where a component that is not there has no "
        "tail, it is so: all N see a target with probability 0.9^N (cells GA).",
        "Misses are not all of it. The means of independent reports lie apart, and the GA of N Gaussians of one width "
        "has on the average the mass (1 + 1/N)^(-(N-1)/2): 0.68 for six. With all targets seen and no false alarm the "
        f"exact GA of six sensors is still {value(seen, 'mass - 5')} off in its mass, and misses "
        f"{value(seen, 'missed')} targets by rank.",
        "(49) and the exact GA: for many sensors (49) is no approximation. 1/N widens every component by sqrt(N) "
        f"before all N are multiplied, and every choice of one each counts: with six sensors its mass is off by "
        f"{value('Fig. 8, rank: GA (49)', 'mass - 5')}, with the widths of Fig. 7 by "
        f"{value('Fig. 8 with P and w of Fig. 7, rank: GA (49)', 'mass - 5')}; the exact GA is off by "
        f"{value('Fig. 8, rank: GA exact', 'mass - 5')}. Another number of states than by the exact GA is read in a "
        f"share of {value('Fig. 8, rank, share of trials: GA (49)', 'another number than exact')} by rank.",
        "The hybrid as the paper has it does not repair GA: its shape is GA's, so that the mass of a lost target goes "
        f"to the others (missed {value('Fig. 8, rank: hybrid', 'missed')} by rank). Matched by target first, as 5.2 "
        f"advises for labelled densities, it misses {value('Fig. 8, rank: cells hybrid', 'missed')}, as AA does. What "
        "the hybrid is for, better places, is small here: RMS error "
        f"{value('Fig. 8, rank: cells hybrid', 'RMS error of those found')} against "
        f"{value('Fig. 8, rank: cells AA', 'RMS error of those found')}.",
    )


SHADES = {"AA": colour("aa"), "GA exact": "#000000", "GA (49)": colour("ci"), "hybrid": colour("ici")}


def _draw(figure: Any, seed: int, table: Floats) -> None:
    axes = figure.subplot_mosaic("abb;cde")
    grid, curves, _ = fig7()
    for name, f in zip(ON_GRID, curves, strict=True):
        axes["a"].plot(grid, f, "--" if name == "hybrid" else "-", color=SHADES[name], label=name, lw=1.3)
    axes["a"].set(title="Fig. 7: two sensors", xlabel="x", ylabel="intensity", xlim=(-40, 150))
    axes["a"].legend(frameon=False, fontsize=9)
    given = reports(np.random.default_rng((seed, 3)), 1)
    fused = on_grid(given, FIG8)[:, 0]
    ax = axes["b"]
    for name, f in zip(ON_GRID, fused, strict=True):
        if name != "hybrid":
            ax.plot(GRID, f, color=SHADES[name], label=name, lw=1.3)
    w, m = given.weight[0, :FIG8], given.mean[0, :FIG8]
    top = 1.15 * float(fused[:3].max())
    for i in range(FIG8):
        for low, high, tint, label in ((0, 5, "#17becf", "detections"), (5, None, "#e377c2", "false alarms")):
            at = m[i, low:high][w[i, low:high] > 0]
            ax.plot(
                at,
                np.full(len(at), -0.05 * top * (i + 1)),
                "|",
                color=tint,
                ms=9,
                mew=2,
                label=label if not i else None,
            )
    ax.plot(TARGETS, np.full(5, 0.0), "s", color="#2ca02c", ms=7, label="targets", clip_on=False)
    ax.set(title="Fig. 8: one trial of six sensors (their reports below)", xlabel="x", ylabel="intensity")
    ax.set(xlim=(-10, 225), ylim=(-0.35 * top, top))
    ax.legend(frameon=False, fontsize=9, ncols=2)
    for key, e, k, title in (
        ("c", 0, 0, "GOSPA, by rank"),
        ("d", 0, 1, "missed targets, by rank"),
        ("e", 1, 0, "GOSPA, by threshold"),
    ):
        ax = axes[key]
        for r, rule in enumerate(RULES):
            value = table[:, r, e, k].mean(axis=-1)
            error = 2 * table[:, r, e, k].std(axis=-1) / np.sqrt(table.shape[-1])
            plain = rule.removeprefix("cells ")
            shade = SHADES[plain] if plain in SHADES else SHADES["GA (49)"]
            ax.errorbar(
                SENSORS, value, error, color=shade, ls="--" if "cells" in rule else "-", marker="o", ms=4, label=rule
            )
        ax.set(title=title, xlabel="sensors", ylabel="targets" if k else "GOSPA", ylim=(0, None))
    axes["d"].legend(frameon=False, fontsize=8, loc="upper left")


STUDIES = (
    Study(
        name="li-phd",
        title="AA, GA and hybrid of intensities with missed targets and false alarms",
        source="Li-2nd 5, Figs. 7 and 8, remarks 9 and 10",
        about=__doc__ or "",
        run=run,
        runs=1_000,
        quick=40,
        seconds=60.0,
    ),
)
