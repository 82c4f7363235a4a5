"""The kit as an integrator meets it: a real hub, real processes, and what reaches a subscriber."""

import inspect
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fusion_service.bus import Bus, BusError, open_bus
from schemas import (
    Disk,
    Enu,
    Height,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    Motion,
    Platform,
    SensorInfo,
    Truth,
    decode,
)
from sensor_clients.publisher import TrackPublisher, TruthPublisher
from tests.helpers.processes import Hub, Program, eventually

SITE = Enu(59.3, 10.4)
SPACE = ("x", "vx", "y", "vy")
P = np.diag([25.0, 1.0, 25.0, 1.0])


@pytest.fixture
def listener(hub: Hub) -> Iterator[tuple[Bus, list[tuple[str, Message]]]]:
    got: list[tuple[str, Message]] = []
    with open_bus([hub.endpoint], wait=60.0) as bus:
        bus.subscribe("**", lambda key, data: got.append((key, decode(data))), history=8)
        yield bus, got


def scan(**changes: Any) -> dict[str, Any]:
    base = {
        "time": 10**18,
        "space": SPACE,
        "frame": SITE,
        "ids": [7, 9],
        "means": np.zeros((2, 4)),
        "covariances": [P, P],
    }
    return base | changes


def test_what_is_published_arrives_with_its_header(hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]) -> None:
    _, got = listener
    ticks = iter(range(1000, 2000))
    with TrackPublisher(
        "radar-1",
        connect=hub.endpoint,
        realm="navy/north",
        origin="exercise",
        lineage=["a", "b"],
        clock=lambda: next(ticks),
    ) as radar:
        assert radar.epoch == 1000
        radar.info(
            frame=SITE,
            position=[1, 2, 3],
            period=2,
            motion=Motion("cv", 0.5),
            coverage=Disk(1e4),
            detection_probability=0.9,
            position_covariance=np.eye(3),
            heading_sigma=0.02,
        )
        radar.tracks(
            **scan(
                means=[[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]],
                covariances=[P.tolist()] * 3,
                counts=[1, 2],
                weights=(1.0, 0.25, 0.75),
                existence=[1, 0.5],
                updated=[5, 6],
                identity=["mmsi:1", None],
                kind=[None, "ship"],
                kind_p=[0, 1],
                height=Height(5.0, 2.0),
                lineages=[["b"], ["a", "b"]],
                platform=Platform((1.0, 2.0, 3.0), heading=0.5),
            )
        )
        radar.intensity(time=5, space=["x", "y"], frame=SITE, weights=[1.5], means=[[1, 2]], covariances=[np.eye(2)])
        radar.tracks(time=np.int64(6), space=["x", "y"], frame=SITE, ids=[], means=[], covariances=[], complete=False)
        eventually(lambda: len(got) == 4)
    by_key = {key: [message for k, message in got if k == key] for key, _ in got}
    prefix = "navy/north/v1/local/radar-1/"
    assert set(by_key) == {prefix + what for what in ("info", "tracks", "intensity")}
    for messages in by_key.values():
        assert [message.seq for message in messages] == list(range(len(messages)))
        for message in messages:
            assert (message.source, message.epoch, message.origin) == ("radar-1", 1000, "exercise")
            assert message.lineage == ("a", "b")
            assert 1000 < message.sent < 2000
    (info,) = by_key[prefix + "info"]
    assert isinstance(info, SensorInfo)
    assert (info.position, info.period, info.coverage) == ((1.0, 2.0, 3.0), 2.0, Disk(1e4))
    full, empty = by_key[prefix + "tracks"]
    assert isinstance(full, LocalTracks)
    assert full.platform is not None
    assert (full.platform.position, full.platform.heading) == ((1.0, 2.0, 3.0), 0.5)
    assert info.heading_sigma == 0.02
    assert full.track_lineage is not None
    assert full.track_lineage.tolist() == [[0b10], [0b11]]
    assert isinstance(full, LocalTracks)
    assert isinstance(empty, LocalTracks)
    assert full.ids.tolist() == [7, 9]
    assert full.means.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]]
    assert (full.covariances == P).all()
    assert full.counts is not None
    assert full.counts.tolist() == [1, 2]
    assert full.updated is not None
    assert full.updated.tolist() == [5, 6]
    assert (full.identity, full.kind, full.height) == (("mmsi:1", None), (None, "ship"), Height(5.0, 2.0))
    assert (empty.complete, len(empty.ids), empty.time) == (False, 0, 6)
    (intensity,) = by_key[prefix + "intensity"]
    assert isinstance(intensity, LocalIntensity)
    assert intensity.weights.tolist() == [1.5]


