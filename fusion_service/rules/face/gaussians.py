"""Fusing Gaussians by a rule of the registry: the checks at the border, and the road a fusion takes.

Every fusion is computed in float64. Where the matrices inverted on the way are so ill-conditioned that
the result could be wrong by more than about 1e-8, or weights cannot be certified as optimal, that one
fusion is computed again in longdouble; where even this could be wrong by more than 1e-6 it is refused.
Weights are within 1e-9 of the best value of their criterion; of a fusion in longdouble rounding can hide
that, and 1e-6 is enough there.
(Where longdouble is no wider than double, everything that needs it is refused.)
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import Case, RuleError, array, checked
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.face.registry import RULES
from fusion_service.rules.weights.simplex import GAP

__all__ = ["Fused", "fuse", "fuse_last"]

FAST_CONDITION = 1e7
SAFE_CONDITION = 4e12 if np.finfo(np.longdouble).eps < 2e-19 else 0.0
"""Largest condition (see `linalg.condition`) accepted in float64 and in longdouble."""
SAFE_GAP = 1e-6
"""Optimality gap of the weights that is accepted in longdouble."""


@dataclass(frozen=True, slots=True)
class Fused:
    """Fused Gaussians. Batch first from `fuse`, as below; batch last from `fuse_last`."""

    mean: Floats
    """(..., n)"""
    covariance: Floats
    """(..., n, n), exactly symmetric, positive definite"""
    weights: Floats
    """(..., N), the weights of the rule's own formula; NaN where it has none"""
    influence: Floats | None
    """(..., N): trace(K_i) / n, K_i the gain of source i in the fused mean, weights held. Sums to 1. None
    unless asked for with `influence=True`; NaN for the sampled rules, which have no gain."""


def fuse(
    rule: str,
    means: ArrayLike,
    covariances: ArrayLike,
    *,
    weights: ArrayLike | str | None = None,
    influence: bool = False,
    **options: Any,
) -> Fused:
    """Fuse N Gaussian estimates of the same state, for any batch of states.

    `means` (..., N, n), `covariances` (..., N, n, n). `weights`: None lets the rule choose (by its
    `criterion`), "uniform", or an array that broadcasts to (..., N), non-negative with sum 1. The options of
    a rule are in `RULES[rule].options`. Identical sources come back unchanged under `ci`,
    `fast-ci`, `ici`, `ei`, `hmd-ga`, `aa` and `cu`; not under `naive`, `bci`, `ffcc`, `bar-shalom-campo`.

    Raises RuleError for an unknown rule or option, shapes or weights that do not fit, NaN or infinity, a
    covariance that is not symmetric positive definite, and input so ill-conditioned (a correlation matrix
    with a condition number beyond about 1e12) that the result could be wrong by more than 1e-6.
    """
    x, P = array("means", means), array("covariances", covariances)
    if x.ndim < 2 or P.ndim < 3 or x.shape != P.shape[:-1] or P.shape[-1] != P.shape[-2]:
        raise RuleError(
            f"means {x.shape} and covariances {P.shape} do not fit: expected (..., N, n) and (..., N, n, n)"
        )
    *batch, N, n = x.shape
    if not N or not n:
        raise RuleError(f"means {x.shape}: at least one source and one component are needed")
    shape = tuple(batch)
    declared, chosen = _prepare(Case(rule, N, n, shape, last=False), options)
    w = _weights(rule, weights, (*shape, N))
    size = prod(shape)
    x, P = x.reshape(size, N, n), P.reshape(size, N, n, n)
    if not influence and (made := _at_once(declared, x, P)) is not None:
        nothing = np.full((*shape, N), np.nan)
        return Fused(made[0].reshape(*shape, n), made[1].reshape(*shape, n, n), nothing, None)
    mean, covariance, out_weights = np.empty((size, n)), np.empty((size, n, n)), np.empty((size, N))
    shares = np.empty((size, N)) if influence else None
    for part in _parts(size, N, n):
        xs, Ps = _last(x[part]), _last(P[part])
        _symmetric(Ps, part.start, shape)
        result = _run(declared, xs, Ps, None if w is None else w[part].T, influence, declared.part(chosen, part))
        if not (np.isfinite(result.covariance[0, 0]).all() and np.isfinite(result.mean).all()):
            raise RuleError(_complaint(rule, xs, Ps, result, part.start, shape))
        count = (len(result.condition),)
        linalg.to_first(result.mean, count, 1, mean[part])
        linalg.to_first(result.covariance, count, 2, covariance[part])
        out_weights[part] = result.weights.T
        if shares is not None and result.influence is not None:
            shares[part] = result.influence.T
    return Fused(
        mean.reshape(*shape, n),
        covariance.reshape(*shape, n, n),
        out_weights.reshape(*shape, N),
        None if shares is None else shares.reshape(*shape, N),
    )


