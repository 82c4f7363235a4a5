"""A recording's tracks as tables, and tables as sources again: what goes out comes back, number for number."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service import geodesy
from fusion_service.bus import open_bus
from fusion_service.cli import main
from fusion_service.errors import ReviewError
from fusion_service.recording import Recorder
from fusion_service.review.export import export
from schemas import Enu, GlobalTracks, Height, LocalTracks, Message, Truth
from schemas.flat import frame_of, frame_text, space_of, track_columns
from sensor_clients.playback import table
from tests.helpers.missions import START, info, picture, tracks, truth
from tests.helpers.processes import Hub, Program, eventually

CLIENT = "import sys; from sensor_clients.cli import main; sys.exit(main(sys.argv[1:]))"
SPACE = ("x", "vx", "y", "vy")


def record(path: Path, messages: list[Message], garbage: int = 0) -> Path:
    with Recorder(path, draw=False) as recorder:
        for message in messages:
            if isinstance(message, GlobalTracks):
                key = schemas.global_key(message.source, "tracks")
            elif isinstance(message, Truth):
                key = schemas.truth_key(message.source)
            else:
                key = schemas.local_key(message.source, "tracks" if isinstance(message, LocalTracks) else "info")
            recorder.handle(key, schemas.encode(message), START)
        for _ in range(garbage):
            recorder.handle(schemas.local_key("a", "tracks"), b"\xc1", START)
    return path


def random_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    root = rng.normal(size=(count, 4, 4))
    return root @ root.transpose(0, 2, 1) + np.eye(4)


def fused(second: float, places: np.ndarray, rng: np.random.Generator) -> GlobalTracks:
    """Up to three tracks, of a and b, of none, and of b."""
    count = len(places)
    base = picture(second, [2**32 + k for k in range(1, count + 1)], places, covariances=random_covariances(rng, count))
    behind = 3 if count else 0
    return replace(
        base,
        lineage=("a", "b"),
        status=np.arange(count, dtype=np.uint8),
        sources=("a", "b"),
        contributor_counts=np.array([2, 0, 1][:count], dtype=np.uint16),
        contributor_source=np.array([1, 0, 1][:behind], dtype=np.uint16),
        contributor_epoch=np.ones(behind, dtype=np.uint64),
        contributor_id=np.arange(behind, dtype=np.uint64),
        contributor_influence=np.array([0.5, 0.5, 1.0][:behind]),
    )


@pytest.fixture
def mission(tmp_path: Path) -> tuple[Path, list[Message]]:
    rng = np.random.default_rng(3)
    messages: list[Message] = [info("a"), info("b")]
    for second in range(6):
        places = rng.normal(size=(3, 2)) * 1e4
        for name in ("a", "b"):
            messages.append(
                tracks(name, second, [5, 2**64 - 1], places[:2], covariances=random_covariances(rng, 2),
                       existence=np.array([0.25, 1.0]), height=Height(120.0, 5.0) if name == "b" else None)
            )  # fmt: skip
        messages.append(fused(second, places[: 3 if second else 0], rng))
        messages.append(truth(second, [1, 2, 3], places))
    return record(tmp_path / "mission.rrd", messages, garbage=2), messages


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("what", ["global", "a", "b", "truth"])
def test_what_goes_out_comes_back(mission: tuple[Path, list[Message]], tmp_path: Path, suffix: str, what: str) -> None:
    path, messages = mission
    out = tmp_path / f"{what}{suffix}"
    done = export(path, out, what)
    kind = {"global": GlobalTracks, "truth": Truth}.get(what, LocalTracks)
    tables = [m for m in messages if isinstance(m, GlobalTracks | LocalTracks | Truth)]
    sent = [m for m in tables if isinstance(m, kind) and (kind is not LocalTracks or m.source == what)]
    assert (done.rows, done.times) == (sum(len(m.ids) for m in sent), 6)
    assert done.left_out["that do not decode (not-msgpack)"] == 2
    scenario = table.load(out)
    events = list(scenario.truth()) if what == "truth" else list(scenario.sensors[sent[0].source](0))
    sent = [message for message in sent if len(message.ids)]  # an empty picture leaves no row
    assert [event.time for event in events] == [message.time for message in sent]
    for event, message in zip(events, sent, strict=True):
        assert event.fields["space"] == message.space
        assert event.fields["frame"] == message.frame
        assert (event.fields["ids"] == message.ids).all()
        assert (event.fields["means"] == message.means).all()  # to the bit: floats are written so that they come back
        if not isinstance(message, Truth):
            assert (event.fields["covariances"] == message.covariances).all()
        if isinstance(message, LocalTracks):
            assert (event.fields["existence"] == message.existence).all()
        if isinstance(message, GlobalTracks):
            assert (event.fields["updated"] == message.updated).all()
            assert table.lineage(out, message.source) == ("a", "b")


def test_a_table_says_where_a_track_is_and_what_it_is_made_of(
    mission: tuple[Path, list[Message]], tmp_path: Path
) -> None:
    path, messages = mission
    export(path, tmp_path / "global.csv")
    export(path, tmp_path / "b.csv", "b")
    with (tmp_path / "global.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows[:3]] == ["tentative", "confirmed", "coasting"]
    assert [row["sources"] for row in rows[:3]] == ["a b", "", "b"]
    assert rows[0]["time"] == "2023-11-14T22:13:21.000000Z"
    assert int(rows[0]["time_ns"]) == START + 10**9
    first = next(m for m in messages if isinstance(m, GlobalTracks) and len(m.ids))
    with (tmp_path / "b.csv").open(newline="") as file:
        high = next(csv.DictReader(file))
    assert float(high["altitude"]) == pytest.approx(120.0, abs=1e-3)
    for row, altitude in ((rows[0], 0.0), (high, 120.0)):
        place = [float(row[name]) for name in ("latitude", "longitude", "altitude")]
        assert place[2] == pytest.approx(altitude, abs=1e-3)
        assert isinstance(first.frame, Enu)
        lat, lon, high_up = place
        x, y, _ = geodesy.geodetic_to_enu(lat, lon, high_up, first.frame)
        assert (float(x), float(y)) == pytest.approx((float(row["x"]), float(row["y"])), abs=1e-3)


@pytest.mark.parametrize("frame", [Enu(59.7, -55.25, 12.5), schemas.Ecef(), schemas.Local("dock 4")])
def test_frames_go_through_a_field(frame: schemas.Frame) -> None:
    assert frame_of(frame_text(frame)) == frame


def test_columns_name_their_space() -> None:
    space = ("x", "vx", "ax", "y", "turn_rate")
    assert space_of(track_columns(space)) == space


def test_what_is_not_there_is_told(mission: tuple[Path, list[Message]], tmp_path: Path) -> None:
    path, _ = mission
    with pytest.raises(ReviewError, match=r"no tracks of 'c'; there are: .*local tracks of a"):
        export(path, tmp_path / "c.csv", "c")
    with pytest.raises(ReviewError, match="no tracks of 'other'"):
        export(path, tmp_path / "c.csv", centre="other")
    with pytest.raises(ReviewError, match=r"\.csv, \.parquet, \.geojson or \.kml"):
        export(path, tmp_path / "c.xlsx")
    with pytest.raises(ReviewError, match="name a file in a folder that exists"):
        export(path, tmp_path / "nowhere" / "c.csv")
    (tmp_path / "there.csv").write_text("")
    with pytest.raises(FileExistsError, match="exists already"):
        export(path, tmp_path / "there.csv")
    assert sorted(found.name for found in tmp_path.iterdir()) == ["mission.rrd", "there.csv"]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda text: text.replace("cov_y_x", "why"), "cov_y_x"),
        (lambda text: text.replace("1700000002", "17x0000002"), "no number"),
        (lambda text: text.replace("enu 60.0", "moon 60.0"), "no frame"),
        (lambda text: text.splitlines()[0] + "\n", "no rows"),
        (lambda text: text[:-40], "fields"),
        (lambda text: "", "not a table"),
    ],
)
def test_a_bad_table_is_told_in_a_line(
    mission: tuple[Path, list[Message]], tmp_path: Path, change: object, word: str
) -> None:
    path, _ = mission
    out = tmp_path / "global.csv"
    export(path, out)
    out.write_text(change(out.read_text()))  # type: ignore[operator]
    with pytest.raises(ValueError, match=word) as told:
        table.load(out)
    assert "\n" not in str(told.value)


def test_exported_tracks_are_played_back_on_the_bus(
    mission: tuple[Path, list[Message]], tmp_path: Path, hub: Hub
) -> None:
    path, messages = mission
    out = tmp_path / "tracks.csv"
    assert main(["export", str(path), "--out", str(out)]) == 0
    heard: list[Message] = []
    with open_bus([hub.endpoint], wait=60.0) as bus:
        bus.subscribe("fusion/v1/local/*/tracks", lambda key, data: heard.append(schemas.decode(data)), history=8)
        arguments = ("playback", str(out), "--sensor", "centre", "--speed", "100", "--connect", hub.endpoint)
        with Program(CLIENT, *arguments) as client:
            assert client.end(20) == (0, "")
        eventually(lambda: len(heard) >= 5)
    assert all(isinstance(m, LocalTracks) and m.source == "centre" and m.lineage == ("a", "b") for m in heard)
    assert all(m.origin == "replay" for m in heard)
    sent = [m for m in messages if isinstance(m, GlobalTracks) and len(m.ids)]
    assert [m.time for m in heard] == [m.time for m in sent]  # type: ignore[union-attr]
    assert (heard[-1].covariances == sent[-1].covariances).all()  # type: ignore[union-attr]


def test_stone_soup_reads_the_table(mission: tuple[Path, list[Message]], tmp_path: Path) -> None:
    generic = pytest.importorskip("stonesoup.reader.generic")
    path, messages = mission
    export(path, tmp_path / "tracks.csv")
    reader = generic.CSVGroundTruthReader(
        str(tmp_path / "tracks.csv"), state_vector_fields=SPACE, time_field="time", path_id_field="track_id"
    )
    paths: dict[str, Any] = {}
    for _, found in reader.groundtruth_paths_gen():
        paths |= {path.id: path for path in found}
    sent = [m for m in messages if isinstance(m, GlobalTracks) and len(m.ids)]
    assert sorted(paths) == [str(2**32 + k) for k in (1, 2, 3)]
    for k in range(3):
        path_of = paths[str(2**32 + 1 + k)]
        states = np.array([np.ravel(state.state_vector) for state in path_of], dtype=float)
        assert np.allclose(states, [m.means[k] for m in sent])
