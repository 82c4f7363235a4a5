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

    for rule in RULES.values():
        options = ", ".join(f"{name}={value!r}" for name, value in rule.options.items()) or "none"
        print(f"{rule.name:<18}{'N-way   ' if rule.n_way else 'pairwise'}  {rule.promise}")
        print(f"{'':<18}options: {options}; source: {rule.source}")