def test_a_late_joiner_gets_the_current_info_and_tracks(hub: Hub) -> None:
    with TrackPublisher("radar-1", connect=hub.endpoint, wait=60.0) as radar:
        for period in (1.0, 2.0):
            radar.info(frame=SITE, position=(0, 0, 0), period=period, motion=Motion("cv", 0.5))
        for i in range(3):
            radar.tracks(**scan(time=i))
        got: list[Message] = []
        with open_bus([hub.endpoint], wait=60.0) as bus:
            bus.subscribe("fusion/v1/local/*/*", lambda key, data: got.append(decode(data)))
            eventually(lambda: len(got) == 2)
    assert {message.seq for message in got if isinstance(message, SensorInfo)} == {1}
    assert {message.time for message in got if isinstance(message, LocalTracks)} == {2}


def test_alive_while_open_and_a_new_epoch_each_time(hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]) -> None:
    bus, got = listener
    alive: list[tuple[str, bool]] = []
    bus.watch("fusion/v1/local/*/alive", lambda key, up: alive.append((key, up)))
    radar = TrackPublisher("radar-1", connect=[hub.endpoint], wait=60.0)
    key = "fusion/v1/local/radar-1/alive"
    for count in (1, 2):
        with radar:
            assert radar.connected
            radar.tracks(**scan())
            eventually(lambda: len(got) == count and alive[-1:] == [(key, True)])  # noqa: B023
        eventually(lambda: alive[-1:] == [(key, False)])
        assert not radar.connected
    assert [message.seq for _, message in got] == [0, 0]
    assert got[0][1].epoch < got[1][1].epoch
    with pytest.raises(BusError, match="with"):
        radar.tracks(**scan())


def test_publications_resume_after_the_hub_died(hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]) -> None:
    _, got = listener
    with TrackPublisher("radar-1", connect=hub.endpoint, wait=60.0) as radar:
        radar.tracks(**scan())
        eventually(lambda: len(got) == 1)
        hub.kill()
        eventually(lambda: not radar.connected)
        radar.tracks(**scan())
        hub.start()
        eventually(lambda: radar.connected)
        radar.tracks(**scan())
        eventually(lambda: got[-1][1].seq == 2)
    assert [message.seq for _, message in got] in ([0, 1, 2], [0, 2])


NAN = np.full((2, 4), np.nan)
BAD_TRACKS: dict[str, tuple[str, dict[str, Any], str]] = {
    "means of another length": ("length", {"means": np.zeros((2, 3))}, "means"),
    "one mean, not a list of them": ("length", {"means": [0, 0, 0, 0]}, "means"),
    "means of another number of tracks": ("length", {"means": np.zeros((3, 4))}, "means|covariances"),
    "standard deviations for covariances": ("length", {"covariances": np.ones((2, 4))}, "covariances"),
    "ragged": ("bad-field", {"means": [[1, 2, 3, 4], [1, 2]]}, "means"),
    "words": ("bad-field", {"means": [["a"] * 4] * 2}, "means"),
    "an id twice": ("bad-field", {"ids": [7, 7]}, "id"),
    "negative ids": ("bad-field", {"ids": [-1, 7]}, "ids"),
    "ids that are not whole": ("bad-field", {"ids": [1.5, 7]}, "ids"),
    "seconds for nanoseconds": ("bad-field", {"time": 1.7e9}, "time"),
    "a component nobody knows": ("bad-field", {"space": ("x", "y", "speed", "course")}, "speed"),
    "no frame": ("bad-field", {"frame": None}, "frame"),
    "NaN": ("not-finite", {"means": NAN}, "track 7"),
    "an indefinite covariance": ("not-positive-definite", {"covariances": [P, P - 2 * np.eye(4)]}, "track 9"),
    "a covariance of zeros": ("not-positive-definite", {"covariances": [P, 0 * P]}, "track 9"),
    "one triangle only": ("bad-field", {"covariances": [P + np.tril(np.ones((4, 4)), -1) * 0.5] * 2}, "not symmetric"),
    "existence above one": ("existence", {"existence": [1, 1.5]}, "track 9"),
    "existence of one track only": ("length", {"existence": [1]}, "existence"),
    "weights that do not sum to one": ("weights", {"weights": [1, 0.5], "counts": [1, 1]}, "track 9"),
    "counts without weights": ("missing", {"counts": [1, 1]}, "weights"),
    "a number for a text": ("bad-field", {"identity": [1, 2]}, "identity"),
}


def test_what_the_centre_would_refuse_is_refused_here_and_never_sent(
    hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]
) -> None:
    _, got = listener
    with TrackPublisher("radar-1", connect=hub.endpoint, wait=60.0) as radar:
        for name, (reason, changes, says) in BAD_TRACKS.items():
            with pytest.raises(MessageError, match=says) as caught:
                radar.tracks(**scan(**changes))
            assert caught.value.reason == reason, name
            assert "\n" not in str(caught.value), name
        with pytest.raises(MessageError, match="component 0"):
            radar.intensity(time=1, space=("x", "y"), frame=SITE, weights=[-1], means=[[0, 0]], covariances=[np.eye(2)])
        with pytest.raises(MessageError, match="position"):
            radar.info(frame=SITE, position=(0, 0), period=1.0, motion=Motion("cv", 1.0))
        radar.tracks(**scan())
        eventually(lambda: got)
    assert [message.seq for _, message in got] == [0]