def fuse_last(
    rule: str,
    means: Floats,
    covariances: Floats,
    weights: Floats | None = None,
    *,
    influence: bool = False,
    start: Floats | None = None,
    **options: Any,
) -> Fused:
    """`fuse` for callers that have checked their input: batch-last, and data are not looked at again.

    `means` (N, n, B), `covariances` (N, n, n, B) of which the lower triangles are read, `weights` (N, B) or
    None. start (N, B): weights that `ci`, and `bci` of one bound, keep of three sources and more where by their own
    certificate (`ci.KEPT`) the criterion could be smaller by .1 % at most; NaN where there are none. Returns mean
    (n, B), covariance (n, n, B), weights and influence (N, B). What cannot be fused
    (not positive definite, too ill-conditioned) becomes NaN, that element only; no element's bits depend
    on the others. Raises RuleError for an unknown rule or option, and nothing else.
    """
    N, n, size = means.shape
    declared, chosen = _prepare(Case(rule, N, n, (size,), last=True), options)
    fused = Fused(
        np.empty((n, size)),
        np.empty((n, n, size)),
        np.empty((N, size)),
        np.empty((N, size)) if influence else None,
    )
    for part in _parts(size, N, n):
        w = None if weights is None else weights[:, part]
        begin = None if start is None else start[:, part]
        options = declared.part(chosen, part)
        result = _run(declared, means[..., part], covariances[..., part], w, influence, options, begin)
        fused.mean[:, part] = result.mean
        fused.covariance[..., part] = result.covariance
        fused.weights[:, part] = result.weights
        if fused.influence is not None:
            fused.influence[:, part] = result.influence
    return fused


def _at_once(rule: Rule, x: Floats, P: Floats) -> tuple[Floats, Floats] | None:
    """Mean and covariance by the rule's faster road; None where it has none, or cannot do all of these."""
    made = rule.at_once(x, P) if rule.at_once is not None else None
    if made is None:
        return None
    mean, covariance, condition = made
    if not ((condition <= FAST_CONDITION).all() and np.isfinite(mean).all() and np.isfinite(covariance).all()):
        return None
    return mean, covariance


def _last(a: Floats) -> Floats:
    """(B, N, ...) -> (N, ..., B), in memory (..., N, B), as `Sources` has it."""
    size, N, *core = a.shape
    out = np.empty((*core, N, size))
    tall, wide = a.reshape(size, N, -1), out.reshape(-1, N, size)
    for i in range(0, size, linalg.TURN):
        wide[..., i : i + linalg.TURN] = tall[i : i + linalg.TURN].transpose(2, 1, 0)
    return np.moveaxis(out, -2, 0)


