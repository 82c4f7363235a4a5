"""The pictures of one centre as a page draws them: what of every track is a number, its texts, and where it was.

A track has a slot, a small number that stands for its id as long as the picture holds it, so that a page needs no
64-bit numbers. Texts go out once, and again when they change; numbers with every picture. All is bounded: tracks by
`MOST_TRACKS`, the trails by points in time and numbers in all, texts by their length.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.console.packing import packed
from fusion_service.console.places import Places, flat_name, frame_words, places
from fusion_service.labels import Labels
from fusion_service.ways import fused_by
from schemas import Enu, GlobalTracks, Wholes

__all__ = ["MOST_TRACKS", "TRAIL", "Pictures", "cut"]

MOST_TRACKS = 20_000
TRAIL = 60
"""Points in time of the trails."""
EVERY = 1.0
"""Seconds between two of them at least."""
GAPS, FEW = 120, 20
"""Times between two pictures by which the usual one is known: at most, and so many that one may be an outage."""
MOST_POINTS = 600_000
LONGEST = 80
"""Characters of a text that are shown."""
SILENCE = 10.0
"""Seconds after which a run of the centre with a smaller epoch is believed."""

U32 = NDArray[np.uint32]


class _Point(NamedTuple):
    """A moment of the trails: which slots were where."""

    slots: U32
    x: Floats
    y: Floats


class _Texts(NamedTuple):
    """A track's: slot, version of the picture since which they stand, label, callsign, identity, kind, number."""

    slot: int
    since: int
    said: tuple[str, str, str, str, int]


def cut(text: Any) -> str:
    """A text as it may be shown: of bounded length; nothing for what is none."""
    return text[:LONGEST] if isinstance(text, str) else ""


