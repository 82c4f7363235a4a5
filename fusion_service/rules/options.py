"""The options of the rules, checked at the border: what does not fit is a RuleError of one line."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.errors import FusionError
from fusion_service.linalg import FloatArray

CRITERIA: Mapping[str, tuple[str, ...]] = {
    "hmd-ga": ("det", "trace", "kl"),
    "aa": ("uniform", "diversity", "bound"),
}
"""What a rule's weights may be chosen by; det or trace where nothing is said."""
FEWEST = 200
"""Samples that a sampled rule works with at least."""


class RuleError(FusionError, ValueError):
    """What a fusion was asked for cannot be done: one line that says what, where and why."""


def array(name: str, value: Any) -> FloatArray:
    """`value` as float64; RuleError if it is none."""
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RuleError(f"{name} are not an array of numbers: {error}") from None
    return out


def checked(
    rule: str, options: dict[str, Any], N: int, n: int, batch: tuple[int, ...], *, last: bool
) -> dict[str, Any]:
    """The options as the rule's function takes them; `cross_covariance` becomes (n, n, B).

    `last`: it is batch-last already.
    """
    out = dict(options)
    criteria = CRITERIA.get(rule, ("det", "trace"))
    if out.get("criterion", criteria[0]) not in criteria:
        raise RuleError(f"criterion {out['criterion']!r}: one of {', '.join(criteria)}")
    if "max_correlation" in out:
        out["max_correlation"] = _bound(out["max_correlation"], N)
    if out.get("scales") is not None:
        out["scales"] = _scales(out["scales"], n)
    if "cross_covariance" in out:
        out["cross_covariance"] = _cross(rule, out["cross_covariance"], N, n, batch, last)
    if "delta" in out and not 0.0 < _number("delta", out["delta"]) <= 1.0:
        raise RuleError(f"delta {out['delta']!r}: a number above 0 and at most 1")
    if "alpha" in out and not 1.0 <= _number("alpha", out["alpha"]) < np.inf:
        raise RuleError(f"alpha {out['alpha']!r}: a number of at least 1")
    for name, least in (("samples", FEWEST), ("seed", 0)):
        if name in out and not (isinstance(out[name], int | np.integer) and out[name] >= least):
            raise RuleError(f"{name} {out[name]!r}: a whole number of at least {least}")
    if "bound" in out and out["bound"] not in ("max", "min"):
        raise RuleError(f"bound {out['bound']!r}: one of max, min")
    return out


def at(options: dict[str, Any], index: Any) -> dict[str, Any]:
    """The options of some elements of the batch."""
    if "cross_covariance" not in options:
        return options
    return options | {"cross_covariance": options["cross_covariance"][..., index]}


def _number(name: str, value: Any) -> float:
    a = array(name, value)
    if a.shape:
        raise RuleError(f"{name} has shape {a.shape}: one number is needed")
    return float(a)


def _bound(value: Any, N: int) -> FloatArray:
    R = array("max_correlation", value)
    if R.shape not in ((), (N, N)):
        raise RuleError(f"max_correlation has shape {R.shape}: a number or ({N}, {N}) is needed")
    if not ((R >= 0.0) & (R <= 1.0)).all():
        raise RuleError("max_correlation must lie between 0 and 1")
    if R.ndim and not ((R == R.T).all() and (R.diagonal() == 1.0).all()):
        raise RuleError("max_correlation must be symmetric with ones on its diagonal")
    return R


def _scales(value: Any, n: int) -> FloatArray:
    scales = array("scales", value)
    if scales.shape != (n,) or not ((scales > 0.0) & np.isfinite(scales)).all():
        raise RuleError(f"scales {value!r}: {n} positive numbers, one unit for each component, are needed")
    return scales


def _cross(rule: str, value: Any, N: int, n: int, batch: tuple[int, ...], last: bool) -> FloatArray:
    if N != 2:
        raise RuleError(f"rule {rule!r} takes two sources, not {N}")
    if value is None:
        raise RuleError(f"rule {rule!r} needs the option cross_covariance, E[e_1 e_2'] (..., {n}, {n})")
    cross = array("cross_covariance", value)
    shape = (n, n, *batch) if last else (*batch, n, n)
    if last and cross.ndim == 2:
        cross = cross[..., None]
    try:
        cross = np.broadcast_to(cross, shape)
    except ValueError:
        raise RuleError(f"cross_covariance {cross.shape} does not fit {shape}") from None
    if not last and not np.isfinite(cross).all():
        raise RuleError("cross_covariance is not finite")
    return cross if last else linalg.to_last(cross, 2)
