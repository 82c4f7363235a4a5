"""`Lineages`: which sources' data a track contains, as small codes so that columns can hold them.

A lineage is a set of names. Names and sets get their numbers at first sight, and messages are seen in canonical order,
so that numbers do not depend on arrival; what nobody uses any more is forgotten when the table has grown, which changes
the codes: the columns go with it. Where the table is full of what is in use, a new set is `ANYONE`, which overlaps all:
a lineage is never told smaller than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Ints
from schemas import GlobalTracks, LocalTracks

__all__ = ["ALONE", "ANYONE", "FEW", "NOBODY", "Codes", "Kin", "Lineages", "Masks", "overlapping"]

Kept = TypeVar("Kept", bound=np.generic)
Codes = NDArray[np.int32]
Masks = NDArray[np.uint64]
"""Sets as bits, (W, M): name k is bit k % 64 of word k // 64."""

ALONE = -1
"""Of a local track: its source alone. Of a global track: not known, as `ANYONE`."""
NOBODY, ANYONE = 0, 1
_NONE, _NO_BITS = np.zeros(0, dtype=np.int32), np.zeros((0, 0), dtype=np.uint8)
MOST_NAMES = 4096
MOST_SETS = 16_384
ROOM = 1000
FEW, RECALLED = 512, 64
"""Codes up to which what they come to is recalled, and how many such answers."""
MOST_BITS = 2**24
"""Of the sets of one message; beyond, each of its tracks counts as containing all that the message does."""


@dataclass(frozen=True, slots=True, eq=False)
class Kin:
    """Of M rows: code (M,) of the lineage of each in the table, and whether it contains data of this centre, (M,)."""

    table: Lineages
    code: Codes
    echo: Bools


