"""An open viewer sees the picture while it is made, and cannot hold the recorder up."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from fusion_service.cli import main
from fusion_service.recording import Recorder, read
from fusion_service.recording import live as module
from fusion_service.recording.live import Live, address
from fusion_service.recording.program import find_program, quiet
from schemas import encode
from tests.helpers import missions
from tests.helpers.processes import Hub, Program, eventually, free_endpoint, slowness
from tests.recording.contents import FIRST, entities, key_of
from tests.recording.mission import mission

HOST = "127.0.0.1"


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


@contextlib.contextmanager
def viewer(url: str, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A viewer that saves what it is shown to `out`."""
    program = find_program()
    assert program is not None
    environment = quiet(out.with_suffix(".home"))
    command = [str(program), "--bind", HOST, "--port", str(free_port()), "--save", str(out), url]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_viewer_that_comes_late_is_shown_the_same_picture(tmp_path: Path) -> None:
    live = Live(HOST, free_port())
    said, out = list(mission(20)), tmp_path / "seen.rrd"
    with Recorder(tmp_path / "a.rrd", live=live) as recorder:
        for sent in said:
            recorder.handle(sent.key, sent.data, sent.received)
        recorder.tick()
        with viewer(live.url, out):

            def seen() -> set[str]:
                try:
                    return entities(out) if RrdReader(out).blueprints() else set()
                except (RuntimeError, ValueError):  # it ends within a record, or holds no recording yet
                    return set()

            with pytest.warns(match="no footer"):
                eventually(lambda: "/picture/local/radar1/ellipses" in seen() and "/grid" in seen(), 20)
            with pytest.warns(match="no footer"):
                shown = seen()
    recorded = {
        name for name in entities(tmp_path / "a.rrd") if not name.startswith(("/raw", "/seal", "/__properties"))
    }
    assert {name for name in shown if not name.startswith("/__properties")} == recorded
    assert live.dropped == 0


@pytest.mark.parametrize(("how", "seconds"), [("stopped viewer", 250), ("silent connections", 60)])
def test_a_viewer_that_never_reads_holds_nothing_up(
    tmp_path: Path, how: str, seconds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than the server holds for it, as fast as it goes: all is recorded and no tick takes longer."""
    monkeypatch.setattr(module, "HELD", 16 * 2**20)
    places = np.random.default_rng(1).uniform(-1e4, 1e4, (1000, 2))
    scans = [missions.tracks("radar", second, range(1000), places + second) for second in range(seconds)]
    coded = [(key_of(scan), encode(scan)) for scan in scans]
    live = Live(HOST, free_port())
    with contextlib.ExitStack() as stack:
        if how == "stopped viewer":
            process = stack.enter_context(viewer(live.url, tmp_path / "seen.rrd"))
            eventually((tmp_path / "seen.rrd").exists, 20)
            time.sleep(1.0)
            process.send_signal(signal.SIGSTOP)
        else:
            port = int(live.url.split(":")[2].split("/")[0])
            for _ in range(5):
                stack.enter_context(socket.create_connection((HOST, port)))
        recorder = stack.enter_context(Recorder(tmp_path / "a.rrd", frame=missions.FRAME, live=live))
        ticks = []
        for number, (key, data) in enumerate(coded):
            recorder.handle(key, data, FIRST + number)
            begin = time.monotonic()
            recorder.tick()
            ticks.append(time.monotonic() - begin)
        begin = time.monotonic()
        recorder.close()
        closing = time.monotonic() - begin
    assert (live.dropped > 0) == (how == "stopped viewer")
    assert live._held <= module.HELD
    assert max(ticks) < 2.0 * slowness(), "for ever where it waits for a viewer"
    assert closing < 5.0 * slowness()
    assert [raw.data for raw in read(tmp_path / "a.rrd")] == [data for _, data in coded]


def is_free(port: int) -> bool:
    try:
        socket.create_server((HOST, port)).close()
    except OSError:
        return False
    return True


def test_a_port_that_is_taken_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"cannot listen on {HOST}:{port}"):
            Live(HOST, port)
        with pytest.raises(OSError, match=rf"cannot listen on {HOST}:{port}"):
            Live(HOST, other := free_port(), web=port)
        assert is_free(other)  # nothing has been begun
        command = ["record", "--out", str(tmp_path / "a.rrd"), "--live", f"{HOST}:{port}"]
        assert main(command) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "a.rrd").exists()
    with pytest.raises(OSError, match="no address of this machine"):
        Live("no.such.host.invalid", 1)


def test_a_recorder_that_finds_no_bus_takes_its_viewers_server_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object, **__: object) -> None:
        raise OSError("no bus")

    monkeypatch.setattr("fusion_service.bus.session.open_bus", none)
    port = free_port()
    assert main(["record", "--out", str(tmp_path / "a.rrd"), "--live", f"{HOST}:{port}"]) == 1
    eventually(lambda: is_free(port))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("9877", (HOST, 9877)),
        ("0.0.0.0", ("0.0.0.0", 9876)),
        ("[::1]:80", ("::1", 80)),
        ("host:1234", ("host", 1234)),
        (":5", (HOST, 5)),
    ],
)
def test_addresses(text: str, found: tuple[str, int]) -> None:
    assert address(text) == found


@pytest.mark.parametrize("text", ["host:", "host:port", "0", "1:65536", "a:b:c"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not HOST:PORT"):
        address(text)


def listeners(port: int) -> set[str]:
    """Local addresses, in the kernel's hexadecimal, that listen on `port`."""
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {line[1].split(":")[0] for line in lines if line[3] == "0A" and int(line[1].split(":")[1], 16) == port}


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_the_command_serves_viewer_and_page_on_loopback_alone(hub: Hub, tmp_path: Path, end: signal.Signals) -> None:
    live, web = free_port(), free_port()
    options = ["--connect", hub.endpoint, "--live", str(live), "--live-web", str(web)]
    command = ["record", "--out", str(tmp_path / "a.rrd"), *options]
    run = f"import sys; from fusion_service.cli import main; sys.exit(main({command!r}))"
    with Program(run) as program:
        assert program.line(20) == f"live: rerun --connect rerun+http://127.0.0.1:{live}/proxy"
        page = program.line().removeprefix("live: ")
        eventually(lambda: listeners(web))
        assert listeners(web) == listeners(live) == {"0100007F"}
        with urllib.request.urlopen(page, timeout=10) as answer:
            assert b"rerun" in answer.read().lower()
        eventually((tmp_path / "a.rrd").exists)
        program.signal(end)
        code, _ = program.end()
        assert code == (0 if end == signal.SIGTERM else -end)
        eventually(lambda: not listeners(web) | listeners(live))
    assert list(read(tmp_path / "a.rrd")) == []


def test_usage_data_is_sent_to_nobody(tmp_path: Path) -> None:
    program = find_program()
    assert program is not None
    done = subprocess.run([program, "analytics", "config"], env=quiet(tmp_path), capture_output=True, check=False)
    assert b'"analytics_enabled": false' in done.stdout.replace(b":false", b": false")
    assert "XDG_CONFIG_HOME" not in os.environ or os.environ["XDG_CONFIG_HOME"] != str(tmp_path)
