"""`fusion-service check`."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion_service.rules.face.own import OwnRule

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Check a config, or a rule of your own; without a file, print a config with every default."
EXAMPLE = """fusion-service check centre.toml
  fusion-service check my_rule.py:fuse"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("config", nargs="?", metavar="FILE", help="TOML file, or FILE.py:FUNCTION")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Say whether the config is good, and try its rule if it is one of one's own; or print an example. Raises
    `ConfigError`, `UsageError`, and `HealthError` for a rule with faults."""
    from fusion_service.config import config_hash, example_toml, load_config
    from fusion_service.errors import UsageError
    from fusion_service.rules import RuleError, is_own, load_own
    from fusion_service.rules.face.own import loaded

    if args.config is None:
        sys.stdout.write(example_toml())
        return
    if is_own(args.config):
        try:
            rule = load_own(args.config)[0]
        except RuleError as error:
            raise UsageError(str(error)) from None
        _try(loaded(rule.name), {})
        return
    config = load_config(args.config)
    print(
        f"{args.config}: good ({config.centre.rule}, {config.centre.memory} memory, hash {config_hash(config.centre)})"
    )
    _try(loaded(config.centre.rule), config.centre.rule_options)


def _try(own: OwnRule | None, options: Mapping[str, Any]) -> None:
    from fusion_service.errors import HealthError
    from fusion_service.rules.face.trial import tried_out

    if own is None:
        return
    trial = tried_out(own, options)
    print(f"{own.name}: {own.doc.splitlines()[0] if own.doc else 'no docstring'}")
    print(f"promise: {own.promise}")
    print("\n".join(trial.lines()))
    if trial.faults:
        raise HealthError(
            f"{own.path}:{own.function.__name__} has {len(trial.faults)} faults, the first: {trial.faults[0]}"
        )
