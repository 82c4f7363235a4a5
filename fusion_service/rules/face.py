"""The face of the rules: the registry, the checks at the border, and the road a fusion takes.

Every fusion is computed in float64. Where the matrices inverted on the way are so ill-conditioned that
the result could be wrong by more than about 1e-8, or weights cannot be certified as optimal, that one
fusion is computed again in longdouble; where even this could be wrong by more than 1e-6 it is refused.
(Where longdouble is no wider than double, everything that needs it is refused.)
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import linalg
from ..linalg import FloatArray
from .harmonic import hmd_ga
from .intersection import bci, ci
from .product import naive
from .simplex import GAP
from .sources import Result, Sources

FAST_CONDITION = 1e7
SAFE_CONDITION = 4e12 if np.finfo(np.longdouble).eps < 2e-19 else 0.0
"""Largest condition (see `sources.condition`) accepted in float64 and in longdouble."""
CRITERIA = ("det", "trace")


class RuleError(ValueError):
    """What a fusion was asked for cannot be done: one line that says what, where and why."""


@dataclass(frozen=True, slots=True)
class Fused:
    """Fused Gaussians. Batch first from `fuse`, as below; batch last from `fuse_last`."""

    mean: FloatArray
    """(..., n)"""
    covariance: FloatArray
    """(..., n, n), exactly symmetric, positive definite"""
    weights: FloatArray
    """(..., N), the weights of the rule's own formula; NaN where it has none"""
    influence: FloatArray | None
    """(..., N): trace(K_i) / n, K_i the gain of source i in the fused mean, weights held. Sums to 1. None
    unless asked for with `influence=True`."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A fusion rule, for people and programs to choose by."""

    name: str
    promise: str
    n_way: bool
    options: Mapping[str, Any]
    """Option names with their defaults."""
    source: str
    takes_weights: bool = True


_FUNCTIONS: dict[str, Callable[..., Result]] = {"naive": naive, "ci": ci, "bci": bci, "hmd-ga": hmd_ga}