class Lineages:
    """A table of names and of sets of them. names[0] stands for anyone at all."""

    def __init__(self) -> None:
        self.names: list[str] = [""]
        self._bits: dict[str, int] = {"": 0}
        self._sets: list[int] = [0, 1]
        self._codes: dict[int, int] = {0: NOBODY, 1: ANYONE}
        self._table: Masks = np.array([[0, 1]], dtype=np.uint64)
        self._recalled: dict[tuple[Any, ...], NDArray[Any]] = {}
        self._last: tuple[Any, Codes, tuple[tuple[str, ...], NDArray[np.uint8]]] = None, _NONE, ((), _NO_BITS)

    def __len__(self) -> int:
        return len(self._sets)

    def of(self, names: Iterable[str]) -> int:
        """The code of a set of names."""
        whole = 0
        for name in names:
            whole |= 1 << self._bit(name)
        return self._code(whole)

    def of_message(self, message: LocalTracks | GlobalTracks) -> Codes:
        """The codes (T,) of the tracks of a message, `ALONE` where nothing is said; a track of which no name is said
        contains all that the message does."""
        count, lineage = len(message.ids), message.lineage
        if not lineage:
            return np.full(count, ALONE, dtype=np.int32)
        if message.track_lineage is None or not count:
            return np.full(count, self.of(lineage), dtype=np.int32)
        bits = message.track_lineage.copy()
        if len(lineage) % 8:
            bits[:, -1] &= 2 ** (len(lineage) % 8) - 1
        sets, which = np.unique(bits, axis=0, return_inverse=True)
        if len(sets) * len(lineage) > MOST_BITS:
            return np.full(count, self.of(lineage), dtype=np.int32)
        said = np.unpackbits(sets, axis=1, count=len(lineage), bitorder="little").astype(np.bool_)
        said[~said.any(axis=1)] = True
        places = np.array([self._bit(name) for name in lineage], dtype=np.intp)
        whole = np.zeros((len(self.names), len(sets)), dtype=np.bool_)
        np.logical_or.at(whole, places, said.T)
        codes = [self._code(int.from_bytes(row.tobytes(), "little")) for row in _packed(whole)]
        return np.array(codes, dtype=np.int32)[which.reshape(-1)]

    def masks(self, codes: Codes) -> Masks:
        """The sets (W, M) of codes (M,)."""
        words, had = -(-len(self.names) // 64), self._table.shape[1]
        if words > len(self._table):
            self._table = np.concatenate([self._table, np.zeros((words - len(self._table), had), dtype=np.uint64)])
        if len(self._sets) > had:
            new = b"".join(whole.to_bytes(8 * words, "little") for whole in self._sets[had:])
            columns = np.frombuffer(new, dtype="<u8").astype(np.uint64).reshape(-1, words).T
            self._table = np.concatenate([self._table, columns], axis=1)
        return np.ascontiguousarray(self._table[:, np.where(codes < 0, ANYONE, codes)])

    def codes(self, masks: Masks) -> Codes:
        """The codes (M,) of sets (W, M)."""
        if not masks.shape[1]:
            return np.zeros(0, dtype=np.int32)
        if len(masks) == 1:
            flat, which = np.unique(masks[0], return_inverse=True)
            sets = flat[None]
        else:
            sets, which = np.unique(masks, axis=1, return_inverse=True)
        wholes = [sum(int(part) << (64 * word) for word, part in enumerate(row)) for row in sets.T.tolist()]
        found = np.array([self._code(whole) for whole in wholes], dtype=np.int32)
        return found[which.reshape(-1)]

    def union(self, codes: Codes) -> Masks:
        """The union (W, B) of the sets of each column of codes (k, B)."""
        return np.asarray(np.bitwise_or.reduce(self.masks(codes.reshape(-1)).reshape(-1, *codes.shape), axis=1))

    def contain(self, codes: Codes, name: str) -> Bools:
        """Which of the sets (M,) hold `name`, or anyone."""
        bits = [0, self._bits[name]] if name in self._bits else [0]
        if len(codes) <= FEW:
            return self.recalled(("contain", codes.tobytes(), *bits), lambda: self._contain(codes, bits))
        return self._contain(codes, bits)

    def recalled(self, key: tuple[Any, ...], make: Callable[[], NDArray[Kept]]) -> NDArray[Kept]:
        """What `make` gives, which is the same for a `key` that names the codes that it is of: no code changes what it
        stands for until `restore`. Not to be written to."""
        known = self._recalled.get(key)
        if known is None:
            if len(self._recalled) >= RECALLED:
                self._recalled.clear()
            known = self._recalled[key] = make()
            known.flags.writeable = False
        return known

    def _contain(self, codes: Codes, bits: list[int]) -> Bools:
        found = np.zeros(len(codes), dtype=np.bool_)
        masks = self.masks(codes)
        for bit in bits:
            found |= masks[bit // 64] >> np.uint64(bit % 64) & np.uint64(1) == 1
        return found

    def told(self, codes: Codes, known: Iterable[str], own: str) -> tuple[tuple[str, ...], NDArray[np.uint8]]:
        """What a picture says: the names that are in it, `own` the last, and the bits (T, ceil(L/8)) of its tracks.
        known: names that it tells in any case."""
        known = tuple(known)
        asked = known, own, len(self._sets), len(self.names)
        if asked == self._last[0] and len(codes) == len(self._last[1]) and (codes == self._last[1]).all():
            return self._last[2]
        masks = self.masks(codes)
        words = np.bitwise_or.reduce(masks, axis=1).tolist()
        used = [k for k in range(1, len(self.names)) if words[k // 64] >> (k % 64) & 1]
        names = (*sorted(({*known} | {self.names[k] for k in used}) - {own}), own)
        anyone = masks[0] & np.uint64(1) == 1
        bits = np.zeros((len(codes), len(names)), dtype=np.bool_)
        place = {name: at for at, name in enumerate(names)}
        for k in used:
            bits[:, place[self.names[k]]] = masks[k // 64] >> np.uint64(k % 64) & np.uint64(1) == 1
        bits[anyone] = True
        bits[:, -1] = True
        told = names, np.packbits(bits, axis=1, bitorder="little")
        self._last = asked, codes.copy(), told
        return told

    def compacted(self, used: Sequence[Codes]) -> Codes | None:
        """Forget the sets, and names, that no column uses, where they are many: the new code of each old one, to index
        with a column (-1, the last, stays -1); None where the table stays."""
        if len(self._sets) < ROOM and len(self.names) < ROOM:
            return None
        mark = np.zeros(len(self._sets) + 1, dtype=np.bool_)
        mark[:2] = True
        for codes in used:
            mark[codes] = True
        mark[-1] = False
        kept = np.flatnonzero(mark).astype(np.int32)
        rows = np.ascontiguousarray(self.masks(kept).T, dtype="<u8")
        bits = np.unpackbits(rows.view(np.uint8), axis=-1, count=None, bitorder="little")
        there = np.flatnonzero(bits.any(axis=0))
        if 2 * len(kept) > len(self._sets) - ROOM and 2 * len(there) > len(self.names) - ROOM:
            return None
        new = np.full(len(mark), ALONE, dtype=np.int32)
        names = [self.names[k] for k in there.tolist()]
        packed = [row.tobytes() for row in _packed(bits[:, there].T.astype(np.bool_))]
        self.restore({"names": names[1:], "sets": packed[2:]})
        new[kept] = np.arange(len(kept))
        return new

    def kept(self) -> dict[str, Any]:
        """What a checkpoint holds of it, as plain values."""
        packed = [one.to_bytes(-(-one.bit_length() // 8), "little") for one in self._sets[2:]]
        return {"names": self.names[1:], "sets": packed}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        Lineages.__init__(self)
        for name in kept["names"]:
            self._bit(str(name))
        for packed in kept["sets"]:
            self._code(int.from_bytes(packed, "little"))

    def _bit(self, name: str) -> int:
        if name not in self._bits:
            if len(self.names) >= MOST_NAMES:
                return 0
            self._bits[name] = len(self.names)
            self.names.append(name)
        return self._bits[name]

    def _code(self, whole: int) -> int:
        if whole not in self._codes:
            if len(self._sets) >= MOST_SETS:
                return ANYONE
            self._codes[whole] = len(self._sets)
            self._sets.append(whole)
        return self._codes[whole]


def _packed(bits: Bools) -> NDArray[np.uint8]:
    """Sets (names, S) as bytes (S, ceil(names/8)), the first name the lowest bit."""
    return np.packbits(bits.T, axis=1, bitorder="little")


def overlapping(masks: Masks, members: Ints) -> Bools:
    """Which rows of each of B groups have data in common (B, k, k). members (B, k): columns of masks (W, M)."""
    sets = masks[:, members]
    meet = (sets[:, :, :, None] & sets[:, :, None, :]).any(axis=0)
    anyone = sets[0] & np.uint64(1) == 1
    return np.asarray(meet | anyone[:, :, None] | anyone[:, None, :])
