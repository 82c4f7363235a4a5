"""What a recording leads with where there is no truth: rates, delays, and how far apart sources see one object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.colours import SOURCES, line_style, marker_of, paper_colour, screen_source_colours, source_colours
from fusion_service.recording import Recorder
from fusion_service.recording.drawing.blueprint import blueprint
from schemas import Message, encode, local_key
from tests.helpers.missions import FRAME, at, info, picture, tracks, truth
from tests.recording.contents import entities, record, rows, static

SPEED = 20.0


def mission(ahead: float) -> list[Message]:
    """Two targets go east at 20 m/s; b reports every second time, and sees them 30 and 50 m north of a."""
    said: list[Message] = [info("a"), info("b", period=2.0)]
    for t in range(8):
        x = SPEED * t
        said.append(tracks("a", t, [1, 2], [[x, SPEED, 0, 0], [x, SPEED, 500, 0]]))
        if t % 2 == 0:
            said.append(tracks("b", t, [8, 9], [[x, SPEED, 30, 0], [x, SPEED, 550, 0]]))
        base = picture(t + ahead, [1, 2], [[x, 15.0], [x, 525.0]])
        fused = replace(
            base,
            sources=("a", "b"),
            contributor_counts=np.array([2, 2], dtype=np.uint16),
            contributor_source=np.array([0, 1, 0, 1], dtype=np.uint16),
            contributor_epoch=np.ones(4, dtype=np.uint64),
            contributor_id=np.array([1, 8, 2, 9], dtype=np.uint64),
            contributor_influence=np.full(4, 0.5),
        )
        said.append(fused)
    return said


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("traffic") / "a.rrd"
    record(found, *mission(0.5))
    return found


def test_rates_are_messages_per_second_of_the_mission(path: Path) -> None:
    for name, rate in (("a", 1.0), ("b", 0.5)):
        found = [row["Scalars:scalars"][0] for row in rows(path, f"/rate/{name}")]
        assert found
        assert found == pytest.approx([rate] * len(found))


def test_sources_are_as_far_apart_as_they_see_the_targets_at_one_time(path: Path) -> None:
    """Though b's report is a second older than a's: both are moved on."""
    found = {row["time"]: row["Scalars:scalars"][0] for row in rows(path, r"/apart/centre/a\ -\ b")}
    assert sorted(found) == [at(t + 0.5) for t in range(8)]
    assert list(found.values()) == pytest.approx([40.0] * 8, abs=1e-3)


def first_tabs(*, assessed: bool) -> list[str]:
    """The names of the views that are seen at first beside the picture, from above."""
    shown = blueprint(FRAME, None, trails=[], trail=1.0, assessed=assessed)
    return [tabs.contents[0].name for tabs in shown.root_container.contents[1].contents]


def test_without_truth_errors_are_no_part_of_the_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert first_tabs(assessed=False) == ["Tracks", "Sources apart (m)", "Status log"]
    assert first_tabs(assessed=True) == ["Error per target (m)", "NEES per target", "Status log"]
    seen: list[bool] = []

    def spied(*args: Any, **rest: Any) -> Any:
        seen.append(rest["assessed"])
        return blueprint(*args, **rest)

    monkeypatch.setattr("fusion_service.recording.recorder.blueprint", spied)
    record(tmp_path / "a.rrd", *mission(0.0))
    assert seen[-1] is False
    assert not any(entity.startswith("/error") for entity in entities(tmp_path / "a.rrd"))
    record(tmp_path / "b.rrd", *mission(0.0), *(truth(t, [1], [[SPEED * t, 15.0]]) for t in range(8)))
    assert seen[-1] is True


def test_more_than_seven_sources_are_told_apart(tmp_path: Path) -> None:
    names = [f"s{k:02d}" for k in range(21)]
    paper, screen = source_colours(names), screen_source_colours(names)
    assert len(set(paper.values())) == len(set(screen.values())) == 21
    assert [paper[name] for name in names[:7]] == list(SOURCES)
    assert [line_style(paper[name]) for name in names] == ["-"] * 7 + ["--"] * 7 + [":"] * 7
    assert [marker_of(screen[name]) for name in names] == [None] * 7 + ["square"] * 7 + ["diamond"] * 7
    assert line_style("black") == "-"
    assert paper_colour(21) == SOURCES[0]
    with Recorder(tmp_path / "a.rrd", frame=FRAME) as recorder:
        for t in range(2):
            for name in names[:9]:
                recorder.handle(local_key(name, "tracks"), encode(tracks(name, t, [1], [[0.0, 0.0]])), at(t))
            recorder.tick()  # colours are known once all names are
    marked = [
        name for name in names[:9] if "SeriesPoints:markers" in static(tmp_path / "a.rrd", f"/counts/local/{name}")
    ]
    assert marked == names[7:9]
