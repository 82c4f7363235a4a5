"""A truth that was given and does not fit: what is said of it, and what would mend it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from fusion_service.review.evaluation import assess
from fusion_service.review.evaluation.gps_table import GpsTable, read_gps
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.reference import NothingToScoreError
from fusion_service.review.evaluation.truth_fit import misfit
from schemas import Message
from tests.helpers.missions import FRAME, SECOND, START, picture, truth

C, SPEED, SECONDS = 500.0, 50.0, 40
STARTS = ((0.0, 0.0), (3000.0, 0.0), (0.0, 4000.0))


def place(who: int, second: float) -> tuple[float, float]:
    x, y = STARTS[who]
    turn = 0.7 * who
    return x + SPEED * second * np.cos(turn), y + SPEED * second * np.sin(turn)


def mission() -> list[Message]:
    """Three targets, each with a track 5 m off, now on one side and now on the other."""
    said: list[Message] = []
    for second in range(SECONDS):
        off = (-1) ** second
        rows = [[x + 3.0 * off, 0.0, y + 4.0 * off, 0.0] for x, y in (place(who, second) for who in range(3))]
        said.append(picture(second, [1, 2, 3], rows, sigma=5.0))
    return said


def table(path: Path, late: float = 0.0, form: Sequence[str] = ("lat", "lon"), sign: float = 1.0) -> GpsTable:
    """Fixes of the three, stamped `late` s too late, with their columns in the order of `form`."""
    lines = ["time,id," + ",".join(("lat", "lon"))]
    for second in range(SECONDS):
        for who in range(3):
            lat, lon, _ = pymap3d.enu2geodetic(*place(who, second), 0.0, FRAME.lat, FRAME.lon, FRAME.alt)
            given = {"lat": float(lat), "lon": sign * float(lon)}
            when = START / SECOND + second + late
            lines.append(f"{when:.3f},{who}," + ",".join(repr(given[name]) for name in form))
    path.write_text("\n".join(lines))
    return read_gps(path)


def said(given: GpsTable) -> str:
    book = Logbook(mission())
    truths = given.messages(FRAME)
    scored = assess(book, c=C, truths=truths).evaluations["centre"].fused
    return misfit(book, "centre", truths, given, C, lost=bool(np.isnan(scored.anees)))


def test_nothing_is_said_of_a_truth_that_fits(tmp_path: Path) -> None:
    assert said(table(tmp_path / "a.csv")) == ""


def test_degrees_that_mean_another_place_are_found_out(tmp_path: Path) -> None:
    assert "with lat and lon swapped they do" in said(table(tmp_path / "a.csv", form=("lon", "lat")))
    assert "with longitudes of the other sign they do" in said(table(tmp_path / "b.csv", sign=-1.0))
    path = tmp_path / "c.csv"
    path.write_text(f"time,id,x,y\n{START // SECOND},1,9e6,0\n{START // SECOND + 30},1,9e6,0\n")
    assert "the nearest are" in (words := said(read_gps(path)))
    assert "are its x and y those of the picture's frame?" in words


@pytest.mark.parametrize(
    ("late", "words"),
    [(2.0, "stamped 2 s earlier: a clock, or tracks that lag?"), (-2.0, "stamped 2 s later")],
)
def test_an_error_of_its_clock_is_found(tmp_path: Path, late: float, words: str) -> None:
    found = said(table(tmp_path / "a.csv", late))
    numbers = re.findall(r"([\d.]+) m ", found)
    assert [float(one) for one in numbers] == pytest.approx([5.0, 100.0], rel=0.01)
    assert words in found


@pytest.mark.parametrize(
    ("hours", "words"),
    [
        (2.0, "2 h earlier it would fit: is it in local time?"),
        (-5.5, "5.5 h later it would fit"),
        (0.3, "pictures from 2023-11-14"),
        (-START / 3.6e12, "since the begin of something"),
    ],
)
def test_spans_that_do_not_meet_are_told(tmp_path: Path, hours: float, words: str) -> None:
    with pytest.raises(NothingToScoreError, match="truth is from") as raised:
        said(table(tmp_path / "a.csv", 3600 * hours))
    assert words in str(raised.value)
    assert ("it would fit" in str(raised.value)) == ("it would fit" in words)


def test_a_gap_of_all_truth_is_not_scored_and_that_of_one_target_is() -> None:
    """From 10 to 30 s nobody says anything of anybody; then, the same with another target that is told of: the track of
    the first is false then."""
    pictures = [picture(second, [1, 2], [[3.0, 4.0], [900.0, 0.0]]) for second in range(SECONDS)]
    known = [*range(11), *range(30, SECONDS)]
    told: list[Message] = [truth(second, [1, 2], [[0.0, 0.0], [900.0, 0.0]]) for second in known]
    scored = assess(Logbook([*pictures, *told]), c=C).evaluations["centre"]
    assert len(scored.times) == len(known)
    assert scored.fused.gospa_false == 0.0
    more: list[Message] = [truth(second, [2], [[900.0, 0.0]]) for second in range(11, 30)]
    scored = assess(Logbook([*pictures, *told, *more]), c=C).evaluations["centre"]
    assert len(scored.times) == SECONDS
    assert scored.fused.gospa_false == pytest.approx(19 / SECONDS * C**2 / 2)
    nobody: list[Message] = [truth(second, [], []) for second in range(11, 30)]
    scored = assess(Logbook([*pictures, *told, *nobody]), c=C).evaluations["centre"]
    assert len(scored.times) == SECONDS
    assert scored.fused.gospa_false == pytest.approx(38 / SECONDS * C**2 / 2)
