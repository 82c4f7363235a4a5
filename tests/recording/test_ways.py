"""What a recording shows of the way in which tracks are fused."""

from __future__ import annotations

from pathlib import Path

from tests.helpers.tracklets import fly
from tests.recording.contents import entities, rows, texts


def test_counts_health_and_log_say_what_is_fused_by_tracklets(tmp_path: Path) -> None:
    flight = fly(10, fed=5)
    path = flight.record(tmp_path / "mission.rrd", draw=True)
    counts = [row["Scalars:scalars"][0] for row in rows(path, "/counts/centre/by/tracklet")]
    assert counts == [3.0] * 9, "from when the first track is"
    page = rows(path, "/health/centre")[-1]["TextDocument:text"][0]
    assert "| r1 | 100 % of its new versions taken as tracklets; innovations " in page
    assert "| r3 | no tracklets: its tracker is fed with fused tracks; innovations " in page
    (line,) = (one for one in texts(path, "sources") if "tracklets" in one)
    assert line.endswith("source r3: no tracklets: its tracker is fed with fused tracks")


def test_a_mission_by_one_rule_shows_nothing_of_it(tmp_path: Path) -> None:
    path = fly(6, memory="restart").record(tmp_path / "mission.rrd", draw=True)
    assert not any("/by/" in one for one in entities(path))
    assert "tracklets" not in rows(path, "/health/centre")[-1]["TextDocument:text"][0]