RULES: Mapping[str, Rule] = MappingProxyType(
    {
        rule.name: rule
        for rule in (
            Rule("naive", "right only for independent tracks", True, {}, "product of the densities", False),
            Rule(
                "ci",
                "conservative for every correlation",
                True,
                {"criterion": "det"},
                "covariance intersection (Julier and Uhlmann 1997; Sharma (4); Li-AA)",
            ),
            Rule(
                "bci",
                "conservative for every correlation within the bound; tight for two sources",
                True,
                {"criterion": "det", "max_correlation": 1.0},
                "bounded covariance inflation (Reece and Roberts 2005), N-way",
            ),
            Rule(
                "hmd-ga",
                "tight; none in general",
                True,
                {"criterion": "det", "constants": True},
                "harmonic mean density, Gaussian approximation: Sharma (31), (77); Dubey (14)-(22)",
            ),
        )
    }
)


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
    a rule are in `RULES[rule].options`. Identical sources come back unchanged under `ci` and `hmd-ga`.

    Raises RuleError for an unknown rule or option, shapes or weights that do not fit, NaN or infinity, a
    covariance that is not symmetric positive definite, and input so ill-conditioned (a correlation matrix
    with a condition number beyond about 1e12) that the result could be wrong by more than 1e-6.
    """
    x, P = _array("means", means), _array("covariances", covariances)
    if x.ndim < 2 or P.ndim < 3 or x.shape != P.shape[:-1] or P.shape[-1] != P.shape[-2]:
        raise RuleError(
            f"means {x.shape} and covariances {P.shape} do not fit: expected (..., N, n) and (..., N, n, n)"
        )
    *batch, N, n = x.shape
    if not N or not n:
        raise RuleError(f"means {x.shape}: at least one source and one component are needed")
    shape = tuple(batch)
    xs, Ps = linalg.to_last(x, 2), linalg.to_last(P, 3)
    w = _weights(rule, weights, (*shape, N))
    _symmetric(Ps, shape)
    fused = fuse_last(rule, xs, Ps, w, influence=influence, **options)
    if not (np.isfinite(fused.covariance[0, 0]).all() and np.isfinite(fused.mean).all()):
        raise RuleError(_complaint(xs, Ps, fused, shape))
    return Fused(
        linalg.to_first(fused.mean, shape, 1),
        linalg.to_first(fused.covariance, shape, 2),
        linalg.to_first(fused.weights, shape, 1),
        None if fused.influence is None else linalg.to_first(fused.influence, shape, 1),
    )


def fuse_last(
    rule: str,
    means: FloatArray,
    covariances: FloatArray,
    weights: FloatArray | None = None,
    *,
    influence: bool = False,
    **options: Any,
) -> Fused:
    """`fuse` for callers that have checked their input: batch-last, and data are not looked at again.

    `means` (N, n, B), `covariances` (N, n, n, B) of which the lower triangles are read, `weights` (N, B) or
    None. Returns mean (n, B), covariance (n, n, B), weights and influence (N, B). What cannot be fused
    (not positive definite, too ill-conditioned) becomes NaN, that element only; no element's bits depend
    on the others. Raises RuleError for an unknown rule or option, and nothing else.
    """
    N, n, size = means.shape
    function, chosen = _FUNCTIONS.get(rule), _options(rule, N, options)
    assert function is not None
    fused = Fused(
        np.empty((n, size)),
        np.empty((n, n, size)),
        np.empty((N, size)),
        np.empty((N, size)) if influence else None,
    )
    with np.errstate(all="ignore"):
        for part in linalg.blocks(n, size, max(N, 4)):
            w = None if weights is None else weights[:, part]
            sources = Sources.of(means[..., part], covariances[..., part])
            result = function(sources, w, influence, **chosen)
            _store(fused, part, result)
            doubtful = ~((result.condition <= FAST_CONDITION) & (result.gap <= GAP) & sources.definite)
            if doubtful.any():
                at = np.flatnonzero(doubtful)
                again = _safely(function, means[..., part][..., at], covariances[..., part][..., at],
                                None if w is None else w[:, at], influence, chosen)  # fmt: skip
                _store(fused, at + part.start, again)
    return fused


def _safely(
    function: Callable[..., Result],
    means: FloatArray,
    covariances: FloatArray,
    weights: FloatArray | None,
    influence: bool,
    chosen: dict[str, Any],
) -> Result:
    """In longdouble; NaN where this is not good enough."""
    wide = np.longdouble
    sources = Sources.of(means.astype(wide), covariances.astype(wide))
    result = function(sources, None if weights is None else weights.astype(wide), influence, **chosen)
    bad = ~((result.condition <= SAFE_CONDITION) & (result.gap <= GAP) & sources.definite)
    for a in (result.mean, result.covariance, result.weights, result.influence):
        if a is not None:
            a[..., bad] = np.nan
    return result


def _store(fused: Fused, at: Any, result: Result) -> None:
    fused.mean[:, at] = result.mean
    fused.covariance[:, :, at] = result.covariance
    fused.weights[:, at] = result.weights
    if fused.influence is not None and result.influence is not None:
        fused.influence[:, at] = result.influence


def _options(rule: str, N: int, given: dict[str, Any]) -> dict[str, Any]:
    if rule not in RULES:
        raise RuleError(f"unknown rule {rule!r}: one of {', '.join(RULES)}")
    known = RULES[rule].options
    for name in given:
        if name not in known:
            raise RuleError(f"rule {rule!r} has no option {name!r}: it has {', '.join(known) or 'none'}")
    chosen = {**known, **given}
    if chosen.get("criterion", "det") not in CRITERIA:
        raise RuleError(f"criterion {chosen['criterion']!r}: one of {', '.join(CRITERIA)}")
    if "max_correlation" in chosen:
        chosen["max_correlation"] = _bound(chosen["max_correlation"], N)
    return chosen


def _bound(value: Any, N: int) -> FloatArray:
    R = _array("max_correlation", value)
    if R.shape not in ((), (N, N)):
        raise RuleError(f"max_correlation has shape {R.shape}: a number or ({N}, {N}) is needed")
    if not ((R >= 0.0) & (R <= 1.0)).all():
        raise RuleError("max_correlation must lie between 0 and 1")
    if R.ndim and not ((R == R.T).all() and (R.diagonal() == 1.0).all()):
        raise RuleError("max_correlation must be symmetric with ones on its diagonal")
    return R


def _array(name: str, value: Any) -> FloatArray:
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RuleError(f"{name} are not an array of numbers: {error}") from None
    return out


def _weights(rule: str, weights: ArrayLike | str | None, shape: tuple[int, ...]) -> FloatArray | None:
    if weights is None:
        return None
    if rule in RULES and not RULES[rule].takes_weights:
        raise RuleError(f"rule {rule!r} takes no weights")
    if isinstance(weights, str):
        if weights != "uniform":
            raise RuleError(f'weights {weights!r}: "uniform", an array, or None to let the rule choose')
        weights = np.full(shape[-1], 1.0 / shape[-1])
    w = _array("weights", weights)
    try:
        w = np.broadcast_to(w, shape)
    except ValueError:
        raise RuleError(f"weights {w.shape} do not fit {shape} (..., N)") from None
    if not ((w >= 0.0).all() and (np.abs(w.sum(axis=-1) - 1.0) <= 1e-9).all()):
        raise RuleError("weights must be non-negative with sum 1 over the sources")
    return linalg.to_last(w, 1)


def _symmetric(P: FloatArray, batch: tuple[int, ...]) -> None:
    """Raise unless every P (N, n, n, B) is symmetric up to rounding. NaN passes: it is found later."""
    for i in range(1, P.shape[1]):
        a, b = P[:, i, :i], P[:, :i, i]
        if (a == b).all():
            continue
        with np.errstate(all="ignore"):
            limit = 1e-9 * np.sqrt(P[:, i, i, None] * np.moveaxis(P.diagonal(axis1=1, axis2=2), 1, 2)[:, :i])
            bad = np.abs(a - b) > limit
        if bad.any():
            source, _, element = np.argwhere(bad)[0]
            raise RuleError(f"covariance of {_place(source, element, batch)} is not symmetric")


def _complaint(means: FloatArray, covariances: FloatArray, fused: Fused, batch: tuple[int, ...]) -> str:
    """Why an element came back as NaN."""
    definite: NDArray[np.bool_] = linalg.is_positive_definite(covariances.transpose(1, 2, 0, 3))
    for name, bad in (
        ("mean of {} is not finite", ~np.isfinite(means).all(axis=1)),
        ("covariance of {} is not finite", ~np.isfinite(covariances).all(axis=(1, 2))),
        ("covariance of {} is not positive definite", ~definite),
    ):
        if bad.any():
            source, at = np.argwhere(bad)[0]
            return name.format(_place(source, at, batch))
    element = int(np.flatnonzero(~np.isfinite(fused.covariance[0, 0]))[0])
    where = f"batch element {tuple(int(i) for i in np.unravel_index(element, batch))}" if batch else "the input"
    return f"{where} is too ill-conditioned to fuse to within 1e-6"


def _place(source: int, element: int, batch: tuple[int, ...]) -> str:
    at = f" of batch element {tuple(int(i) for i in np.unravel_index(element, batch))}" if batch else ""
    return f"source {int(source)}{at}"
