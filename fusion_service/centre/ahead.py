"""What of a step can be done for a message as soon as it is queued, in the time in which nothing else is to be done.

Of a large message its digest, the check of its numbers, and its table follow from the message alone, and from what is
declared of its source; they are a fourth of a step. Nothing depends on whether they were made ahead: the step takes
what finds it asking the same, and makes the rest itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.extents import tells_extent
from fusion_service.centre.lineage import Lineages
from fusion_service.centre.scans import Scan, message_tracks
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks, unlinked
from fusion_service.centre.words import Lexicon, Words
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.records import altered
from schemas import Frame, Height, LocalTracks, Message, check_numbers, digest

__all__ = ["LARGE", "Ahead", "Asked"]

LARGE = 256
"""Tracks of a message from which on it is worth while: small ones cost calls, and are made together."""
MOST = 50_000
"""Tracks of all messages that are made ahead: their tables are about as large as they. Those that were taken last stay
as long as there is room, for steps that are made again."""


class Border(Protocol):
    """What of the intake is asked here (see there)."""

    @property
    def config(self) -> CentreConfig: ...
    @property
    def frame(self) -> Frame | None: ...
    @property
    def sources(self) -> Mapping[str, Source]: ...
    def blank(self, name: str) -> Source: ...
    def declared(self, source: Source) -> SourceConfig: ...


class Asked(NamedTuple):
    """What a table follows from besides its message: the frame of the picture, the height of a source that states
    none, and the components that a track may have."""

    frame: Frame
    height: Height
    most: int


@dataclass(slots=True)
class _Made:
    """Of a message: its digest, the fault codes of its tracks, and its table with what it was made for."""

    message: LocalTracks
    code: int
    faults: NDArray[np.uint8]
    table: tuple[Asked, Tracks] | None


class Ahead:
    """What was made of queued messages."""

    def __init__(self) -> None:
        self._made: dict[int, _Made] = {}
        self._taken: deque[int] = deque()
        self._tracks = 0

    def make(self, message: Message, intake: Border) -> None:
        """All that can be, of a message that may be taken. Never raises: what is wrong with it is found in the step."""
        if not isinstance(message, LocalTracks) or not LARGE <= len(message.ids) <= MOST or id(message) in self._made:
            return
        source = intake.sources.get(message.source)
        if (source is not None and _is_refused(message, source)) or not self._has_room(len(message.ids)):
            return
        try:
            code, (faults,) = digest(message), check_numbers([message])
            table = None
            if intake.frame is not None and _is_plain(message) and not faults.any():
                height = intake.declared(source or intake.blank(message.source)).height
                asked = Asked(intake.frame, height, intake.config.max_components)
                table = asked, _table(message, faults, asked)
        except Exception:  # of what was never encoded, anything
            return
        self._made[id(message)] = _Made(message, code, faults, table)
        self._tracks += len(message.ids)

    def digest(self, message: Message) -> int:
        """Of a message. Raises `MessageError`."""
        known = self._made.get(id(message))
        return digest(message) if known is None else known.code

    def faults(self, messages: Sequence[Scan]) -> list[NDArray[np.uint8]]:
        """As `check_numbers`."""
        known = [self._made.get(id(message)) for message in messages]
        if not any(known):
            return check_numbers(messages)
        rest = iter(check_numbers([one for one, made in zip(messages, known, strict=True) if made is None]))
        return [next(rest) if made is None else made.faults for made in known]

    def table(self, message: LocalTracks, asked: Asked) -> Tracks | None:
        """The table of a message that is taken alone; None where it was not made, or for something else."""
        known = self._made.get(id(message))
        if known is None or known.table is None or known.table[0] != asked:
            return None
        count = len(message.ids)
        return altered(known.table[1], **unlinked(count))  # these columns are written to

    def _has_room(self, count: int) -> bool:
        """Make room for so many tracks, where it is not taken by what is queued: the oldest goes."""
        while self._taken and self._tracks + count > MOST:
            made = self._made.pop(self._taken.popleft())
            self._tracks -= len(made.message.ids)
        return self._tracks + count <= MOST

    def forget(self, queue: Sequence[tuple[Message, int]]) -> None:
        """Nothing but these messages is queued any more."""
        if len(self._made) > len(self._taken):
            held = {id(message) for message, _ in queue}
            self._taken = deque(key for key in self._made if key not in held)


def _is_refused(message: LocalTracks, source: Source) -> bool:
    """Whether it looks as if it were: nobody makes the centre work twice by saying everything again."""
    return source.muted or (message.epoch == source.epoch and message.time <= source.last)


def _is_plain(message: LocalTracks) -> bool:
    """Whether its tracks are Gaussian, and nothing in it gets a code, of which the order is that of the messages in a
    step."""
    columns = (message.identity, message.kind, message.lineage, message.track_lineage, message.counts, message.weights)
    return all(column is None for column in columns) and not tells_extent(message)


def _table(message: LocalTracks, faults: NDArray[np.uint8], asked: Asked) -> Tracks:
    codes = Lexicon(Words(), Words()), Lineages()
    return message_tracks([message], [faults == 0], asked.frame, asked.height, asked.most, *codes)
