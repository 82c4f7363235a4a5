"""The line of `benchmarks.service` under a small load: nothing is lost, every target is in every picture, and once."""

from __future__ import annotations

from benchmarks.load import Load
from benchmarks.service import Way, measure


def test_every_picture_is_whole_and_nothing_is_lost() -> None:
    report = measure(Way(Load(3, 60, 2), seconds=5.0, centre={"period": 0.2}))
    print(report.told())
    assert report.taken == report.offered > 0
    assert not report.lost
    assert report.pictures > 5
    assert report.looked > 2
    assert (report.uneven, report.missing, report.doubled, report.mixed) == (0, 0, 0, 0)
