"""The rules there are: what stands in the folder, and rules of one's own that were loaded (`own`). `RULES`, by name.

Every file of `fusion_service/rules` is one rule and declares it as `RULE`; the folders within are what rules share. So
to add a rule is to add a file. A rule must not import this module, nor what does: the registry imports all of them.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from pkgutil import iter_modules, resolve_name
from types import MappingProxyType
from typing import TypeVar

from fusion_service.rules.base.rule import Declaration, Rule

__all__ = ["RULES", "Rules", "collect"]

R = TypeVar("R", bound=Declaration)


class Rules(Mapping[str, Rule]):
    """The rules of the folder, in their order. One of somebody's own is found by its name once it is loaded, and is in
    no list: `own` holds these."""

    def __init__(self, shipped: Mapping[str, Rule]) -> None:
        self._shipped = shipped
        self.own: dict[str, Rule] = {}

    def __getitem__(self, name: str) -> Rule:
        return self._shipped[name] if name in self._shipped else self.own[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._shipped)

    def __len__(self) -> int:
        return len(self._shipped)


def collect(kind: type[R], folder: Path, package: str) -> Mapping[str, R]:
    """The rules that the files of a folder, which is the package's, declare, in the order they ask for.

    Raises AttributeError for a file without a RULE, TypeError for one of another kind, ValueError for a name that two
    files give.
    """
    rules: dict[str, R] = {}
    for rule in sorted(_found(folder, package), key=lambda rule: (rule.order, rule.name)):
        if not isinstance(rule, kind):
            raise TypeError(f"rule {rule.name!r} in {folder} is no {kind.__name__}")
        if rule.name in rules:
            raise ValueError(f"two rules in {folder} are called {rule.name!r}")
        rules[rule.name] = rule
    return MappingProxyType(rules)


def _found(folder: Path, package: str) -> Iterator[Declaration]:
    for file in iter_modules([str(folder)]):
        if not (file.ispkg or file.name.startswith("_")):
            yield resolve_name(f"{package}.{file.name}:RULE")


RULES: Rules = Rules(collect(Rule, Path(__file__).parents[1], "fusion_service.rules"))
