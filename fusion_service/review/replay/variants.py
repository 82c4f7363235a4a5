"""The ways in which a recorded mission is fused again: each a name, and changes of the mission's own settings."""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fusion_service.config import CentreConfig, ConfigError, centre_config
from fusion_service.config.own_rule import is_own_rule, load_own_rule
from fusion_service.config.settings import change, merge

__all__ = ["Variant", "variants_of"]

SAME = "replay"
"""Name of the variant under the mission's own rule."""


@dataclass(frozen=True)
class Variant:
    """One centre of a replay. rule: "" for the mission's own; options: of that rule; changes: of any settings."""

    name: str
    rule: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def unchanged(self) -> bool:
        """Whether it is fused under the settings it is given."""
        return not self.rule and not self.changes

    def config(self, base: Mapping[str, Any]) -> CentreConfig:
        """The config made of the mission's own settings `base`. `ConfigError` for what it cannot be."""
        settings = copy.deepcopy(dict(base))
        if self.rule and settings.get("kind", "tracks") == "intensity":
            settings["intensity_rule"] = self.rule
        elif self.rule:
            settings |= {"rule": self.rule, "rule_options": dict(self.options)}
        merge(settings, copy.deepcopy(dict(self.changes)))
        return centre_config(settings)


def variants_of(rules: Sequence[str], settings: Sequence[str], taken: Collection[str]) -> list[Variant]:
    """The variants that `--rule` and `--set` ask for, each with a name that is not `taken`. `ConfigError` says what
    cannot be read."""
    changes: dict[str, Any] = {}
    for text in settings:
        merge(changes, change(text))
    names = set(taken)
    found = []
    for text in rules or [""]:
        own = _own(text)
        rule, rest = own if own else text.partition(":")[::2]
        options: dict[str, Any] = {}
        for part in _parts(rest):
            try:
                merge(options, change(part))
            except ConfigError:
                hint = "write NAME or NAME:OPTION=VALUE,..., as in --rule hmd-ga:criterion=trace"
                raise ConfigError([f"--rule {text}: {hint}"]) from None
        short = rule.partition(".py:")[0] if own else rule
        name = _free("-".join([short, *map(_word, options.values())]) if rule else SAME, names)
        names.add(name)
        found.append(Variant(name, rule, options, changes))
    return found


def _own(text: str) -> tuple[str, str] | None:
    """The name of a rule of one's own that `text` names, loaded, and its options; None where it names none."""
    if not is_own_rule(text):
        return None
    try:
        return load_own_rule(text)
    except ValueError as error:
        raise ConfigError([f"--rule {text}: {error}"]) from None


def _parts(text: str) -> list[str]:
    """Split at the commas that are in no bracket."""
    parts, depth, start = [], 0, 0
    for place, sign in enumerate(text):
        depth += (sign in "[{") - (sign in "]}")
        if sign == "," and depth == 0:
            parts.append(text[start:place])
            start = place + 1
    return [part for part in (*parts, text[start:]) if part.strip()]


def _word(value: Any) -> str:
    """A value as a part of a name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", str(value)).strip("-")[:20] or "x"


def _free(name: str, taken: Collection[str]) -> str:
    name = re.sub(r"[^A-Za-z0-9_.:-]", "-", name)[:60]
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free
