"""Fusion of Gaussian mixtures f_i = sum_c alpha_ic N(m_ic, P_ic), any number of sources at once.

* aa: sum w_i f_i, the union of all components (Li-AA (6)); weights uniform, or by a criterion of the Gaussian rule
  `aa` on the sources' moments.
* gm-ga: prod f_i^w_i with every power of a sum taken as the sum of the powers (Li-2nd (49)-(51)). That drops the
  cross terms: the result is nowhere below the exact density and its mass is too large (1.8964 instead of 1.5634 in
  the example of Fig. 7). cross_terms="sampled" gives every component its share of the exact density.
* gmd-s, hmd-s: geometric mean prod f_i^w_i and harmonic mean 1 / sum (w_i / f_i) (Sharma (61), (69)-(73)), split into

      prod_i alpha_ic N_ic / D(x),    D = prod f_i^(1-w_i)   or   D = prod f_i sum (w_i / f_i),

  one part for each choice of a component c from every source, each part a Gaussian with the part's moments and its
  weight alpha beta zeta / sum. (70) and (73) as printed leave zeta out of the weights.
* cu-modes: for each such choice, weighed by the product of the alphas: covariance intersection of the modes if every
  two of them agree, (m_i - m_j)' (P_i + P_j)^-1 (m_i - m_j) within the quantile `gate` of chi-square, and their
  covariance union if they conflict. A mode of any source keeps its weight, spread over components that cover it where
  the others conflict with it; where they agree, all are taken for right.
* every rule of `RULES` but those: on the sources' moments; the result has one component.

The samples of a part come from its component of gm-ga, q = prod a_i^w_i with a_i = alpha_ic N_ic <= f_i, which bounds
the part from above. gmd-s: part / q = prod (a_i / f_i)^(1-w_i) <= 1. hmd-s: prod (a_i / f_i) is at most the least
a_i / f_i, so the part is at most the harmonic mean of the a_i, and that is at most their geometric mean q. So no sample
weighs more than 1, and nothing has to be chosen between sources; Sharma's choice (74) is biased and not used. All parts
share their normal draws: a result depends on its sources, `samples` and `seed` only.

All rules take all sources in one step, or (`ici`, `ei`) in the canonical order of `chain`: the order of arrival does
not matter. Weights are None (the `criterion` decides), "uniform", or given. Criteria of gm-ga, gmd-s and hmd-s:
"chernoff", of the Gaussians with the sources' moments (Uney Algorithm 1 in closed form); "chernoff-mixture", of the
mixtures themselves, by sampling; "det" and "trace" as `ci` (`hmd-ga` for hmd-s) finds them from the moments. `alpha`
multiplies every covariance first, as in the Gaussian `hmd-s`.
"""

from collections.abc import Mapping, Sequence
from math import prod
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from fusion_service import linalg
from fusion_service.densities import (
    DensityError,
    Mixture,
    Mixtures,
    chernoff_gaussians,
    chernoff_mixtures,
    draws,
    log_gaussian,
    log_sum,
    power_product,
    reduce_mixtures,
    sampled_moments,
)
from fusion_service.linalg import FloatArray, total
from fusion_service.rules.face import fuse_last
from fusion_service.rules.options import RuleError, array, checked
from fusion_service.rules.registry import RULES, Rule

__all__ = ["MIXTURE_RULES", "fuse_mixtures", "fuse_mixtures_last"]

MOST = 1 << 16
"""Components that a product may have before reduction."""
AT_ONCE = 1 << 18
"""Components of products in one block of elements."""
NEGLIGIBLE = np.log(1e-7)
"""Parts bounded by this share of the largest bound are not sampled."""
FEW = 50
"""Effective samples that a part needs."""
LIGHT = 0.01
"""Share of the mass below which a part with fewer takes the moments of its gm-ga component."""
CRITERIA = ("chernoff", "chernoff-mixture", "det", "trace")
_SAMPLED = {"criterion": "chernoff", "samples": 5000, "alpha": 1.0, "seed": 0}

