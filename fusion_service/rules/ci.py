"""Covariance intersection (CI): Julier and Uhlmann 1997; Sharma (4); Li-AA section II.

    P^-1 = sum w_i P_i^-1,    P^-1 x = sum w_i P_i^-1 x_i

The sources are fused as independent ones, with covariances inflated until the block-diagonal joint covariance bounds
every admissible one. It is the geometric mean of the densities. Conservative whatever the correlation.

Weights: min over w of det P or trace P, convex and found exactly (`pairs`, `line`, `active`, `simplex`).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.compiled import either
from fusion_service.linalg import inner
from fusion_service.rules.base.block import Result, Sources, weighted_product
from fusion_service.rules.base.matrices import diagonal, weighted_sum
from fusion_service.rules.base.options import CRITERION
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.weights import active, pairs, simplex
from fusion_service.rules.weights.pairs import is_one, of_elements
from fusion_service.rules.weights.two import best_of_two

__all__ = ["KEPT", "RULE", "ci", "intersection"]

KEPT = 1e-3
"""Weights that are given to start from are kept while their gap is at most this."""
NEARER = 1e-6
"""Else better ones are sought from there, until their gap is at most this."""
LIMITS = KEPT, NEARER, float(active.ROUNDS), active.RIDGE, active.NEAR
"""As `compiled.three` takes them."""


def ci(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str) -> Result:
    """Covariance intersection."""
    return intersection(sources, weights, influence, criterion, 1.0)


RULE = Rule(
    name="ci",
    order=2,
    title="covariance intersection; weights by det or trace, exactly optimal, or given",
    promise="conservative for every correlation",
    source="covariance intersection (Julier and Uhlmann 1997; Sharma (4); Li-AA (16)-(18))",
    fuse=in_scales(ci),
    information=True,
    takes={"criterion": CRITERION, "scales": SCALES},
)


def intersection(
    sources: Sources, weights: Floats | None, influence: bool, criterion: str, rho: float | Floats
) -> Result:
    """The intersection of the sources inflated for correlations up to rho, a number or (B,) positive ones: CI for 1,
    the naive rule for 0."""
    model = Inflated(sources.information, rho)
    optimise = weights is None and not (isinstance(rho, float) and rho == 0.0) and sources.count > 1
    if optimise and sources.start is not None and sources.count > 2:
        return _from_start(sources, influence, criterion, rho)
    w = sources.uniform if weights is None else weights
    if optimise and sources.count == 2:
        A, P, dets = model.A, sources.covariances, 1.0 / sources.dets
        ends = (A[:, :, 1], A[:, :, 0]), (P[:, :, 1], P[:, :, 0]), (dets[1], dets[0])
        w = best_of_two(criterion, *ends, rho=rho)
    elif optimise:
        w = _best(criterion, model, w)
    return _weighed(sources, model, w, influence, criterion, optimise)


def _weighed(
    sources: Sources, model: "Inflated", w: Floats, influence: bool, criterion: str, optimised: bool
) -> Result:
    """The intersection under weights (N, B), with the gap of those that are `optimised`."""
    scale, slope, _ = model.scale(w)
    mean, P, condition = weighted_product(sources, scale)
    gap, share = np.zeros_like(condition), None
    if optimised:
        g = simplex.gradient(criterion, P, model.A)
        gap = simplex.gap(w, g * slope)
    if influence:
        share = (-g if optimised and criterion == "det" else inner(P[:, :, None], model.A)) * scale / len(P)
    return Result(mean, P, w, share, condition, gap)


def _best(criterion: str, model: "Inflated", uniform: Floats, near: Floats | None = None) -> Floats:
    """The best weights (N, B); a search that begins `near` them ends at a gap of `NEARER`."""
    few = len(uniform) <= active.SETS[0] or (is_one(model.rho) and len(model.A) <= pairs.LIMIT)
    if uniform.dtype != np.float64 or not few:  # of the others, too many have weight
        return simplex.best_weights(criterion, model, uniform)
    return active.best_weights(criterion, model, uniform, near, active.DONE if near is None else NEARER)


def _from_start(sources: Sources, influence: bool, criterion: str, rho: float | Floats) -> Result:
    """With the weights to start from where their gap is at most `KEPT`, they count as given; elsewhere from there to
    the best.

    The criterion, det P or trace P, is then at most exp(gap) times the smallest."""
    assert sources.start is not None
    if sources.count == active.THREE and criterion == "det" and is_one(rho):
        begun = from_start_of_three(sources.information, sources.means, sources.condition, sources.start, LIMITS)
        if begun is not None:
            *columns, found = begun
            mean, P, w, share, condition, gap = columns
            result = Result(mean, P, w, share if influence else None, condition, gap)
            hard = np.flatnonzero(found == 0.0)
            if len(hard):
                result.overwrite(hard, _from_start_plain(sources.take(hard), influence, criterion, rho))
            return result
    return _from_start_plain(sources, influence, criterion, rho)


@either
def from_start_of_three(
    A: Floats, x: Floats, bound: Floats, start: Floats, limits: tuple[float, ...]
) -> tuple[Floats, ...] | None:
    """What `compiled.three` makes of it; None on the plain road."""
    return None


def _from_start_plain(sources: Sources, influence: bool, criterion: str, rho: float | Floats) -> Result:
    assert sources.start is not None
    model, w = Inflated(sources.information, rho), np.array(sources.start)
    result = _weighed(sources, model, w, influence, criterion, True)
    anew = np.flatnonzero(~(result.gap <= KEPT))
    if len(anew):
        size = len(result.gap)
        few = model if len(anew) == size else model.take(anew)
        w[:, anew] = _best(criterion, few, sources.uniform[:, anew], w[:, anew])
        if 2 * len(anew) > size:
            result = _weighed(sources, model, w, influence, criterion, True)
        else:
            result.overwrite(anew, _weighed(sources.take(anew), few, w[:, anew], influence, criterion, True))
    return replace(result, gap=np.where(result.gap <= KEPT, 0.0, result.gap))


@dataclass(frozen=True, slots=True)
class Inflated:
    """M(w) = sum c(w_i) A_i, c(w) = w / ((1-rho) w + rho)."""

    A: Floats  # (n, n, N, B)
    rho: float | Floats  # a number, or (B,)

    def scale(self, w: Floats) -> tuple[Floats, Floats | float, Floats | float]:
        """c, c' and c''."""
        if is_one(self.rho):
            return w, 1.0, 0.0
        if isinstance(self.rho, float) and self.rho == 0.0:
            return np.ones_like(w), 0.0, 0.0
        d = (1.0 - self.rho) * w + self.rho
        slope = self.rho / (d * d)
        return w / d, slope, -2.0 * (1.0 - self.rho) * slope / d

    def __call__(self, w: Floats) -> tuple[Floats, Floats]:
        c, slope, _ = self.scale(w)
        return weighted_sum(self.A, c), self.A * slope

    def bend(self, w: Floats, G: Floats) -> Floats | None:
        if is_one(self.rho):
            return None
        return diagonal(-self.scale(w)[2] * inner(G[:, :, None], self.A))

    def take(self, index: Bools | Ints) -> Self:
        return replace(self, A=self.A[..., index], rho=of_elements(self.rho, index))

    def of(self, which: Ints) -> Self:
        """The sources `which` (K, B), of each element its own."""
        return replace(self, A=np.take_along_axis(self.A, which[None, None], axis=2))