def test_covariances_that_rounding_made_slightly_asymmetric_pass(hub: Hub) -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(4, 4))
    covariance = root @ root.T + np.eye(4)
    covariance[0, 1] *= 1 + 1e-12
    with TrackPublisher("radar-1", connect=hub.endpoint, wait=60.0) as radar:
        sent = radar.tracks(**scan(covariances=[covariance] * 2))
    assert sent.seq == 0


@pytest.mark.parametrize(("name", "origin"), [("a/b", "live"), ("*", "live"), ("radar-1", "imagined")])
def test_bad_names_are_refused_before_anything_is_opened(name: str, origin: str) -> None:
    with pytest.raises(ValueError, match=r"bad (name|origin)"):
        TrackPublisher(name, origin=origin)


def test_truth(hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]) -> None:
    _, got = listener
    with TruthPublisher("three-radars", connect=hub.endpoint, origin="simulated", wait=60.0) as scenario:
        scenario.truth(time=5, space=("x", "y"), frame=SITE, ids=[1, 2], means=[[1, 2], [3, 4]])
        with pytest.raises(MessageError, match="finite"):
            scenario.truth(time=6, space=("x", "y"), frame=SITE, ids=[1], means=[[1, np.inf]])
        eventually(lambda: got)
    ((key, message),) = got
    assert isinstance(message, Truth)
    assert (key, message.source) == ("fusion/v1/truth/three-radars", "three-radars")
    assert message.means.tolist() == [[1, 2], [3, 4]]


def test_the_example_in_the_documentation_runs_as_it_stands(
    hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]
) -> None:
    _, got = listener
    text = inspect.getdoc(TrackPublisher)
    assert text is not None
    example = textwrap.dedent("\n".join(line for line in text.splitlines() if line.startswith("    ") or not line))
    assert example.strip().count("\n") < 12
    assert "tcp/127.0.0.1:7447" in example
    with Program(example.replace("tcp/127.0.0.1:7447", hub.endpoint)) as program:
        assert program.end() == (0, "")
    eventually(lambda: len(got) == 4)
    assert isinstance(got[0][1], SensorInfo)
    tracks = [message for _, message in got if isinstance(message, LocalTracks)]
    assert [message.means.tolist() for message in tracks] == [[[1200, 400]], [[1194, 400]], [[1188, 400]]]


def test_importing_it_loads_nothing_heavy() -> None:
    code = "import sys, sensor_clients.publisher; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "zenoh" in loaded
    assert not {"scipy", "rerun", "matplotlib", "pyarrow", "pandas"} & set(loaded)


def test_extents_are_sent_and_unsound_ones_are_not(hub: Hub, listener: tuple[Bus, list[tuple[str, Message]]]) -> None:
    _, got = listener
    hulls = [[36.0, 9.6, 0.5], [np.nan] * 3]
    said: dict[str, Any] = {
        "extent": hulls,
        "extent_sigma": [[1, 0.5, 0.1], [np.nan] * 3],
        "shape": "box",
        "reference": "antenna",
    }
    with TrackPublisher("radar-1", connect=hub.endpoint) as radar:
        radar.tracks(**scan(**said, reference_covariances=[np.diag([108.0, 8.0]), np.full((2, 2), np.nan)]))
        for bad in ([[5.0, 6.0, 0.0], hulls[1]], [[0.0, np.nan, 0.0], hulls[1]], [[1e5, 1.0, 0.0], hulls[1]]):
            with pytest.raises(MessageError, match="track 7") as caught:
                radar.tracks(**scan(extent=bad))
            assert caught.value.reason == "extent"
        for odd in ({"shape": "circle"}, {"reference": "bow"}, {"extent": [[1.0, 1.0, 0.0]]}):
            with pytest.raises(MessageError):
                radar.tracks(**scan(**odd))
    with TruthPublisher("three-radars", connect=hub.endpoint) as scenario:
        place: dict[str, Any] = {"space": ("x", "y"), "frame": SITE, "ids": [1, 2], "means": [[1, 2], [3, 4]]}
        scenario.truth(time=5, **place, extent=hulls, extent_offset=[[-12.0, 0.0], [np.nan, np.nan]], shape="box")
        with pytest.raises(MessageError):
            scenario.truth(time=6, **place, extent=[[1, 2, 0], [1, 1, 0]])
        eventually(lambda: len(got) == 2)
    tracks, truth = (message for _, message in got)
    assert isinstance(tracks, LocalTracks)
    assert isinstance(truth, Truth)
    for message in (tracks, truth):
        assert message.extent is not None
        np.testing.assert_array_equal(message.extent, hulls)
        assert message.shape == "box"
    assert tracks.reference == "antenna"
    assert tracks.reference_covariances is not None
    assert truth.extent_offset is not None
    assert tracks.reference_covariances[0].tolist() == [[108, 0], [0, 8]]
    assert truth.extent_offset[0].tolist() == [-12, 0]
