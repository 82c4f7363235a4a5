"""Recordings written by the recorder and read back: what came in is there, and what is drawn is right."""

from __future__ import annotations

import logging
import math
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import missions
import numpy as np
import pymap3d
import pytest
from processes import Hub, Program
from recording.contents import entities, row, rows
from recording.mission import LOST, RADARS, SIGMA, START, TARGETS, Sent, mission, positions
from rerun.chunk import RrdReader
from scipy.stats import binomtest, chi2

from fusion_service.bus import open_bus
from fusion_service.recording import RawMessage, Recorder, default_path, messages, read
from fusion_service.recording.assessment import Assessment, Score
from fusion_service.recording.columns import Stamp
from fusion_service.recording.geometry import moments
from schemas import (
    Ecef,
    Enu,
    Local,
    LocalIntensity,
    Message,
    Polygon,
    encode,
    global_key,
    local_key,
    truth_key,
)

SECOND = 10**9


def key_of(message: Message) -> str:
    return {
        "local_tracks": lambda: local_key(message.source, "tracks"),
        "local_intensity": lambda: local_key(message.source, "intensity"),
        "sensor_info": lambda: local_key(message.source, "info"),
        "global_tracks": lambda: global_key(message.source, "tracks"),
        "truth": lambda: truth_key(message.source),
    }[message.type]()


def record(path: Path, *said: Message, **options: Any) -> Recorder:
    with Recorder(path, **options) as recorder:
        for number, message in enumerate(said):
            recorder.handle(key_of(message), encode(message), START + number)
    return recorder


def texts(path: Path, about: str) -> list[str]:
    return [said["TextLog:text"][0] for said in rows(path, f"/log/{about}")]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Sent]]:
    """The whole made-up mission, recorded with a tick every few messages."""
    path, said = tmp_path_factory.mktemp("recordings") / "flown.rrd", list(mission())
    with Recorder(path) as recorder:
        for number, sent in enumerate(said):
            recorder.handle(sent.key, sent.data, sent.received)
            if number % 50 == 0:
                recorder.tick()
    assert not recorder.undecodable
    assert not recorder.undrawn
    return path, said


# ------------------------------------------------------------------ what came in


