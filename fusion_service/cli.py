"""`fusion-service`: builds the commands of `fusion_service.commands`, and calls one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from fusion_service import __version__
from fusion_service.commands import COMMANDS
from fusion_service.logs import FORMATS, set_up_logging
from fusion_service.process import Parser, exit_code, left_behind, stop_on_signals

__all__ = ["main"]

COMPILER = "compiler"
"""The thread of `compiled.THREAD`, which is not loaded for that: it may be in one call for a minute."""
LASTING = ("hub", "run", "record", "metrics", "console")
"""Commands that go on until they are stopped: SIGHUP does not end them, and a machine may read their logs."""
CODES = "Exit codes: 0 done, or stopped by a signal; 2 bad usage or config; 1 failure, with one line that says why."


class _Help(argparse.RawDescriptionHelpFormatter):
    """Keeps the examples as they are written."""


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="fusion-service",
        description="Associates and fuses the tracks of remote sensors into one picture.",
        epilog="Example: fusion-service demo\n"
        f"`fusion-service COMMAND --help` shows an example for each command.\n{CODES}",
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, module in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=module.HELP,
            description=module.HELP,
            epilog=f"Example:\n  {module.EXAMPLE}",
            formatter_class=_Help,
        )
        command.add_argument("-v", "--verbose", action="store_true", help="log more")
        if name in LASTING:
            command.add_argument(
                "--log-format", choices=FORMATS, default="auto", help="of its log (auto: text; under systemd json)"
            )
        module.add(command)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    try:
        args = _parser().parse_args(argv)
        with stop_on_signals(args.command in LASTING) as stop:
            set_up_logging(args.verbose, getattr(args, "log_format", "auto"))
            code = exit_code(f"fusion-service {args.command}", lambda: COMMANDS[args.command].run(args, stop))
        return left_behind(code, COMPILER) if stop.is_set() else code
    except KeyboardInterrupt:  # before the handlers were there
        return 0
