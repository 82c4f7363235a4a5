"""One track in full, for a page that asks for it: what it is, from whom it comes, and what was decided of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fusion_service.console.histories import Histories
from fusion_service.console.pictures import Pictures, cut
from fusion_service.console.places import flat_name
from fusion_service.ways import fused_by
from schemas import ORIGINS, STATUSES, GlobalTracks
from schemas.messages import MARKS

__all__ = ["explained"]

MARK_WORDS = {
    "apart": "apart: of a source in quarantine, fused with no other",
    "identity_twice": "its identity is in two places",
    "identity_ordered": "an operator gave its identity",
}
MOST_MEMBERS = 200


def explained(track: int, pictures: Pictures, histories: Histories) -> dict[str, Any]:
    """What is known of a track of the newest picture, or of one that has ended; times in ms, ids as texts."""
    said = {
        "type": "track",
        "id": str(track),
        "label": pictures.label(track),
        "version": pictures.version,
        "history": histories.of(track),
    }
    row, whole = pictures.row(track), pictures.whole
    if row is None or whole is None or pictures.places is None:
        return {**said, "gone": histories.end_of(track) or "it is not in the picture"}
    names, which = fused_by(whole)
    where = pictures.places
    origin = ORIGINS[whole.track_origin[row]] if whole.track_origin is not None else whole.origin
    return {
        **said,
        "callsign": cut(_text(whole, "callsign", row)),
        "number": int(whole.number[row]) if whole.number is not None else 0,
        "status": STATUSES[whole.status[row]],
        "existence": float(whole.existence[row]),
        "time": whole.time // 10**6,
        "updated": int(whole.updated[row]) // 10**6,
        "origin": origin,
        "marks": [MARK_WORDS[name] for bit, name in enumerate(MARKS) if _marks(whole, row) >> bit & 1],
        "what": [one for one in (_what(whole, "identity", row), _what(whole, "kind", row)) if one],
        "geo": flat_name(whole.frame) is None,
        "place": [_number(where.x[row]), _number(where.y[row]), _number(where.height[row])],
        "ellipse": [_number(where.major[row]), _number(where.minor[row]), _number(where.turn[row])],
        "velocity": [_number(where.vx[row]), _number(where.vy[row])],
        "way": cut(names[which[row]]),
        "members": _members(whole, row, track, histories),
    }


def _members(whole: GlobalTracks, row: int, track: int, histories: Histories) -> list[dict[str, Any]]:
    """The local tracks that contribute, those of most influence first."""
    end = int(np.cumsum(whole.contributor_counts, dtype=np.intp)[row])
    some = range(end - int(whole.contributor_counts[row]), end)
    distances = histories.distances(track)
    found = []
    for k in some[:MOST_MEMBERS]:
        source = whole.sources[whole.contributor_source[k]]
        epoch, local = int(whole.contributor_epoch[k]), int(whole.contributor_id[k])
        influence, d2 = _number(whole.contributor_influence[k]), distances.get((source, epoch, local))
        found.append({"source": source, "epoch": str(epoch), "id": str(local), "influence": influence, "d2": d2})
    return sorted(found, key=lambda one: -(one["influence"] or 0.0))


def _what(whole: GlobalTracks, name: str, row: int) -> dict[str, Any] | None:
    """An identity or a class, with its probability."""
    said, p = cut(_text(whole, name, row)), getattr(whole, f"{name}_p")
    return {"name": name, "said": said, "p": _number(p[row]) if p is not None else None} if said else None


def _text(whole: GlobalTracks, name: str, row: int) -> Any:
    column = getattr(whole, name)
    return column[row] if column is not None else None


def _marks(whole: GlobalTracks, row: int) -> int:
    return int(whole.marks[row]) if whole.marks is not None else 0


def _number(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None