def test_every_message_is_read_back_as_it_came(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    expected = [RawMessage(n, sent.received, sent.key, sent.data) for n, sent in enumerate(said)]
    assert list(read(path)) == expected
    assert [encode(message) for message in messages(path)] == [sent.data for sent in said]


def test_raw_rows_stand_at_their_mission_time_where_they_have_one(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    times = [item["time"] for item in rows(path, "/raw/local/radar1/tracks")]
    assert times == [s.message.time for s in said if s.key == local_key("radar1", "tracks")]  # type: ignore[union-attr]
    assert [item["time"] for item in rows(path, "/raw/local/radar1/info")] == [None]


def test_what_does_not_decode_is_kept_counted_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, good = tmp_path / "a.rrd", missions.tracks("radar", 0, [1], [(1, 2)])
    odd = [("fusion/v1/local/radar/tracks", b"\xc1"), ("fusion/v1/other/a b/c", b""), (key_of(good), encode(good)[:-3])]
    with Recorder(path) as recorder:
        recorder.handle(key_of(good), encode(good), START)
        for key, data in odd:
            recorder.handle(key, data, START + 1)
    assert [(raw.key, raw.data) for raw in read(path)] == [(key_of(good), encode(good)), *odd]
    assert recorder.undecodable.total() == len(odd)
    told = sorted(text.split("  ", 1)[1] for text in texts(path, "recorder"))
    assert told == [
        "1 messages on fusion/v1/other/a b/c do not decode: not-msgpack",
        "2 messages on fusion/v1/local/radar/tracks do not decode: not-msgpack",
    ]
    with caplog.at_level(logging.WARNING):
        assert [encode(message) for message in messages(path)] == [encode(good)]
    assert "3 messages do not decode" in caplog.text


def test_a_recording_is_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.rrd"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError, match=r"a\.rrd exists already"):
        Recorder(path)
    assert path.read_bytes() == b"precious"
    monkeypatch.setattr("fusion_service.recording.recorder.datetime", FrozenClock)
    names = []
    for _ in range(3):
        names.append(default_path(tmp_path).name)
        (tmp_path / names[-1]).touch()
    assert len(set(names)) == 3


class FrozenClock:
    @staticmethod
    def now(zone: object) -> FrozenClock:
        return FrozenClock()

    def strftime(self, form: str) -> str:
        return "mission-now"


def test_what_is_no_recording_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "a.rrd").write_bytes(b"hello")
    with pytest.raises(ValueError, match="is not a recording"):
        list(read(tmp_path / "a.rrd"))
    with pytest.raises(FileNotFoundError, match="no recording"):
        list(read(tmp_path / "b.rrd"))


def test_an_empty_recording_opens(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.rrd"):
        pass
    assert list(read(tmp_path / "a.rrd")) == []


@pytest.mark.parametrize("torn", [0, 1, 9, 700])
def test_a_file_that_ends_anywhere_gives_all_that_is_whole(tmp_path: Path, torn: int) -> None:
    said = list(mission(6))
    recorder = Recorder(tmp_path / "a.rrd", draw=False)
    sizes = []
    for sent in said:
        recorder.handle(sent.key, sent.data, sent.received)
        recorder.tick()
        sizes.append(os.path.getsize(recorder.path))
    whole = sizes[-1] - torn
    (tmp_path / "torn.rrd").write_bytes(recorder.path.read_bytes()[:whole])
    recorder.close()
    found = [raw.data for raw in read(tmp_path / "torn.rrd")]
    count = sum(size <= whole for size in sizes)
    assert count >= len(said) - 5
    assert found == [sent.data for sent in said[:count]]


# ------------------------------------------------------------------ the process on the bus

RECORD = """
import os, signal, sys, threading
from fusion_service.bus import open_bus
from fusion_service.recording import run_recorder
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
def say(recorder):
    os.write(1, f"{recorder.messages}\\n".encode())
with open_bus([sys.argv[1]], stop=stop) as bus:
    run_recorder(bus, sys.argv[2], realm="sea/north", stop=stop, interval=0.1, on_tick=say)
"""


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_recorder_that_is_killed_or_stopped_leaves_all_it_wrote(
    hub: Hub, tmp_path: Path, end: signal.Signals
) -> None:
    path = tmp_path / "new" / "a.rrd"
    said = [(sent.key.replace("fusion/", "sea/north/"), sent.data) for sent in mission(5)]
    with Program(RECORD, hub.endpoint, str(path)) as program, open_bus([hub.endpoint], wait=10) as bus:
        publishers = {key: bus.publisher(key, cache=100) for key, _ in said}
        program.line(20)
        begin = time.time_ns()
        token = bus.announce("sea/north/v1/local/radar1/alive")
        for key, data in said:
            publishers[key].put(data)
        while int(program.line()) < len(said):
            pass
        token.close()
        done = time.time_ns()
        program.line()
        stopped = time.monotonic()
        program.signal(end)
        program.end()
        assert time.monotonic() - stopped < 2.0
    found = list(read(path))
    assert sorted((raw.key, raw.data) for raw in found) == sorted(said)
    assert [raw.arrival for raw in found] == list(range(len(said)))
    assert all(begin <= raw.received <= done for raw in found)
    for key in publishers:
        assert [raw.data for raw in found if raw.key == key] == [data for name, data in said if name == key]
    if end == signal.SIGTERM:
        assert any("left the bus" in text for text in texts(path, "sources"))


# ------------------------------------------------------------------ what is drawn


def test_a_recording_brings_its_own_layout(flown: tuple[Path, list[Sent]]) -> None:
    reader = RrdReader(flown[0])
    assert len(reader.recordings()) == 1
    layouts = reader.blueprints()
    assert layouts
    shown = {str(chunk.to_record_batch()) for chunk in reader.stream(store=layouts[-1])}
    for name in ("Map", "Local picture", "Error per target", "NEES per target", "Status log"):
        assert any(name in text for text in shown)


def test_places_are_those_of_another_geodesy(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    centre = next(sent.message.frame for sent in said if sent.key == global_key("main", "tracks"))  # type: ignore[union-attr]
    for name, frame in RADARS.items():
        message: Any = next(sent.message for sent in said if sent.key == local_key(name, "tracks"))
        drawn = row(path, f"/picture/local/{name}", message.time)
        x, y = message.means[:, 0], message.means[:, 2]
        up = -(x * x + y * y) / (2 * 6378137.0)  # onto the ellipsoid; within 0.1 m, 15 km away
        lat, lon, _ = pymap3d.enu2geodetic(x, y, up, frame.lat, frame.lon, frame.alt)
        np.testing.assert_allclose(drawn["GeoPoints:positions"], np.stack([lat, lon], axis=1), atol=1e-7)
        east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, centre.lat, centre.lon, centre.alt)
        np.testing.assert_allclose(drawn["Points2D:positions"], np.stack([east, -north], axis=1), atol=0.1)


def test_ellipses_hold_95_percent_and_are_dashed_while_a_track_coasts(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    for step in (10, 50):
        message: Any = [sent.message for sent in said if sent.key == global_key("main", "tracks")][step]
        strips = row(path, "/picture/global/main/ellipses", message.time)["LineStrips2D:strips"]
        coasting = message.status == 2
        assert len(strips) == (~coasting).sum() + 8 * coasting.sum()
        order = [*np.flatnonzero(~coasting), *np.repeat(np.flatnonzero(coasting), 8)]
        for strip, track in zip(strips, order, strict=True):
            mean, covariance = message.means[track, ::2], message.covariances[track, ::2, ::2]
            apart = np.array(strip) * (1, -1) - mean
            distance = np.einsum("ki,ij,kj->k", apart, np.linalg.inv(covariance), apart)
            np.testing.assert_allclose(distance, chi2.ppf(0.95, 2), rtol=1e-3)
    assert coasting.any()


def test_labels_trails_and_colours_of_global_tracks(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    first, second, third = (START + step * SECOND for step in (2, 3, 4))
    before, now = (row(path, "/picture/global/main", at) for at in (first, second))
    assert now["Points2D:labels"] == [str(n) for n in range(1, TARGETS + 1)]
    alphas = [{colour & 0xFF for colour in drawn["Points2D:colors"]} for drawn in (before, now)]
    assert [len(values) for values in alphas] == [1, 1]
    assert max(alphas[0]) < max(alphas[1]) == 255  # tentative ones are faint
    trail = row(path, "/picture/global/main/trail", second)["LineStrips2D:strips"]
    ends = [before["Points2D:positions"], now["Points2D:positions"]]
    np.testing.assert_array_equal(np.array(trail), np.swapaxes(np.array(ends), 0, 1))
    assert row(path, "/picture/global/main/trail", third)["GeoLineStrings:line_strings"]


def test_sensors_and_what_they_see(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    sensor = rows(path, "/picture/sensors/radar3")[0]
    assert sensor["Points2D:labels"] == ["radar3"]
    np.testing.assert_allclose(
        sensor["GeoPoints:positions"][0], [RADARS["radar3"].lat, RADARS["radar3"].lon], atol=1e-9
    )
    disk = rows(path, "/picture/sensors/radar3/coverage")[0]["LineStrips2D:strips"]
    centre = np.array(sensor["Points2D:positions"][0])
    reach = [np.hypot(*(np.array(strip) - centre).T) for strip in disk]
    np.testing.assert_allclose(reach[0], 9000.0, rtol=1e-3)
    np.testing.assert_allclose(reach[1], 300.0, rtol=1e-2)
    (sector,) = rows(path, "/picture/sensors/radar1/coverage")[0]["LineStrips2D:strips"]
    own = (np.array(sector) - np.array(rows(path, "/picture/sensors/radar1")[0]["Points2D:positions"][0])) * (1, -1)
    azimuth = np.arctan2(own[:, 0], own[:, 1])
    assert 0.2 - 0.01 < azimuth.min() < 0.21 < 2.19 < azimuth.max() < 2.2 + 0.01  # azimuth 1.2, width 2


def test_a_polygon_is_drawn_where_it_is(tmp_path: Path) -> None:
    corners = ((0.0, 0.0), (100.0, 0.0), (100.0, 50.0))
    info = missions.info("radar", position=(10.0, 20.0, 0.0), coverage=Polygon(corners))
    record(tmp_path / "a.rrd", info, missions.tracks("radar", 0, [1], [(1, 2)]))
    (strip,) = rows(tmp_path / "a.rrd", "/picture/sensors/radar/coverage")[0]["LineStrips2D:strips"]
    assert strip == [[0, 0], [100, 0], [100, -50], [0, 0]]


def test_a_lost_source_is_wiped_from_the_picture_until_it_returns(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    name, gone, back = LOST
    counts = {
        (drawn["time"] - START) // SECOND: len(drawn["Points2D:positions"])
        for drawn in rows(path, f"/picture/local/{name}")
    }
    empty = [step for step in counts if gone <= step < back]
    assert [counts[step] for step in empty] == [0]
    assert counts[gone - 1] > 0
    assert counts[back] > 0


def test_an_incomplete_message_leaves_the_other_tracks_for_three_periods(tmp_path: Path) -> None:
    said: list[Message] = [missions.info("radar", period=1.0), missions.tracks("radar", 0, [1, 2], [(0, 0), (9, 9)])]
    said += [missions.tracks("radar", s, [1], [(s, 0)], complete=False) for s in (1, 2, 3, 4)]
    said += [missions.tracks("radar", 5, [], [])]
    record(tmp_path / "a.rrd", *said)
    labels = [sorted(drawn["Points2D:labels"]) for drawn in rows(tmp_path / "a.rrd", "/picture/local/radar")]
    assert labels == [["1", "2"]] * 4 + [["1"], []]


def test_a_mixture_is_drawn_by_its_moments() -> None:
    rng = np.random.default_rng(3)
    weights = np.array([0.2, 0.8, 0.5, 0.25, 0.25, 1.0])
    counts = np.array([2, 3, 1], dtype=np.uint16)
    means, roots = rng.normal(0, 10, (6, 4)), rng.normal(0, 1, (6, 4, 4))
    covariances = roots @ roots.transpose(0, 2, 1) + np.eye(4)
    mixed = missions.tracks("a", 0, [1, 2, 3], [], means=means, covariances=covariances, counts=counts, weights=weights)
    mean, covariance = moments(mixed)
    for track, part in enumerate((slice(0, 2), slice(2, 5), slice(5, 6))):
        w = weights[part]
        second = np.einsum("c,cij->ij", w, covariances[part] + np.einsum("ci,cj->cij", means[part], means[part]))
        first = w @ means[part]
        np.testing.assert_allclose(mean[track], first)
        np.testing.assert_allclose(covariance[track], second - np.outer(first, first), rtol=1e-9, atol=1e-9)


def test_an_intensity_shows_where_it_expects_something(tmp_path: Path) -> None:
    plain = missions.tracks("phd", 0, [1, 2, 3], [(0, 0), (5, 5), (9, 9)])
    intensity = LocalIntensity(
        source="phd", epoch=1, seq=0, sent=0, time=plain.time, space=plain.space, frame=plain.frame,
        weights=np.array([0.9, 0.01, 1.3]), means=plain.means, covariances=plain.covariances,
    )  # fmt: skip
    record(tmp_path / "a.rrd", intensity)
    (drawn,) = rows(tmp_path / "a.rrd", "/picture/local/phd")
    assert drawn["Points2D:labels"] == ["0.90", "1.30"]
    assert rows(tmp_path / "a.rrd", "/counts/local/phd")[0]["Scalars:scalars"] == [pytest.approx(2.21)]


def test_the_frame_is_that_of_the_first_global_tracks(tmp_path: Path) -> None:
    there = Enu(60.1, 10.0)
    local = missions.tracks("radar", 0, [1], [(0, 0)], frame=there)
    record(tmp_path / "a.rrd", local, missions.picture(0, [1], [(0, 0)]))
    _, y = rows(tmp_path / "a.rrd", "/picture/local/radar")[0]["Points2D:positions"][0]
    assert y == pytest.approx(-pymap3d.geodetic2enu(60.1, 10, 0, 60, 10, 0)[1], abs=0.01)
    record(tmp_path / "b.rrd", local)  # none come: that of the first message
    assert rows(tmp_path / "b.rrd", "/picture/local/radar")[0]["Points2D:positions"] == [[0, 0]]
    record(tmp_path / "c.rrd", local, frame=missions.FRAME)
    drawn = rows(tmp_path / "c.rrd", "/picture/local/radar")[0]["Points2D:positions"]
    assert drawn == [pytest.approx([0.0, y], abs=1e-6)]


def test_ecef_and_local_frames_are_drawn_too(tmp_path: Path) -> None:
    place = np.array([pymap3d.geodetic2ecef(60.0, 10.0, 100.0)])
    ecef = missions.tracks("a", 0, [1], [], means=place, space=("x", "y", "z"), frame=Ecef())
    record(tmp_path / "a.rrd", ecef)
    drawn = rows(tmp_path / "a.rrd", "/picture/local/a")[0]
    assert drawn["GeoPoints:positions"] == [pytest.approx([60.0, 10.0], abs=1e-9)]
    assert drawn["Points2D:positions"] == [pytest.approx([0.0, 0.0], abs=1e-3)]
    record(tmp_path / "b.rrd", missions.tracks("a", 0, [1], [(3, 4)], frame=Local("piren")))
    drawn = rows(tmp_path / "b.rrd", "/picture/local/a")[0]
    assert drawn["Points2D:positions"] == [[3, -4]]
    assert "GeoPoints:positions" not in drawn


# ------------------------------------------------------------------ nothing stops the recorder


def test_what_cannot_be_drawn_is_recorded_counted_and_harms_nothing_else(tmp_path: Path) -> None:
    broken = np.tile(np.eye(4), (3, 1, 1))
    broken[1] = -broken[1]
    centre = missions.picture(0, [1], [(0, 0)])
    indefinite = missions.tracks("a", 0, [1, 2, 3], [(1, 1), (2, 2), (3, 3)], covariances=broken)
    not_finite = missions.tracks("b", 0, [1, 2], [(math.nan, 1), (2, 2)])
    elsewhere = missions.tracks("c", 0, [1], [(1, 1)], frame=Local("nowhere"))
    future = missions.tracks("d", 10 * 365 * 86400, [1], [(1, 1)])
    far = missions.tracks("e", 0, [1, 2], [(1e11, 1), (2, 2)], frame=Enu(60.5, 10.0))
    good = missions.tracks("f", 0, [1], [(1, 1)])
    said = [centre, indefinite, not_finite, elsewhere, future, far, good]
    path = tmp_path / "a.rrd"
    recorder = record(path, *said)
    assert [raw.data for raw in read(path)] == [encode(message) for message in said]
    labels = {name: [d["Points2D:labels"] for d in rows(path, f"/picture/local/{name}")] for name in "abcdef"}
    assert labels == {"a": [["1", "3"]], "b": [["2"]], "c": [], "d": [], "e": [["2"]], "f": [["1"]]}
    assert recorder.undrawn["not-positive-definite"] == 1
    assert recorder.undrawn["not-finite"] == 1
    assert sum("nowhere" in reason for reason in recorder.undrawn) == 1
    newest = max(
        item["time"] for item in rows(path, "/raw/local/d/tracks") + rows(path, "/raw/local/f/tracks") if item["time"]
    )
    assert newest == good.time
    assert any("c: 1 not drawn" in text for text in texts(path, "recorder"))


def test_a_message_that_comes_late_is_drawn_at_its_own_time(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    record(path, *(missions.tracks("radar", s, [1], [(s, 0)]) for s in (0, 2, 1, 3)))
    drawn = [item["Points2D:positions"][0][0] for item in rows(path, "/picture/local/radar")]
    assert drawn == [0, 1, 2, 3]
    trails = [item["LineStrips2D:strips"] for item in rows(path, "/picture/local/radar/trail")]
    assert trails == [[[[0, 0], [2, 0]]], [[[2, 0], [3, 0]]]]


# ------------------------------------------------------------------ errors, NEES, counts, the log


def test_error_and_nees_per_target_are_those_of_the_messages(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    centre: list[Any] = [sent.message for sent in said if sent.key == global_key("main", "tracks")]
    step = 30
    apart = (centre[step].means - positions(float(step)))[:, ::2]
    for target in range(TARGETS):
        error = row(path, f"/error/main/{target + 1}", centre[step].time)["Scalars:scalars"]
        nees = row(path, f"/nees/main/{target + 1}", centre[step].time)["Scalars:scalars"]
        assert error == [pytest.approx(math.hypot(*apart[target]), rel=1e-9)]
        covariance = centre[step].covariances[target][::2, ::2]
        assert nees == [pytest.approx(apart[target] @ np.linalg.inv(covariance) @ apart[target] / 2, rel=1e-9)]
    early = [math.isnan(item["Scalars:scalars"][0]) for item in rows(path, "/error/main/1")[:4]]
    assert early == [True, True, True, False]  # tentative ones are not assessed
    limits = [rows(path, f"/nees/main/bounds/{name}")[9]["Scalars:scalars"][0] for name in ("low", "high")]
    assert limits == pytest.approx(chi2.ppf([0.025, 0.975], 2) / 2)


def test_a_consistent_centre_stays_within_the_bounds(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    series = [rows(path, f"/anees/main/{name}") for name in ("bounds/low", "mean", "bounds/high")]
    values = np.array([[item["Scalars:scalars"][0] for item in part] for part in series])
    assert np.isnan(values[:, :3]).all()  # tentative
    values = values[:, 3:]
    assert np.isfinite(values).all()
    inside = int(((values[0] <= values[1]) & (values[1] <= values[2])).sum())
    assert binomtest(inside, 117, 0.95).pvalue > 1e-3
    errors = [item["Scalars:scalars"][0] for n in range(1, 6) for item in rows(path, f"/error/main/{n}")[3:]]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(SIGMA * math.sqrt(2), rel=0.1)


def scores(*said: Message, cutoff: float | None = None) -> list[Score]:
    assessment, found = Assessment(cutoff), []
    for message in said:
        if message.type == "truth":
            assessment.truth(message)  # type: ignore[arg-type]
        else:
            assessment.step(message, Stamp(0, message.time))  # type: ignore[arg-type, union-attr]
        found += list(assessment.scores())
    return found


def test_truth_is_interpolated_and_waited_for() -> None:
    shown = missions.picture(1.25, [7], [(5, 5)])
    before, after = missions.truth(1, [1], [(0, 0)]), missions.truth(2, [1], [(8, 4)])
    for order in ([shown, before, after], [before, shown, after], [before, after, shown]):
        (score,) = scores(*order)
        assert score.ids.tolist() == [1]
        assert score.error == pytest.approx([5.0])  # (2, 1) to (5, 5)
    assert scores(before, shown) == []
    assert scores(shown, after) == []  # nothing is known of the time before


def test_each_object_gets_the_nearest_free_track_within_the_cutoff() -> None:
    truth = missions.truth(0, [1, 2, 3], [(0, 0), (10, 0), (500, 0)])
    shown = missions.picture(0, [5, 6, 7], [(4, 0), (6, 1), (900, 0)])
    (score,) = scores(truth, shown, cutoff=100.0)
    np.testing.assert_allclose(score.error, [4.0, math.sqrt(17), math.nan])
    np.testing.assert_allclose(score.nees, [8.0, 8.5, math.nan])
    (score,) = scores(truth, replace(shown, status=np.array([0, 1, 1], dtype=np.uint8)), cutoff=100.0)
    np.testing.assert_allclose(score.error, [math.nan, math.sqrt(17), math.nan])


def test_labels_tell_the_ids_of_two_generations_apart(tmp_path: Path) -> None:
    said = [
        missions.picture(s, ids, [(0, 0), (5, 5)])
        for s, ids in ((0, (7 << 32 | 1, 7 << 32 | 2)), (1, (9 << 32 | 1, 7 << 32 | 2)))
    ]
    record(tmp_path / "a.rrd", *said)
    labels = [drawn["Points2D:labels"] for drawn in rows(tmp_path / "a.rrd", "/picture/global/centre")]
    assert labels == [["1", "2"], ["2.1", "2"]]


def test_a_status_does_not_bend_the_time_of_the_mission(tmp_path: Path) -> None:
    """A service that has not stepped yet says the time of the day; the mission may be played back."""
    path = tmp_path / "a.rrd"
    (status,) = (sent.message for sent in list(mission(1)) if sent.message.type == "status")
    with Recorder(path) as recorder:
        recorder.alive(local_key("radar", "alive"), True, START)
        recorder.handle(global_key("main", "status"), encode(status), START)
        recorder.tick()
        for message in (missions.tracks("radar", 0, [1], [(0, 0)]), missions.picture(0, [1], [(0, 0)])):
            recorder.handle(key_of(message), encode(message), START)
        recorder.handle(global_key("main", "status"), encode(status), START)
    assert abs(status.time - missions.at(0)) > 10**9 * 86400  # type: ignore[union-attr]
    shown = {item["time"] for name in entities(path) for item in rows(path, name)} - {None}
    assert shown == {missions.at(0)}
    assert any("radar is on the bus" in text for text in texts(path, "sources"))
    assert len(rows(path, "/health/main")) == 1


def test_without_truth_there_is_no_error_and_no_complaint(tmp_path: Path) -> None:
    recorder = record(tmp_path / "a.rrd", missions.picture(0, [1], [(0, 0)]), missions.tracks("a", 0, [1], [(0, 0)]))
    assert not recorder.undrawn
    assert not any(path.startswith(("/error", "/nees")) for path in entities(tmp_path / "a.rrd"))
    assert rows(tmp_path / "a.rrd", "/log/recorder") == []


def test_counts_and_influence(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    local: Any = next(sent.message for sent in said if sent.key == local_key("radar2", "tracks"))
    assert rows(path, "/counts/local/radar2")[0]["Scalars:scalars"] == [len(local.ids)]
    at = START + 50 * SECOND
    counted = [row(path, f"/counts/main/{s}", at)["Scalars:scalars"] for s in ("tentative", "confirmed", "coasting")]
    assert counted == [[0], [TARGETS - 1], [1]]
    shares = [row(path, f"/influence/main/{name}", at)["Scalars:scalars"][0] for name in RADARS]
    assert shares == pytest.approx([0.5, 0.3, 0.2])


def test_the_log_tells_what_happened(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    told = {about: texts(path, about) for about in ("sources", "services", "tracks", "refusals")}
    assert [text.split("  ", 1)[1] for text in told["sources"] if "->" in text] == [
        "source radar2: alive -> stale",
        "source radar2: stale -> lost",
        "source radar2: lost -> alive",
    ]
    assert [text.split("  ", 1)[1] for text in told["tracks"]] == [
        "track 5 ended: merged, goes on as 9",
        "track 9 split from 4",
    ]
    assert sum("refused 2 tracks of radar3: not-finite" in text for text in told["refusals"]) == 3
    assert any("main appears" in text for text in told["services"])
    assert "| radar1 | alive |" in rows(path, "/health/main")[-1]["TextDocument:text"][0]


def test_a_restarted_source_is_told(tmp_path: Path) -> None:
    record(tmp_path / "a.rrd", *(missions.tracks("radar", s, [1], [(s, 0)], epoch=s // 2) for s in range(4)))
    told = texts(tmp_path / "a.rrd", "sources")
    assert [("started again" in text) for text in told] == [False, True]
    assert len(rows(tmp_path / "a.rrd", "/picture/local/radar/trail")) == 2  # no line from one run to the next


# ------------------------------------------------------------------ it keeps up


def test_a_thousand_tracks_a_second_take_little_of_it(tmp_path: Path) -> None:
    places = np.random.default_rng(1).uniform(-1e4, 1e4, (100, 2))
    said = [(s, missions.tracks(f"radar{n}", s, range(100), places)) for s in range(10) for n in range(10)]
    coded = [(key_of(message), encode(message), START + s * SECOND) for s, message in said]
    with Recorder(tmp_path / "a.rrd", frame=missions.FRAME) as recorder:
        begin = time.process_time()
        for number, (key, data, received) in enumerate(coded):
            recorder.handle(key, data, received)
            if number % 10 == 9:
                recorder.tick()
        used = time.process_time() - begin
    assert used < 5.0  # of ten seconds


def test_closing_twice_changes_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.rrd")
    recorder.close()
    content = recorder.path.read_bytes()
    recorder.close()
    assert recorder.path.read_bytes() == content
