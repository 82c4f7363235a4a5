"""The chain of hashes over the messages of a recording.

Every message has a digest, SHA-256 over its receive time, its key and its bytes (and whether it is one that a part
repeats). What came between two flushes is a block; the seal of a block says, as text (JSON),

    recording, part    whose block it is; part 0 for a recording of one file
    number, previous   which seal of the mission, from 0; the hash of the seal before it, of the part before too
    first, count       arrival numbers, in this part, of the messages in the block
    repeated, total    messages at the head of the part that it repeats; messages of the mission until now without such
    time               when the last message was received, ns UTC, 0 before the first
    ends               "" , "part" or "recording": nothing comes after it in the part
    keeps              whether old parts of this mission may be deleted by its recorder
    digests            SHA-256 over the digests of the block, one after the other; they stand beside the seal
    signer             SHA-256 over the certificate, or public key, that its signature is checked with

and its hash is SHA-256 over that text. So each hash stands for all messages before it, and the same messages with the
same flushes have the same chain. A digest beside its seal says which message it is that is not as it was.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

__all__ = ["DIGEST", "Chain", "Link", "Seal", "Statement", "digest", "signed_bytes"]

DIGEST = 32
"""Bytes of a digest."""
LONGEST = 4096
"""Letters of a statement."""
_HEAD = struct.Struct("<?qI")
_KINDS = ("", "part", "recording")


class Link(NamedTuple):
    """Where a chain has come to: the number of its last seal, that seal's hash, messages of the mission, and when the
    last of them was received."""

    number: int = -1
    hash: str = ""
    total: int = 0
    time: int = 0


@dataclass(frozen=True, slots=True)
class Statement:
    """What a seal says, as at the head of this module."""

    recording: str
    part: int
    number: int
    previous: str
    first: int
    count: int
    repeated: int
    total: int
    time: int
    ends: str
    keeps: bool
    digests: str
    signer: str

    @property
    def new(self) -> int:
        """Messages of the block that no part before holds."""
        return max(self.first + self.count - self.repeated, 0) - max(self.first - self.repeated, 0)


class Seal(NamedTuple):
    """A statement, as text and as read; the digests of its block; its signature, empty for none."""

    text: str
    statement: Statement
    digests: bytes
    signature: bytes

    @property
    def hash(self) -> str:
        """What the next seal names."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def link(self) -> Link:
        """From where the chain goes on."""
        return Link(self.statement.number, self.hash, self.statement.total, self.statement.time)

    @classmethod
    def read(cls, text: Any, digests: Any, signature: Any) -> Seal:
        """From what a file holds. Raises ValueError for what no recorder writes."""
        if not (isinstance(text, str) and isinstance(digests, bytes) and isinstance(signature, bytes)):
            raise ValueError("not a seal")
        return cls(text, _parse(text), digests, signature)


def digest(received: int, key: str, data: bytes, standing: bool = False) -> bytes:
    """Of one message. standing: it is repeated from an earlier part."""
    name = key.encode("utf-8", "surrogatepass")
    made = hashlib.sha256(_HEAD.pack(standing, received, len(name)) + name)
    made.update(data)
    return made.digest()


def signed_bytes(text: str) -> bytes:
    """What is signed of a statement: no signature made for anything else will do."""
    return b"track fusion seal 1\n" + text.encode()


class Chain:
    """The chain of one part as it grows. recording: its id; link: where the part before it ended."""

    def __init__(self, recording: str, part: int, link: Link, *, keeps: bool = False, signer: str = "") -> None:
        self.link = link
        self._recording, self._part = recording, part
        self._keeps, self._signer = keeps, signer
        self._digests: list[bytes] = []
        self._first = self._repeated = 0
        self._received = link.time

    @property
    def waiting(self) -> int:
        """Messages that no seal stands for yet."""
        return len(self._digests)

    def add(self, received: int, key: str, data: bytes, *, standing: bool = False) -> None:
        """The next message of the part."""
        self._digests.append(digest(received, key, data, standing))
        self._repeated += standing
        self._received = received

    def close(self, ends: str = "") -> tuple[str, bytes]:
        """End a block: the statement to be signed, and its digests."""
        digests, first = b"".join(self._digests), self._first
        count = len(self._digests)
        self._digests.clear()
        self._first += count
        new = max(self._first - self._repeated, 0) - max(first - self._repeated, 0)
        statement = Statement(
            recording=self._recording,
            part=self._part,
            number=self.link.number + 1,
            previous=self.link.hash,
            first=first,
            count=count,
            repeated=self._repeated,
            total=self.link.total + new,
            time=self._received,
            ends=ends,
            keeps=self._keeps,
            digests=hashlib.sha256(digests).hexdigest(),
            signer=self._signer,
        )
        text = json.dumps(asdict(statement), separators=(",", ":"))
        self.link = Seal(text, statement, digests, b"").link
        return text, digests


def _parse(text: str) -> Statement:
    if len(text) > LONGEST:
        raise ValueError("a statement too long")
    try:
        said = json.loads(text)
    except RecursionError:
        raise ValueError("a statement too deep") from None
    if not isinstance(said, dict) or set(said) != set(Statement.__dataclass_fields__):
        raise ValueError("not a statement")
    for name, kind in Statement.__annotations__.items():
        value = said[name]
        if type(value).__name__ != kind or (kind == "int" and not -(2**63) <= value < 2**63):
            raise ValueError(f"{name}: not a statement")
    whole = all(said[name] >= 0 for name in ("part", "number", "first", "count", "repeated", "total"))
    if not whole or said["ends"] not in _KINDS:
        raise ValueError("not a statement")
    return Statement(**said)
