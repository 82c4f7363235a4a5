"""`fusion-service rules`."""

from __future__ import annotations

import argparse
import textwrap
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion_service.rules import Rule

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The fusion rules and what each promises; one of your own, by its file."
EXAMPLE = """fusion-service rules
  fusion-service rules my_rule.py:fuse            what it says of itself"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument(
        "own", nargs="*", metavar="FILE.py:FUNCTION", help="rules of your own, which are run (docs/rules.md)"
    )


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Print them. Raises `UsageError` for a file that cannot be loaded."""
    from fusion_service.errors import UsageError
    from fusion_service.rules import RULES, RuleError, load_own
    from fusion_service.rules.face.own import loaded
    from fusion_service.ways import AUTO_PROMISE

    if args.own:
        for text in args.own:
            try:
                rule = load_own(text)[0]
            except RuleError as error:
                raise UsageError(str(error)) from None
            _say(rule)
            own = loaded(rule.name)
            print(textwrap.indent(own.doc if own and own.doc else "(it has no docstring)", " " * 18))
        return
    for rule in RULES.values():
        _say(rule)
    print(f"{'auto':<18}N-way     {AUTO_PROMISE}")
    options = "criterion='det', scales=None, max_correlation=bounds between groups"
    print(f"{'':<18}options: {options}; source: the default of a centre, docs/rules.md")


def _say(rule: Rule) -> None:
    options = ", ".join(f"{name}={value!r}" for name, value in rule.options.items()) or "none"
    name = rule.name if len(rule.name) < 18 else f"{rule.name}\n{'':<18}"
    print(f"{name:<18}{'N-way   ' if rule.n_way else 'pairwise'}  {rule.promise}")
    print(f"{'':<18}options: {options}; source: {rule.source}")
