"""`sensor-client` as its users meet it: real processes on a real hub, its refusals, its pace and its end."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from fusion_service.bus import open_bus
from schemas import LocalTracks, Message, SensorInfo, Truth, decode
from sensor_clients.cli import main
from sensor_clients.events import Event
from sensor_clients.publisher import TrackPublisher
from sensor_clients.runner import pace
from sensor_clients.scenarios import three_radars as world
from tests.helpers.processes import Hub, Program, eventually, free_endpoint

MAIN = "import sys; from sensor_clients.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture
def heard(hub: Hub) -> Iterator[list[tuple[str, Message]]]:
    got: list[tuple[str, Message]] = []
    with open_bus([hub.endpoint], wait=60.0) as bus:
        bus.subscribe("**", lambda key, data: got.append((key, decode(data))), history=8)
        yield got


def test_a_radar_truth_and_their_end(hub: Hub, heard: list[tuple[str, Message]]) -> None:
    common = ("simulate", "three-radars", "--connect", hub.endpoint, "--realm", "sea", "--speed", "100")
    with (
        Program(MAIN, *common, "--sensor", "radar1", "--duration", "40", "--seed", "4") as radar,
        Program(MAIN, *common, "--sensor", "truth", "--duration", "40") as truth,
    ):
        assert radar.end(20) == (0, "")
        assert truth.end(20) == (0, "")
        eventually(lambda: len(heard) >= 1 + 5 + 9)
    tracks = [message for _, message in heard if isinstance(message, LocalTracks)]
    infos = [message for _, message in heard if isinstance(message, SensorInfo)]
    truths = [message for _, message in heard if isinstance(message, Truth)]
    assert {key for key, _ in heard} >= {"sea/v1/local/radar1/tracks", "sea/v1/truth/three-radars"}
    assert [m.time - world.START for m in tracks] == [k * 10**10 for k in range(5)]
    assert [m.seq for m in tracks] == list(range(5))
    assert all(m.origin == "simulated" and m.complete for m in tracks)
    assert len(infos) == 1
    assert infos[0].frame == world.RADARS["radar1"]
    assert len(truths) == 9
    expected = [event for event in world.radar_events("radar1", 4) if event.kind == "tracks"]
    assert tracks[-1].ids.tolist() == expected[4].fields["ids"].tolist()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it(hub: Hub, heard: list[tuple[str, Message]], number: signal.Signals) -> None:
    with Program(MAIN, "simulate", "three-radars", "--sensor", "radar2", "--connect", hub.endpoint) as client:
        eventually(lambda: heard, 20)
        client.signal(number)
        assert client.end(3) == (0, "")


def test_a_signal_ends_the_wait_for_a_hub() -> None:
    with Program(MAIN, "simulate", "three-radars", "--sensor", "truth", "--connect", free_endpoint()) as client:
        pipe = client._process.stderr
        assert pipe is not None
        assert b"waiting for the hub" in pipe.readline()
        client.signal(signal.SIGTERM)
        assert client.end(5)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["simulate", "two-radars", "--sensor", "radar1"], "known: three-radars"),
        (["simulate", "three-radars", "--sensor", "radar4"], "known: radar1, radar2, radar3, truth"),
        (["simulate", "three-radars", "--sensor", "radar1", "--realm", "a b"], "bad name 'a b'"),
        (["playback", "autoferry:1", "--sensor", "lidar"], "autoferry:16"),
        (["playback", "autoferry:2", "--sensor", "lidar"], "--data DIR or set FUSION_DATA"),
        (["playback", "radar", "--sensor", "radar"], "radar-v2x"),
        (["playback", "radar-v2x", "--sensor", "radar"], "--data DIR or set FUSION_DATA"),
        (["playback", "mrclam:7", "--sensor", "robot1"], "known: autoferry:2"),
        (["playback", "mrclam:6", "--sensor", "robot1"], "MR.CLAM sets, or one above it"),
    ],
)
def test_bad_usage_is_2_and_says_how_to_mend_it(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATA", raising=False)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("option", [["--speed", "0"], ["--speed", "nan"], ["--seed", "-1"], ["--duration", "x"], []])
def test_argparse_refuses(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["simulate", "three-radars", *option, *(["--sensor", "radar1"] if option else [])]
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_missing_or_broken_data_is_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["playback", "autoferry:2", "--sensor", "lidar", "--data", str(tmp_path)]
    assert main(command) == 1
    assert "scenario2_detections.json is not there" in capsys.readouterr().err
    for content, says in (("{", "is not JSON"), ("{}", "list of records"), ('[{"sensorID": 1}]', "cannot be read")):
        (tmp_path / "scenario2_detections.json").write_text(content)
        assert main(command) == 1
        error = capsys.readouterr().err
        assert says in error
        assert error.count("\n") == 1


def test_list_names_every_parameter_with_its_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    for row in world.PARAMETERS:
        assert any(row.name in line and row.source in line for line in out.splitlines())
    assert "autoferry:N" in out
    assert "mrclam:N" in out


def test_help_has_examples(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ([], ["simulate"], ["playback"], ["list"]):
        with pytest.raises(SystemExit) as ended:
            main([*command, "--help"])
        assert ended.value.code == 0
        assert "examples:\n  sensor-client" in capsys.readouterr().out


class Listener:
    """Stands for a publisher: notes when each message came, by a clock that only waiting moves."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.heard: list[tuple[str, float]] = []

    def info(self, **_: Any) -> None:
        self.heard.append(("info", self.now))

    def tracks(self, *, time: int, **_: Any) -> None:
        self.heard.append((str(time // 10**9), self.now))


class Waiting(threading.Event):
    """Waiting takes no time, but moves the listener's clock."""

    def __init__(self, listener: Listener) -> None:
        super().__init__()
        self.listener = listener

    def wait(self, timeout: float | None = None) -> bool:
        self.listener.now += timeout or 0.0
        return self.is_set()


def play(listener: Listener, start_at: float, speed: float, stop: threading.Event | None = None) -> int:
    events = [Event(0, "info", {})] + [Event(t * 10**9, "tracks", {}) for t in (0, 10, 20, 30)]
    return pace(
        events,
        cast(TrackPublisher, listener),
        start=0,
        start_at=start_at,
        speed=speed,
        stop=stop or Waiting(listener),
        clock=lambda: listener.now,
    )


def test_an_event_is_due_at_its_time_over_the_speed() -> None:
    listener = Listener()
    assert play(listener, start_at=1002.0, speed=4.0) == 5
    assert [name for name, _ in listener.heard] == ["info", "0", "10", "20", "30"]
    assert [when for _, when in listener.heard] == pytest.approx([1002.0, 1002.0, 1004.5, 1007.0, 1009.5])


def test_a_late_client_catches_up() -> None:
    listener = Listener()
    play(listener, start_at=985.0, speed=1.0)
    assert [when for _, when in listener.heard] == pytest.approx([1000.0, 1000.0, 1000.0, 1005.0, 1015.0])


def test_nothing_is_published_after_stop() -> None:
    listener = Listener()
    stop = Waiting(listener)
    stop.set()
    assert play(listener, start_at=0.0, speed=1.0, stop=stop) == 0
    assert listener.heard == []


def test_the_commands_load_no_rerun() -> None:
    code = "import sensor_clients.cli, sys; print([name for name in sys.modules if name.startswith('rerun')])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
