"""A rule tried on random inputs: what it gives, whether order and batch matter to it, and how far it is too sure.

Excess: the largest eigenvalue of E[e e'], e the error of the fused mean in units of the covariance stated with it
(e = L^-1 (x - truth), P = L L'), over errors of the sources that have their covariances and are correlated one way or
another: P_ij = L_i C L_j', C = 0 (independent), I (the same error in both), and random orthogonal C for two sources, at
a strength of 1 and of 1/2 (`|P_i^-1/2 P_ij P_j^-T/2|`). 1 or less is conservative there; 2 is a variance twice as
large as stated in some direction. By Monte Carlo: an eigenvalue of n true 1 comes out at about 1 + 2 sqrt(n / samples),
so up to `noise` nothing is said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.rules.base.options import RuleError
from fusion_service.rules.face.own import OwnRule, own_fuse

__all__ = ["Trial", "tried_out"]

BATCH = 200
COUNTS = (2, 3, 5)
PAIRS = 12
"""Pairs of covariances of which the excess is taken."""
SAMPLES = 4000
CHANCE = 2.0
"""Standard deviations of a variance by so many samples, for the worst of all pairs."""
Fuse: TypeAlias = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]


class Trial(NamedTuple):
    """What came of it. faults: lines, each of something that the centre has to mend or that a replay may not find
    again; remarks: lines of what should be known; excess: by kind of correlation the worst of all pairs; noise: what a
    conservative rule may come to."""

    faults: list[str]
    remarks: list[str]
    excess: dict[str, float]
    noise: float

    def lines(self) -> list[str]:
        """In words."""
        told = [f"fault: {line}" for line in self.faults] or ["gives sound means and covariances, every time the same"]
        told += self.remarks
        if self.excess:
            told.append(
                f"true over stated variance in the worst direction, two sources, worst of {PAIRS} pairs, by {SAMPLES} "
                f"samples each (1: as stated; up to {self.noise:.2f} may be chance):"
            )
            for kind, value in self.excess.items():
                verdict = "not seen to be too sure" if value <= self.noise else "too sure"
                told.append(f"  errors {kind:<42} {value:6.2f}  {verdict}")
        return told


def tried_out(rule: OwnRule, options: Mapping[str, Any] | None = None, n: int = 4, seed: int = 1) -> Trial:
    """Try it with these options, its defaults by default, on states of n components."""
    fuse = partial(own_fuse, rule, options=options or {})
    rng = np.random.default_rng(seed)
    faults: list[str] = []
    remarks: list[str] = []
    for count in COUNTS:
        try:
            _look(fuse, rng, count, n, faults, remarks)
        except RuleError as error:
            faults.append(str(error))
    excess: dict[str, float] = {}
    if not faults:
        try:
            excess = _excess(fuse, rng, n)
        except RuleError as error:
            faults.append(str(error))
    return Trial(
        list(dict.fromkeys(faults)),
        list(dict.fromkeys(remarks)),
        excess,
        float((1 + np.sqrt(n / SAMPLES)) ** 2 + CHANCE * np.sqrt(2 / SAMPLES)),
    )


def _look(fuse: Fuse, rng: np.random.Generator, count: int, n: int, faults: list[str], remarks: list[str]) -> None:
    means, covariances = _sources(rng, BATCH, count, n)
    first = fuse(means.copy(), covariances.copy())
    again = fuse(means.copy(), covariances.copy())
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, again, strict=True)):
        faults.append(f"the same {count} sources give something else the second time: a replay will differ")
    alone = [fuse(means[k : k + 1].copy(), covariances[k : k + 1].copy()) for k in range(20)]
    if not all(np.array_equal(np.concatenate([one[i] for one in alone]), first[i][:20]) for i in (0, 1)):
        faults.append(
            f"of {count} sources the last bits depend on the batch, so a replay may differ in them: use sums and "
            f"np.linalg over the last axes, not one matrix product of the whole batch"
        )
    fuse(means[:0], covariances[:0])
    order = rng.permutation(count)
    if (order == np.arange(count)).all():
        order = order[::-1]
    turned = fuse(means[:, order].copy(), covariances[:, order].copy())
    apart = max(float(np.max(np.abs(turned[i] - first[i]) / np.max(np.abs(first[i])))) for i in (0, 1))
    if apart > 1e-9:
        remarks.append(f"the order of {count} sources matters, by up to {apart:.1g}: the centre sorts them by name")
    same = fuse(np.repeat(means[:, :1], count, axis=1), np.repeat(covariances[:, :1], count, axis=1))
    share = np.trace(same[1], axis1=1, axis2=2) / np.trace(covariances[:, 0], axis1=1, axis2=2)
    if count == 2:
        remarks.append(f"of two equal sources the variance is {share.mean():.3g} times theirs (ci: 1, naive: 0.5)")


def _sources(rng: np.random.Generator, size: int, count: int, n: int) -> tuple[Floats, Floats]:
    """Means (B, N, n) apart by what their covariances (B, N, n, n), of conditions to about 1e3, allow."""
    turn = np.linalg.qr(rng.standard_normal((size, count, n, n)))[0]
    spread = 10.0 ** rng.uniform(-1.5, 1.5, (size, count, 1, n))
    covariances = (turn * spread) @ turn.swapaxes(-1, -2)
    covariances = 0.5 * (covariances + covariances.swapaxes(-1, -2))
    noise = np.linalg.cholesky(covariances) @ rng.standard_normal((size, count, n, 1))
    return 1000.0 * rng.standard_normal((size, 1, n)) + noise[..., 0], covariances


def _excess(fuse: Fuse, rng: np.random.Generator, n: int) -> dict[str, float]:
    _, covariances = _sources(rng, PAIRS, 2, n)
    roots = np.linalg.cholesky(covariances)
    turns = np.linalg.qr(rng.standard_normal((PAIRS, n, n)))[0]
    kinds = {
        "independent": np.zeros((PAIRS, n, n)),
        "the same in both": np.tile(np.eye(n), (PAIRS, 1, 1)),
        "opposite": np.tile(-np.eye(n), (PAIRS, 1, 1)),
        "turned at random, strength 1/2": 0.5 * turns,
        "turned at random, strength 1": turns,
    }
    found = {}
    for name, cross in kinds.items():
        values = []
        for root, covariance, turn in zip(roots, covariances, cross, strict=True):
            one = rng.standard_normal((SAMPLES, n))
            left = np.sqrt(max(0.0, 1.0 - float(np.linalg.norm(turn, 2)) ** 2))
            other = one @ turn + left * rng.standard_normal((SAMPLES, n))
            errors = np.stack([one @ root[0].T, other @ root[1].T], axis=1)
            mean, stated, _ = fuse(errors, np.broadcast_to(covariance, (SAMPLES, 2, n, n)).copy())
            scaled = np.linalg.solve(np.linalg.cholesky(stated), mean[..., None])[..., 0]
            values.append(float(np.linalg.eigvalsh(scaled.T @ scaled / SAMPLES)[-1]))
        found[name] = max(values)
    return found
