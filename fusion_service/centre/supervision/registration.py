"""Clock offsets and registration errors of the sources, estimated from the targets that they share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.supervision.shared import Shared
from fusion_service.centre.treatment import Correction

__all__ = ["Registration"]


class Registration:
    """The estimates of all sources."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake

    def observe(
        self, rows: Rows, names: tuple[str, ...], now: Picture, shared: Shared, time: int, journal: Journal
    ) -> None:
        """Learn from a step. now: the picture predicted to it, with its links decided."""

    def correction(self, name: str) -> tuple[int, Correction | None]:
        """What is to be done with a source from the next step on: its clock, ns, and what is taken off its states."""
        return 0, None

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        return {}

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        return {}

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave."""
