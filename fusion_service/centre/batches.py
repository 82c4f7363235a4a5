"""Messages whose numbers have been checked: which of them are taken together, and as what."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.pictures import is_picture_of
from fusion_service.centre.sources import Source
from schemas import Entry, Frame, LocalTracks

__all__ = ["Checked", "framed", "run_key"]

Checked: TypeAlias = tuple[tuple[Source, LocalTracks, Entry], NDArray[np.uint8]]
"""A message with its source and its entry in the log, and the fault code of each track."""


def framed(message: LocalTracks, frame: Frame | None) -> LocalTracks:
    """A scan; an empty picture of another centre is in the frame that this one has by now: it may have had none."""
    if frame is None or len(message.ids) or message.frame == frame or not is_picture_of(message.source):
        return message
    return replace(message, frame=frame)


def run_key(item: tuple[int, Checked]) -> tuple[object, ...]:
    """Messages in a row that may be taken together: of one source, all partial, in one space and frame."""
    place, ((source, message, _), _) = item
    alone = place if message.complete else -1
    return source.name, alone, message.space, message.frame, message.height
