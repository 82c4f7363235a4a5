"""Covariance intersection under a bound on the correlation (BCI): Reece and Roberts 2005, N-way.

    P^-1 = sum c_i P_i^-1,    P^-1 x = sum c_i P_i^-1 x_i

If ||P_i^-1/2 P_ij P_j^-T/2|| <= R_ij for each pair of errors, c_i = w_i / (R w)_i is conservative for
every such joint covariance, since x' J x <= sum R_ij |x_i||x_j| <= sum_i ((R w)_i / w_i) |x_i|^2 in
whitened coordinates. With one number rho for all pairs, c(w) = w / ((1-rho) w + rho), concave, so the best
weights are unique in effect; rho = 1 is CI, rho = 0 the naive rule. A matrix R of different bounds, for
N > 2, makes the search for weights non-convex: the best of N + 1 local optima is used, from equal weights and
from each source in turn with four fifths of the weight. It is as conservative as any.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import inner
from fusion_service.rules.base.block import Result, Sources, weighted_product
from fusion_service.rules.base.matrices import fill_upper, weighted_sum
from fusion_service.rules.base.options import CRITERION, Case, Option, RuleError, array
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.ci import intersection
from fusion_service.rules.weights import simplex

__all__ = ["RULE", "bci"]


def bci(
    sources: Sources,
    weights: Floats | None,
    influence: bool,
    *,
    criterion: str,
    max_correlation: float | Floats,
) -> Result:
    """Bounded covariance inflation; `max_correlation` a number or (N, N)."""
    R = np.asarray(max_correlation, dtype=np.float64)
    if R.ndim == 2:
        others = R[~np.eye(len(R), dtype=np.bool_)]
        if others.size and (others != others[0]).any():
            return _bounded_by_pair(sources, weights, influence, criterion, R)
        R = others[:1] if others.size else np.ones(1)
    return intersection(sources, weights, influence, criterion, float(R.item()))


def _bound(name: str, value: Any, case: Case) -> Floats:
    R, N = array(name, value), case.N
    if R.shape not in ((), (N, N)):
        raise RuleError(f"{name} has shape {R.shape}: a number or ({N}, {N}) is needed")
    if not ((R >= 0.0) & (R <= 1.0)).all():
        raise RuleError(f"{name} must lie between 0 and 1")
    if R.ndim and not ((R == R.T).all() and (R.diagonal() == 1.0).all()):
        raise RuleError(f"{name} must be symmetric with ones on its diagonal")
    return R


RULE = Rule(
    name="bci",
    order=3,
    title="CI under a bound on the correlation (`max_correlation`)",
    promise="conservative for every correlation within the bound; tight for two sources",
    source="bounded covariance inflation (Reece and Roberts 2005), N-way",
    fuse=in_scales(bci),
    information=True,
    takes={"criterion": CRITERION, "scales": SCALES, "max_correlation": Option(1.0, _bound)},
)


def _bounded_by_pair(sources: Sources, weights: Floats | None, influence: bool, criterion: str, R: Floats) -> Result:
    model = Coupled(sources.information, R)
    w = _best_of_several(criterion, model, sources.uniform) if weights is None else weights
    scale = w / model.crowd(w)
    mean, P, condition = weighted_product(sources, scale)
    share = inner(P[:, :, None], model.A) * scale / len(P) if influence else None
    return Result(mean, P, w, share, condition, np.zeros_like(condition))


def _best_of_several(criterion: str, model: "Coupled", uniform: Floats) -> Floats:
    best, low = uniform, np.full_like(uniform[0], np.inf)
    for i in range(-1, len(uniform)):
        start = uniform if i < 0 else 0.2 * uniform
        if i >= 0:
            start[i] += 0.8
        w = simplex.best_weights(criterion, model, start)
        M, _ = model(w)
        value = -linalg.logdet(M) if criterion == "det" else np.log(linalg.trace(linalg.inverse(M)))
        better = value < low
        best, low = np.where(better, w, best), np.where(better, value, low)
    return best


@dataclass(frozen=True, slots=True)
class Coupled:
    """M(w) = sum w_i / (R w)_i A_i. Its second derivatives may have either sign, and are left out."""

    A: Floats  # (n, n, N, B)
    R: Floats  # (N, N)

    def crowd(self, w: Floats) -> Floats:
        """R w."""
        return linalg.matvec(self.R, w)

    def __call__(self, w: Floats) -> tuple[Floats, Floats]:
        crowd = self.crowd(w)
        own = self.A / crowd
        pull = own * (w / crowd)
        others = np.stack([weighted_sum(pull, self.R[:, j, None]) for j in range(len(w))], axis=2)
        return weighted_sum(own, w), own - fill_upper(others)

    def bend(self, w: Floats, G: Floats) -> None:
        return None

    def take(self, index: Bools) -> Self:
        return replace(self, A=self.A[..., index])
