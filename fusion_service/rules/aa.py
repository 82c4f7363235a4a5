"""Arithmetic average (AA) of the densities, merged: the moments of the mixture sum w_i N(x_i, P_i).

    x = sum w_i x_i,    P = sum w_i (P_i + (x_i - x)(x_i - x)')                        (Li-AA (5), (10), (11))

It keeps what every source says, so one faulty source widens the result instead of pulling it away. P is
never below CI's covariance in the sense of the densities' second moments; it grows with disagreement.

Weights:

* uniform, the default;
* diversity, Li-AA (40): the largest sum w_i KL(p_i, p_AA) = (log det P_AA(w) - sum w_i log det P_i) / 2.
  Concave in w (P_AA is concave as a matrix), so the optimum is found exactly. It is the radius of the
  smallest KL ball around the sources: the active ones end equally far from the average, (37);
* bound, Li-AA (45): the smallest sum w_i log(|P_i|^1/2 sum_j w_j z_ij), z_ij = N(x_i; x_j, P_i + P_j), from
  Jensen's inequality. Not convex: for two sources the best of a scan, for more a local minimum reached from
  equal weights (see `search`).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import inner, total
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.matrices import fill_upper
from fusion_service.rules.base.options import Option, one_of
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.weights import search, simplex
from fusion_service.rules.weights.mixture_covariance import MixtureCovariance
from fusion_service.rules.weights.pencil import pencil
from fusion_service.rules.weights.root import root, slopes_at_ends

__all__ = ["RULE", "aa"]


def aa(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str) -> Result:
    """Arithmetic average, merged."""
    mixture = MixtureCovariance(sources.covariances, sources.spread)
    w, gap, condition = weights, np.zeros_like(sources.condition), np.ones_like(sources.condition)
    if w is None and (criterion == "uniform" or sources.count == 1):
        w = sources.uniform
    elif w is None and criterion == "bound":
        w = search.lowest(_bound(sources), sources)
    elif w is None:
        logs = np.log(sources.dets)
        model = Tilted(mixture, logs - total(logs) / sources.count)
        w = _of_two(sources) if sources.count == 2 else simplex.best_weights("det", model, sources.uniform)
        M, D = model(w)
        gap, condition = simplex.gap(w, simplex.gradient("det", linalg.inverse(M), D)), sources.condition
    return Result(
        sources.means[:, 0] + mixture.mean(w), fill_upper(mixture(w)[0]), w, w if influence else None, condition, gap
    )


RULE = Rule(
    name="aa",
    order=12,
    title="arithmetic average; uniform, diversity or bound weights",
    promise="fault tolerant; a mixture keeps modes",
    source="arithmetic average, merged: Li-AA (5), (10), (40), (45)",
    fuse=aa,
    takes={"criterion": Option("uniform", one_of("uniform", "diversity", "bound"))},
)


def _of_two(sources: Sources) -> Floats:
    """Diversity weights (2, B), where both covariances are diagonal and the first is I."""
    P = sources.covariances
    _, inverse, r, _ = pencil(P[:, :, 0], P[:, :, 1])
    d = linalg.matvec(inverse, sources.spread[:, 1])
    data = np.stack([r, d * d, np.log(r)], axis=1)
    return root(_diversity_slope, data, *slopes_at_ends(_diversity_slope, data))


def _diversity_slope(t: Floats, u: Floats, data: Floats) -> tuple[Floats, Floats]:
    """First and second derivative of sum w_i log det P_i - log det P_AA at w = (t, 1 - t).

    With g = t + (1-t) r: det P_AA = prod g (1 + t(1-t) q), q = sum d^2 / g.
    """
    r, square, logs = data[:, 0], data[:, 1], data[:, 2]
    inverse, lean = 1.0 / (t + u * r), 1.0 - r
    rate = lean * inverse
    part = square * inverse
    q, dq, ddq = total(part), -total(part * rate), 2.0 * total(part * rate * rate)
    s, ds = t * u, u - t
    f, df, ddf = 1.0 + s * q, ds * q + s * dq, -2.0 * q + 2.0 * ds * dq + s * ddq
    return -total(rate + logs) - df / f, total(rate * rate) - ddf / f + (df / f) ** 2


@dataclass(frozen=True, slots=True)
class Tilted:
    """P_AA(w) exp(-c'w / n): minus its log-determinant is c'w - log det P_AA(w), convex in w."""

    mixture: MixtureCovariance
    c: Floats  # (N, B)

    def _scale(self, w: Floats) -> Floats:
        out: Floats = np.exp(-total(self.c * w) / len(self.mixture.C))
        return out

    def __call__(self, w: Floats) -> tuple[Floats, Floats]:
        M, D = self.mixture(w)
        s = self._scale(w)
        M = fill_upper(M)
        return M * s, (D - M[:, :, None] * (self.c / len(M))) * s

    def bend(self, w: Floats, G: Floats) -> Floats:
        s, n = self._scale(w), len(G)
        _, D = self.mixture(w)
        t, lean = inner((G * s)[:, :, None], D) - 0.5 * self.c, self.c / n
        # a multiple of ones: no matter where sum dw = 0, and a Hessian that can be inverted
        free = n + total(t * t)
        return self.mixture.bend(w, G * s) + lean[:, None] * t + t[:, None] * lean + free

    def take(self, index: Bools) -> Self:
        return replace(self, mixture=self.mixture.take(index), c=self.c[:, index])


def _bound(sources: Sources) -> search.Cost:
    """Li-AA (45)."""
    x, P = sources.spread, sources.covariances
    N = sources.count
    log_z = np.empty((N, *sources.dets.shape), x.dtype)
    for i in range(N):
        S, d = P + P[:, :, i : i + 1], x - x[:, i : i + 1]
        log_z[i] = -0.5 * (linalg.quadratic(S, d) + linalg.logdet(S))
    height = log_z.max(axis=1)  # of each row: no underflow
    z = np.exp(log_z - height[:, None])
    offset = 0.5 * np.log(sources.dets) + height

    def cost(w: Floats) -> Floats:
        out: Floats = total(w * (offset + np.log(linalg.matvec(z, w))))
        return out

    return cost
