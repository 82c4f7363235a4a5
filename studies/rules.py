"""Fusion rules as studies name them: `ci`, `ci:criterion=trace`, `bci:max_correlation=0.5`, `my_rule.py:fuse`.

A rule of your own is a function in a Python file, called with the batch last, as `fusion_service.rules.fuse_last`:
means (N, n, B), covariances (N, n, n, B) -> mean (n, B), covariance (n, n, B).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.errors import FusionError
from fusion_service.rules import RULES, Fused, RuleError, fuse_last

__all__ = ["Fuser", "OwnRuleError", "fuser"]


class OwnRuleError(FusionError):
    """A rule of the user's own failed or gave something else than a mean and a covariance; one line."""


@dataclass(frozen=True, slots=True)
class Fuser:
    """A rule with its options; `weights`: "uniform", or None to let the rule choose. `function`: one of your own, and
    `text`: how the command line named it, by which another process finds it again."""

    label: str
    rule: str = ""
    options: tuple[tuple[str, Any], ...] = ()
    weights: str | None = None
    function: Callable[[Floats, Floats], tuple[Floats, Floats]] | None = None
    text: str = ""

    def __reduce__(self) -> tuple[Any, ...]:
        if self.text:
            return fuser, (self.text,)
        return Fuser, (self.label, self.rule, self.options, self.weights, self.function)

    def __call__(self, means: Floats, covariances: Floats) -> Fused:
        """Fuse means (N, n, B) and covariances (N, n, n, B): mean (n, B), covariance (n, n, B), weights (N, B)."""
        if self.function is not None:
            try:
                mean, covariance = map(np.asarray, self.function(means, covariances))
            except Exception as error:
                raise OwnRuleError(f"rule {self.text}: {type(error).__name__}: {error}") from error
            wanted = means.shape[1:], covariances.shape[1:]
            if (mean.shape, covariance.shape) != wanted:
                got = f"{mean.shape} and {covariance.shape}, not {wanted[0]} and {wanted[1]}"
                raise OwnRuleError(f"rule {self.text}: gives mean and covariance of shape {got}")
            return Fused(mean, covariance, np.full(means[:, 0].shape, np.nan), None)
        N, _, B = means.shape
        weights = np.full((N, B), 1.0 / N) if self.weights == "uniform" else None
        return fuse_last(self.rule, means, covariances, weights, **dict(self.options))


def fuser(text: str) -> Fuser:
    """The rule that `text` names; ValueError of one line for what is no rule."""
    name, _, rest = text.partition(":")
    if name.endswith(".py"):
        return _own(Path(name), rest)
    if name not in RULES:
        raise ValueError(f"unknown rule {name!r}: one of {', '.join(RULES)}, or FILE.py:FUNCTION")
    options: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if not equals or (key not in RULES[name].options and key != "weights"):
            known = ", ".join([*RULES[name].options, "weights"])
            raise ValueError(f"rule {text!r}: {part!r} is not KEY=VALUE with one of {known}")
        options[key] = _value(value)
    weights = options.pop("weights", None)
    one = Fuser(text, name, tuple(options.items()), weights)
    try:
        one(np.zeros((2, 2, 1)), np.stack([np.eye(2)[..., None]] * 2))
    except RuleError as error:
        raise ValueError(f"rule {text!r}: {error}") from None
    return one


def _value(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _own(path: Path, name: str) -> Fuser:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise ValueError(f"no file {path} to take a rule from")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"{path} cannot be run: {type(error).__name__}: {error}") from None
    function = getattr(module, name, None)
    if not callable(function):
        raise ValueError(f"{path} has no function {name!r}: write {path}:FUNCTION")
    return Fuser(f"{path.stem}.{name}", function=function, text=f"{path}:{name}")
