"""How one that stands by copies the state of the active process: asked for, made there between two steps, fetched part
by part.

A question may get lost: who stands by asks as soon as it sees the other's token, when its hub may not know yet who
answers, or while the bus is being joined again. So it is asked again where nothing comes, and soon tried again where no
copy came: only one that came has cost the other anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

__all__ = ["AGAIN", "FETCH", "Loaded", "copied", "pause"]

FETCH, AGAIN = 5.0, 0.7
"""Seconds for a copy to come, and without any part of it until it is asked for again."""
ROUND = 0.02
SPACING, SHARE, MOST_SPACING = 0.25, 10.0, 2.0
"""Seconds between two copies, and so many times what the last one took, but no more than so many seconds: one that
cannot follow the other is as ready as its last copy is new."""


class Loaded(NamedTuple):
    """A checkpoint that was fetched: of the run `epoch`, after its step `step`."""

    blob: bytes
    epoch: int
    step: int


def copied(
    ask: Callable[[dict[str, Any]], Mapping[str, Any]],
    over: Callable[[float], bool],
    now: Callable[[], float],
    made: bool = False,
) -> Loaded | None:
    """A copy; None where none comes within `FETCH` seconds. ask: a question to the active process, its answer, empty if
    none came; over: waits so many seconds, and says whether to give up; made: it holds one ready by itself, since it
    hands over, and makes no other."""
    begin = now()
    asked = float("-inf")
    parts: list[bytes] = []
    of: tuple[int, int] | None = None
    while now() - begin < FETCH and not over(0.0):
        if not made and now() - asked > AGAIN:
            ask({"what": "state"})
            asked, of, parts = now(), None, []
        answer = ask({"what": "state", "part": len(parts)})
        which, data, count = _mark(answer.get("of")), answer.get("data"), answer.get("parts")
        if which is None or not isinstance(data, bytes) or type(count) is not int or answer.get("part") != len(parts):
            over(ROUND)
        elif of not in (None, which):  # another was made meanwhile
            of, parts = None, []
        else:
            asked, of = now(), which
            parts.append(data)
            if len(parts) >= count:
                return Loaded(b"".join(parts), *which)
    return None


def pause(took: float, came: bool) -> float:
    """Seconds until the next copy may be asked for, after one that took so long, or did not come."""
    return min(max(SPACING, SHARE * took), MOST_SPACING) if came else SPACING


def _mark(of: object) -> tuple[int, int] | None:
    """Which step it is of, as said; None where nothing sound is."""
    sound = isinstance(of, list) and len(of) == 2 and all(type(one) is int for one in of)
    return (of[0], of[1]) if sound and isinstance(of, list) else None
