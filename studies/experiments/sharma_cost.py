"""The time that a fusion takes, relative to the naive rule. The paper gives one number a rule, and neither dimension,
nor language, nor how weights were found; ours are measured side by side in one process, two sources, n = 2 and n = 4,
weights by determinant. Three ways:

* "a scipy loop": what a script would do, one fusion at a time: inverses by NumPy, weights by
  `scipy.optimize.minimize_scalar` (bounded), EI by two eigendecompositions. Presumably the nearest to how the paper's
  column came about, though its ratios for rules with weights lie well below these: a coarser search, or a naive rule
  that itself cost more;
* "ours, one": the product's rules, a batch of one fusion, where the overhead of Python is nearly all;
* "ours, 10,000": a batch, where arithmetic is nearly all. Here the weights of CI and HMD-GA come from a polynomial and
  a bracketed Newton for all fusions at once, so that the ratio is of arithmetic, not of calls to an optimiser.

A repeat times every rule in turn, in CPU time of the process; the ratio to naive is taken within the repeat, and the
table has the median over repeats with its standard error. Numbers depend on the machine and no seed repeats them.
Layout is batch-last, checks at the border are not counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from studies.pictures import colour
from studies.rules import Fuser, fuser
from studies.statistics import Estimate
from studies.study import Floats, Result, Row, Run, Study

PUBLISHED = {"naive": 1.0, "ci": 3.74, "ici": 4.43, "ei": 4.09, "hmd-ga": 3.68}
BATCH = 10_000
WAYS = ("a scipy loop", "ours, one", f"ours, {BATCH:,}")
SHORT = dict(zip(WAYS, ("scipy", "one", f"{BATCH:,}"), strict=True))
PAIRS = 5
"""Fusions in one timing of the first two ways."""


def pairs(rng: np.random.Generator, n: int, size: int) -> tuple[Floats, Floats]:
    """Means (2, n, B) and covariances (2, n, n, B), standard deviations over a decade, directions at random."""
    q, _ = np.linalg.qr(rng.standard_normal((size, 2, n, n)))
    P = (q * 10.0 ** rng.uniform(-1, 1, (size, 2, 1, n))) @ q.swapaxes(-1, -2)
    P = 0.5 * (P + P.swapaxes(-1, -2))
    return rng.standard_normal((2, n, size)), np.ascontiguousarray(P.transpose(1, 2, 3, 0))


def script(rule: str, x: Floats, P: Floats) -> tuple[Floats, Floats]:
    """One fusion as a script would have it: x (2, n), P (2, n, n); mean and covariance."""
    A = np.linalg.inv(P)
    d = x[1] - x[0]
    a, b = A[0], A[1]
    if rule == "ci":
        w = _search(lambda w: np.linalg.det(np.linalg.inv(w * A[0] + (1 - w) * A[1])))
        a, b = w * a, (1 - w) * b
        common, shared = np.zeros_like(P[0]), x[0]
    elif rule == "ici":
        w = _search(lambda w: np.linalg.det(np.linalg.inv(a + b - np.linalg.inv(w * P[0] + (1 - w) * P[1]))))
        common, shared = np.linalg.inv(w * P[0] + (1 - w) * P[1]), w * x[0] + (1 - w) * x[1]
    elif rule == "hmd-ga":
        outer = np.outer(d, d)
        w = _search(lambda w: np.linalg.det(np.linalg.inv((1 - w) * P[0] + w * P[1] + w * (1 - w) * outer)))
        common = np.linalg.inv((1 - w) * P[0] + w * P[1] + w * (1 - w) * outer)
        shared = (1 - w) * x[0] + w * x[1]
    elif rule == "ei":
        first, turn = np.linalg.eigh(P[0])
        root = turn * np.sqrt(first)
        second, turn = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, P[1]).T))
        T = root @ turn
        common = np.linalg.inv((T * np.maximum(second, 1.0)) @ T.T)
        eta = 1e-6 * np.eye(len(d))
        shared = np.linalg.solve(a + b - 2 * common + 2 * eta, (b - common + eta) @ x[0] + (a - common + eta) @ x[1])
    else:
        common, shared = np.zeros_like(P[0]), x[0]
    fused = np.linalg.inv(a + b - common)
    return fused @ (a @ x[0] + b @ x[1] - common @ shared), fused


def _search(cost: Callable[[float], float]) -> float:
    return float(minimize_scalar(cost, bounds=(0.0, 1.0), method="bounded").x)


def timed(call: Callable[[], Any]) -> float:
    """s of CPU time"""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def loop(rule: str, x: Floats, P: Floats) -> None:
    for k in range(PAIRS):
        script(rule, x[..., k], P[..., k])


def one_by_one(rule: Fuser, x: Floats, P: Floats) -> None:
    for k in range(PAIRS):
        rule(x[..., k : k + 1], P[..., k : k + 1])


def middle(ratios: Floats) -> Estimate:
    """Median with its standard error, from the median absolute deviation: one slow repeat does not spoil it."""
    value = np.median(ratios)
    spread = 1.4826 * np.median(np.abs(ratios - value))
    return Estimate(float(value), float(1.2533 * spread / np.sqrt(len(ratios))))


def run(run: Run) -> Result:
    rules = [*map(fuser, PUBLISHED), *run.rules]
    data = {n: pairs(run.rng(n), n, BATCH) for n in (2, 4)}
    work: dict[tuple[int, str, str], Callable[[], Any]] = {}
    for n, (x, P) in data.items():
        for rule in rules:
            if rule.label in PUBLISHED:
                work[n, WAYS[0], rule.label] = partial(loop, rule.rule, x, P)
            work[n, WAYS[1], rule.label] = partial(one_by_one, rule, x, P)
            work[n, WAYS[2], rule.label] = partial(rule, x, P)
    for call in work.values():
        call()
    times = {key: np.empty(run.runs) for key in work}
    for repeat in range(run.runs):
        for key, call in work.items():
            times[key][repeat] = timed(call)
        run.progress((repeat + 1) / run.runs, "repeats")
    found = {key: middle(one / times[key[0], key[1], "naive"]) for key, one in times.items()}
    rows = [
        Row(label, f"{way}, n = {n}", PUBLISHED.get(label), value, stderr or None, 2 if label in PUBLISHED else None)
        for (n, way, label), (value, stderr) in found.items()
    ]
    rows.sort(key=lambda row: [rule.label for rule in rules].index(row.name))
    return Result(
        tuple(rows), _notes(times, found), partial(picture, found, [rule.label for rule in rules]), (9.0, 6.0)
    )


def _notes(times: dict[tuple[int, str, str], Floats], found: dict[tuple[int, str, str], Estimate]) -> tuple[str, ...]:
    def us(n: int, way: int, rule: str) -> float:
        return float(np.median(times[n, WAYS[way], rule])) / (BATCH if way == 2 else PAIRS) * 1e6

    each = [
        f"n = {n}: naive {us(n, 0, 'naive'):.0f}, {us(n, 1, 'naive'):.0f} and {us(n, 2, 'naive'):.2f} us, HMD-GA "
        f"{us(n, 0, 'hmd-ga'):.0f}, {us(n, 1, 'hmd-ga'):.0f} and {us(n, 2, 'hmd-ga'):.2f} us"
        for n in (2, 4)
    ]
    order = " < ".join(sorted(PUBLISHED, key=lambda label: PUBLISHED[label]))
    orders = []
    for way in WAYS:
        for n in (2, 4):
            costs = {label: found[n, way, label].value for label in PUBLISHED}
            orders.append(f"{way}, n = {n}: {' < '.join(sorted(costs, key=lambda label: costs[label]))}")
    return (
        f"Order in the paper: {order}. Here {'; '.join(orders)}.",
        f"A fusion in a scipy loop, by ours alone, and by ours in a batch took here, {'; '.join(each)}.",
    )


def picture(found: dict[tuple[int, str, str], Estimate], labels: list[str], figure: Any) -> None:
    for axes, n in zip(figure.subplots(2, 1, sharex=True), (2, 4), strict=True):
        for index, label in enumerate(labels):
            bars = [found[n, way, label].value for way in WAYS if (n, way, label) in found]
            places = index + 0.25 * (np.arange(len(bars)) - 1 + len(WAYS) - len(bars))
            axes.bar(places, bars, 0.22, color=colour(label), edgecolor="none")
            for place, value, way in zip(places, bars, WAYS[len(WAYS) - len(bars) :], strict=True):
                axes.annotate(SHORT[way], (place, value), xytext=(0, 2), textcoords="offset points",
                              ha="center", fontsize=7)  # fmt: skip
            if label in PUBLISHED:
                axes.plot(
                    [index - 0.38, index + 0.38], [PUBLISHED[label]] * 2, color="#000000", linewidth=1.2, zorder=1.5
                )
        axes.set(yscale="log", ylabel="time / naive", ylim=(0.6, None))
        axes.set_title(f"n = {n}", fontsize=10)
        axes.set_xticks(range(len(labels)), labels)
    figure.suptitle(
        "Time of a fusion over the naive rule's: scipy loop, ours alone, ours 10,000 at once; line: the paper",
        fontsize=10,
    )


STUDIES = (
    Study(
        name="sharma-rule-cost",
        title="Time of the rules relative to naive fusion",
        source="Sharma Table 1",
        about=__doc__ or "",
        run=run,
        runs=200,
        quick=5,
        seconds=40.0,
        takes_rules=True,
        deterministic=False,
    ),
)
