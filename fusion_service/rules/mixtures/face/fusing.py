"""Fusing mixtures by a rule of the folder, or by a rule for Gaussians on the sources' moments."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_service.arrays import Floats
from fusion_service.densities import DensityError, Mixture, Mixtures, reduce_mixtures
from fusion_service.rules.base.options import Case, RuleError, array, checked
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.face.gaussians import fuse_last
from fusion_service.rules.face.registry import RULES, collect
from fusion_service.rules.mixtures.base.source_moments import source_moments

__all__ = ["MIXTURE_RULES", "fuse_mixtures", "fuse_mixtures_last"]

MOST = 1 << 16
"""Components that a product may have before reduction."""
AT_ONCE = 1 << 18
"""Components of products in one block of elements."""

MIXTURE_RULES: Mapping[str, MixtureRule] = collect(
    MixtureRule, Path(__file__).parents[1], "fusion_service.rules.mixtures"
)
"""The rules for mixtures, by name."""

Method = Callable[[Sequence[Mixtures], Floats | None, float], tuple[Mixtures, Floats]]


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
    w: Floats | str | None
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
    weights: Floats | str | None = None,
    *,
    max_components: int | None = None,
    prune: float = 0.0,
    reduction: str = "runnalls",
    normalise: bool = True,
    **options: Any,
) -> tuple[Mixtures, Floats]:
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
    declared = MIXTURE_RULES.get(rule)
    method = _by_moments(rule, options) if declared is None else _by_rule(declared, options, N, n)
    if normalise:
        sources = [f.normalised() for f in sources]
    elif declared is None or not declared.intensities:
        raise RuleError(f"rule {rule!r} fuses densities, not intensities")
    size = prod(len(f.log_weights) for f in sources) if declared is not None and declared.multiplies else 1
    if size > MOST:
        raise RuleError(f"the product of the sources has {size} components, more than {MOST}: reduce them first")
    if declared is None and weights is not None and not RULES[rule].takes_weights:
        raise RuleError(f"rule {rule!r} takes no weights")

    def block(at: slice) -> tuple[Mixtures, Floats]:
        some = [Mixtures(f.log_weights[:, at], f.means[..., at], f.covariances[..., at]) for f in sources]
        out, w = method(some, None if weights is None else weights[:, at], prune)
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


def _by_rule(rule: MixtureRule, given: dict[str, Any], N: int, n: int) -> Method:
    return partial(rule.fuse, **checked(rule.takes, given, Case(rule.name, N, n, (1,), last=True)))


def _by_moments(rule: str, options: dict[str, Any]) -> Method:
    """By a rule for Gaussians, whose options `fuse_last` checks."""
    if rule not in RULES:
        raise RuleError(f"unknown rule {rule!r}: one of {', '.join(dict.fromkeys([*MIXTURE_RULES, *RULES]))}")

    def method(sources: Sequence[Mixtures], weights: Floats | None, prune: float) -> tuple[Mixtures, Floats]:
        fused = fuse_last(rule, *source_moments(sources), weights, **options)
        zero = np.zeros_like(fused.mean[:1])
        return Mixtures(zero, fused.mean[:, None], fused.covariance[:, :, None]), fused.weights

    return method
