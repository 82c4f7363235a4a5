"""Fusion of two sources whose cross-covariance is known (Bar-Shalom and Campo 1986).

With J the joint covariance of both errors, [P_1, P_12; P_12', P_2], and H = [I; I]:

    P^-1 = H' J^-1 H,    x = P H' J^-1 [x_1; x_2]

which is x = x_1 + (P_1 - P_12)(P_1 + P_2 - P_12 - P_12')^-1 (x_2 - x_1): the best linear unbiased estimate.
"""

from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import condition
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import Case, Option, RuleError, array
from fusion_service.rules.base.rule import Rule

__all__ = ["RULE", "bar_shalom_campo"]


def bar_shalom_campo(sources: Sources, weights: Floats | None, influence: bool, *, cross_covariance: Floats) -> Result:
    """`cross_covariance` (n, n, B) is E[e_1 e_2']. A joint covariance that is not positive definite is refused."""
    n = len(sources.means)
    J = np.empty((2 * n, 2 * n, *sources.means.shape[2:]), sources.means.dtype)
    J[:n, :n], J[n:, n:] = sources.covariances[:, :, 0], sources.covariances[:, :, 1]
    J[:n, n:], J[n:, :n] = cross_covariance, cross_covariance.swapaxes(0, 1)
    inverse, _, margin = linalg.sweep(J)
    worst = np.where(margin > 1e-14, condition(J, inverse), np.inf)
    first = inverse[:n, :n] + inverse[n:, :n]
    second = inverse[:n, n:] + inverse[n:, n:]
    M = first + second
    P = linalg.inverse(M)
    gain = linalg.product(P, second)
    mean = sources.means[:, 0] + linalg.matvec(gain, sources.spread[:, 1])
    share = None
    if influence:
        second_share = linalg.trace(gain) / n
        share = np.stack([1.0 - second_share, second_share])
    nan = np.full_like(sources.means[0], np.nan)
    return Result(
        mean, P, nan, share, np.maximum(np.maximum(sources.condition, worst), condition(M, P)), np.zeros_like(worst)
    )


def _cross(name: str, value: Any, case: Case) -> Floats:
    """The cross-covariances, batch-last: (n, n, B)."""
    N, n = case.N, case.n
    if N != 2:
        raise RuleError(f"rule {case.rule!r} takes two sources, not {N}")
    if value is None:
        raise RuleError(f"rule {case.rule!r} needs the option {name}, E[e_1 e_2'] (..., {n}, {n})")
    cross = array(name, value)
    shape = (n, n, *case.batch) if case.last else (*case.batch, n, n)
    if case.last and cross.ndim == 2:
        cross = cross[..., None]
    try:
        cross = np.broadcast_to(cross, shape)
    except ValueError:
        raise RuleError(f"{name} {cross.shape} does not fit {shape}") from None
    if not case.last and not np.isfinite(cross).all():
        raise RuleError(f"{name} is not finite")
    return cross if case.last else linalg.to_last(cross, 2)


RULE = Rule(
    name="bar-shalom-campo",
    order=6,
    title="known cross-covariance, two sources",
    promise="optimal (linear) for the cross-covariance given",
    source="Bar-Shalom and Campo 1986; two sources",
    fuse=bar_shalom_campo,
    information=True,
    n_way=False,
    takes={"cross_covariance": Option(None, _cross, per_element=True)},
    takes_weights=False,
    refusal="is too ill-conditioned to fuse, or its joint covariance is not positive definite",
)
