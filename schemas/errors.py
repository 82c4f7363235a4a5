"""Why a message is refused."""

from __future__ import annotations

__all__ = ["REASONS", "MessageError"]

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


class MessageError(ValueError):
    """A message that cannot be read or written. `reason` is one of `REASONS`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail[:300]}")
        self.reason = reason
