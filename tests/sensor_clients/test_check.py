"""`sensor-client check`: files and sources that are right and wrong."""

from __future__ import annotations

import time
from pathlib import Path

import msgpack
import numpy as np
import pytest

from sensor_clients.cli import main
from tests.helpers.processes import Hub
from tests.helpers.scene import opened

VECTORS = Path(__file__).parents[2] / "schemas" / "vectors"


def message(**changes: object) -> bytes:
    said = {
        "v": 1, "type": "local_tracks", "source": "m01", "epoch": time.time_ns(), "seq": 0, "sent": time.time_ns(),
        "origin": "live", "time": time.time_ns(), "complete": True, "space": ["x", "y"],
        "frame": {"kind": "enu", "lat": 59.0, "lon": 10.0}, "ids": np.array([1], "<u8").tobytes(),
        "means": np.array([1.0, 2.0], "<f8").tobytes(), "covs": np.array([4.0, 0.0, 9.0], "<f8").tobytes(),
    }  # fmt: skip
    return msgpack.packb({**said, **changes})  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", sorted(path.stem for path in VECTORS.glob("local_*.msgpack")))
def test_nothing_is_wrong_with_a_golden_message(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(VECTORS / f"{name}.msgpack")]) == 0
    assert "nothing wrong" in capsys.readouterr().out


def test_everything_that_is_wrong_with_a_file_is_told_field_by_field(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.msgpack"
    path.write_bytes(
        message(time=1.78e9, space=["x", "speed"], frame={"kind": "enu", "lat": 120.0, "lon": 10.0}, origin="LIVE")
        + message()
        + message(covs=np.array([0.0, 0.0, 9.0], "<f8").tobytes())
    )
    assert main(["check", str(path)]) == 1
    told = capsys.readouterr()
    for words in (
        "is it in seconds",
        "states are Cartesian",
        "are they swapped",
        'did you mean "live"',
        "variance of x is 0",
    ):
        assert words in told.out, words
    assert told.out.count("message ") == 3
    assert "5 things are wrong" in told.err


def test_a_file_that_is_not_there_and_one_that_is_no_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(tmp_path / "none.msgpack")]) == 2
    (tmp_path / "a.json").write_text('{"v": 1}')
    assert main(["check", str(tmp_path / "a.json")]) == 1
    assert "payload is JSON" in capsys.readouterr().out


def test_a_source_on_the_bus(hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with opened(hub, tmp_path) as scene:
        scene.sensor("r1", 0, 1)
        assert main(["check", "r1", "--for", "2.5", "--connect", hub.endpoint]) == 0
        told = capsys.readouterr().out
        assert "nothing is wrong with r1" in told
        assert "sensor_info" in told
        publisher = scene.bus.publisher("fusion/v1/local/m01/track")
        publisher.put(message(means=[1.0, 2.0]))
        assert main(["check", "m01", "--for", "1.5", "--connect", hub.endpoint]) == 1
        told = capsys.readouterr().out
        assert 'did you mean "tracks"' in told
        assert "columns are bytes" in told
        assert "no liveliness token" in told
        assert main(["check", "nobody", "--for", "0.3", "--connect", hub.endpoint]) == 1
        assert "nothing came of nobody" in capsys.readouterr().err
