"""Covariance intersection under a bound on the correlation (BCI): Reece and Roberts 2005, N-way.

    P^-1 = sum c_i P_i^-1,    P^-1 x = sum c_i P_i^-1 x_i

If ||P_i^-1/2 P_ij P_j^-T/2|| <= R_ij for each pair of errors, c_i = w_i / (R w)_i is conservative for
every such joint covariance, since x' J x <= sum R_ij |x_i||x_j| <= sum_i ((R w)_i / w_i) |x_i|^2 in
whitened coordinates. With one number rho for all pairs, c(w) = w / ((1-rho) w + rho), concave, so the best
weights are unique in effect; rho = 1 is CI, rho = 0 the naive rule. A matrix R of different bounds, for
N > 2, makes the search for weights non-convex: the best of N + 1 local optima is used, from equal weights and
from each source in turn with four fifths of the weight. It is as conservative as any.

Bounds may be each fusion's own. Where those of a fusion are one number its weights are the best; else they go by some
rounds of the fixed point of the conditions for the best, with a_i = c_i tr(P A_i), or c_i tr(P A_i P) / tr P,

    w_j <- w_j ((a_j / w_j) / sum_i R_ij a_i / (R w)_i)^power,

the multiplicative algorithm of D-optimal design where R is all ones: a hundredth of the time, and a log det P that is
larger by some 1e-3 on average. It is as conservative as any, again.
"""

from dataclasses import dataclass, fields, replace
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

ROUNDS, POWER = 20, {"det": 1.5, "trace": 1.0}
LEAST = 1e-6
"""Of the bounds that two sources have for each fusion: below, weights mean next to nothing and are hard to find."""


def bci(
    sources: Sources,
    weights: Floats | None,
    influence: bool,
    *,
    criterion: str,
    max_correlation: float | Floats,
) -> Result:
    """Bounded covariance inflation; `max_correlation` a number, (N, N), or (N, N, B)."""
    R = np.asarray(max_correlation, dtype=np.float64)
    if R.ndim == 3:
        return _bounded_each(sources, weights, influence, criterion, R)
    if R.ndim == 2:
        others = R[~np.eye(len(R), dtype=np.bool_)]
        if others.size and (others != others[0]).any():
            return _bounded_by_pair(sources, weights, influence, criterion, R)
        R = others[:1] if others.size else np.ones(1)
    return intersection(sources, weights, influence, criterion, float(R.item()))


def _bound(name: str, value: Any, case: Case) -> Floats:
    """A number, (N, N), or one matrix for each fusion, batch-last: (N, N, B)."""
    R, N, batch = array(name, value), case.N, case.batch
    each = R.ndim > 2
    if each:
        try:
            R = np.broadcast_to(R, (N, N, *batch) if case.last else (*batch, N, N))
        except ValueError:
            raise RuleError(f"{name} has shape {R.shape}: one ({N}, {N}) for each of {batch} is needed") from None
        R = R if case.last else linalg.to_last(R, 2)
    elif R.shape not in ((), (N, N)):
        raise RuleError(f"{name} has shape {R.shape}: a number or ({N}, {N}) is needed")
    if not ((R >= 0.0) & (R <= 1.0)).all():
        raise RuleError(f"{name} must lie between 0 and 1")
    if R.ndim and not ((R.swapaxes(0, 1) == R).all() and (R[range(N), range(N)] == 1.0).all()):
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
    takes={"criterion": CRITERION, "scales": SCALES, "max_correlation": Option(1.0, _bound, per_element=2)},
)


def _bounded_by_pair(sources: Sources, weights: Floats | None, influence: bool, criterion: str, R: Floats) -> Result:
    model = Coupled(sources.information, R)
    w = _best_of_several(criterion, model, sources.uniform) if weights is None else weights
    scale = w / model.crowd(w)
    mean, P, condition = weighted_product(sources, scale)
    share = inner(P[:, :, None], model.A) * scale / len(P) if influence else None
    return Result(mean, P, w, share, condition, np.zeros_like(condition))


def _bounded_each(sources: Sources, weights: Floats | None, influence: bool, criterion: str, R: Floats) -> Result:
    """Bounds (N, N, B) of each fusion's own."""
    if len(R) == 1:
        return intersection(sources, weights, influence, criterion, 1.0)
    others = R[~np.eye(len(R), dtype=np.bool_)]
    one = (others == others[0]).all(axis=0)
    parts: list[tuple[Bools, Result]] = []
    for flat in (True, False):
        some = one == flat
        if not some.any() and not (flat and not len(one)):
            continue
        mine = _taken(sources, some)
        w = None if weights is None else weights[:, some]
        if flat:
            result = intersection(mine, w, influence, criterion, np.maximum(others[0, some], LEAST))
        else:
            w = _by_rounds(criterion, mine, R[..., some]) if w is None else w
            result = _bounded_by_pair(mine, w, influence, criterion, R[..., some])
        if some.all():
            return result
        parts.append((some, result))
    return _joined(parts)


def _taken(sources: Sources, some: Bools) -> Sources:
    return sources if some.all() else sources.take(some)


def _joined(parts: list[tuple[Bools, Result]]) -> Result:
    columns: list[Any] = []
    for one in fields(Result):
        values = [getattr(result, one.name) for _, result in parts]
        if values[0] is None:
            columns.append(None)
            continue
        whole = np.empty((*values[0].shape[:-1], len(parts[0][0])), values[0].dtype)
        for (some, _), value in zip(parts, values, strict=True):
            whole[..., some] = value
        columns.append(whole)
    return Result(*columns)


def _by_rounds(criterion: str, sources: Sources, R: Floats) -> Floats:
    """Good weights (N, B) under bounds R (N, N, B) of each fusion's own."""
    A, w, power = sources.information, sources.uniform, POWER[criterion]
    for _ in range(ROUNDS):
        crowd = linalg.matvec(R, w)
        c = w / crowd
        V = linalg.inverse(weighted_sum(A, c))
        a = c * inner((V if criterion == "det" else linalg.product(V, V))[:, :, None], A)
        w = w * (a / (w * linalg.matvec(R, a / crowd))) ** power
        w = np.maximum(w / linalg.total(w), 1e-12)
    return w / linalg.total(w)


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
    R: Floats  # (N, N), or (N, N, B)

    def crowd(self, w: Floats) -> Floats:
        """R w."""
        return linalg.matvec(self.R, w)

    def __call__(self, w: Floats) -> tuple[Floats, Floats]:
        crowd = self.crowd(w)
        own = self.A / crowd
        pull = own * (w / crowd)
        R = self.R if self.R.ndim == 3 else self.R[..., None]
        others = np.stack([weighted_sum(pull, R[:, j]) for j in range(len(w))], axis=2)
        return weighted_sum(own, w), own - fill_upper(others)

    def bend(self, w: Floats, G: Floats) -> None:
        return None

    def take(self, index: Bools) -> Self:
        return replace(self, A=self.A[..., index], R=self.R if self.R.ndim == 2 else self.R[..., index])
