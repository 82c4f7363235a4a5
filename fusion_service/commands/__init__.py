"""The commands of `fusion-service`, one file each.

A command is a module with HELP, EXAMPLE, `add(parser)`, which gives it its arguments, and `run(args, stop)`, which
does it and raises what a person can mend (`fusion_service.errors`). What is slow to import it imports when it runs. A
command whose `stop` is set leaves its work as it is, says so, and returns: it has done what it was told.
"""

from __future__ import annotations

from types import ModuleType

from fusion_service.commands import (
    check,
    console,
    demo,
    evaluate,
    explain,
    export,
    hub,
    keys,
    listen,
    metrics,
    order,
    record,
    repair,
    replay,
    rules,
    run,
    status,
    top,
    verify,
)

__all__ = ["COMMANDS"]

COMMANDS: dict[str, ModuleType] = {
    module.__name__.rpartition(".")[2]: module
    for module in (
        hub,
        keys,
        run,
        status,
        console,
        top,
        listen,
        order,
        record,
        metrics,
        demo,
        check,
        rules,
        replay,
        evaluate,
        explain,
        export,
        verify,
        repair,
    )
}
"""By name, in the order of the help."""
