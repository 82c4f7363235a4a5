"""An operator's console in a browser, from the bus alone: a process of its own, which costs the service nothing."""

from fusion_service.console.serving import ConsoleOptions, run_console

__all__ = ["ConsoleOptions", "run_console"]
