"""What was found of a recording's seals, in a line and as plain values."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any

from fusion_service.extras import install_hint

__all__ = ["Finding", "Gathered", "at", "span"]

MOST = 20
"""Faults, notes and signers that are told one by one."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What was found.

    state: "whole"; "open": whole as far as it is sealed, but not ended by its recorder, or not all sealed; "broken";
    "doubtful": not broken, but not, or not all of it, signed by whom the authority given vouches for, or signatures
    could not be checked; "not sealed". messages: that were read; whole: of these, those that are as they were sealed;
    missing: sealed, and not there; unsealed: that no seal stands for. faults: the first of `count`. signers: by the
    names in their certificates, empty without signatures. doubts: why the authority does not vouch.
    """

    state: str
    messages: int
    whole: int
    missing: int
    unsealed: int
    count: int
    faults: tuple[str, ...]
    signers: tuple[str, ...]
    doubts: str
    notes: tuple[str, ...]

    @property
    def bad(self) -> bool:
        """Whether it is an alarm."""
        return self.state in ("broken", "doubtful") or bool(self.doubts)

    def __str__(self) -> str:
        if self.state == "not sealed" and not self.messages:
            return "; ".join(["nothing has been recorded in it yet", *[self.doubts] * bool(self.doubts)])
        if self.state == "not sealed":
            text = "not sealed: recorded by a version without seals, or by another program"
            return "; ".join([text, *[self.doubts] * bool(self.doubts)])
        said = [*self.faults[:1]]
        if self.count > 1:
            missing = f", {self.missing:,} messages missing in all" if self.missing else ""
            said.append(f"{self.count - 1:,} more faults{missing}")
        said += [self.doubts] * bool(self.doubts)
        who = f"signed by {', '.join(self.signers)}" if self.signers else "no signature"
        if self.state in ("whole", "open") or (self.state == "doubtful" and not said):
            said.append(f"{who}, whole: {self.whole:,} messages")
        else:
            said.append(f"{who}; {self.whole:,} of {self.messages:,} messages are as they were sealed")
        return "; ".join([*said, *self.notes])

    def as_json(self) -> dict[str, Any]:
        """Plain values; `text` is the line."""
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
        return {"text": str(self), **plain}


@dataclass
class Gathered:
    """A finding while it is made; fields as in `Finding`."""

    messages: int = 0
    whole: int = 0
    missing: int = 0
    unsealed: int = 0
    count: int = 0
    sealed: bool = False
    unsigned: bool = False
    unchecked: bool = False
    open: str = ""
    faults: list[str] = field(default_factory=list)
    signers: list[str] = field(default_factory=list)
    keys: set[str] = field(default_factory=set)
    doubts: str = ""
    notes: list[str] = field(default_factory=list)

    def fault(self, text: str) -> None:
        """One more."""
        self.count += 1
        if len(self.faults) < MOST:
            self.faults.append(text)

    def note(self, text: str) -> None:
        """What is no fault."""
        if len(self.notes) < MOST and text not in self.notes:
            self.notes.append(text)

    def signed(self, name: str, key: str) -> None:
        """A signature was good. key: the fingerprint of whose it is."""
        self.keys.add(key)
        if len(self.signers) < MOST and name not in self.signers:
            self.signers.append(name)

    def told(self, asked: bool) -> Finding:
        """asked: whether an authority was given, so that what nobody signed is an alarm too."""
        doubts = self.doubts
        if not doubts and self.unsigned and (asked or self.signers):
            doubts = "not all of it is signed" if self.signers else "not signed by anybody of the authority given"
        if self.unchecked:
            doubts = f"signatures cannot be checked: {install_hint('keys')}"
        if len(self.keys) > 1:
            self.note(f"by {len(self.keys)} different keys")
        if not asked and self.signers:
            self.note("not compared with an authority (--ca FILE)")
        if self.open:
            self.note(self.open)
        state = "open" if self.open or self.unsealed else "whole"
        if not self.sealed:
            state = "not sealed"
        elif self.count:
            state = "broken"
        elif doubts:
            state = "doubtful"
        return Finding(
            state=state,
            messages=self.messages,
            whole=self.whole,
            missing=self.missing,
            unsealed=self.unsealed,
            count=self.count,
            faults=tuple(self.faults),
            signers=tuple(self.signers),
            doubts=doubts,
            notes=tuple(self.notes),
        )


def at(number: int, where: str, time: int) -> str:
    """Where in a recording: a message's number, its part, when it was sealed."""
    try:
        clock = f"{datetime.fromtimestamp(time / 1e9, UTC):%H:%M:%S} UTC"
    except (OverflowError, OSError, ValueError):
        clock = "no time"
    return f"message {number:,}{where}, {clock}"


def span(numbers: Collection[int]) -> str:
    """A few numbers: 7, or 7 to 9."""
    return f"{min(numbers):,}" if len(numbers) == 1 else f"{min(numbers):,} to {max(numbers):,}"
