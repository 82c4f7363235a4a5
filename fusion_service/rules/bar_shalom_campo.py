"""Fusion of sources whose cross-covariances are known: Bar-Shalom and Campo 1986 for two, maximum likelihood for any
number (Kim 1994; Chen, Kirubarajan and Bar-Shalom 2003).

With J the joint covariance of all errors, blocks P_ij with P_ii = P_i and P_ji = P_ij', and H = [I; ...; I]:

    P^-1 = H' J^-1 H,    x = P H' J^-1 [x_1; ...; x_N]

the best linear unbiased estimate, and for Gaussian errors the most likely state. For two sources it is
x = x_1 + (P_1 - P_12)(P_1 + P_2 - P_12 - P_12')^-1 (x_2 - x_1).
"""

from itertools import combinations
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import condition
from fusion_service.rules.base.block import Result, Sources, alone
from fusion_service.rules.base.options import Case, Option, RuleError, array
from fusion_service.rules.base.rule import Rule

__all__ = ["RULE", "bar_shalom_campo"]


def bar_shalom_campo(sources: Sources, weights: Floats | None, influence: bool, *, cross_covariance: Floats) -> Result:
    """`cross_covariance` (n, n, N (N - 1) / 2, B) holds E[e_i e_j'] of the pairs i < j in lexical order. A joint
    covariance that is not positive definite is refused."""
    n, N = len(sources.means), sources.count
    if N == 1:
        return alone(sources, influence)
    parts = [slice(i * n, (i + 1) * n) for i in range(N)]
    J = np.empty((N * n, N * n, *sources.means.shape[2:]), sources.means.dtype)
    for i, part in enumerate(parts):
        J[part, part] = sources.covariances[:, :, i]
    for k, (i, j) in enumerate(combinations(range(N), 2)):
        cross = cross_covariance[:, :, k]
        J[parts[i], parts[j]], J[parts[j], parts[i]] = cross, cross.swapaxes(0, 1)
    inverse, _, margin = linalg.sweep(J)
    worst = np.where(margin > 1e-14, condition(J, inverse), np.inf)
    columns = [linalg.total(np.stack([inverse[row, part] for row in parts])) for part in parts]
    M = linalg.total(np.stack(columns))
    P = linalg.inverse(M)
    gains = [linalg.product(P, column) for column in columns[1:]]
    spread = sources.spread
    mean = np.array(sources.means[:, 0])
    for i, gain in enumerate(gains, start=1):
        mean += linalg.matvec(gain, spread[:, i])
    share = None
    if influence:
        others = np.stack([linalg.trace(gain) / n for gain in gains])
        share = np.concatenate([1.0 - linalg.total(others)[None], others])
    nan = np.full_like(sources.means[0], np.nan)
    return Result(
        mean, P, nan, share, np.maximum(np.maximum(sources.condition, worst), condition(M, P)), np.zeros_like(worst)
    )


def _cross(name: str, value: Any, case: Case) -> Floats:
    """The cross-covariances of the pairs i < j, batch-last: (n, n, N (N - 1) / 2, B)."""
    N, n, batch = case.N, case.n, case.batch
    if N == 1:
        return np.zeros((n, n, 0, int(np.prod(batch))))
    one = f"E[e_1 e_2'] (..., {n}, {n}), or " if N == 2 else ""
    whole = (N, N, n, n)
    if value is None:
        raise RuleError(f"rule {case.rule!r} needs the option {name}: {one}of all pairs (..., {N}, {N}, {n}, {n})")
    given = array(name, value)
    # of a pair alone where that fits: with two sources and a batch of (2, 2) both could be meant
    pair, cross = N == 2 and (given.ndim <= 3 if case.last else _fits(given, (*batch, n, n))), given
    wanted = (n, n) if pair else whole
    if case.last and given.ndim == len(wanted):
        cross = given[..., None]
    shape = (*wanted, *batch) if case.last else (*batch, *wanted)
    core = given.shape[: len(wanted)] if case.last else given.shape[given.ndim - len(wanted) :]
    if core != wanted or not _fits(cross, shape):
        raise RuleError(f"{name} {given.shape} does not fit {shape}")
    cross = np.broadcast_to(cross, shape)
    if not case.last:
        if not np.isfinite(cross).all():
            raise RuleError(f"{name} is not finite")
        cross = linalg.to_last(cross, len(wanted))
    if pair:
        return cross[:, :, None]
    first, second = np.triu_indices(N, 1)
    upper = cross[first, second]
    lower, rounding = cross[second, first].swapaxes(1, 2), 1e-9 * np.abs(upper).max(initial=0.0)
    if not case.last and not np.allclose(upper, lower, rtol=1e-9, atol=rounding):
        raise RuleError(f"{name} of a pair and of the same the other way round must be each other's transpose")
    return np.moveaxis(upper, 0, 2)


def _fits(given: Floats, shape: tuple[int, ...]) -> bool:
    """Whether it broadcasts to the shape."""
    try:
        return np.broadcast_shapes(given.shape, shape) == shape
    except ValueError:
        return False


RULE = Rule(
    name="bar-shalom-campo",
    order=6,
    title="known cross-covariances",
    promise="optimal (linear) for the cross-covariances given",
    source="Bar-Shalom and Campo 1986, N-way by maximum likelihood (Kim 1994)",
    fuse=bar_shalom_campo,
    information=True,
    takes={"cross_covariance": Option(None, _cross, per_element=3)},
    takes_weights=False,
    refusal="is too ill-conditioned to fuse, or its joint covariance is not positive definite",
)