MIXTURE_RULES: Mapping[str, Rule] = MappingProxyType(
    {
        rule.name: rule
        for rule in (
            Rule("aa", "keeps every mode; fault tolerant", True, {"criterion": "uniform"}, "Li-AA (6)"),
            Rule(
                "gm-ga",
                "keeps modes that all sources share; mass too large, cross terms dropped",
                True,
                _SAMPLED | {"cross_terms": "dropped"},
                "Li-2nd (49)-(51)",
            ),
            Rule("gmd-s", "as conservative as alpha makes it", True, dict(_SAMPLED), "Sharma (61)-(65), (67)-(73)"),
            Rule("hmd-s", "as conservative as alpha makes it", True, dict(_SAMPLED), "Sharma (66)-(73)"),
            Rule(
                "cu-modes",
                "conservative where modes conflict if one of them is, and where they agree if all are",
                True,
                {"criterion": "det", "gate": 0.99},
                "covariance union of modes that conflict, covariance intersection of those that agree",
            ),
        )
    }
)


def fuse_mixtures(
    rule: str,
    mixtures: Sequence[Mixture],
    *,
    weights: ArrayLike | str | None = None,
    max_components: int | None = None,
    prune: float = 0.0,
    reduction: str = "runnalls",
    normalise: bool = True,
    **options: Any,
) -> Mixture:
    """Fuse N mixtures of the same state by a rule of `MIXTURE_RULES`, or of `RULES` on their moments.

    `weights` None, "uniform" or (N,), not negative with sum 1. The result is reduced by `reduce_mixture` with
    `max_components`, `prune` and method `reduction`. Sources are normalised first, and so is the result; with
    normalise=False they are intensities, whose masses count (not for rules on moments, nor cu-modes).

    Raises RuleError for an unknown rule, option or weights, sources of different state dimensions, more than
    65,536 components before reduction, and sources too far apart or too ill-conditioned to fuse.
    """
    if not len(mixtures):
        raise RuleError("at least one source is needed")
    if len({m.means.shape[1] for m in mixtures}) > 1:
        raise RuleError("the sources have different state dimensions")
    w: FloatArray | str | None
    if weights is None or isinstance(weights, str):
        w = weights
    else:
        w = array("weights", weights)
        if w.shape != (len(mixtures),) or not ((w >= 0.0).all() and abs(w.sum() - 1.0) <= 1e-9):
            raise RuleError(f"weights must be {len(mixtures)} numbers, not negative, with sum 1")
        w = w[:, None]
    batch = [Mixtures.of([m]) for m in mixtures]
    limits: dict[str, Any] = {"max_components": max_components, "prune": prune, "reduction": reduction}
    fused, _ = fuse_mixtures_last(rule, batch, w, normalise=normalise, **limits, **options)
    try:
        return fused[0]
    except DensityError:
        raise RuleError("the sources are too ill-conditioned to fuse, or too far apart for this many samples") from None


