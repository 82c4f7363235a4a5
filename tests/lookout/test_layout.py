"""What `top` draws of a view: the troubled first, whole at any width, with nothing in it that steers a terminal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fusion_service.escape import STEERING
from fusion_service.hints.health import health_of
from fusion_service.lookout.keyboard import split_keys
from fusion_service.lookout.layout import ORDERS, Look, frame, listed, plain
from fusion_service.lookout.screen import pressed
from fusion_service.lookout.view import Keeper, Seen, View
from schemas import Status

NOW = 1_790_000_000 * 10**9
WELL = {"alive": True, "stale": False, "messages": 5, "tracks": 2, "rate": 1.0, "declared_period": 1.0}
REFUSED = {"reason": "late", "count": 3, "time": NOW, "said": "tracks are late by 57 years: is `time` in seconds?"}
SOURCES: dict[str, dict[str, Any]] = {
    "a": {**WELL, "tracks": 7},
    "bad": {**WELL, "stale": True, "last_refusal": REFUSED, "refused": {"late": 3}, "rate": 0.2},
    "evil": {**WELL, "doubts": ["\x1b[2J\x07its\nperiod \u202e is 9"]},
    "gone": {**WELL, "alive": False},
    "rest": {"alive": True, "resting": True, "stale": True, "messages": 0, "last_refusal": {**REFUSED, "time": 1}},
}
STATUS = Status(
    source="centre", epoch=1, seq=0, sent=NOW, time=NOW, step=3, uptime=5.0, rates={"messages": 4.0},
    queue={"waiting": 0, "capacity": 10, "high_water": 2}, refused={"late": 3}, dropped={}, sources=SOURCES,
    tracks={"confirmed": 2}, step_time={"mean": 0.01, "max": 0.02, "failed": 0.0, "skipped": 0.0},
)  # fmt: skip


def view(status: Status = STATUS, *ignored: str, keepers: tuple[Keeper, ...] = ()) -> View:
    health = health_of(status, None, NOW, ignored)
    seen = [Seen("centre", health, 0.5, False)]
    return View(NOW, "fusion", True, True, seen, list(keepers), [], [], health.wrong, [])


def text(seen: View, look: Look | None = None, width: int = 100, height: int = 0) -> list[str]:
    return [plain(line) for line in frame(seen, look or Look(), width, height)]


def test_the_troubled_are_first_and_those_that_rest_last() -> None:
    assert [row.name for _, row in listed(view(), "trouble")] == ["bad", "evil", "gone", "a", "rest"]
    lines = text(view())
    rows = {line.split()[1]: line for line in lines if line.startswith("! ") and line.split()[1] in SOURCES}
    assert set(rows) == {"bad", "evil", "gone"}
    assert "refused" in rows["bad"]
    assert lines[lines.index(rows["bad"]) + 1] == f"    refused (late, 3 times): {REFUSED['said']}"
    assert any(line.startswith("- rest") and "resting" in line for line in lines)
    assert lines[0].startswith("! 3 things are wrong")
    assert any("recorder: none is there" in line for line in lines)


@pytest.mark.parametrize("order", ORDERS)
def test_sources_are_sorted_by_any_column(order: str) -> None:
    names = [row.name for _, row in listed(view(), order)]
    assert sorted(names) == sorted(SOURCES)
    first = {"name": "a", "tracks": "a", "refused": "bad", "rate": "rest", "trouble": "bad"}
    assert names[0] == first.get(order, names[0])


@pytest.mark.parametrize("width", [60, 61, 79, 100, 140, 200])
@pytest.mark.parametrize("height", [3, 12, 24, 60])
def test_it_fits_any_terminal_and_nothing_in_it_steers_one(width: int, height: int) -> None:
    for look in (Look(live=True), Look(live=True, chosen=("centre", "evil")), Look("name", ("centre", "bad"), True)):
        lines = text(view(), look, width, height)
        assert len(lines) == height
        assert max(map(len, lines)) <= width
        assert not STEERING & {ord(letter) for line in lines for letter in line}
        assert "\n" not in "".join(lines)


def test_the_chosen_source_is_on_the_screen_whatever_its_height() -> None:
    many = replace(STATUS, sources={f"s{k:03}": WELL for k in range(300)})
    for name in ("s000", "s150", "s299"):
        lines = text(view(many), Look("name", ("centre", name), live=True), 80, 20)
        assert [line for line in lines if f"> {name}" in line or f">{name}" in line]


def test_what_is_ignored_is_shown_and_is_not_wrong() -> None:
    seen = view(STATUS, "g*", "bad", "evil")
    assert seen.wrong == []
    lines = text(seen)
    assert lines[0].startswith("  all is well")
    assert any(line.startswith("- gone") for line in lines)


def test_a_source_by_itself_shows_all_that_is_known() -> None:
    lines = "\n".join(text(view(), Look(chosen=("centre", "bad"), alone=True)))
    assert "bad of centre centre: refused: it sends, and nothing of it is taken" in lines
    assert "declared_period    1" in lines
    assert "q quit" not in lines


def test_a_recorder_in_trouble_is_marked() -> None:
    keeper = Keeper("rec", "recorder rec: a.rrd on host, 1 MB", ("it does not answer",), {})
    assert "! recorder rec: a.rrd on host, 1 MB" in text(view(keepers=(keeper,)))


def test_keys_choose_sort_pause_and_open() -> None:
    look = pressed("down", Look(), view())
    assert look.chosen == ("centre", "bad")
    assert pressed("down", look, view()).chosen == ("centre", "evil")
    assert pressed("up", look, view()).chosen == ("centre", "bad")
    assert pressed("up", Look(), view()).chosen == ("centre", "rest")
    assert pressed("page down", look, view()).chosen == ("centre", "rest")
    assert pressed("enter", look, view()).alone
    assert not pressed("back", look._replace(alone=True), view()).alone
    assert pressed("back", look, view()).chosen is None
    alone = pressed("enter", look, view())
    assert pressed("page down", alone, view()).scroll == 10
    assert pressed("up", alone, view()).scroll == 0
    assert pressed("s", Look(), view()).order == "name"
    assert pressed("p", Look(), view()).paused
    assert pressed("x", look, view()) == look
    assert pressed("enter", Look(), view(replace(STATUS, sources={}))) == Look()


def test_sequences_of_a_terminal_are_keys() -> None:
    assert list(split_keys("\x1b[Aq\x1b[6~\x1bOB\r")) == ["up", "q", "page down", "down", "enter"]
    assert list(split_keys("\x1b")) == ["back"]
    assert list(split_keys("j k")) == ["down", "p", "up"]
