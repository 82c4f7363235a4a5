"""`Supervisor`: watches the sources beside each other, and says how each is treated in the next step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.supervision.conduct import Conduct
from fusion_service.centre.supervision.registration import Registration
from fusion_service.centre.supervision.shared import shared_pairs
from fusion_service.centre.treatment import Treatment

__all__ = ["Supervisor"]


class Supervisor:
    """What is known of every source of a centre, and what follows from it."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self.registration = Registration(intake)
        self.conduct = Conduct(intake)

    def observe(self, rows: Rows, names: tuple[str, ...], now: Picture, step: int, time: int, journal: Journal) -> None:
        """Learn from a step, its links decided and nothing fused yet, and settle how sources are treated in the next.
        now: the picture predicted to `time`, ns."""
        self.conduct.observe(rows, names, time, journal)
        shared = shared_pairs(rows, step)
        self.registration.observe(rows, names, now, shared, time, journal)
        self._treat(names)

    def _treat(self, names: tuple[str, ...]) -> None:
        treatments = {name: Treatment(*self.registration.correction(name)) for name in names}
        self._intake.treatments = {name: one for name, one in treatments.items() if one != Treatment()}

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        return self.registration.health(name) | self.conduct.health(name)

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self.registration.rebase(time)
        self.conduct.rebase(time)

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        return {"registration": self.registration.packed(), "conduct": self.conduct.packed()}

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave."""
        self.registration.restore(packed.get("registration", {}))
        self.conduct.restore(packed.get("conduct", {}))
        self._treat(self._intake.names())