def fuse_mixtures_last(
    rule: str,
    sources: Sequence[Mixtures],
    weights: FloatArray | str | None = None,
    *,
    max_components: int | None = None,
    prune: float = 0.0,
    reduction: str = "runnalls",
    normalise: bool = True,
    **options: Any,
) -> tuple[Mixtures, FloatArray]:
    """`fuse_mixtures` for many tracks at once: data are trusted, N batches of B mixtures each.

    `weights` None, "uniform" or (N, B). Returns the fused mixtures and the weights used (N, B), NaN where a rule has
    none. What cannot be fused becomes NaN, that element only; no element's bits depend on the others. Raises RuleError
    for what is asked, not for data.
    """
    N, n, B = len(sources), len(sources[0].means), len(sources[0])
    if isinstance(weights, str):
        if weights != "uniform":
            raise RuleError(f'weights {weights!r}: "uniform", an array, or None to let the criterion choose')
        weights = np.full((N, B), 1.0 / N)
    chosen = _options(rule, options, N, n)
    if normalise:
        sources = [f.normalised() for f in sources]
    elif rule not in MIXTURE_RULES or rule == "cu-modes":
        raise RuleError(f"rule {rule!r} fuses densities, not intensities")
    size = prod(len(f.log_weights) for f in sources) if rule != "aa" and rule in MIXTURE_RULES else 1
    if size > MOST:
        raise RuleError(f"the product of the sources has {size} components, more than {MOST}: reduce them first")
    if rule in RULES and rule not in MIXTURE_RULES and weights is not None and not RULES[rule].takes_weights:
        raise RuleError(f"rule {rule!r} takes no weights")

    def block(at: slice) -> tuple[Mixtures, FloatArray]:
        some = [Mixtures(f.log_weights[:, at], f.means[..., at], f.covariances[..., at]) for f in sources]
        out, w = _fused(rule, some, None if weights is None else weights[:, at], chosen, prune)
        if normalise:
            out = out.normalised()
        return reduce_mixtures(out, max_components=max_components, prune=prune, method=reduction), w

    step = max(1, AT_ONCE // size)
    try:
        with np.errstate(all="ignore"):
            parts = [block(slice(i, i + step)) for i in range(0, max(B, 1), step)]
    except DensityError as error:
        raise RuleError(str(error)) from None
    return Mixtures.joined([p[0] for p in parts]), np.concatenate([p[1] for p in parts], axis=1)


def _fused(
    rule: str, sources: Sequence[Mixtures], weights: FloatArray | None, chosen: dict[str, Any], prune: float
) -> tuple[Mixtures, FloatArray]:
    if rule not in MIXTURE_RULES:
        fused = fuse_last(rule, *_moments(sources), weights, **chosen)
        zero = np.zeros_like(fused.mean[:1])
        return Mixtures(zero, fused.mean[:, None], fused.covariance[:, :, None]), fused.weights
    if rule == "aa":
        w = fuse_last("aa", *_moments(sources), **chosen).weights if weights is None else weights
        union = Mixtures(
            np.concatenate([f.log_weights + np.log(v) for f, v in zip(sources, w, strict=True)]),
            np.concatenate([f.means for f in sources], axis=1),
            np.concatenate([f.covariances for f in sources], axis=2),
        )
        return union, w
    if rule == "cu-modes":
        return _modes(sources, weights, prune, **chosen)
    sources = [Mixtures(f.log_weights, f.means, f.covariances * chosen["alpha"]) for f in sources]
    w = _weights(rule, sources, chosen) if weights is None else weights
    return _means(rule, sources, w, chosen), w


def _options(rule: str, given: dict[str, Any], N: int, n: int) -> dict[str, Any]:
    """The options of a rule of `MIXTURE_RULES`, checked and complete; those of another as they are."""
    if rule not in MIXTURE_RULES:
        if rule not in RULES:
            raise RuleError(
                f"unknown rule {rule!r}: one of {', '.join([*MIXTURE_RULES, *(set(RULES) - {*MIXTURE_RULES})])}"
            )
        return given
    known = MIXTURE_RULES[rule].options
    for name in given:
        if name not in known:
            raise RuleError(f"rule {rule!r} has no option {name!r}: it has {', '.join(known)}")
    out = {**known, **given}
    criterion = out.pop("criterion")
    criteria = CRITERIA if "samples" in known else ("det", "trace")
    if rule != "aa" and criterion not in criteria:
        raise RuleError(f"criterion {criterion!r}: one of {', '.join(criteria)}")
    if out.get("cross_terms", "dropped") not in ("dropped", "sampled"):
        raise RuleError(f"cross_terms {out['cross_terms']!r}: one of dropped, sampled")
    if "gate" in out and not (isinstance(out["gate"], float) and 0.0 < out["gate"] < 1.0):
        raise RuleError(f"gate {out['gate']!r}: a probability between 0 and 1")
    return {**checked(rule, out, N, n, (1,), last=True), "criterion": criterion}


def _moments(sources: Sequence[Mixtures]) -> tuple[FloatArray, FloatArray]:
    """(N, n, B) and (N, n, n, B)."""
    both = [f.moments() for f in sources]
    return np.stack([b[0] for b in both]), np.stack([b[1] for b in both])


def _weights(rule: str, sources: Sequence[Mixtures], chosen: dict[str, Any]) -> FloatArray:
    criterion = chosen["criterion"]
    if criterion == "chernoff-mixture":
        return chernoff_mixtures(sources, chosen["samples"], chosen["seed"])
    if criterion == "chernoff":
        return chernoff_gaussians(*_moments(sources))
    return fuse_last("hmd-ga" if rule == "hmd-s" else "ci", *_moments(sources), criterion=criterion).weights


def _means(rule: str, sources: Sequence[Mixtures], w: FloatArray, chosen: dict[str, Any]) -> Mixtures:
    """gm-ga, gmd-s and hmd-s."""
    q = power_product(sources, w)
    if rule == "gm-ga" and chosen["cross_terms"] == "dropped":
        return q
    z = draws(len(q.means), chosen["samples"], chosen["seed"])
    shape = [len(f.log_weights) for f in sources]
    part, element = np.nonzero(q.log_weights > q.log_weights.max(axis=0) + NEGLIGIBLE)
    logs = np.full_like(q.log_weights, -np.inf)
    few = np.zeros(logs.shape, dtype=np.bool_)
    means, covariances = q.means.copy(), q.covariances.copy()
    step = max(1, (1 << 19) // (z.shape[1] * sum(shape)))
    for i in range(0, len(part), step):
        p, b = part[i : i + step], element[i : i + step]
        ratio = _Ratio(rule, [f.take(b) for f in sources], w[:, b], np.unravel_index(p, shape))
        mass, x, P, effective = sampled_moments(q.means[:, p, b], q.covariances[:, :, p, b], ratio, z)
        logs[p, b] = q.log_weights[p, b] + mass
        few[p, b] = ~(effective >= FEW)
        good = ~few[p, b]
        means[:, p[good], b[good]], covariances[:, :, p[good], b[good]] = x[:, good], P[..., good]
    heavy = (few & (logs > log_sum(logs) + np.log(LIGHT))).any(axis=0)
    logs[:, ~np.isfinite(q.log_weights.max(axis=0))] = np.nan
    logs[:, heavy] = np.nan
    return Mixtures(logs, means, covariances)


class _Ratio:
    """log of part / q at x (n, S, K), for K parts at once."""

    def __init__(
        self, rule: str, sources: Sequence[Mixtures], w: FloatArray, choice: tuple[NDArray[np.intp], ...]
    ) -> None:
        self.rule, self.w, self.sources = rule, w, sources
        self.choice = choice
        self.factors = [linalg.ldl(f.covariances) for f in sources]

    def __call__(self, x: FloatArray) -> FloatArray:
        k = np.arange(x.shape[-1])
        out: FloatArray = np.zeros(x.shape[1:])
        inverse = []
        for f, (L, d), w, c in zip(self.sources, self.factors, self.w, self.choice, strict=True):
            parts = np.stack(
                [
                    f.log_weights[j] + log_gaussian(x - f.means[:, None, j], L[:, :, None, j], d[:, None, j])
                    for j in range(len(f.log_weights))
                ]
            )
            whole, own, used = log_sum(parts), parts[c, :, k].T, w > 0.0
            if self.rule == "gm-ga":
                out += np.where(used, w * whole - log_sum(w * parts), 0.0)
            elif self.rule == "gmd-s":
                out += np.where(used, (1.0 - w) * (own - whole), 0.0)
            else:
                out += np.where(used, (1.0 - w) * own - whole, 0.0)
                inverse.append(np.where(used, np.log(w) - whole, -np.inf))
        return out - log_sum(np.stack(inverse)) if inverse else out


def _modes(
    sources: Sequence[Mixtures], weights: FloatArray | None, prune: float, criterion: str, gate: float
) -> tuple[Mixtures, FloatArray]:
    """cu-modes. What will be pruned, which the weights tell, is not computed."""
    N, n, B = len(sources), len(sources[0].means), len(sources[0])
    w = np.full((N, B), 1.0 / N) if weights is None else weights
    choice = np.indices([len(f.log_weights) for f in sources]).reshape(N, -1)
    logs = total(np.stack([f.log_weights[c] for f, c in zip(sources, choice, strict=True)]))
    light = (logs < log_sum(logs) + np.log(prune)) & (logs < logs.max(axis=0))
    logs = np.where(light, -np.inf, logs)
    part, b = np.nonzero(~np.isneginf(logs))
    x = np.stack([f.means[:, c[part], b] for f, c in zip(sources, choice, strict=True)])
    P = np.stack([f.covariances[:, :, c[part], b] for f, c in zip(sources, choice, strict=True)])
    limit = 2.0 * gammaincinv(n / 2.0, gate)
    conflict = np.zeros(len(part), dtype=np.bool_)
    for i in range(N):
        for j in range(i):
            conflict |= linalg.quadratic(P[i] + P[j], x[i] - x[j]) > limit
    means = np.zeros((n, *logs.shape))
    covariances = np.zeros((n, n, *logs.shape))
    covariances[range(n), range(n)] = 1.0
    for rule, at in (("ci", ~conflict), ("cu", conflict)):
        given = w[:, b[at]] if rule == "cu" or weights is not None else None
        fused = fuse_last(rule, x[..., at], P[..., at], given, criterion=criterion)
        means[:, part[at], b[at]], covariances[:, :, part[at], b[at]] = fused.mean, fused.covariance
    return Mixtures(logs, means, covariances), w
