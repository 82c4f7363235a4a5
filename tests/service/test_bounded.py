"""What counts is told once, not again with every count."""

from __future__ import annotations

from fusion_service.centre.notes import UNPLACED
from fusion_service.service.bounded import BoundedLog, uncounted


def test_a_note_that_counts_is_one_note() -> None:
    told = BoundedLog(1.0)
    notes = [f"{UNPLACED}{count} while the centre was behind" for count in (1, 2, 31)]
    assert [told.allows(uncounted(note), 600.0) for note in notes] == [True, False, False]
    assert uncounted("source load-01: no sensor_info came from it") == "source load-01: no sensor_info came from it"
