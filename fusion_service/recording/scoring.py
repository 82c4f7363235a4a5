"""How a mission is to be scored, as whoever recorded it said: kept in each part, as a property of the recording."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any, NamedTuple

from fusion_service.errors import ReviewError
from fusion_service.recording.columns import import_rerun
from fusion_service.recording.parts import parts
from fusion_service.recording.reader import stored

__all__ = ["Scoring", "scoring_of", "write_scoring"]

NAME = "scoring"


class Scoring(NamedTuple):
    """cutoff: largest error that still counts as followed, m; every: s between scored times. None: not said."""

    cutoff: float | None = None
    every: float | None = None


def write_scoring(stream: Any, scoring: Scoring) -> None:
    """Keep it in a recording that begins."""
    said = {name: float(value) for name, value in scoring._asdict().items() if value is not None}
    if said:
        stream.send_property(NAME, import_rerun().AnyValues(**said))


def scoring_of(path: str | Path) -> Scoring:
    """What a recording, or a folder of parts, says of it; what cannot be read says nothing."""
    path = Path(path)
    files = parts(path)[:1] if path.is_dir() else [path]
    found: dict[str, float] = {}
    for file in files:
        with contextlib.suppress(ReviewError, FileNotFoundError, RuntimeError):
            for chunk in stored(file, [f"/__properties/{NAME}"]):
                batch = chunk.to_record_batch()
                for name in set(Scoring._fields) & set(batch.schema.names):
                    for value in map(_number, batch.column(name).to_pylist()):
                        if value is not None:
                            found[name] = value
    return Scoring(**found)


def _number(cell: Any) -> float | None:
    """The positive number of a cell, be it in a list."""
    one = cell[0] if isinstance(cell, list) and cell else cell
    return float(one) if isinstance(one, int | float) and math.isfinite(one) and one > 0 else None
