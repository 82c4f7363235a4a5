"""Orders of the active centre as one that stands by has heard of them: what it must give again should it take over.

Every order that was answered there is told here first, in the log of the step that obeyed it, or, where it waits for a
step, with the answer to a question for a sign of life (see `tenure`). From a checkpoint that knows less than these the
one that takes over gives them again, under their numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fusion_service.centre import Order
from fusion_service.order import order_of

__all__ = ["HeardOrders"]

MOST = 1024
"""Orders that are kept since the last checkpoint."""


class HeardOrders:
    """known: the greatest number of an order that this process would go on with, of the run that is the newest."""

    def __init__(self) -> None:
        self._orders: dict[int, tuple[int, Order]] = {}
        self._epoch = -1
        self.known = 0

    @property
    def full(self) -> bool:
        """Whether the oldest will soon be let go: time for a checkpoint that has them."""
        return len(self._orders) > MOST // 2

    def tell(self, epoch: int, events: Iterable[Mapping[str, Any]]) -> None:
        """Orders that a run of the active centre, that of `epoch`, obeyed or holds, among other events of its log."""
        if epoch < self._epoch:
            return
        if epoch > self._epoch:
            self._epoch, self.known = epoch, 0
        for event in events:
            order = order_of(event)
            if order is not None and order.number:
                self._orders.pop(order.number, None)
                self._orders[order.number] = epoch, order
                self.known = max(self.known, order.number)
        while len(self._orders) > MOST:
            del self._orders[min(self._orders)]

    def settle(self, epoch: int, following: int) -> None:
        """A checkpoint of the run `epoch` is here, which knows all orders below `following`."""
        self.tell(epoch, ())
        if epoch == self._epoch:
            self.known = max(self.known, following - 1)
        self._orders = {number: one for number, one in self._orders.items() if number >= following and one[0] >= epoch}

    def since(self, following: int) -> list[Order]:
        """Those of number `following` and above, in order."""
        return [order for number, (_, order) in sorted(self._orders.items()) if number >= following]
