"""Inputs that a step log may still name, by their digest: of a recording, or of a centre that another one follows.

A log comes after what it took, so that little has to be held: a message goes when a log has named it, or when it is too
old for any step to take. But the last few of each source and kind stay, since a source sends them again to a service
that begins anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from fusion_service.centre.pictures import source_of
from schemas import GlobalTracks, LocalIntensity, LocalTracks, SensorInfo, StepLog

__all__ = ["Input", "InputBuffer", "LocalMessage"]

SENT_AGAIN = 8
"""Messages of a source and kind that its publisher sends to who comes later."""
MOST_BYTES = 256 * 2**20
MOST_INPUTS = 200_000
MOST_NAMES = 10_000
SWEEP = 64
"""Logs between two looks for what is too old."""
MARGIN = 60.0
"""Seconds beyond `lateness` after which a message is too old."""

LocalMessage = LocalTracks | LocalIntensity | SensorInfo | GlobalTracks
"""What a source sends; the picture of another centre is what that one sends."""


@dataclass(slots=True)
class Input:
    """A message that a step may take; received, ns; size of it, bytes; named: whether a log has named it; key: on
    which it came, and data: its bytes, where they are to be handed on."""

    message: LocalMessage
    received: int
    size: int
    named: bool = False
    key: str = ""
    data: bytes = b""


class InputBuffer:
    """Inputs under their digests. `forgotten`: how many no log had named when there was no more room for them."""

    def __init__(self) -> None:
        self._inputs: dict[int, Input] = {}
        self._recent: dict[tuple[str, str], deque[int]] = {}
        self._bytes = 0
        self._settled = 0
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._inputs)

    def add(self, code: int, one: Input) -> None:
        """Hold a message under its digest; a repeat of what is held changes nothing."""
        if code in self._inputs:
            return
        self._inputs[code] = one
        self._bytes += one.size
        recent = self._recent.setdefault((source_of(one.message), one.message.type), deque())
        if len(self._recent) > MOST_NAMES:
            del self._recent[next(iter(self._recent))]
        recent.append(code)
        if len(recent) > SENT_AGAIN:
            old = recent.popleft()
            if old in self._inputs and self._inputs[old].named:
                self._drop(old)
        while self._bytes > MOST_BYTES or len(self._inputs) > MOST_INPUTS:
            oldest = next(iter(self._inputs))
            self.forgotten += not self._inputs[oldest].named
            self._drop(oldest)

    def get(self, code: int) -> Input | None:
        """The message with this digest."""
        return self._inputs.get(code)

    def has_all(self, log: StepLog) -> bool:
        """Whether every message that `log` took is here."""
        return all(entry.hash in self._inputs for entry in log.taken)

    def settle(self, log: StepLog, lateness: float) -> None:
        """Let go what `log` has named, and now and then what is too old for any later step."""
        for entries in (log.taken, log.refused, log.dropped):
            for entry in entries:
                if (one := self._inputs.get(entry.hash)) is not None:
                    self._name(entry.hash, one)
        self._settled += 1
        if self._settled % SWEEP == 0:
            oldest = log.time - round((lateness + MARGIN) * 1e9)
            for code, one in list(self._inputs.items()):
                if getattr(one.message, "time", oldest) < oldest:
                    self._name(code, one)

    def unclaimed(self, received: int, time: int, but: StepLog | None) -> Iterator[Input]:
        """What came until `received` for a step at `time`, that no log has named, nor `but` names: each once."""
        names = {entry.hash for entry in (*but.taken, *but.refused)} if but is not None else set()
        for code, one in list(self._inputs.items()):
            fits = one.received <= received and getattr(one.message, "time", time) <= time
            if fits and not one.named and code not in names:
                yield one
                self._name(code, one)

    def other(self, source: str, epoch: int, seq: int) -> list[int]:
        """Digests of what is held of this source, epoch and number, and no log has named."""
        return [
            code
            for code, one in self._inputs.items()
            if not one.named and (source_of(one.message), one.message.epoch, one.message.seq) == (source, epoch, seq)
        ]

    def _name(self, code: int, one: Input) -> None:
        one.named = True
        if code not in self._recent.get((source_of(one.message), one.message.type), ()):
            self._drop(code)

    def _drop(self, code: int) -> None:
        self._bytes -= self._inputs.pop(code).size
