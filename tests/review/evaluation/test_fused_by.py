"""What share of the steps of confirmed tracks each way of fusion has, in words, numbers and on a page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.review.evaluation.account import Account
from fusion_service.review.evaluation.tables import way_shares
from tests.helpers.tracklets import fly


def test_the_share_of_each_way_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = fly(10, fed=4)
    path = flight.record(tmp_path / "mission.rrd")
    assert main(["evaluate", str(path), "--json", str(tmp_path / "a.json"), "--html", str(tmp_path / "a.html")]) == 0
    text = capsys.readouterr().out
    assert {one.tracks.rules for one in flight.steps[1:]} == {("tracklet",)}
    assert "Confirmed tracks were fused by tracklet 90 %, ci 10 %." in text
    assert "r3: no tracklets: its tracker is fed with fused tracks" in text
    (recording,) = json.loads((tmp_path / "a.json").read_text())["recordings"]
    assert recording["centres"]["centre"]["fused_by"] == {"ci": 3, "tracklet": 27}
    assert recording["centres"]["centre"]["no_tracklets"] == {"r3": "feedback"}
    page = (tmp_path / "a.html").read_text()
    assert "What confirmed tracks were fused by" in page
    assert "<td>90 %</td>" in page
    assert "its tracker is fed with fused tracks" in page


def test_a_centre_by_one_rule_has_no_such_line() -> None:
    account = Account()
    flight = fly(6, memory="restart")
    for one in flight.steps:
        account.picture(one.tracks)
        account.log(one.log)
    assert account.ways == {"ci": 18}
    assert way_shares(account) == []
    assert account.ungiven == {}
