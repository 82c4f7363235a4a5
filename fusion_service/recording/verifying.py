"""Whether a recording is as its recorder left it: its messages beside the seals of their blocks (`chain`), the seals
beside each other, and their signatures.

A fault is a message that is not the one that was sealed, is missing, or is there twice; a seal that is not what was
signed, does not follow on the one before, or is missing; messages after the end. No fault, but said: a recording that
its recorder did not end (what came after its last seal is not sealed), parts that the recorder may delete and that are
gone, the beginning of a mission that is not in what is read, no seals at all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from fusion_service.errors import ReviewError, Stopped
from fusion_service.recording.chain import DIGEST, Link, Seal, Statement, digest
from fusion_service.recording.finding import Finding, Gathered, at, span
from fusion_service.recording.parts import number_of, parts
from fusion_service.recording.reader import RawMessage, read_file
from fusion_service.recording.salvage import NOTHING_YET, nothing_yet
from fusion_service.recording.sealing import CHAIN, SIGNER, seals_of, signers_of
from fusion_service.recording.signing import Authority, Identity, fingerprint, import_cryptography

__all__ = ["verify"]

MINUTE = 60 * 10**9
PATIENCE = 100_000
"""Messages that are kept for seals that do not come: then it is taken for a recording without any."""


def verify(path: Path, authority: Authority | None = None, stopped: Callable[[], bool] = lambda: False) -> Finding:
    """Read a recording, or a folder of parts, and compare it with its seals. Raises `FileNotFoundError`, `ReviewError`
    for what is no recording, `Stopped`."""
    mission = _Mission(authority, path.is_dir())
    if not path.is_dir():
        _check(path, mission, "", stopped)
        return mission.told()
    there = parts(path)
    if not there:
        raise FileNotFoundError(f"no recordings 0001.rrd, ... in {path}")
    unread, begun = 0, 0
    for one in there:
        try:
            _check(one, mission, f" of part {number_of(one)}", stopped)
        except FileNotFoundError:  # its recorder has deleted it meanwhile
            continue
        except ReviewError:  # torn at its beginning; if it held what was sealed, the chain says so
            if nothing_yet(one):
                mission.found.note(f"part {number_of(one)} has just begun")
                begun += 1
            else:
                mission.found.note(f"part {number_of(one)} cannot be read")
                unread += 1
    if begun == len(there):
        raise ReviewError(f"{path}: {NOTHING_YET}")
    if unread + begun == len(there):
        raise ReviewError(f"{path}: none of its parts can be read")
    return mission.told()


def _check(path: Path, mission: _Mission, where: str, stopped: Callable[[], bool]) -> None:
    """Of a file without seals little is kept; one whose seals come long after its messages is read twice."""
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    for patience in (PATIENCE, None):
        part = _Part(mission, where, patience)
        for message, standing in read_file(path, None, part):
            if stopped():
                raise Stopped("stopped while the recording was compared with its seals")
            part.message(message, standing)
        if not part.late:
            break
    part.finish()


class _Mission:
    """What goes on from part to part."""

    def __init__(self, authority: Authority | None, folder: bool) -> None:
        self.found = Gathered()
        self.folder = folder
        self.link: Link | None = None
        """Of the last seal; None before the first."""
        self.recording = ""
        self.leftover = 0
        """Messages of the part before that no seal stands for."""
        self.ends = ""
        """How the last part ended."""
        self._authority = authority
        self._doubts: dict[tuple[str, int], str] = {}

    def follow(self, seal: Seal, new_part: bool, where: str) -> None:
        """Compare a seal with the one before."""
        said, link, here = seal.statement, self.link, at(seal.statement.first, where, seal.statement.time)
        if self.recording and said.recording != self.recording:
            self.found.fault(f"chain broken at {here}: from there on it is of another recording")
        elif link is None and said.number and (said.part < 2 or self.leftover):
            self.found.fault(f"chain broken at {here}: {said.number} seals before it are missing")
        elif link is None and said.number:
            self._begins_late(said)
        elif link is None and self.leftover:
            self.found.note(f"{self.leftover:,} messages before part {said.part} have no seals")
            self.found.unsealed += self.leftover
            self.found.unsigned = True
        elif link is None and said.previous:
            self.found.fault(f"chain broken at {here}: the first seal follows on another")
        elif link is not None and new_part and said.number == 0 and not said.previous:
            self.found.note(f"part {said.part} begins a chain of its own, for that before it could not be read")
        elif link is not None and said.number != link.number + 1:
            missing = max(said.total - said.new - link.total - self.leftover, 0) if new_part else 0
            self.found.missing += missing
            seals = f"{max(said.number - link.number - 1, 0):,} seals"
            self.found.fault(
                f"{missing:,} messages missing before {here}, with {seals}"
                if missing
                else f"chain broken at {here}: {seals} before it are missing"
            )
        elif link is not None and said.previous != link.hash:
            self.found.fault(f"chain broken at {here}: its seal does not follow on the one before it")
        self.recording, self.link = said.recording, seal.link

    def _begins_late(self, said: Statement) -> None:
        before = max(said.total - said.new, 0)
        text = f"begins with part {said.part}; {before:,} messages before it"
        if not self.folder:
            self.found.note(f"{text} are in parts before")
        elif said.keeps:
            self.found.note(f"{text} are gone with parts that its recorder may delete")
        else:
            self.found.missing += before
            self.found.fault(f"{text} are missing, and its recorder deletes none")

    def vouched(self, identity: Identity, mark: str, time: int) -> None:
        """Note a good signature, and what the authority says of it."""
        self.found.signed(identity.name, mark)
        if self._authority is not None and not self.found.doubts:
            key = mark, time // MINUTE
            if key not in self._doubts:
                self._doubts[key] = self._authority.doubts(identity, time)
            self.found.doubts = self._doubts[key]

    def told(self) -> Finding:
        """The finding."""
        if self.found.sealed and not self.ends:
            self.found.open = "not ended by its recorder: it runs, was killed, or the end was cut off"
        elif self.found.sealed and self.folder and self.ends == "part":
            self.found.open = "a part that followed is not there, or its recorder was killed just then"
        self.found.unsigned |= not self.found.sealed
        return self.found.told(self._authority is not None)


class _Held(NamedTuple):
    """What is kept of a message until its seal is there."""

    digest: bytes
    standing: bool


class _Part:
    """The check of one file. Messages come in the order of their numbers, seals whenever they come."""

    def __init__(self, mission: _Mission, where: str, patience: int | None) -> None:
        self.late = False
        """Whether seals came after messages that were not kept for them."""
        self._mission, self._found, self._where = mission, mission.found, where
        self._patience = patience
        self._held: dict[int, _Held] = {}
        self._seals: dict[int, Seal] = {}
        self._passed: dict[int, str] = {}
        self._signers: dict[str, Identity | None] = {}
        self._named: set[str] = set()
        self._unchecked: list[Seal] = []
        self._after: list[str] = []
        self._messages = self._next = 0
        self._seen = self._last = -1
        self._ends = ""

    def seals(self, chunk: Any) -> None:
        """A chunk of seals, or of signers."""
        self.late |= self._impatient
        if self.late:
            return
        if chunk.entity_path == SIGNER:
            for pem in signers_of(chunk):
                if fingerprint(pem) not in self._signers:
                    self._signers[fingerprint(pem)] = _identity(pem, self._found)
        for seal in seals_of(chunk) if chunk.entity_path == CHAIN else ():
            if seal is None:
                self._later(f"a seal{self._where} cannot be read")
                continue
            number = seal.statement.number
            known = self._passed.get(number) or (self._seals[number].hash if number in self._seals else "")
            if known and known != seal.hash:
                self._later(f"there are two seals with the number {number}{self._where}")
            elif not known and number <= self._last:
                self._later(f"seal {number}{self._where} is one of an earlier part")
            elif not known:
                self._seals[number] = seal

    @property
    def _impatient(self) -> bool:
        known = self._seals or self._passed or self._signers
        return not known and self._patience is not None and self._messages > self._patience

    def message(self, message: RawMessage, standing: bool) -> None:
        """The next message."""
        self._messages += 1
        if self._impatient:
            self._held.clear()
            return
        number = message.arrival
        if number in self._held or number < self._next:
            self._later(f"message {number:,}{self._where} is there twice")
            return
        self._held[number] = _Held(digest(message.received, message.key, message.data, standing), standing)
        self._seen = max(self._seen, number)
        self._advance(False)

    def double(self, message: RawMessage) -> None:
        """A message whose number was read already."""
        self._later(f"message {message.arrival:,}{self._where} is there twice")

    def finish(self) -> None:
        """All was read."""
        sealed = bool(self._seals or self._passed)
        self._advance(True)
        for seal in self._unchecked:
            self._signed(seal, self._signers.get(seal.statement.signer))
        for text in self._after:
            self._found.fault(text)
        self._found.messages += self._messages
        if not sealed:
            if self._messages and (self._found.sealed or self._after):
                self._found.fault(f"no seals{self._where}")
            self._mission.leftover += self._messages
            return
        self._found.sealed = True
        if self._held and self._ends:
            self._found.fault(f"{len(self._held):,} messages{self._where} stand after its end: {span(self._held)}")
        elif self._held:
            self._found.unsealed += len(self._held)
            self._found.note(f"{len(self._held):,} messages{self._where} are not sealed: {span(self._held)}")
        self._mission.leftover = sum(not held.standing for held in self._held.values())
        self._mission.ends = self._ends
        if len(self._named) > 1:
            self._found.fault(f"the seals{self._where or ' of the recording'} are not all signed by the same")

    def _later(self, text: str) -> None:
        """A fault that is told with the file's end."""
        if text not in self._after[-1:] and len(self._after) < 1000:
            self._after.append(text)

    def _advance(self, all_read: bool) -> None:
        """Pass the seals whose messages are there, in their order."""
        while self._seals:
            number = self._last + 1
            if self._last < 0:
                number = min((n for n, seal in self._seals.items() if seal.statement.first == 0), default=-1)
            if all_read and number not in self._seals:
                number = min(self._seals)
            seal = self._seals.get(number)
            if seal is None or not (all_read or self._seen >= seal.statement.first + seal.statement.count - 1):
                return
            del self._seals[number]
            self._pass(seal)

    def _pass(self, seal: Seal) -> None:
        said = seal.statement
        if self._ends:
            self._found.fault(f"seal {said.number}{self._where} stands after the end")
        self._mission.follow(seal, self._last < 0, self._where)
        self._last, self._passed[said.number], self._ends = said.number, seal.hash, said.ends
        between = [number for number in self._held if number < said.first]
        absent = said.first - self._next - len(between)
        if between:
            self._found.fault(f"{len(between):,} messages{self._where} have no seal: {span(between)}")
        if absent > 0:
            self._found.missing += absent
            self._found.fault(
                f"{absent:,} messages missing before {at(said.first, self._where, said.time)}, and the seal"
            )
        for number in between:
            del self._held[number]
        if len(seal.digests) != DIGEST * said.count or hashlib.sha256(seal.digests).hexdigest() != said.digests:
            self._found.fault(
                f"chain broken at {at(said.first, self._where, said.time)}: the digests are not those that were sealed"
            )
            for number in [number for number in self._held if number < said.first + said.count]:
                del self._held[number]
        else:
            self._compare(seal)
        self._next = max(self._next, said.first + said.count)
        self._signature(seal)

    def _compare(self, seal: Seal) -> None:
        """The messages of a block with their digests."""
        said, missing = seal.statement, list[int]()
        wanted = [seal.digests[k : k + DIGEST] for k in range(0, len(seal.digests), DIGEST)]
        places: dict[bytes, int] | None = None
        for number, want in enumerate(wanted, said.first):
            held = self._held.pop(number, None)
            if held is None:
                missing.append(number)
            elif held.digest == want:
                self._found.whole += 1
            else:
                places = places or {one: place for place, one in enumerate(wanted, said.first)}
                moved = places.get(held.digest)
                why = "it is not what was sealed" if moved is None else f"there stands what was message {moved:,}"
                self._found.fault(f"chain broken at {at(number, self._where, said.time)}: {why}")
        if missing:
            self._found.missing += len(missing)
            some = "" if len(missing) == missing[-1] - missing[0] + 1 else "some of "
            sealed = at(missing[0], self._where, said.time).partition(", ")[2]
            self._found.fault(f"{len(missing):,} messages missing: {some}{span(missing)}{self._where}, {sealed}")

    def _signature(self, seal: Seal) -> None:
        """Check it, or keep it until the signer is read: tools that merge files put what is static at their end."""
        signer = seal.statement.signer
        self._named.add(signer)
        self._found.unsigned |= not signer
        if signer in self._signers:
            self._signed(seal, self._signers[signer])
        elif signer:
            self._unchecked.append(seal._replace(digests=b""))

    def _signed(self, seal: Seal, identity: Identity | None) -> None:
        said = seal.statement
        here = at(said.first, self._where, said.time)
        if self._found.unchecked:
            return
        if identity is None:
            self._found.fault(f"chain broken at {here}: the certificate that its seal names is not there")
        elif not identity.signed(seal.text, seal.signature):
            self._found.fault(f"chain broken at {here}: the signature of its seal is not by {identity.name}")
        else:
            self._mission.vouched(identity, said.signer, said.time)


def _identity(pem: str, found: Gathered) -> Identity | None:
    try:
        import_cryptography()
    except ImportError:
        found.unchecked = True
        return None
    return Identity.read(pem)
