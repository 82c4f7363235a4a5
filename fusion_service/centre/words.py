"""`Words`: the texts that sources say (identities, classes) as small codes, so that columns can hold them.

A text gets its code at first sight, and messages are seen in canonical order, so codes do not depend on arrival. What
nobody uses any more is forgotten when the table has grown, which changes the codes: the columns go with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["MOST_TEXT", "NONE", "Codes", "Lexicon", "Words"]

Codes = NDArray[np.int32]
NONE = -1
"""The code of no text."""
MOST_TEXT = 64
"""Characters of a text; a longer one, like an empty one, says nothing."""
ROOM = 1000


class Words:
    """A table of texts and their codes. texts: by code."""

    def __init__(self, texts: Iterable[str] = ()) -> None:
        self.texts: list[str] = []
        self._codes: dict[str | None, int] = {None: NONE}
        self._schemes = np.zeros(0, dtype=np.int32)
        self.codes([*texts])

    def codes(self, texts: Sequence[str | None]) -> Codes:
        """The codes of texts, new ones where they are new."""
        known = self._codes
        for text in dict.fromkeys(texts):
            if text is not None and text not in known and 0 < len(text) <= MOST_TEXT and text.isprintable():
                known[text] = len(self.texts)
                self.texts.append(text)
        return np.array([known.get(text, NONE) for text in texts], dtype=np.int32)

    def code(self, text: str | None) -> int:
        """The code of one text."""
        return int(self.codes([text])[0])

    def schemes(self) -> Codes:
        """The scheme of each text, what stands before its colon, as the code of the first text that has it."""
        if len(self._schemes) != len(self.texts):
            first: dict[str, int] = {}
            codes = [first.setdefault(text.partition(":")[0], k) for k, text in enumerate(self.texts)]
            self._schemes = np.array(codes, dtype=np.int32)
        return self._schemes

    def said(self, codes: Codes) -> tuple[str | None, ...]:
        """The texts of codes."""
        texts = self.texts
        return tuple([texts[code] if code >= 0 else None for code in codes.tolist()])

    def compacted(self, used: Iterable[Codes]) -> Codes | None:
        """Forget the texts that no column uses, where they are many: the new code of each old one, to index with a
        column (-1, the last, stays -1); None where the table stays."""
        if len(self.texts) < ROOM:
            return None
        mark = np.zeros(len(self.texts) + 1, dtype=np.bool_)
        for codes in used:
            mark[codes] = True
        mark[-1] = False
        if len(self.texts) < ROOM + 2 * int(mark.sum()):
            return None
        new = np.where(mark, np.cumsum(mark) - 1, NONE).astype(np.int32)
        texts = [text for text, there in zip(self.texts, mark[:-1].tolist(), strict=True) if there]
        self.texts, self._codes = texts, {None: NONE, **{text: k for k, text in enumerate(texts)}}
        self._schemes = self._schemes[:0]
        return new


class Lexicon(NamedTuple):
    """What is said of tracks in texts: identities and classes."""

    identity: Words
    kind: Words
