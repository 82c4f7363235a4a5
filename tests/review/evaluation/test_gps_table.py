"""Truth from a plain table of fixes: what is read, in which units, and what is said of a table that is wrong."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from fusion_service.errors import ReviewError
from fusion_service.review.evaluation import assess
from fusion_service.review.evaluation.gps_table import read_gps, slopes
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.truth import read_truth
from schemas import Enu, Local, Truth
from tests.helpers.missions import FRAME, SECOND, START, picture

SPEED = 7.0


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def geodetic(x: float, y: float) -> tuple[float, float, float]:
    lat, lon, alt = pymap3d.enu2geodetic(x, y, 0.0, FRAME.lat, FRAME.lon, FRAME.alt)
    return float(lat), float(lon), float(alt)


def told(path: Path, frame: Enu | Local = FRAME) -> list[Truth]:
    return read_gps(path).messages(frame)


@pytest.mark.parametrize("unit", ["ns", "s", "iso"])
def test_fixes_of_named_boats_are_truth_in_the_frame_of_the_picture(tmp_path: Path, unit: str) -> None:
    """Two boats go east and north at 7 m/s, converted here by pymap3d."""

    def time(second: int) -> str:
        when = datetime.fromtimestamp(START / 1e9 + second, UTC)
        return {"ns": str(START + second * SECOND), "s": f"{START // SECOND + second}.000", "iso": when.isoformat()}[
            unit
        ]

    lines = ["ID;Timestamp;Longitude;Latitude;Altitude;sats"]
    for second in range(9):
        for name, x, y in (("tern", SPEED * second, 0.0), ("auk", 0.0, SPEED * second)):
            lat, lon, alt = geodetic(x, y)
            lines.append(f"{name};{time(second)};{lon!r};{lat!r};{alt!r};9")
    path = written(tmp_path / "gps.csv", "\n".join([*lines, ""]))
    table = read_gps(path)
    assert table.names == {1: "auk", 2: "tern"}
    said = table.messages(FRAME)
    assert [message.time for message in said] == [START + k * SECOND for k in range(9)]
    for second, message in enumerate(said):
        assert message.ids.tolist() == [1, 2]
        want = [[0.0, SPEED * second], [SPEED * second, 0.0]]
        assert np.allclose(message.means[:, [0, 2]], want, atol=1e-6)
        assert np.allclose(message.means[:, [1, 3]], [[0.0, SPEED], [SPEED, 0.0]], atol=1e-4)
    assert "18 fixes of 2 objects" in table.note
    assert "slopes of straight lines through five fixes" in table.note


def test_a_slope_is_that_of_the_line_through_five_fixes_and_none_goes_over_a_gap() -> None:
    rng = np.random.default_rng(5)
    seconds = np.array([0.0, 1.0, 2.5, 3.0, 4.0, 60.0, 61.0, 62.0])
    places = rng.normal(size=(8, 2))
    found = slopes((seconds * 1e9).astype(np.int64), places)
    for k in range(8):
        near = [j for j in range(max(0, k - 2), min(8, k + 3)) if (j < 5) == (k < 5)]
        want = np.polyfit(seconds[near], places[near], 1)[0]
        assert found[k] == pytest.approx(want, abs=1e-9)
    assert np.isnan(slopes(np.array([5]), np.zeros((1, 2)))).all()


def test_metres_are_those_of_the_picture_and_velocities_are_taken_as_given(tmp_path: Path) -> None:
    path = written(tmp_path / "gps.csv", "time,id,x,y,vx,vy\n100,12,1,2,3,4\n101,12,5,6,7,8\n")
    table = read_gps(path)
    first, last = table.messages(Local("dock"))
    assert (table.names, first.ids.tolist(), first.frame) == ({}, [12], Local("dock"))
    assert first.means.tolist() == [[1.0, 3.0, 2.0, 4.0]]
    assert last.time == 101 * SECOND
    assert "as given" in table.note


def test_a_mission_is_scored_against_it(tmp_path: Path) -> None:
    """A centre that is 3 m off a boat at rest, by its table alone; a frame is taken from the picture."""
    lat, lon, _ = geodetic(0.0, 0.0)
    rows = [f"{START // SECOND + k},boat,{lat!r},{lon!r}" for k in range(5)]
    path = written(tmp_path / "gps.csv", "\n".join(["time,id,lat,lon", *rows]))
    book = Logbook([picture(k, [4], [[3.0, 0.0]]) for k in range(5)])
    truth = read_truth(path)
    found = assess(book, c=10.0, truths=truth.messages(book), called=truth.names).evaluations["centre"]
    (record,) = found.records
    assert (record.name, record.followed, record.life) == ("boat", 4.0, 4.0)
    assert record.rmse == pytest.approx(3.0, abs=1e-6)
    assert "no alt: 0 m above the ellipsoid" in truth.note


HEAD = "time,id,lat,lon\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("id,lat,lon\n", "line 1: column time is missing"),
        ("time,lat,lon\n", "line 1: column id is missing"),
        ("time,id,lat\n", "line 1: no place"),
        ("time,id,x,y,vx\n", "line 1: vx alone: give vx, vy"),
        ("time,id,lat,lat,lon\n", "line 1: column lat stands twice"),
        (HEAD, "holds no fix"),
        (HEAD + "1,a,10,20\n2,a,10\n", "line 3 has 3 fields, line 1 has 4"),
        (HEAD + "1,a,10,20\n\n2,a,north,20\n", "line 4: lat is 'north', no number"),
        (HEAD + "1,a,nan,20\n", "line 2: lat is 'nan': leave the row out"),
        (HEAD + "1,a,120,20\n", "line 2: lat 120, lon 20 is no place in degrees: are lat and lon swapped"),
        (HEAD + "1,,10,20\n", "line 2: id is empty"),
        (HEAD + "1700000000000,a,10,20\n", "line 2: time is '1700000000000': that looks like ms"),
        (HEAD + "1700000000,a,10,20\n1700000001000000000,a,10,20\n", "line 3: .*no time in s as in line 2"),
        (HEAD + "2026-01-31T12:00:00Z,a,10,20\nnoon,a,10,20\n", "line 3: time is 'noon', no time in ISO 8601"),
        (HEAD + "noon,a,10,20\n", "line 2: time is 'noon', no time as in 2026"),
        (HEAD + "1,a,10,20\n2,a,10,20\n1,a,11,20\n", "line 4: the same id at the same time as in line 2"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ReviewError, match=says) as caught:
        told(written(tmp_path / "gps.csv", text))
    assert "\n" not in str(caught.value)


def test_degrees_do_not_go_with_a_frame_that_is_nowhere(tmp_path: Path) -> None:
    path = written(tmp_path / "gps.csv", HEAD + "1,a,10,20\n")
    with pytest.raises(ReviewError, match="do not go with this mission"):
        told(path, Local("dock"))


ROWS = (("1", "59.5", "10.25"), ("2", "59.75", "10.5"))


def in_text(heading: str, row: str) -> str:
    """Two objects, two fixes each, in rows of a form with the fields t, i, a and o."""
    times = ("2026-01-31T12:00:00Z", "2026-01-31T12:00:01Z")
    lines = [row.format(t=time, i=who, a=lat, o=lon) for time in times for who, lat, lon in ROWS]
    return "\n".join([heading, *lines, ""])


@pytest.mark.parametrize(
    ("name", "text", "encoding"),
    [
        ("excel.csv", in_text("time,id,lat,lon", "{t},{i},{a},{o}"), "utf-8-sig"),
        ("unicode.txt", in_text("time\tid\tlat\tlon", "{t}\t{i}\t{a}\t{o}"), "utf-16"),
        ("said.CSV", "sep=;\n" + in_text("time;id;lat;lon", "{t};{i};{a};{o}"), "utf-8"),
        ("logger.tsv", "# logger 2\n\n" + in_text("time\tid\tlat\tlon", "{t}\t{i}\t{a}\t{o}"), "utf-8"),
        ("units.csv", in_text("Time (UTC),id,Latitude [°],lon (deg)", "{t},{i},{a},{o}"), "utf-8"),
    ],
)
def test_what_spreadsheets_and_loggers_write_is_read(tmp_path: Path, name: str, text: str, encoding: str) -> None:
    path = tmp_path / name
    path.write_text(text, encoding=encoding)
    table = read_truth(path).table
    assert table is not None
    assert table.places[:, :2].tolist() == [[59.5, 10.25], [59.5, 10.25], [59.75, 10.5], [59.75, 10.5]]


def test_a_comma_is_the_point_where_columns_are_apart_by_semicolons(tmp_path: Path) -> None:
    text = in_text("time;id;lat;lon", "{t};{i};{a};{o}").replace(".", ",")
    assert read_gps(written(tmp_path / "a.csv", text)).places[:, 1].tolist() == [10.25, 10.25, 10.5, 10.5]


def test_a_row_twice_counts_once_and_another_place_at_one_time_is_refused(tmp_path: Path) -> None:
    text = in_text("time,id,lat,lon", "{t},{i},{a},{o}")
    table = read_gps(written(tmp_path / "a.csv", text + text.splitlines()[1] + "\n"))
    assert len(table.times) == 4
    assert "4 fixes of 2 objects" in table.note
    assert "1 row that said the same twice left out" in table.note
    other = text.splitlines()[1].replace("59.5", "59.6") + "\n"
    with pytest.raises(ReviewError, match="line 6: the same id at the same time as in line 2, elsewhere"):
        read_gps(written(tmp_path / "b.csv", text + other))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("{t},{i},59°30.0'N,10°15'0\"W", r"lat is .*write degrees with decimals, as in 59\.500000"),
        ("{t},{i},59.5 S,10.25 E", r"as in -59\.500000"),
        ("{t},{i},5930.000,1015.0", r"as NMEA writes them\? Then it is 59\.500000, 10\.250000"),
        ("{t},{i},6600000.0,262000.0", "metres of a map"),
        ("{t},{i},,", "leave the row out where there is no fix"),
        ("31/01/2026 12:00,{i},{a},{o}", "no time as in 2026-01-31T12:00:00Z, nor s or ns since 1970"),
        ("{t}," + "n" * 201 + "{i},{a},{o}", "of 200 characters at most"),
        ("{t},\x1b[2J{i},{a},{o}", "text in one line"),
    ],
)
def test_what_is_clumsy_is_said_with_how_to_mend_it(tmp_path: Path, row: str, said: str) -> None:
    with pytest.raises(ReviewError, match=said) as raised:
        read_gps(written(tmp_path / "a.csv", in_text("time,id,lat,lon", row)))
    assert "line 2: " in str(raised.value)


def test_gaps_are_told(tmp_path: Path) -> None:
    lines = [f"{second},1,{second},0" for second in (*range(10), *range(40, 50))]
    note = read_gps(written(tmp_path / "a.csv", "\n".join(["time,id,x,y", *lines]))).note
    assert "1 object has a gap of up to 31 s" in note
