"""Orders on disk that no step has obeyed yet: a file beside the checkpoint, which they leave for it.

One that is answered before a step, since none comes, is written here first; a service that begins again gives its
centre those whose numbers the checkpoint does not know. So does one that takes over, with the other's (`inherit`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import msgpack

from fusion_service.centre import Order
from fusion_service.order import order_event, order_of

__all__ = ["HeldOrders"]

NAME = "orders"
MOST_BYTES = 4 * 2**20

log = logging.getLogger(__name__)


class HeldOrders:
    """The file in `folder`; None holds nothing."""

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / NAME
        self._newest = 0
        self._inherited: list[Order] = []

    def inherit(self, orders: Sequence[Order]) -> None:
        """A service begins next that goes on where another one was, which had taken these."""
        self._inherited = list(orders)
        try:
            if orders:
                self.add(orders)
        except OSError as error:
            log.error("cannot keep what was ordered: %s", error)

    def read(self, following: int) -> list[Order]:
        """Those of number `following` and above, in order; what cannot be read, and all behind it, is left out."""
        found: dict[int, Order] = {}
        inherited, self._inherited = self._inherited, []
        try:
            for event in msgpack.Unpacker(_Start(self._bytes()), max_buffer_size=MOST_BYTES):
                order = order_of(event) if isinstance(event, dict) else None
                if order is not None and order.number >= following:
                    found[order.number] = order
        except (OSError, ValueError, TypeError, msgpack.exceptions.UnpackException, RecursionError) as error:
            log.warning("%s cannot be read to its end: %s", self._path, error or type(error).__name__)
        found |= {order.number: order for order in inherited if order.number >= following}
        self._newest = max(found, default=0)
        return [order for _, order in sorted(found.items())]

    def _bytes(self) -> bytes:
        if self._path is None or not self._path.exists():
            return b""
        with open(os.open(self._path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as file:
            return file.read(MOST_BYTES)

    def add(self, orders: Sequence[Order]) -> bool:
        """These are on disk when this returns True; False where nothing is kept. Raises OSError."""
        if self._path is None:
            return False
        handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o600)
        with open(handle, "ab") as file:
            file.write(b"".join(msgpack.packb(order_event(order)) for order in orders))
            file.flush()
            os.fsync(handle)
        self._newest = max([self._newest, *(order.number for order in orders)])
        return True

    def saved(self, following: int) -> None:
        """A checkpoint that knows all orders below `following` is on disk. Raises OSError."""
        if self._path is not None and 0 < self._newest < following:
            os.truncate(self._path, 0)
            self._newest = 0


class _Start:
    """Bytes to be read once."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def read(self, size: int) -> bytes:
        part, self._data = self._data[:size], self._data[size:]
        return part
