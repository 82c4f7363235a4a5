"""The root of every error of ours, and why a message is refused.

`fusion_service.errors` draws the whole tree; the root stands here, where everything else may import it from.
"""

from __future__ import annotations

from typing import ClassVar

__all__ = ["REASONS", "FusionError", "MessageError"]

REASONS = {
    "too-large": "more than 16 MiB",
    "not-msgpack": "not one complete MessagePack map in valid UTF-8, or a list of more than 65,536 items in it",
    "version": "`v` is missing or not 1",
    "type": "`type` is missing or not one of the seven",
    "missing": "a field that must be there is not (or is nil)",
    "bad-field": "a field has the wrong MessagePack type, or a value outside its range",
    "length": "a column has not as many numbers as the others ask for",
}
"""Reason -> what it says of a message. The words are for counting and do not change within a version."""


class FusionError(Exception):
    """What whoever calls or types can mend: the message says what, where and how, as a rule in one line.

    exit_code: what a command that ends with it returns; 0 is an end that was asked for, of which nothing is told.
    places: whether its lines begin with where the fault is (`file:line:`), so that nothing is put before them.
    """

    exit_code: ClassVar[int] = 1
    places: ClassVar[bool] = False


class MessageError(FusionError, ValueError):
    """A message that cannot be read or written. `reason` is one of `REASONS`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail[:300]}")
        self.reason = reason
