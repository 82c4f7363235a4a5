"""The section of an evaluation about the sources, from a recorded mission."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.review.evaluation.source_record import MOST_SAID, MOST_SAMPLES, SourceRecord
from tests.helpers.supervised import CLOCK, STEPS, WHY, mission
from tests.helpers.tracklets import fly


def test_table_page_and_numbers_tell_of_the_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = mission(tmp_path / "mission.rrd")
    assert main(["evaluate", str(path), "--json", str(tmp_path / "a.json"), "--html", str(tmp_path / "a.html")]) == 0
    text = capsys.readouterr().out
    line = next(line for line in text.splitlines() if line.startswith("r2") and "inflated" in line)
    assert line.split()[1:3] == ["inflated", "4.50"]
    assert f"+{CLOCK:g} ± 0.05" in line
    assert "not observable" in line
    assert f"r2: inflated: {WHY}" in text
    page = (tmp_path / "a.html").read_text()
    for part in (
        "The sources",
        "What was said of them",
        "Clock offsets",
        "Registration, x",
        "beside each other",
    ):
        assert part in page, part
    assert "inflated, was trusted" in page
    (recording,) = json.loads((tmp_path / "a.json").read_text())["recordings"]
    told = recording["centres"]["centre"]["sources"]["r2"]
    assert (told["state"], told["consistency"], told["bias"]["clock"]["value"]) == ("inflated", 4.5, CLOCK)
    assert [one["bad"] for one in told["said"]] == [True, True, True, False]
    assert told["said"][0]["time_ns"] - told["said"][1]["time_ns"] == -(10**9)


def test_a_centre_that_says_nothing_of_them_has_no_section(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = fly(4, supervision="off", registration="off")
    assert main(["evaluate", str(flight.record(tmp_path / "a.rrd")), "--html", str(tmp_path / "a.html")]) == 0
    assert "The sources" not in capsys.readouterr().out


def test_a_long_mission_is_thinned_evenly_and_events_are_counted() -> None:
    record = SourceRecord()
    said = {"consistency": 1.0, "consistency_low": 0.5, "consistency_high": 2.0}
    for time in range(4 * MOST_SAMPLES + 7):
        record.status(time, said)
        record.event(time, True, "x")
    times = [one.time for one in record.samples]
    assert MOST_SAMPLES / 2 <= len(times) <= MOST_SAMPLES
    steps = {b - a for a, b in itertools.pairwise(times)}
    assert len(steps) == 1, steps
    assert (len(record.said), record.more) == (MOST_SAID, 4 * MOST_SAMPLES + 7 - MOST_SAID)
    assert not any(math.isnan(one.consistency) for one in record.samples)
    assert STEPS < MOST_SAID
