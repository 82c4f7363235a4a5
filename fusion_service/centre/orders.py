"""`Orders`: what operators have ordered and still holds.

What stands forbids or forces links (`constraints`) and names tracks; it ends at its time, with what it is about, or
when it is withdrawn. Numbers are given in the order of coming and never again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fusion_service.centre.judging import Standing, View, lives
from fusion_service.order import MOST_NUMBER, LocalId, Order, order_event, order_of

__all__ = ["Orders"]


class Orders:
    """The orders that stand, by number. next: the number of the next one."""

    def __init__(self) -> None:
        self.next = 1
        self.standing: dict[int, Standing] = {}

    def numbered(self, order: Order) -> Order:
        """The order with its number: its own where that is new, else the next."""
        number = max(order.number if order.number < MOST_NUMBER else 0, self.next)
        self.next = number + 1
        return replace(order, number=number)

    def stand(self, order: Order, held: tuple[LocalId, ...] = ()) -> None:
        """The order stands from now on; what it replaces no longer does."""
        if order.what in ("rename", "identify"):
            self.end(n for n, one in self.standing.items() if _same(one.order, order))
        self.standing[order.number] = Standing(order, held)

    def end(self, numbers: Iterable[int]) -> None:
        """These stand no more."""
        for number in list(numbers):
            self.standing.pop(number, None)

    def about(self, what: str) -> frozenset[str]:
        """The sources that `what` stands for: mute or quarantine."""
        return frozenset(one.order.source for one in self.standing.values() if one.order.what == what)

    def expire(self, view: View) -> Iterator[tuple[Standing, str]]:
        """Take away what stands no more at `view.time`: each with the reason."""
        for number, one in list(self.standing.items()):
            why = self._over(number, one, view)
            if why:
                del self.standing[number]
                yield one, why

    def _over(self, number: int, one: Standing, view: View) -> str:
        order = one.order
        if order.until is not None:
            if order.until <= view.time:
                return "its time is over"
            if order.what == "delete":
                return ""
        if order.what == "delete":
            left = tuple(local for local in one.locals if lives(view, local))
            if left != one.locals:
                self.standing[number] = replace(one, locals=left)
            return "" if left else "the local tracks ended"
        if not all(lives(view, local) for local in (order.local, order.against) if local is not None):
            return "the local track ended"
        if order.track is not None and not np.isin(np.uint64(order.track), view.ids).item():
            return "the track ended"
        return ""

    def follow(self, heirs: Mapping[int, int]) -> None:
        """Tracks go on as others {old id: new}: so do the orders about them; a name that the heir has already
        stays the heir's."""
        for number, one in list(self.standing.items()):
            order = one.order
            if order.track is not None and order.track in heirs:
                moved = replace(order, track=heirs[order.track])
                if order.what in ("rename", "identify") and any(_same(o.order, moved) for o in self.standing.values()):
                    del self.standing[number]
                else:
                    self.standing[number] = replace(one, order=moved)

    def kept(self) -> dict[str, Any]:
        """What a checkpoint holds of it, as plain values."""
        standing = [[order_event(one.order), [list(local) for local in one.locals]] for one in self.standing.values()]
        return {"next": self.next, "standing": standing}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        self.next = int(kept["next"])
        self.standing = {}
        for event, held in kept["standing"]:
            order = order_of(event)
            if order is None:
                raise ValueError("an order that cannot be read")
            self.standing[order.number] = Standing(order, tuple(LocalId(*local) for local in held))

    def listed(self) -> list[dict[str, Any]]:
        """The standing orders as plain values, by number."""
        found = []
        for _, one in sorted(self.standing.items()):
            event = order_event(one.order)
            del event["kind"]
            found.append(event | ({"holds": [list(local) for local in one.locals]} if one.locals else {}))
        return found


def _same(one: Order, other: Order) -> bool:
    return (one.what, one.track) == (other.what, other.track)
