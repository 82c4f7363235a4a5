"""`rule = "my_rule.py:fuse"` in a config file: the file is loaded, and the rule gets a name that says which."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fusion_service.config.config import ConfigError

__all__ = ["is_loaded", "is_own_rule", "load_from_here", "load_own_rule", "told_rule", "with_own_rule"]


def is_own_rule(text: str) -> bool:
    """Whether a text names a rule by its file."""
    from fusion_service.rules import is_own

    return is_own(text)


def load_own_rule(text: str) -> tuple[str, str]:
    """Load the rule whose file `text` names: its name, and its options as text. ValueError of one line."""
    from fusion_service.rules import load_own

    rule, options = load_own(text)
    return rule.name, options


def load_from_here(text: str) -> tuple[str, str]:
    """The same of a path from the working folder: the name, and what a config anywhere may say. `ConfigError`."""
    try:
        name, options = load_own_rule(text)
    except ValueError as error:
        raise ConfigError([f"--rule {text}: {error}"]) from None
    if options:
        raise ConfigError([f"--rule {text}: give its options with --set, as in --set rule_options.factor=2"])
    file, _, function = text.rpartition(":")
    return name, f"{Path(file).resolve()}:{function}"


def told_rule(name: str) -> tuple[str, str] | None:
    """(`my_rule.py:fuse`, hash) of a rule of one's own as settings and pictures name it; None for any other."""
    from fusion_service.rules.face.own import told_name

    return told_name(name)


def is_loaded(name: str) -> bool:
    """Whether there is a rule of this name."""
    from fusion_service.rules import RULES

    return name in RULES


def with_own_rule(raw: dict[str, Any], folder: Path, problems: list[tuple[tuple[str, ...], str]]) -> dict[str, Any]:
    """The tables of a config file, a rule of one's own loaded from its file, relative to the config's `folder`. What is
    wrong with it goes to `problems`, and the rule is left out."""
    centre = raw.get("centre")
    rule = centre.get("rule") if isinstance(centre, Mapping) else None
    if not isinstance(centre, Mapping) or not isinstance(rule, str):
        return raw
    from fusion_service.rules import RuleError, is_own, load_own

    if not is_own(rule):
        return raw
    rest = {key: value for key, value in centre.items() if key not in ("rule", "rule_options")}
    try:
        if "#" in rule:
            raise RuleError(f"is {rule!r}: leave out what follows #, the hash is made of the file")
        loaded, options = load_own(rule, folder)
        if options:
            raise RuleError(f"is {rule!r}: write its options as rule_options, as in rule_options = {{factor = 2.0}}")
    except RuleError as error:
        problems.append((("centre", "rule"), str(error)))
        return {**raw, "centre": rest}
    return {**raw, "centre": {**centre, "rule": loaded.name}}
