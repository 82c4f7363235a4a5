"""Does the target exist, and how many are there: fusing what the sources say about number (Uney).

A source's random finite set has a cardinality distribution and localisation densities. The exponential mixture of two
such sets multiplies the fused cardinality by the overlap z = int prod rho_i^w_i <= 1 of the localisation densities
(Uney (15)), so that 0.8 and 0.8 from two sensors with different aspects become less than one half: it loses targets,
and the more the sensors differ the surer. Fusing number and place apart does not (Uney P4): the fused distribution is
then the weighted geometric mean of the cardinality distributions alone, with the weights that put it equally far from
both, and never outside them. For existence and for a Poisson rate this has a closed form. Methods:

* "consistent": P4. For N sources, of one parameter, the smallest and the largest decide: the rest lies between;
* "average": the arithmetic mean;
* "geometric": the exponential mixture with its z, kept to show what it loses.

`loses_*` say where the exponential mixture would have lost a target, that is, gives a number less belief than any of
the sources does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.densities import chernoff_discrete
from fusion_service.errors import FusionError

__all__ = [
    "ExistenceError",
    "cardinality_map",
    "cardinality_mean",
    "fuse_cardinality",
    "fuse_existence",
    "fuse_poisson",
    "loses_cardinality",
    "loses_existence",
    "loses_rate",
    "loss_bound",
    "loss_threshold",
    "lower_existence",
]

METHODS = ("consistent", "average", "geometric")


class ExistenceError(FusionError, ValueError):
    """Numbers that are no probabilities, rates or weights: one line that says which."""


def fuse_existence(
    r: ArrayLike, method: str = "consistent", *, weights: ArrayLike | None = None, overlap: ArrayLike | None = None
) -> Floats:
    """Existence probability (...) from those of N sources, r (..., N).

    "consistent" (Uney (50), (51)) for smallest a and largest b: with u = ln((1-a)/(1-b)) and v = ln(b/a) it is
    u / (u + v), and a itself where a = b, where (50) is 0/0. Takes no weights. A source that is certain decides; 0
    and 1 together give 1/2, the limit of e and 1 - e.

    "average": sum w_i r_i. "geometric" (Uney (21)): prod r_i^w_i z / (prod (1-r_i)^w_i + prod r_i^w_i z) with
    z = `overlap` (...), which it needs. `weights` (..., N), uniform if not given.

    Raises ExistenceError for what is no probability or weight, an unknown method, and under "geometric" for sources
    that are certain of the contrary.
    """
    p = _array("existence", r, 1, 1.0)
    if _check(method, weights, overlap) == "consistent":
        a, b = p.min(axis=-1), p.max(axis=-1)
        with np.errstate(all="ignore"):
            out = 1.0 / (1.0 + _log_ratio(b, a) / _log_ratio(1.0 - a, 1.0 - b, b - a))
        out = np.where((a == 0.0) & (b == 1.0), 0.5, np.where(a == b, a, np.where(b == 1.0, 1.0, out)))
        return np.asarray(np.clip(out, a, b))
    w = _weights(weights, p.shape)
    if method == "average":
        return _clip_between(_sum(w * p), p)
    with np.errstate(divide="ignore"):
        there = _power(np.log(p), w) + np.log(_array("overlap", overlap, 0, 1.0))
        gone = _power(np.log1p(-p), w)
    top = np.maximum(there, gone)
    if np.isneginf(top).any():
        raise ExistenceError("sources that are certain contradict each other: their exponential mixture does not exist")
    return np.asarray(np.exp(there - top) / (np.exp(there - top) + np.exp(gone - top)))


def fuse_poisson(
    rates: ArrayLike, method: str = "consistent", *, weights: ArrayLike | None = None, overlap: ArrayLike | None = None
) -> Floats:
    """Expected number (...) from those of N Poisson sources, rates (..., N), not negative.

    "consistent" (Uney (52), (53), corrected): the logarithmic mean (b - a) / ln(b/a) of the smallest and the largest.
    "geometric" (Uney (30), with the z it lacks): prod lambda_i^w_i z.

    Raises ExistenceError for what is no rate or weight.
    """
    x = _array("rates", rates, 1, np.inf)
    if _check(method, weights, overlap) == "consistent":
        a, b = x.min(axis=-1), x.max(axis=-1)
        with np.errstate(all="ignore"):
            out = np.where(a == b, a, np.where(a == 0.0, 0.0, (b - a) / _log_ratio(b, a)))
        return np.asarray(np.clip(out, a, b))
    w = _weights(weights, x.shape)
    if method == "average":
        return _clip_between(_sum(w * x), x)
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(_power(np.log(x), w)) * _array("overlap", overlap, 0, 1.0))


def fuse_cardinality(
    pmfs: ArrayLike, method: str = "consistent", *, weights: ArrayLike | None = None, overlap: ArrayLike | None = None
) -> tuple[Floats, Floats]:
    """Cardinality distribution p (..., K) and weights w (..., N) from pmfs (..., N, K) over 0 ... K-1 targets.

    "consistent" (Uney (37), Algorithm 2 corrected): p ~ prod p_i^w_i with the Chernoff weights. "geometric": the same
    product at `weights` times z^n, z = `overlap` (...) (Uney (15), (28), IID clusters). What one source excludes the
    product excludes. Raises ExistenceError where nothing is left.
    """
    p = _array("pmfs", pmfs, 2, 1.0)
    if (np.abs(p.sum(axis=-1) - 1.0) > 1e-9).any():
        raise ExistenceError("a cardinality distribution does not sum to 1")
    _check(method, weights, overlap)
    *batch, N, K = p.shape
    if method == "average":
        w = _weights(weights, (*batch, N))
        out = np.zeros((*batch, K))
        for i in range(N):
            out += w[..., i, None] * p[..., i, :]
        return out, w
    with np.errstate(divide="ignore"):
        logs = np.log(p)
    common = np.asarray(p.min(axis=-2) > 0.0)
    if not common.any(axis=-1).all():
        raise ExistenceError("no number of targets is possible for all sources")
    logs = np.where(common[..., None, :], logs, 0.0)
    base = np.where(common, 0.0, -np.inf)
    if method == "consistent":
        w = chernoff_discrete(linalg.to_last(logs, 2), linalg.to_last(base, 1)).T.reshape(*batch, N)
    else:
        w = _weights(weights, (*batch, N))
        with np.errstate(divide="ignore"):
            log_z = np.log(_array("overlap", overlap, 0, 1.0))
        base = base + np.where(np.arange(K) > 0, np.arange(K) * np.maximum(log_z, -1e9)[..., None], 0.0)
    return _softmax(base + _power(logs.swapaxes(-1, -2), w[..., None, :])), w


def cardinality_map(p: ArrayLike) -> Ints:
    """Most probable number (...) of p (..., K); the smallest of equals. Raises ExistenceError for no probabilities."""
    return np.asarray(_array("pmf", p, 1, 1.0).argmax(axis=-1))


def cardinality_mean(p: ArrayLike) -> Floats:
    """Expected number (...) of p (..., K). Raises ExistenceError for what are no probabilities."""
    a = _array("pmf", p, 1, 1.0)
    return _sum(a * np.arange(a.shape[-1]))


def lower_existence(r: ArrayLike, p: ArrayLike) -> Floats:
    """Existence (...) after a scan without a report where the detection probability is p: r (1-p) / (1 - r p).

    Raises ExistenceError for what are no probabilities.
    """
    a, b = _array("existence", r, 0, 1.0), _array("detection probability", p, 0, 1.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(a * b < 1.0, a * (1.0 - b) / (1.0 - a * b), 0.0))


def loses_existence(r: ArrayLike, overlap: ArrayLike, weights: ArrayLike | None = None) -> Bools:
    """Where (...) the exponential mixture of r (..., N) believes less in the target than every source (Uney (17)).

    Raises ExistenceError as `fuse_existence`.
    """
    fused = fuse_existence(r, "geometric", weights=weights, overlap=overlap)
    return _below(fused, _array("existence", r, 1, 1.0).min(axis=-1))


def loses_rate(rates: ArrayLike, overlap: ArrayLike, weights: ArrayLike | None = None) -> Bools:
    """Where (...) the exponential mixture of Poissons expects fewer than every source (Uney (31)).

    Uney's (32), z < min / max of the rates, is sufficient for that but not necessary. Raises ExistenceError as
    `fuse_poisson`.
    """
    fused = fuse_poisson(rates, "geometric", weights=weights, overlap=overlap)
    return _below(fused, _array("rates", rates, 1, np.inf).min(axis=-1))


def loses_cardinality(pmfs: ArrayLike, overlap: ArrayLike, weights: ArrayLike | None = None) -> Bools:
    """For which numbers (..., K) the exponential mixture of IID clusters is below every source (Uney (17), (33)).

    Raises ExistenceError as `fuse_cardinality`.
    """
    fused, _ = fuse_cardinality(pmfs, "geometric", weights=weights, overlap=overlap)
    return _below(fused, _array("pmfs", pmfs, 2, 1.0).min(axis=-2))


def loss_bound(pmfs: ArrayLike, scales: ArrayLike, weights: ArrayLike | None = None) -> Floats:
    """The scale (..., K) that z(n) must stay below for number n to be lost, with the other scales as they are.

    pmfs (..., N, K), scales (..., K) the z(n) of Uney (14), z(0) = 1: Uney (18). For IID clusters scales = z^n, and
    the n-th root is then compared with z as in (33). Infinite where the weighted geometric mean is not above the least.
    Raises ExistenceError for what are no probabilities or weights.
    """
    p, z = _array("pmfs", pmfs, 2, 1.0), _array("scales", scales, 1, 1.0)
    w = _weights(weights, p.shape[:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.exp(_power(np.log(p).swapaxes(-1, -2), w[..., None, :]))
        terms = mean * z
        rest = _sum(terms)[..., None] - terms
        bound = rest / (mean / p.min(axis=-2) - mean)
    return np.asarray(np.where(np.isnan(bound), np.inf, bound))


def loss_threshold(pmfs: ArrayLike, overlap: ArrayLike, weights: ArrayLike | None = None) -> Floats:
    """The number of targets (...) above which every number is lost by IID clusters (Uney (34)).

    ln(N gamma) / ln z with N = sum prod p_i^w_i z^n and gamma = min_n min_i p_i / prod p_i^w_i, of numbers that all
    sources allow. Infinite for z = 1: nothing need be lost.
    Raises ExistenceError for what are no probabilities or weights.
    """
    p, z = _array("pmfs", pmfs, 2, 1.0), _array("overlap", overlap, 0, 1.0)
    w = _weights(weights, p.shape[:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.exp(_power(np.log(p).swapaxes(-1, -2), w[..., None, :]))
        gamma = np.where(mean > 0.0, p.min(axis=-2) / mean, np.inf).min(axis=-1)
        norm = _sum(mean * z[..., None] ** np.arange(p.shape[-1]))
        return np.asarray(np.where(z < 1.0, np.log(norm * gamma) / np.log(z), np.inf))


def _array(name: str, value: Any, axes: int, most: float) -> Floats:
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ExistenceError(f"{name} is not an array of numbers: {error}") from None
    if out.ndim < axes or (axes and not all(out.shape[-axes:])):
        raise ExistenceError(f"{name} has shape {out.shape}: at least {axes} axes that are not empty")
    if not ((out >= 0.0) & (out <= most) & np.isfinite(out)).all():
        raise ExistenceError(f"{name} must be finite and {'between 0 and 1' if most == 1.0 else 'not negative'}")
    return out


def _check(method: str, weights: ArrayLike | None, overlap: ArrayLike | None) -> str:
    if method not in METHODS:
        raise ExistenceError(f"unknown method {method!r}: one of {', '.join(METHODS)}")
    if method == "consistent" and weights is not None:
        raise ExistenceError("the consistent method finds its own weights")
    if (overlap is not None) != (method == "geometric"):
        raise ExistenceError("the overlap z goes with the geometric method, and no other")
    return method


def _weights(weights: ArrayLike | None, shape: tuple[int, ...]) -> Floats:
    if weights is None:
        return np.full(shape, 1.0 / shape[-1])
    w = _array("weights", weights, 1, 1.0)
    try:
        w = np.broadcast_to(w, shape)
    except ValueError:
        raise ExistenceError(f"weights {w.shape} do not fit {shape}") from None
    if (np.abs(w.sum(axis=-1) - 1.0) > 1e-9).any():
        raise ExistenceError("weights must sum to 1 over the sources")
    return w


def _sum(a: Floats) -> Floats:
    """Over the last axis, in its order."""
    return linalg.total(np.moveaxis(a, -1, 0))


def _power(logs: Floats, w: Floats) -> Floats:
    """sum_i w_i logs_i over the last axis, where a weight of 0 counts for nothing."""
    with np.errstate(invalid="ignore"):
        return _sum(np.where(w > 0.0, w * logs, 0.0))


def _log_ratio(b: Floats, a: Floats, difference: Floats | None = None) -> Floats:
    """ln(b / a) for b >= a, to full precision where they are close."""
    d = b - a if difference is None else difference
    return np.asarray(np.where(b > 2.0 * a, np.log(b) - np.log(a), np.log1p(d / a)))


def _below(value: Floats, least: Floats) -> Bools:
    """By more than rounding."""
    return np.asarray(value < least * (1.0 - 1e-12))


def _clip_between(value: Floats, of: Floats) -> Floats:
    return np.asarray(np.clip(value, of.min(axis=-1), of.max(axis=-1)))


def _softmax(logs: Floats) -> Floats:
    e = np.exp(logs - logs.max(axis=-1, keepdims=True))
    return np.asarray(e / _sum(e)[..., None])
