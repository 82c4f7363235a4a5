"""How far each rule's reported covariance can be from the truth, and what its caution costs, in dimension 1 to 6.

Pairs: P1 = T T', P2 = T diag(r) T', the variance ratios r_k independent and log-uniform in [1/16, 16]; T a random
rotation times sizes log-uniform in [1/e, e] (no matter to rules that choose by determinant). The cross-covariance is
C = L1 K L2' with Cholesky factors L; every K of spectral norm at most rho is admissible under the bound rho, and
rho = 1 admits every positive semidefinite joint covariance. Random K = rho U diag(s) V' with uniform (Haar) rotations U
and V, and s_k uniform in [0, 1]. Three sources, in two dimensions: r_k anew for the third.

Excess: the largest eigenvalue of the true mean squared error relative to the (mean) reported covariance. Above 1 there
is a direction in which the rule is too sure. The tables give its mean over the pairs, with the standard error of that
mean; the notes give the largest of all pairs.

* Rules whose gain does not depend on the data (`naive`, `ci`, `bci`, `fast-ci`, `ffcc`, `ici`, `ei`; found by trial):
  the worst K is found exactly, as the minimum of a convex function of one variable (`studies/correlation.py` has the
  derivation and a test compares it with brute force), and the average needs no draws of errors.
* Rules that look at the difference of the means (`hmd-ga`, `aa`, `cu`): a tenth of the pairs; the mean over the
  difference by 256 whitened draws; K by search from the K worst for `naive` and for `ici`, by turns towards the K worst
  for the rule's own mean gain and by random steps. The K found is judged with 2,048 fresh draws. This is a lower bound
  of the worst case. For `aa` and `cu` an upper one is known: with weights 1/2 the MSE is (P1 + P2 + C + C')/4, and the
  mean reported covariance at least (P1 + P2)/2 + E[dd']/4, which is larger by (P1 + P2 - C - C')/2, never negative.
* Sampled rules (2,000 samples, alpha = 1) are slow: a fiftieth of the pairs, 32 draws, no search beyond the two
  starts, up to three dimensions; their sampling error, some per cent, is in the excess. Fusions that they refuse
  (means so far apart that too few samples count; below 1 %) are left out.
* Three sources: rules that fuse them at once; for data-dependent ones a lower bound from the naive rule's worst case
  and two turns towards their own.

Size: geometric mean of (det P)^(1/n), reported or true, relative to the optimal fusion, which knows C
(`bar-shalom-campo`). 1 reported is as tight as any honest rule can be, 1 true as accurate.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fusion_service.rules import RULES
from studies import pictures
from studies.correlation import (
    Outcome,
    draws,
    excess,
    expected,
    independent,
    joint_of,
    mse,
    optimal,
    rank_one,
    top,
    worst,
    worst_in_plane,
)
from studies.rules import Fuser, fuser
from studies.study import Floats, Result, Row, Run, Study

RULE_NAMES = (
    "naive",
    "ci",
    "ci:criterion=trace",
    "bci:max_correlation=0.5",
    "bci:max_correlation=0.9",
    "fast-ci",
    "ffcc",
    "ici",
    "ei",
    "hmd-ga",
    "hmd-ga:weights=uniform",
    "hmd-s:samples=2000",
    "gmd-s:samples=2000",
    "aa",
    "cu",
)
DIMENSIONS = (1, 2, 3, 4, 5, 6)
BOUNDS = (0.5, 0.9, 1.0)
SHOWN = (0.0, 0.5, 0.9)
SAMPLED = ("hmd-s", "gmd-s")
SAMPLED_UP_TO = 3
"""Dimensions; above, the samples are often refused as too few."""
ROUNDS = 10
SEVERAL = 16
"""Random correlations of a pair."""


class Task(NamedTuple):
    """One rule in one dimension."""

    seed: int
    runs: int
    n: int
    N: int
    rule: Fuser


class Found(NamedTuple):
    """Of every pair, by the bound that the correlations keep: worst excess (bounds, B); and the means over random
    correlations, (bounds, B) each: excess, log size relative to the optimum as reported, and as it is."""

    worst: Floats
    average: Floats
    reported: Floats
    true: Floats


def rotation(rng: np.random.Generator, B: int, n: int) -> Floats:
    """Uniform (Haar) orthogonal matrices (B, n, n)."""
    Q, R = np.linalg.qr(rng.standard_normal((B, n, n)))
    return np.asarray(Q * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None])


def sources(rng: np.random.Generator, B: int, N: int, n: int) -> Floats:
    """Covariances (B, N, n, n)."""
    T = rotation(rng, B, n) * np.exp(rng.uniform(-1.0, 1.0, (B, 1, n)))
    r = np.exp(np.log(16.0) * rng.uniform(-1.0, 1.0, (B, N, n)))
    r[:, 0] = 1.0
    return np.asarray((T[:, None] * r[:, :, None]) @ T[:, None].swapaxes(-1, -2))


def correlations(rng: np.random.Generator, B: int, n: int) -> Floats:
    """Random K (B, n, n) for two sources under the bound 1."""
    s = rng.uniform(0.0, 1.0, (B, 1, n))
    return np.asarray((rotation(rng, B, n) * s) @ rotation(rng, B, n))


def whole(K: Floats) -> Floats:
    """[I, K; K', I] (B, 2 n, 2 n)."""
    eye = np.broadcast_to(np.eye(K.shape[1]), K.shape)
    return np.block([[eye, K], [K.swapaxes(1, 2), eye]])


def search(rule: Fuser, P: Floats, rho: Floats, z: Floats, rounds: int, rng: np.random.Generator) -> Floats:
    """Correlations (B, N n, N n) within rho (B,) that are bad for a rule of any kind."""
    B, N, n, _ = P.shape
    find = worst if N == 2 else worst_in_plane
    best, value = np.empty((B, N * n, N * n)), np.full(B, -np.inf)
    u, gains = np.empty((B, n)), np.empty((B, N, n, n))

    def attempt(K: Floats) -> None:
        outcome = expected(rule, P, joint_of(P, K), z)
        new, direction = top(outcome.mse, outcome.reported)
        better = new > value
        for kept, one in ((best, K), (value, new), (u, direction), (gains, outcome.gains)):
            kept[better] = one[better]

    for start in ("naive", "ici") if N == 2 else ("naive",):
        simple = expected(fuser(start), P, independent(P), draws(rng, (N - 1) * n, 0))
        attempt(rank_one(simple.gains, P, find(simple.gains, simple.reported, P, rho)[1], rho))
    for step in np.geomspace(1.0, 0.05, rounds):
        attempt(rank_one(gains, P, u, rho))
        if N == 2:
            noise = rho[:, None, None] * step * rng.standard_normal((B, n, n))
            U, s, V = np.linalg.svd(best[:, :n, n:] + noise)
            attempt(whole((U * np.minimum(s, rho[:, None])[:, None]) @ V))
    return best


def worst_of(rule: Fuser, known: Outcome | None, P: Floats, few: int, rng: np.random.Generator) -> Floats:
    """Worst excess (bounds, B); known: what a rule does that does not look at the data."""
    B, N, n, _ = P.shape
    rho, P = np.repeat(BOUNDS, B), np.tile(P, (len(BOUNDS), 1, 1, 1))
    if known is not None:
        gains, reported = np.tile(known.gains, (len(BOUNDS), 1, 1, 1)), np.tile(known.reported, (len(BOUNDS), 1, 1))
        return (worst if N == 2 else worst_in_plane)(gains, reported, P, rho)[0].reshape(len(BOUNDS), B)
    rounds = 0 if rule.rule in SAMPLED else min(ROUNDS, few // 16) if N == 2 else 2
    K = search(rule, P, rho, draws(rng, (N - 1) * n, few), rounds, rng)
    fresh = draws(rng, (N - 1) * n, few if rule.rule in SAMPLED else 8 * few)
    outcome = expected(rule, P, joint_of(P, K), fresh)
    found = excess(outcome.mse, outcome.reported).reshape(len(BOUNDS), B)
    return np.asarray(np.maximum.accumulate(found))  # what a bound admits, the next one does too


def study(task: Task) -> Found:
    """Everything about one rule in one dimension."""
    seed, runs, n, N, rule = task
    sampled = rule.rule in SAMPLED
    P = sources(np.random.default_rng([seed, n, N]), runs, N, n)
    rng = np.random.default_rng([seed, n, N, 1])
    probe = None if sampled else expected(rule, P, independent(P), draws(rng, (N - 1) * n, 0))
    known = probe if probe is not None and probe.constant else None
    if known is None:
        P = P[: max(2, runs // 50) if sampled else max(4, runs // 10)]
    few = max(8, min(32, runs)) if sampled else max(16, min(256, 4 * runs))
    worst_found = worst_of(rule, known, P, few, rng)
    none = np.empty((0, len(P)))
    if N > 2:
        return Found(worst_found, none, none, none)
    several = 1 if sampled else SEVERAL if known is not None else 2
    every = correlations(np.random.default_rng([seed, n, 2]), SEVERAL * runs, n).reshape(SEVERAL, runs, n, n)
    K = every[:several, : len(P)].reshape(-1, n, n)
    P = np.tile(P, (several, 1, 1, 1))
    answers = []
    for rho in SHOWN:
        J = joint_of(P, whole(rho * K))
        best = np.linalg.slogdet(optimal(J, n))[1] / n
        if known is not None:
            error, claimed = mse(np.tile(known.gains, (several, 1, 1, 1)), J), np.tile(known.reported, (several, 1, 1))
        else:
            error, claimed, _, _ = expected(rule, P, J, draws(rng, n, few))
        sizes = (np.linalg.slogdet(which)[1] / n - best for which in (claimed, error))
        answers.append(np.stack([excess(error, claimed), *sizes]).reshape(3, several, -1).mean(axis=1))
    average, reported, true = np.stack(answers, axis=1)
    return Found(worst_found, average, reported, true)


def run(run: Run) -> Result:
    rules = (*map(fuser, RULE_NAMES), *run.rules)
    tasks = [
        Task(run.seed, run.runs, n, 2, rule)
        for n in DIMENSIONS[::-1]
        for rule in rules[::-1]
        if rule.rule not in SAMPLED or n <= SAMPLED_UP_TO
    ]
    at_once = [rule for rule in rules if not rule.rule or (RULES[rule.rule].n_way and rule.rule not in SAMPLED)]
    tasks += [Task(run.seed, run.runs, 2, 3, rule) for rule in at_once]
    answers = run.map(study, tasks, "rule by rule")
    found = {(task.rule.label, task.n, task.N): one for task, one in zip(tasks, answers, strict=True)}
    rows = []
    for k, rho in enumerate(BOUNDS):
        head = f"worst excess, correlation up to {rho:g}"
        rows += [_row(found, rule, n, f"{head}: n = {n}", "worst", k) for rule in rules for n in DIMENSIONS]
    head = "mean excess, random correlation up to 0.9"
    rows += [_row(found, rule, n, f"{head}: n = {n}", "average", 2) for rule in rules for n in DIMENSIONS]
    for which in ("reported", "true"):
        rows += [
            _row(found, rule, n, f"{which} size / optimum, random correlation: n = {n}, up to {rho:g}", which, k)
            for rule in rules
            for n in (2, 4)
            for k, rho in enumerate(SHOWN)
        ]
    rows += [
        _row(found, rule, 2, f"worst excess, three sources, n = 2: correlation up to {rho:g}", "worst", k, 3)
        for rule in rules
        for k, rho in enumerate(BOUNDS)
    ]
    kept = tuple(row for row in rows if row)
    return Result(kept, _notes(found, rules), partial(_draw, kept), (12.0, 6.0))


Answers = dict[tuple[str, int, int], Found]


def _row(found: Answers, rule: Fuser, n: int, quantity: str, which: str, k: int, N: int = 2) -> Row | None:
    """The mean over pairs, of logarithms for sizes."""
    if (rule.label, n, N) not in found:
        return None
    samples = getattr(found[rule.label, n, N], which)[k]
    value, error = float(samples.mean()), float(samples.std(ddof=1) / np.sqrt(len(samples)))
    if which in ("reported", "true"):
        value = float(np.exp(value))
        error *= value
    return Row(rule.label, quantity, None, value, error if error > 1e-5 else None)


def _notes(found: Answers, rules: Sequence[Fuser]) -> tuple[str, ...]:
    """Each rule's own promise beside the largest excess of all pairs and dimensions."""
    true = {rule.label: np.exp(found[rule.label, 4, 2].true[0].mean()) for rule in rules if rule.rule not in SAMPLED}
    size = {rule.label: np.exp(found[rule.label, 4, 2].reported[0].mean()) for rule in rules if rule.label in true}
    one = found["hmd-ga", 1, 2].worst[-1].mean()
    notes = [
        "With two sources the naive rule is wrong by 1 + rho at worst, and `bci` whose bound is too small by "
        "(1 + rho) / (1 + bound). `ci` at bound 1 and `bci` at its own are not conservative by luck: their worst case "
        "is 1.000 in every pair, so no smaller covariance in proportion could be reported for the same mean.",
        f"In one dimension `ici` and `ei` are `ci` (take the better source); `hmd-ga` is not, and exceeds 1 ({one:.3f} "
        "on average) even there. In more, none of the three is conservative, and all get worse with the dimension.",
        f"A loose report is not a bad mean: of independent errors in four dimensions `fast-ci` reports "
        f"{size['fast-ci']:.2f} times the optimum's size and is at {true['fast-ci']:.2f}, `hmd-ga` "
        f"{size['hmd-ga']:.2f} and {true['hmd-ga']:.2f}, `ci` {size['ci']:.2f} and {true['ci']:.2f}: its best weight "
        "is often near an end.",
        "The largest excess of all pairs and dimensions, at correlations up to "
        f"{', '.join(f'{rho:g}' for rho in BOUNDS)}, beside the rule's own promise (data-dependent rules: of what was "
        "found):",
    ]
    for rule in rules:
        most = [found[rule.label, n, 2].worst.max(axis=1) for n in DIMENSIONS if (rule.label, n, 2) in found]
        figures = ", ".join(f"{value:.3f}" for value in np.max(most, axis=0))
        promise = f'"{RULES[rule.rule].promise}"' if rule.rule else "a rule of one's own"
        notes.append(f"`{rule.label}`: {figures}; {promise}")
    return tuple(notes)


def _draw(rows: Sequence[Row], figure: Any) -> None:
    value = {(row.name, row.quantity): row.ours for row in rows}
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    seen: list[str] = []
    for label in dict.fromkeys(row.name for row in rows):
        colour = pictures.colour(label)
        kind = seen.count(colour) % 3
        seen.append(colour)
        look: dict[str, Any] = {"color": colour, "marker": "osD"[kind]}
        quantity = f"worst excess, correlation up to {BOUNDS[-1]:g}: n = "
        n = [one for one in DIMENSIONS if (label, f"{quantity}{one}") in value]
        worst_found = [value[label, f"{quantity}{one}"] for one in n]
        left.plot(n, worst_found, ("-", "--", ":")[kind], ms=4, label=label, **look)
        size = value.get((label, "reported size / optimum, random correlation: n = 4, up to 0.9"))
        mean = value.get((label, "mean excess, random correlation up to 0.9: n = 4"))
        if size is not None:
            right.plot(size, mean, "", ms=8, **look)
    for axes in (left, right):
        axes.axhline(1.0, color="#000000", lw=0.8)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.tick_params(which="both", labelsize=8)
    left.set(xlabel="dimension n", ylabel="worst excess, correlation up to 1 (mean over pairs)", xticks=DIMENSIONS)
    left.set_title("Above 1: too sure in some direction", fontsize=10)
    right.set_xscale("log")
    right.xaxis.set_major_formatter("{x:g}")
    right.xaxis.set_minor_formatter("{x:g}")
    right.set(xlabel="reported size / optimum's", ylabel="mean excess, random correlation up to 0.9")
    right.set_title("The trade-off, n = 4", fontsize=10)
    figure.legend(*left.get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)


STUDIES = (
    Study(
        name="correlation-sweep",
        title="Every rule under the worst and the average admissible correlation",
        source="our own",
        about=__doc__ or "",
        run=run,
        runs=400,
        quick=8,
        seconds=70.0,
        takes_rules=True,
    ),
)