def _parts(size: int, N: int, n: int) -> Iterator[slice]:
    return linalg.blocks(n, size, max(N // 2, 1))


def _run(
    rule: Rule,
    means: Floats,
    covariances: Floats,
    weights: Floats | None,
    influence: bool,
    chosen: dict[str, Any],
    start: Floats | None = None,
) -> Result:
    """One block; what float64 cannot carry again in longdouble, and NaN where this is not good enough."""
    with np.errstate(all="ignore"):
        sources = Sources.of(means, covariances, start)
        result = rule.fuse(sources, weights, influence, **chosen)
        limit = FAST_CONDITION if sources.fast else SAFE_CONDITION
        enough = GAP if sources.fast else SAFE_GAP
        doubtful = ~((result.condition <= limit) & (result.gap <= enough) & sources.definite)
        if not doubtful.any():
            return result
        share = None if result.influence is None else np.array(result.influence)
        result = replace(
            result,
            mean=np.array(result.mean),
            covariance=np.array(result.covariance),
            weights=np.array(result.weights),
            influence=share,
        )
        bad = np.flatnonzero(doubtful)
        if sources.fast:
            w = None if weights is None else _wide(weights[:, bad])
            x, P = _wide(means[..., bad]), _wide(covariances[..., bad])
            again = _run(rule, x, P, w, influence, rule.part(chosen, bad))
            _overwrite(result, bad, again.mean, again.covariance, again.weights, again.influence)
        else:
            _overwrite(result, bad, np.nan, np.nan, np.nan, np.nan)
        return result


def _wide(a: Floats) -> Floats:
    out: Any = a.astype(np.longdouble)
    return out  # type: ignore[no-any-return]


def _overwrite(result: Result, at: Ints, mean: Any, covariance: Any, weights: Any, share: Any) -> None:
    result.mean[:, at] = mean
    result.covariance[..., at] = covariance
    result.weights[:, at] = weights
    if result.influence is not None:
        result.influence[:, at] = share


def _prepare(case: Case, given: dict[str, Any]) -> tuple[Rule, dict[str, Any]]:
    """The rule that is asked for, and its options, checked."""
    if case.rule not in RULES:
        raise RuleError(f"unknown rule {case.rule!r}: one of {', '.join(RULES)}")
    return RULES[case.rule], checked(RULES[case.rule].takes, given, case)


def _weights(rule: str, weights: ArrayLike | str | None, shape: tuple[int, ...]) -> Floats | None:
    """(size, N), checked."""
    if weights is None:
        return None
    if not RULES[rule].takes_weights:
        raise RuleError(f"rule {rule!r} takes no weights")
    if isinstance(weights, str):
        if weights != "uniform":
            raise RuleError(f'weights {weights!r}: "uniform", an array, or None to let the rule choose')
        weights = np.full(shape[-1], 1.0 / shape[-1])
    w = array("weights", weights)
    try:
        w = np.broadcast_to(w, shape)
    except ValueError:
        raise RuleError(f"weights {w.shape} do not fit {shape} (..., N)") from None
    if not ((w >= 0.0).all() and (np.abs(w.sum(axis=-1) - 1.0) <= 1e-9).all()):
        raise RuleError("weights must be non-negative with sum 1 over the sources")
    return w.reshape(prod(shape[:-1]), shape[-1])


def _symmetric(P: Floats, start: int, batch: tuple[int, ...]) -> None:
    """Raise unless every P (N, n, n, B) is symmetric up to rounding. NaN passes: it is found later."""
    for i in range(1, P.shape[1]):
        lower, upper = P[:, i, :i], P[:, :i, i]
        if (lower == upper).all():
            continue
        with np.errstate(all="ignore"):
            limit = 1e-9 * np.sqrt(P[:, i, i, None] * np.stack([P[:, k, k] for k in range(i)], axis=1))
            bad = np.abs(lower - upper) > limit
        if bad.any():
            source, _, element = np.argwhere(bad)[0]
            raise RuleError(f"covariance of {_place(source, start + element, batch)} is not symmetric")


def _complaint(
    rule: str, means: Floats, covariances: Floats, result: Result, start: int, batch: tuple[int, ...]
) -> str:
    """Why an element came back as NaN."""
    definite: Bools = linalg.is_positive_definite(covariances.transpose(1, 2, 0, 3))
    for problem, bad in (
        ("mean of {} is not finite", ~np.isfinite(means).all(axis=1)),
        ("covariance of {} is not finite", ~np.isfinite(covariances).all(axis=(1, 2))),
        ("covariance of {} is not positive definite", ~definite),
    ):
        if bad.any():
            source, element = np.argwhere(bad)[0]
            return problem.format(_place(source, start + element, batch))
    element = np.flatnonzero(~np.isfinite(result.covariance[0, 0] + result.mean[0]))[0]
    where = f"batch element {_index(start + element, batch)}" if batch else "the input"
    return f"{where} {RULES[rule].refusal}"


def _index(element: int, batch: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(element, batch))


def _place(source: int, element: int, batch: tuple[int, ...]) -> str:
    return f"source {source}" + (f" of batch element {_index(element, batch)}" if batch else "")
