"""Commands that work on recordings, one file each.

A command is a module with HELP, EXAMPLE, `add(parser)`, which gives it its arguments, and `run(args, stop)`. What it
needs that is slow to import it imports when it runs.
"""

from __future__ import annotations

from types import ModuleType

from fusion_service.commands import evaluate, explain, export, order, repair, replay

__all__ = ["COMMANDS"]

COMMANDS: tuple[ModuleType, ...] = (order, replay, evaluate, explain, export, repair)
"""In the order of the help; a command is called as its module, with hyphens."""
