"""Fusion rules as studies name them: `ci`, `ci:criterion=trace`, `bci:max_correlation=0.5`, `my_rule.py:fuse`.

A rule of your own is a function in a Python file, as a config and `replay` take it (`fusion_service.rules.face.own`):
means (B, N, n), covariances (B, N, n, n) -> mean (B, n), covariance (B, n, n).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.errors import FusionError
from fusion_service.rules import RULES, Fused, RuleError, fuse_last, is_own, load_own
from fusion_service.rules.face.own import OwnRule, loaded, own_fuse

__all__ = ["Fuser", "OwnRuleError", "fuser"]


class OwnRuleError(FusionError):
    """A rule of the user's own failed or gave something else than a mean and a covariance; one line."""


@dataclass(frozen=True, slots=True)
class Fuser:
    """A rule with its options; `weights`: "uniform", or None to let the rule choose. `own`: one of your own, and
    `text`: how the command line named it, by which another process finds it again."""

    label: str
    rule: str = ""
    options: tuple[tuple[str, Any], ...] = ()
    weights: str | None = None
    own: OwnRule | None = None
    text: str = ""

    def __reduce__(self) -> tuple[Any, ...]:
        if self.text:
            return fuser, (self.text,)
        return Fuser, (self.label, self.rule, self.options, self.weights, self.own)

    def __call__(self, means: Floats, covariances: Floats) -> Fused:
        """Fuse means (N, n, B) and covariances (N, n, n, B): mean (n, B), covariance (n, n, B), weights (N, B)."""
        if self.own is not None:
            x, P = (np.ascontiguousarray(np.moveaxis(part, -1, 0)) for part in (means, covariances))
            try:
                given = own_fuse(self.own, x, P, dict(self.options))
            except RuleError as error:
                raise OwnRuleError(str(error)) from error
            mean, covariance, chosen = (np.moveaxis(part, 0, -1).copy() for part in given)
            return Fused(mean, covariance, chosen, None)
        N, _, B = means.shape
        uniform = np.full((N, B), 1.0 / N) if self.weights == "uniform" else None
        return fuse_last(self.rule, means, covariances, uniform, **dict(self.options))


def fuser(text: str) -> Fuser:
    """The rule that `text` names; ValueError of one line for what is no rule."""
    if is_own(text):
        return _own(text)
    name, _, rest = text.partition(":")
    if name not in RULES:
        raise ValueError(f"unknown rule {name!r}: one of {', '.join(RULES)}, or FILE.py:FUNCTION")
    options = _options(text, rest, [*RULES[name].options, "weights"])
    weights = options.pop("weights", None)
    one = Fuser(text, name, tuple(options.items()), weights)
    try:
        one(np.zeros((2, 2, 1)), np.stack([np.eye(2)[..., None]] * 2))
    except RuleError as error:
        raise ValueError(f"rule {text!r}: {error}") from None
    return one


def _options(text: str, rest: str, known: list[str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if not equals or key not in known:
            raise ValueError(f"rule {text!r}: {part!r} is not KEY=VALUE with one of {', '.join(known) or 'none'}")
        options[key] = _value(value)
    return options


def _value(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _own(text: str) -> Fuser:
    rule, rest = load_own(text)
    own = loaded(rule.name)
    assert own is not None
    label = f"{own.path.stem}.{own.function.__name__}" + (f":{rest}" if rest else "")
    return Fuser(label, rule.name, tuple(_options(text, rest, list(rule.options)).items()), own=own, text=text)
