"""`fusion-service rules`."""

from __future__ import annotations

import argparse
import threading

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The fusion rules and what each promises."
EXAMPLE = "fusion-service rules"


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments: none."""


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Print them."""
    from fusion_service.rules import RULES
    from fusion_service.ways import AUTO_PROMISE

    for rule in RULES.values():
        options = ", ".join(f"{name}={value!r}" for name, value in rule.options.items()) or "none"
        print(f"{rule.name:<18}{'N-way   ' if rule.n_way else 'pairwise'}  {rule.promise}")
        print(f"{'':<18}options: {options}; source: {rule.source}")
    print(f"{'auto':<18}N-way     {AUTO_PROMISE}")
    print(f"{'':<18}options: criterion='det', max_correlation=bounds between groups; in a centre only: docs/rules.md")
