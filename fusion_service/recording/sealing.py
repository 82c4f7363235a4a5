"""Seals in the file of a recording.

    /seal/signer    static: the certificate or public key, PEM, empty for a recording that is not signed
    /seal/chain     a row for each seal: its statement, the digests of its block, its signature

The signer is written at the head and again at the end of a part, so that a damage does not take both. A part begins
with the seal of an empty block: what has messages has seals.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fusion_service.recording.chain import Chain, Link, Seal
from fusion_service.recording.columns import import_rerun
from fusion_service.recording.reader import stored
from fusion_service.recording.signing import Signer

__all__ = ["CHAIN", "SIGNER", "Sealer", "last_link", "seals_of", "signers_of"]

log = logging.getLogger(__name__)

CHAIN, SIGNER = "/seal/chain", "/seal/signer"
FEW = 4
"""Parts at the end of a mission in which its chain is looked for: one that was torn at its beginning has none."""


class Sealer:
    """Seals what a recorder writes. signer: None for a chain without signatures; keeps: whether old parts may go."""

    def __init__(self, signer: Signer | None, *, keeps: bool = False) -> None:
        self._signer = signer
        self._keeps = keeps
        self._link = Link()
        self._count = 0

    def follow(self, link: Link) -> None:
        """Go on from the chain of an earlier recorder, in the part that begins next."""
        self._link = link

    def begin(self, stream: Any, recording: str, part: int) -> None:
        """A part begins, in `stream`."""
        self._stream = stream
        named = self._signer.fingerprint if self._signer else ""
        self._chain = Chain(recording, part, self._link, keeps=self._keeps, signer=named)
        self._count = 0
        self._sign_on()
        self._write("")

    def add(self, key: str, data: bytes, received: int, *, standing: bool = False) -> None:
        """The next message of the part."""
        self._chain.add(received, key, data, standing=standing)
        self._count += 1

    def seal(self, ends: str = "") -> None:
        """Write the seal of what came since the last one; of nothing, where a part or the recording ends."""
        if self._chain.waiting or ends:
            self._write(ends)
        if ends:
            self._sign_on()

    def _write(self, ends: str) -> None:
        rr = import_rerun()
        text, digests = self._chain.close(ends)
        self._link = self._chain.link
        index = rr.TimeColumn("arrival", sequence=[max(self._count - 1, 0)])
        try:
            signature = self._signer.sign(text) if self._signer else b""
            self._stream.send_columns(CHAIN, [index], _seal(rr, text, digests, signature), strict=True)
        except Exception:
            log.exception("a seal cannot be written")

    def _sign_on(self) -> None:
        identity = self._signer.identity if self._signer else ""
        self._stream.log(SIGNER, _signer(import_rerun(), identity), static=True)


def seals_of(chunk: Any) -> Iterator[Seal | None]:
    """The seals in a chunk of `CHAIN`; None for what is none."""
    rows = chunk.to_record_batch()
    names = [f"Seal:{name}" for name in ("statement", "digests", "signature")]
    if not set(names) <= set(rows.schema.names):
        yield None
        return
    for row in zip(*(rows.column(name).to_pylist() for name in names), strict=True):
        try:
            yield Seal.read(*(cell[0] if cell else None for cell in row))
        except (ValueError, TypeError, KeyError):
            yield None


def signers_of(chunk: Any) -> list[str]:
    """The identities in a chunk of `SIGNER`."""
    rows = chunk.to_record_batch()
    if "Signer:identity" not in rows.schema.names:
        return []
    cells = rows.column("Signer:identity").to_pylist()
    return [cell[0] for cell in cells if cell and isinstance(cell[0], str) and cell[0]]


def last_link(there: Sequence[Path]) -> Link:
    """Where the chain of a mission in parts has come to; its beginning if the last few have no seals."""
    for path in there[-FEW:][::-1]:
        try:
            return max(seal.link for chunk in stored(path, [CHAIN]) for seal in seals_of(chunk) if seal)
        except (ValueError, OSError, RuntimeError):  # without seals, or unread
            continue
    return Link()


def _seal(rr: Any, text: str, digests: bytes, signature: bytes) -> list[Any]:
    import pyarrow as pa

    components = {
        "statement": pa.array([text], pa.string()),
        "digests": pa.array([digests], pa.binary()),
        "signature": pa.array([signature], pa.binary()),
    }
    return [*rr.DynamicArchetype.columns(archetype="Seal", components=components)]


def _signer(rr: Any, identity: str) -> Any:
    return rr.DynamicArchetype(archetype="Signer", components={"identity": [identity]})
