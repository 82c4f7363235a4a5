"""A link between two hubs that comes and goes: what do they know of each other afterwards?

    python -m tests.flapping --times 100

Two routers of Zenoh with a link that is cut and mended one to four times within moments; on each side clients that were
there before. Afterwards a sample, a question and a token of one side must reach the other. What never does is printed,
with the moments: declarations that were made before are lost to the other side, though the link is up
(https://github.com/eclipse-zenoh/zenoh/issues/1886), new ones pass, and a link that is cut for longer mends it all.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import time
from contextlib import ExitStack

from fusion_service.bus import Bus, BusError, open_bus
from tests.helpers.link import Link
from tests.helpers.processes import free_endpoint

MOMENTS = (0.003, 0.02, 0.1, 0.3, 0.5, 1.0)
PATIENCE = 12.0


class Sides:
    """Two hubs with a link, and what crosses it."""

    def __init__(self, stack: ExitStack) -> None:
        here, there = free_endpoint(), free_endpoint()
        stack.enter_context(open_bus([], [here], mode="router"))
        self.link = Link(here)
        stack.callback(self.link.close)
        stack.enter_context(open_bus([self.link.endpoint], [there], mode="router"))
        self._one, self._two, self._looks = (
            stack.enter_context(open_bus([end], wait=60.0)) for end in (here, there, there)
        )
        self._got: list[bytes] = []
        self._two.subscribe("t/data", lambda key, data: self._got.append(data), history=0)
        self._publisher = self._one.publisher("t/data")
        self._one.answer("t/one", lambda data: b"yes")
        self._two.answer("t/two", lambda data: b"yes")
        self._one.announce("t/token")

    def crossing(self) -> dict[str, bool]:
        """What reaches the other side now."""
        count = len(self._got)
        self._publisher.put(b"x")
        time.sleep(0.1)
        return {
            "samples": len(self._got) > count,
            "answers": _answered(self._two, "t/one"),
            "answers back": _answered(self._one, "t/two"),
            "tokens": bool(self._looks.present("t/token")[0]),
        }

    def whole(self) -> dict[str, bool]:
        """The same when all does, or after `PATIENCE` seconds."""
        begin = time.monotonic()
        while not all((found := self.crossing()).values()) and time.monotonic() - begin < PATIENCE:
            time.sleep(0.2)
        return found


def _answered(bus: Bus, key: str) -> bool:
    with contextlib.suppress(BusError):
        return bool(bus.ask(key, b""))
    return False


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100, help="bursts (default 100)")
    parser.add_argument("--seed", type=int, default=1, help="of the moments")
    given = parser.parse_args()
    draw, lost = random.Random(given.seed), 0
    with ExitStack() as stack:
        sides = Sides(stack)
        assert all(sides.whole().values())
        for number in range(given.times):
            moments = [draw.choice(MOMENTS) * draw.random() for _ in range(2 * draw.randrange(1, 5))]
            for cut, up in zip(moments[::2], moments[1::2], strict=True):
                sides.link.cut()
                time.sleep(cut)
                sides.link.mend()
                time.sleep(up)
            found = sides.whole()
            if not all(found.values()):
                lost += 1
                missing = ", ".join(name for name, there in found.items() if not there)
                print(f"burst {number}, cut and up for {', '.join(f'{one:.3f}' for one in moments)} s: no {missing}")
                sides.link.cut()
                time.sleep(1.5)
                sides.link.mend()
                assert all(sides.whole().values()), "nor after a longer cut"
    print(f"{given.times} bursts, seed {given.seed}: after {lost} something did not cross any more")


if __name__ == "__main__":
    main()
