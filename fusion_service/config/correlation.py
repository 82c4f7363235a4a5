"""How the centre's rule is told of correlation: rule_options `max_correlation` and `cross`, as a config has them.

`max_correlation` of `bci`: a number; a table of bounds between the groups of sources that are declared,

    {within = 1.0, between = 0.2, pairs = [{groups = ["nav", "shore"], bound = 0.5}]}

or "derived": what follows from the successive covariances of the tracks. `cross` of `bar-shalom-campo`: "derived".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fusion_service.config.readers import number, table, text

__all__ = ["DERIVED", "GroupBounds", "group_bounds", "is_derived", "rule_options", "tried"]

DERIVED = "derived"
BOUND = number(0.0, 1.0)
AUTO_OPTIONS = ("criterion", "max_correlation", "scales")
"""Of rule auto, which hands them on to `ci` and `bci`."""


@dataclass(frozen=True, slots=True)
class GroupBounds:
    """Bounds on the correlation of the errors of two tracks: of one group, of two groups, and of two that are named
    (sorted, one name twice: within that group)."""

    within: float
    between: float
    pairs: Mapping[tuple[str, str], float]

    def of(self, first: str, second: str) -> float:
        """The bound for a track of a source of the group `first` and one of `second`."""
        usual = self.within if first == second else self.between
        return self.pairs.get((min(first, second), max(first, second)), usual)


def group_bounds(options: Mapping[str, Any]) -> GroupBounds | None:
    """The table of bounds between groups in the rule's options, None where there is none. ValueError for a bad one."""
    value = options.get("max_correlation")
    if not isinstance(value, Mapping):
        return None
    known = ("within", "between", "pairs")
    for key in value:
        if key not in known:
            raise ValueError(f"max_correlation has no key {key!r} (known: {', '.join(known)})")
    within, between = (_bound(key, value.get(key, 1.0)) for key in known[:2])
    return GroupBounds(within, between, _pairs(value.get("pairs", [])))


def rule_options(value: Any) -> dict[str, Any]:
    """A table, as a dict of its own; pairs of groups, {groups = ["a", "b"], bound = 0.5}, as lists ["a", "b", 0.5]:
    what a step log has room for."""
    options = table(value)
    bounds = options.get("max_correlation")
    if isinstance(bounds, Mapping) and isinstance(bounds.get("pairs"), (list, tuple)):
        options["max_correlation"] = {**bounds, "pairs": [_triple(one) for one in bounds["pairs"]]}
    return options


def _triple(one: Any) -> Any:
    named = isinstance(one, Mapping) and set(one) == {"groups", "bound"} and isinstance(one["groups"], (list, tuple))
    return [*one["groups"], one["bound"]] if named else one


def _pairs(value: Any) -> dict[tuple[str, str], float]:
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"max_correlation.pairs is {value!r}, must be a list of tables")
    found: dict[tuple[str, str], float] = {}
    for one in value:
        one = _triple(one)
        if not isinstance(one, (list, tuple)) or len(one) != 3:
            raise ValueError(f'max_correlation.pairs has {one!r}, wants {{groups = ["a", "b"], bound = 0.5}}')
        try:
            first, second = sorted(text(name) for name in one[:2])
        except ValueError as error:
            raise ValueError(f"max_correlation.pairs: a group {error}") from None
        if (first, second) in found:
            raise ValueError(f"max_correlation.pairs names {first} and {second} twice")
        found[first, second] = _bound("pairs: bound", one[2])
    return found


def _bound(name: str, value: Any) -> float:
    try:
        return BOUND(value)
    except ValueError as error:
        raise ValueError(f"max_correlation.{name} {error}") from None


def is_derived(rule: str, options: Mapping[str, Any]) -> bool:
    """Whether the rule goes by cross-covariances that the centre derives."""
    return (rule == "bci" and options.get("max_correlation") == DERIVED) or rule == "bar-shalom-campo"


def tried(rule: str, options: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """A rule and its options by which it can be told whether the centre could fuse by these: with a bound of 1 where
    it is to be found. ValueError for what cannot be."""
    if rule == "bar-shalom-campo":
        for key in options:
            if key != "cross":
                raise ValueError(f"{rule} has no option {key!r} in a centre (known: cross)")
        if options.get("cross") != DERIVED:
            raise ValueError(f'{rule} needs rule_options = {{cross = "{DERIVED}"}}, not {options.get("cross")!r}')
        return "bci", {}
    if rule == "auto":
        for key in options:
            if key not in AUTO_OPTIONS:
                raise ValueError(f"auto has no option {key!r} (known: {', '.join(AUTO_OPTIONS)})")
        if "max_correlation" in options and group_bounds(options) is None:
            raise ValueError("auto takes max_correlation as a table of bounds between groups")
        return "bci", {key: value for key, value in options.items() if key != "max_correlation"}
    few = dict(options)
    if rule == "bci" and (few.get("max_correlation") == DERIVED or group_bounds(options) is not None):
        few["max_correlation"] = 1.0
    return rule, few
