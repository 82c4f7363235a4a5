"""Connections made and closed: what each leaves in the memory of hub, service and recorder."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import schemas
from fusion_service.bus import open_bus
from tests.chaos.report import Report
from tests.chaos.scene import Product, product

__all__ = ["count_connections"]

BATCH = 500
MOST = 16.0
"""KiB that one connection may leave in a process."""
NAMES = ("hub", "service", "recorder")


def _bare(endpoint: str, _: int) -> None:
    with open_bus([endpoint], wait=30.0):
        pass


def _token(endpoint: str, number: int) -> None:
    with open_bus([endpoint], wait=30.0) as bus:
        bus.announce(schemas.local_key(f"t{number % 10}", "alive"))


def _publisher(endpoint: str, number: int) -> None:
    with open_bus([endpoint], wait=30.0) as bus:
        bus.publisher(schemas.local_key(f"p{number % 10}", "tracks")).put(b"x")


def _name(endpoint: str, number: int) -> None:
    with open_bus([endpoint], wait=30.0) as bus:
        bus.publisher(schemas.local_key(f"n{number}", "tracks")).put(b"x")


KINDS: dict[str, Callable[[str, int], None]] = {
    "nothing said": _bare,
    "a token": _token,
    "a message, of ten names": _publisher,
    "a message, each a name of its own": _name,
}


def count_connections(most: int, until: float = float("inf")) -> Report:
    """`most` connections of each kind, after some that warm the processes."""
    report = Report("connections")
    for said, one in KINDS.items():
        if time.monotonic() < until:
            _one_kind(said, one, most, until, report)
    return report


def _one_kind(said: str, one: Callable[[str, int], None], most: int, until: float, report: Report) -> None:
    with product(*NAMES) as (all_of, watch), ThreadPoolExecutor(4) as pool:
        numbers = itertools.count()

        def some(count: int) -> dict[str, int]:
            list(pool.map(one, itertools.repeat(all_of.endpoint), itertools.islice(numbers, count)))
            time.sleep(1.0)
            return {name: all_of[name].memory() for name in NAMES}

        _warmed(all_of)
        before = after = some(min(BATCH, most))
        begin, made = time.monotonic(), 0
        while made < most and time.monotonic() < until:
            after, made = some(min(BATCH, most)), made + min(BATCH, most)
        each = {name: (after[name] - before[name]) / max(made, 1) for name in NAMES}
        if max(each.values()) > MOST and made > BATCH:
            report.escaped(f"{said}: {each} KiB for each connection")
        report.tried += made
        kept = ", ".join(f"{name} {each[name]:.1f}" for name in NAMES)
        report.say(f"{made} connections, {said}: {kept} KiB each; longest silence {watch.silence(begin):.1f} s")


def _warmed(all_of: Product) -> None:
    """Wait until the memory of all stands still."""
    sizes, end = [0], time.monotonic() + 60.0
    while time.monotonic() < end and (len(sizes) < 5 or sizes[-1] > 1.005 * sizes[-4]):
        time.sleep(1.0)
        sizes.append(sum(all_of[name].memory() for name in NAMES))
