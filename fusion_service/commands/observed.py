"""`--metrics` of the commands that last: what Prometheus and a health check ask, on one port."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from fusion_service.commands.arguments import address
from fusion_service.process import argument

if TYPE_CHECKING:
    from fusion_service.monitoring import Sample

__all__ = ["PORTS", "add_metrics", "observed"]

PORTS = {"hub": 9465, "service": 9464, "recorder": 9466, "metrics": 9467}
"""Where each process serves if nothing else is said."""


def add_metrics(parser: argparse.ArgumentParser, process: str) -> None:
    """The argument, of a process of `PORTS`."""
    parser.add_argument(
        "--metrics",
        nargs="?",
        const=("127.0.0.1", PORTS[process]),
        type=argument(partial(address, port=PORTS[process])),
        metavar="HOST:PORT",
        help=f"serve /metrics for Prometheus, /healthz and /readyz (default 127.0.0.1:{PORTS[process]}; any other host "
        "opens them to the network)",
    )


@contextmanager
def observed(
    where: tuple[str, int] | None,
    process: str,
    samples: Callable[[], Iterable[Sample]],
    alive: Callable[[], str],
    ready: Callable[[], str],
) -> Iterator[None]:
    """Serve these, and what every process says of itself, at `where`; nothing where that is None. Raises ImportError,
    OSError."""
    if where is None:
        yield
        return
    from fusion_service.monitoring import Serving, process_samples, served

    def all_of_them() -> Iterator[Sample]:
        yield from process_samples(process, ready())
        yield from samples()

    with served(where, Serving(all_of_them, alive, ready)):
        yield