class Pictures:
    """What is known of the pictures of one centre. version: grows with each; frame: the newest as bytes; whole, places:
    it, and where its tracks are; received: when it came, monotonic s."""

    def __init__(self) -> None:
        self.version = 0
        self.frame = b""
        self.whole: GlobalTracks | None = None
        self.places: Places | None = None
        self.received = 0.0
        self.label = Labels()
        self._gaps: deque[float] = deque(maxlen=GAPS)
        self._interrupted = False
        self._wholes = Wholes()
        self._texts: dict[int, _Texts] = {}
        self._next = 0
        self._trail: deque[_Point] = deque(maxlen=TRAIL)
        self._marked = -EVERY
        self._ground: object = None
        self._around = 0.0
        """The longitude about which the map lies, degrees."""

    def take(self, message: GlobalTracks, now: float) -> bool:
        """Take a picture that came at `now`, s; whether it is one to show."""
        before = self.whole
        if before is not None and message.epoch < before.epoch and now - self.received < SILENCE:
            return False
        whole = self._wholes.of(message)
        if whole is None:
            return False
        self.label.see(message)
        if self.whole is not None and not self._interrupted:
            self._gaps.append(now - self.received)
        self._interrupted = False
        self.whole, self.received = whole, now
        self.version += 1
        self._show(whole, now)
        return True

    @property
    def interval(self) -> float:
        """The usual time between two pictures, s, where they come several at a time that between two times: the longest
        of the last ones, or of many the longest but one."""
        gaps = sorted(self._gaps)
        return gaps[-1 - (len(gaps) >= FEW)] if gaps else 0.0

    def interrupted(self) -> None:
        """Centre or hub has gone: until the next picture is no usual time."""
        self._interrupted = True

    def _show(self, whole: GlobalTracks, now: float) -> None:
        self._settle(whole)
        where = self.places = places(whole, self._around)
        rows = np.flatnonzero(where.sound)[:MOST_TRACKS]
        slots = self._slots(whole, rows)
        if now - self._marked >= EVERY:
            self._marked = now
            self._trail.append(_Point(slots, where.x[rows], where.y[rows]))
            while sum(len(one.slots) for one in self._trail) > MOST_POINTS:
                self._trail.popleft()
        self.frame = self._packed(whole, where, rows, slots)

    def _settle(self, whole: GlobalTracks) -> None:
        """On which ground the picture is: a plane with a name, or the Earth about a longitude, of the first picture."""
        ground = flat_name(whole.frame)
        if self.version > 1 and ground == self._ground:
            return
        self._trail.clear()
        if isinstance(whole.frame, Enu):
            self._around = whole.frame.lon
        elif ground is None and (there := places(whole)).sound.any():
            self._around = float(there.x[there.sound][0])
        elif ground is None:
            return
        self._ground = ground

    def _slots(self, whole: GlobalTracks, rows: NDArray[np.intp]) -> U32:
        """The slots of these rows; notes their texts, and forgets those of tracks that are gone."""
        count = len(whole.ids)
        texts = [_column(column, count) for column in (whole.callsign, whole.identity, whole.kind)]
        numbers = whole.number.tolist() if whole.number is not None else [0] * count
        ids, known, slots = whole.ids.tolist(), self._texts, []
        for row in rows.tolist():
            track = ids[row]
            callsign, identity, kind = (column[row] for column in texts)
            said = self.label(track), cut(callsign), cut(identity), cut(kind), numbers[row]
            before = known.get(track)
            if before is None:
                known[track] = before = _Texts(self._next, self.version, said)
                self._next += 1
            elif before.said != said:
                known[track] = before._replace(since=self.version, said=said)
            slots.append(before.slot)
        if len(known) > len(slots):
            for track in known.keys() - {ids[row] for row in rows.tolist()}:
                del known[track]
        return np.array(slots, dtype=np.uint32)

    def _packed(self, whole: GlobalTracks, where: Places, rows: NDArray[np.intp], slots: U32) -> bytes:
        ways, which = fused_by(whole)
        header = {
            "type": "picture",
            "version": self.version,
            "time": whole.time // 10**6,
            "step": whole.step,
            "rule": cut(whole.rule),
            "frame": frame_words(whole.frame),
            "around": self._around,
            "ways": [cut(one) for one in ways],
            "left_out": len(whole.ids) - len(rows),
        }
        age = (whole.time - whole.updated[rows]) / 1e9
        marks = whole.marks[rows] if whole.marks is not None else np.zeros(len(rows), dtype=np.uint8)
        small = {name: getattr(where, name)[rows].astype(np.float32) for name in ("major", "minor", "turn", "vx", "vy")}
        columns = {
            "slot": slots,
            "x": where.x[rows],
            "y": where.y[rows],
            **small,
            "age": age.astype(np.float32),
            "status": whole.status[rows],
            "marks": marks,
            "existence": np.clip(np.rint(255 * np.nan_to_num(whole.existence[rows])), 0, 255).astype(np.uint8),
            "sources": np.minimum(whole.contributor_counts[rows], 255).astype(np.uint8),
            "way": which[rows].astype(np.uint8),
        }
        return packed(header, columns)

    def texts_since(self, version: int) -> list[list[Any]]:
        """[slot, id, label, callsign, identity, kind, number] of the tracks whose texts are newer than `version`."""
        return [[one.slot, str(track), *one.said] for track, one in self._texts.items() if one.since > version]

    def trail(self) -> bytes:
        """Where the tracks were, as bytes: the points one after another, the oldest first."""
        points = self._trail
        slots = np.concatenate([np.zeros(0, dtype=np.uint32), *(one.slots for one in points)])
        x = np.concatenate([np.zeros(0), *(one.x for one in points)])
        y = np.concatenate([np.zeros(0), *(one.y for one in points)])
        return packed({"type": "trail", "counts": [len(one.slots) for one in points]}, {"slot": slots, "x": x, "y": y})

    def row(self, track: int) -> int | None:
        """The row of a track in the newest picture."""
        if self.whole is None:
            return None
        rows = np.flatnonzero(self.whole.ids == np.uint64(track))
        return int(rows[0]) if len(rows) else None


def _column(column: Sequence[str | None] | None, count: int) -> Sequence[str | None]:
    return column if column is not None else (None,) * count
