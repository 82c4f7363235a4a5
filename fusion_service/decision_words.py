"""What a step log says was decided of a track, in the short words that `explain` and the console use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from schemas.messages import (
    BORN,
    BROKEN,
    COASTING_NOW,
    CONFIRMED_NOW,
    DELETED,
    EXCHANGED,
    GATE_FAILED,
    KEPT,
    LINKED,
    MERGED,
    SPLIT,
)

__all__ = ["MINE", "SAID", "THEIRS", "made_again"]

SAID = {
    LINKED: "linked",
    KEPT: "kept",
    GATE_FAILED: "outside its gate",
    BROKEN: "broken off",
    BORN: "born",
    CONFIRMED_NOW: "confirmed",
    COASTING_NOW: "coasts: no source has it",
    DELETED: "lost",
}
"""Of a track, or of one of its members."""
MINE = {MERGED: "merged into", SPLIT: "split from", EXCHANGED: "comes over by exchange from"}
"""Of a track, before the name of the other that the decision is about too."""
THEIRS = {MERGED: "took in", SPLIT: "split off it:", EXCHANGED: "goes over by exchange to"}
"""The same of that other one, before the name of the first."""
MOST_NAMES, LONGEST = 3, 120


def made_again(event: Mapping[str, Any], at: int) -> str:
    """What a step at `at`, ns, says of those that were made again before it (event "revised")."""
    since, sources = event.get("since"), event.get("sources")
    names = [str(one)[:LONGEST] for one in sources] if isinstance(sources, (list, tuple)) else []
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    back = f" from {(at - since) / 1e9:.1f} s before on" if type(since) is int else ""
    return f"made again{back}, with late data of {', '.join(names[:MOST_NAMES]) or 'nobody'}{more}"
