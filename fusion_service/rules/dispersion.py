"""HMD-GA with weights by dispersion of divergences: Dubey (23) to (29).

    min over w of sum_i (D_i - mean D)^2,    D_i = (KL(p, p_i) + KL(p_i, p)) / 2,  p = HMD-GA at w

which makes the fused density equally far from all sources. For two sources a root of D_1 = D_2 exists: at
w_1 = 1 the result is source 1. There can be several minima. Found is, for two sources, the best of a scan of
65 weights, refined, and of equally good ones the nearest to equal weights; for more sources a local minimum
reached from equal weights (see `search`).

These weights favour the worst source (it must be as near as the best one), as Dubey's own tables show; equal
weights did better there.
"""

from fusion_service import linalg
from fusion_service.linalg import FloatArray, inner, total
from fusion_service.rules.harmonic import hmd_ga as fixed
from fusion_service.rules.sources import Result, Sources
from fusion_service.rules.weights import search


def hmd_ga(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str, constants: bool) -> Result:
    """Harmonic mean density, Gaussian approximation, with criterion "kl" too."""
    if criterion == "kl":
        if weights is None:
            weights = search.lowest(_dispersion(sources, constants), sources)
        criterion = "det"
    return fixed(sources, weights, influence, criterion=criterion, constants=constants)


def _dispersion(sources: Sources, constants: bool) -> search.Cost:
    def cost(w: FloatArray) -> FloatArray:
        fused = fixed(sources, w, False, criterion="det", constants=constants)
        P, A = fused.covariance[:, :, None], sources.information
        inverse = linalg.inverse(fused.covariance)[:, :, None]
        d = sources.spread - (fused.mean - sources.means[:, 0])[:, None]
        n = len(d)
        distance = inner(A, P) + inner(inverse, sources.covariances) - 2.0 * n
        distance = 0.25 * (distance + total(d * linalg.matvec(A + inverse, d)))
        off = distance - total(distance) / sources.count
        return total(off * off)

    return cost
