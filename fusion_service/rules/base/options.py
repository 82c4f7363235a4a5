"""The options of the rules, checked at the border: what does not fit is a RuleError of one line.

An `Option` has a default and a check. A check takes the option's name, the value given and the `Case` it is for, and
returns the value as the rule's function takes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.errors import FusionError

__all__ = [
    "CRITERION",
    "Case",
    "Check",
    "Option",
    "RuleError",
    "array",
    "checked",
    "in_range",
    "number",
    "one_of",
    "whole",
]


class RuleError(FusionError, ValueError):
    """What a fusion was asked for cannot be done: one line that says what, where and why."""


class Case(NamedTuple):
    """What is being fused: N sources of n components, in a batch of a shape; `last`: options are batch-last too."""

    rule: str
    N: int
    n: int
    batch: tuple[int, ...]
    last: bool


Check = Callable[[str, Any, Case], Any]


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a rule: its default, its check (None: anything goes), and, where it may have an element for each
    fusion of the batch, the number of axes that one has (`per_element`): once checked, a value of more axes has the
    batch along its last one."""

    default: Any
    check: Check | None = None
    per_element: int = 0


def array(name: str, value: Any) -> Floats:
    """`value` as float64; RuleError if it is none."""
    try:
        out = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RuleError(f"{name} are not an array of numbers: {error}") from None
    return out


def number(name: str, value: Any) -> float:
    """`value` as one number; RuleError if it is none."""
    a = array(name, value)
    if a.shape:
        raise RuleError(f"{name} has shape {a.shape}: one number is needed")
    return float(a)


def checked(takes: Mapping[str, Option], given: Mapping[str, Any], case: Case) -> dict[str, Any]:
    """All options of a rule as its function takes them. Raises RuleError for one that is unknown or does not fit."""
    for name in given:
        if name not in takes:
            raise RuleError(f"rule {case.rule!r} has no option {name!r}: it has {', '.join(takes) or 'none'}")
    out = {}
    for name, option in takes.items():
        value = given.get(name, option.default)
        out[name] = value if option.check is None else option.check(name, value, case)
    return out


def one_of(*known: str) -> Check:
    """The check that a value is one of these words: RuleError if not."""

    def check(name: str, value: Any, case: Case) -> Any:
        if value not in known:
            raise RuleError(f"{name} {value!r}: one of {', '.join(known)}")
        return value

    return check


def whole(least: int) -> Check:
    """The check that a value is a whole number and not too small: RuleError if not."""

    def check(name: str, value: Any, case: Case) -> Any:
        if not (isinstance(value, int | np.integer) and value >= least):
            raise RuleError(f"{name} {value!r}: a whole number of at least {least}")
        return value

    return check


def in_range(good: Callable[[float], bool], words: str) -> Check:
    """The check that a value is one number that is `good`, RuleError if not; `words` say which are."""

    def check(name: str, value: Any, case: Case) -> Any:
        if not good(number(name, value)):
            raise RuleError(f"{name} {value!r}: {words}")
        return value

    return check


CRITERION = Option("det", one_of("det", "trace"))
"""What a rule's weights are chosen by."""
