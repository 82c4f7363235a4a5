"""Covariance intersection (CI) and its version for bounded correlation (BCI).

Both fuse the sources as independent, with covariances inflated until the block-diagonal joint covariance
bounds every admissible one:

    P^-1 = sum c_i P_i^-1,    P^-1 x = sum c_i P_i^-1 x_i

CI (Julier and Uhlmann; Li-AA sec. II; geometric mean of the densities): c_i = w_i. Conservative whatever
the correlation.

BCI: if ||P_i^-1/2 P_ij P_j^-T/2|| <= R_ij for each pair of errors, c_i = w_i / (R w)_i is conservative for
every such joint covariance, since x' J x <= sum R_ij |x_i||x_j| <= sum_i ((R w)_i / w_i) |x_i|^2 in
whitened coordinates. With one number rho for all pairs, c(w) = w / ((1-rho) w + rho), concave, so the best
weights are unique in effect; rho = 1 is CI, rho = 0 the naive rule. A matrix R of different bounds, for
N > 2, makes the search for weights non-convex: the best of N + 1 local optima is used, from equal weights and
from each source in turn with four fifths of the weight. It is as conservative as any.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.linalg import FloatArray, inner
from fusion_service.rules.sources import Result, Sources, weighted_product, weighted_sum
from fusion_service.rules.weights import line, pairs, simplex


def ci(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str) -> Result:
    """Covariance intersection."""
    return _intersection(sources, weights, influence, criterion, 1.0)


def bci(
    sources: Sources,
    weights: FloatArray | None,
    influence: bool,
    *,
    criterion: str,
    max_correlation: float | FloatArray,
) -> Result:
    """Bounded covariance inflation; `max_correlation` a number or (N, N)."""
    R = np.asarray(max_correlation, dtype=np.float64)
    if R.ndim == 2:
        others = R[~np.eye(len(R), dtype=np.bool_)]
        if others.size and (others != others[0]).any():
            return _bounded_by_pair(sources, weights, influence, criterion, R)
        R = others[:1] if others.size else np.ones(1)
    return _intersection(sources, weights, influence, criterion, float(R.item()))


def _intersection(sources: Sources, weights: FloatArray | None, influence: bool, criterion: str, rho: float) -> Result:
    model = Inflated(sources.information, rho)
    optimise = weights is None and rho > 0.0 and sources.count > 1
    w = sources.uniform if weights is None else weights
    if optimise and sources.count == 2:
        A, P, dets = model.A, sources.covariances, 1.0 / sources.dets
        M = A[:, :, 1], A[:, :, 0]
        if sources.fast and len(sources.means) <= pairs.LIMIT:
            t = pairs.best_weight(criterion, M, (P[:, :, 1], P[:, :, 0]), (dets[1], dets[0]), rho=rho)
        else:
            t = line.best_weight(criterion, M, rho=rho)
        w = np.stack([t, 1.0 - t])
    elif optimise:
        w = simplex.best_weights(criterion, model, w)
    scale, slope, _ = model.scale(w)
    mean, P, condition = weighted_product(sources, scale)
    gap, share = np.zeros_like(condition), None
    if optimise:
        g = simplex.gradient(criterion, P, model.A)
        gap = simplex.gap(w, g * slope)
    if influence:
        share = (-g if optimise and criterion == "det" else inner(P[:, :, None], model.A)) * scale / len(P)
    return Result(mean, P, w, share, condition, gap)


def _bounded_by_pair(
    sources: Sources, weights: FloatArray | None, influence: bool, criterion: str, R: FloatArray
) -> Result:
    model = Coupled(sources.information, R)
    w = _best_of_several(criterion, model, sources.uniform) if weights is None else weights
    scale = w / model.crowd(w)
    mean, P, condition = weighted_product(sources, scale)
    share = inner(P[:, :, None], model.A) * scale / len(P) if influence else None
    return Result(mean, P, w, share, condition, np.zeros_like(condition))


def _best_of_several(criterion: str, model: "Coupled", uniform: FloatArray) -> FloatArray:
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
class Inflated:
    """M(w) = sum c(w_i) A_i, c(w) = w / ((1-rho) w + rho)."""

    A: FloatArray  # (n, n, N, B)
    rho: float

    def scale(self, w: FloatArray) -> tuple[FloatArray, FloatArray | float, FloatArray | float]:
        """c, c' and c''."""
        if self.rho == 1.0:
            return w, 1.0, 0.0
        if self.rho == 0.0:
            return np.ones_like(w), 0.0, 0.0
        d = (1.0 - self.rho) * w + self.rho
        slope = self.rho / (d * d)
        return w / d, slope, -2.0 * (1.0 - self.rho) * slope / d

    def __call__(self, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        c, slope, _ = self.scale(w)
        return weighted_sum(self.A, c), self.A * slope

    def bend(self, w: FloatArray, G: FloatArray) -> FloatArray | None:
        if self.rho == 1.0:
            return None
        return simplex.diagonal(-self.scale(w)[2] * inner(G[:, :, None], self.A))

    def take(self, index: NDArray[np.bool_]) -> Self:
        return replace(self, A=self.A[..., index])


@dataclass(frozen=True, slots=True)
class Coupled:
    """M(w) = sum w_i / (R w)_i A_i. Its second derivatives may have either sign, and are left out."""

    A: FloatArray  # (n, n, N, B)
    R: FloatArray  # (N, N)

    def crowd(self, w: FloatArray) -> FloatArray:
        """R w."""
        return linalg.matvec(self.R, w)

    def __call__(self, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        crowd = self.crowd(w)
        own = self.A / crowd
        pull = own * (w / crowd)
        others = np.stack([weighted_sum(pull, self.R[:, j, None]) for j in range(len(w))], axis=2)
        return weighted_sum(own, w), own - others

    def bend(self, w: FloatArray, G: FloatArray) -> None:
        return None

    def take(self, index: NDArray[np.bool_]) -> Self:
        return replace(self, A=self.A[..., index])
