"""The line of `benchmarks.service` under a small load: every scan is taken, or told as overtaken by a newer one where
the machine is too busy for it; every target is in every picture, and once."""

from __future__ import annotations

from benchmarks.load import Load
from benchmarks.service import Way, measure


def test_every_picture_is_whole_and_nothing_is_lost_untold() -> None:
    report = measure(Way(Load(3, 60, 2), seconds=5.0, centre={"period": 0.2}))
    print(report.told())
    assert set(report.lost) <= {"overtaken"}
    assert report.heard + report.lost.get("overtaken", 0) == report.scans
    assert report.heard > report.scans / 4
    assert report.pictures > 5
    assert report.looked > 2
    assert (report.uneven, report.missing, report.doubled, report.mixed) == (0, 0, 0, 0)
