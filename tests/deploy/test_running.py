"""The lines of the units, as processes: they tell the service manager that they are ready and alive, serve figures and
health, take SIGHUP without an end, and log in JSON. One set of processes for all of it."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from fusion_service.monitoring import METRICS
from tests.deploy.units import command
from tests.helpers.processes import Program, eventually, free_endpoint
from tests.helpers.scene import SENSOR

CONFIG = """
[centre]
period = 0.2
delay = 0.1
[bus]
connect = ["{endpoint}"]
[service]
state = "{folder}/state"
status_period = 0.2
{more}
"""


class Unit:
    """A process, what it told the service manager, and what it logged."""

    def __init__(self, name: str, folder: Path, line: list[str], port: str) -> None:
        self.name, self._port = name, port.rpartition(":")[2]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        address = str(folder / f"{name}.notify")
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._log = folder / f"{name}.log"
        self._told = ""
        with self._log.open("wb") as log:
            environment = os.environ | {"NOTIFY_SOCKET": address, "JOURNAL_STREAM": "1:1"}
            self.process = subprocess.Popen(line, stderr=log, stdout=log, env=environment, cwd=folder)

    def told(self) -> str:
        """All that the service manager was told until now."""
        while True:
            try:
                self._told += self._socket.recv(4096).decode() + "\n"
            except BlockingIOError:
                return self._told

    def telling(self, words: str, times: int = 1) -> Callable[[], bool]:
        """Whether the service manager was told this so often."""
        return lambda: self.told().count(words) >= times

    def is_ready(self) -> bool:
        return self.get("/readyz") == (200, "ok\n")

    def log(self) -> str:
        return self._log.read_text("utf-8")

    def says(self, words: str) -> bool:
        assert self.process.poll() is None, self.log()
        return words in self.log()

    def get(self, path: str) -> tuple[int, str]:
        """Code and body of an answer; 0 where nobody listens yet."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}{path}", timeout=20) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()
        except OSError:
            return 0, ""

    def figures(self) -> dict[str, float]:
        """By name, with labels as they are written."""
        _, text = self.get("/metrics")
        lines = [line.rpartition(" ") for line in text.splitlines() if not line.startswith("#")]
        return {name: float(value) for name, _, value in lines}

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._socket.close()


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Unit]]:
    folder = tmp_path_factory.mktemp("units")
    endpoint = free_endpoint()
    ports = {name: free_endpoint().removeprefix("tcp/") for name in ("hub", "centre", "recorder", "metrics")}
    config = folder / "centre.toml"
    config.write_text(CONFIG.format(endpoint=endpoint, folder=folder, more=""))
    join = ["--connect", endpoint]
    lines = {
        "hub": [*command("fusion-hub", **{"tcp/127.0.0.1:7447": endpoint}), ports["hub"]],
        "centre": [*command("fusion-centre", **{"/etc/fusion/centre.toml": str(config)}), ports["centre"]],
        "recorder": [
            *command("fusion-recorder", **{"/var/lib/fusion/recordings/": f"{folder}/recordings/"}),
            *(ports["recorder"], "--no-draw", "--flush", "0.2", *join),
        ],
        "metrics": [*command("fusion-metrics"), "--listen", ports["metrics"], *join],
    }
    with ExitStack() as stack:
        made = {}
        for name, line in lines.items():
            made[name] = Unit(name, folder, line, ports[name])
            stack.callback(made[name].end)
        stack.enter_context(Program(SENSOR, endpoint, "r1", "given", "0", "1"))
        yield made


def test_each_says_that_it_is_ready_and_alive(units: dict[str, Unit]) -> None:
    for name, unit in units.items():
        eventually(unit.telling("READY=1"), 60)
        if name in ("centre", "recorder"):
            eventually(unit.telling("WATCHDOG=1", 2))
            assert "STATUS=" in unit.told()


def test_figures_and_health_are_served(units: dict[str, Unit]) -> None:
    for unit in units.values():
        eventually(unit.is_ready, 60)
        assert unit.get("/healthz") == (200, "ok\n")
        assert unit.get("/nothing")[0] == 404
        figures = unit.figures()
        assert figures["fusion_ready"] == 1.0
        assert figures["process_resident_memory_bytes"] > 1e6
        assert {re.split(r"[{ ]", name)[0] for name in figures if name.startswith("fusion_")} <= set(METRICS)
    eventually(lambda: units["centre"].figures().get('fusion_tracks{centre="centre",status="confirmed"}') == 2.0)

    def of_centre(name: str) -> set[str]:
        return {one for one in units[name].figures() if "centre=" in one}

    eventually(lambda: of_centre("centre") == of_centre("metrics"))
    eventually(lambda: units["metrics"].figures().get('fusion_source_alive{centre="centre",source="r1"}') == 1.0)
    assert units["recorder"].figures()["fusion_recorder_messages_total"] > 0
    assert units["hub"].figures()["fusion_hub_links"] >= 3


def test_logs_are_json_with_stable_fields(units: dict[str, Unit]) -> None:
    eventually(lambda: units["centre"].says("source r1 is there"))
    for unit in units.values():
        entries = [json.loads(line) for line in unit.log().splitlines()]
        assert entries
        for entry in entries:
            assert list(entry)[:4] == ["time", "level", "logger", "message"], unit.name
            assert set(entry) <= {"time", "level", "logger", "message", "source", "reason", "trace"}
            assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", entry["time"])
    (there,) = [
        entry for entry in map(json.loads, units["centre"].log().splitlines()) if "r1 is there" in entry["message"]
    ]
    assert there["source"] == "r1"


def test_a_hangup_reloads_and_ends_none(units: dict[str, Unit], tmp_path: Path) -> None:
    """After the figures were served: all have begun."""
    centre, recorder = units["centre"], units["recorder"]
    for unit in units.values():
        eventually(unit.is_ready, 60)
        unit.process.send_signal(signal.SIGHUP)
    eventually(lambda: centre.says("reloaded: nothing has changed"))
    eventually(lambda: units["hub"].says("there is nothing to reload"))
    eventually(lambda: units["metrics"].says("there is nothing to reload"))
    eventually(lambda: recorder.says("0002.rrd goes on from"))

    config = Path(centre.process.args[-3])  # type: ignore[index, arg-type]
    text = config.read_text()
    config.write_text("[centre]\nlateness = 'long'\n" + text.replace("[centre]", ""))
    centre.process.send_signal(signal.SIGHUP)
    eventually(lambda: centre.says("the old config goes on"))
    assert centre.says("lateness")
    limits = "[limits.sources.r1]\nmessages = 0.001\nburst = 0.01\n"
    config.write_text(text.replace("[centre]", "[centre]\ncoast = 9.0") + limits)
    centre.process.send_signal(signal.SIGHUP)
    eventually(lambda: centre.says("reloaded, at once: limits.sources.r1"))
    assert centre.says("taken by a restart only: centre.coast: 5.0 -> 9.0")
    eventually(lambda: centre.figures().get('fusion_dropped_total{centre="centre",source="r1"}', 0.0) > 0)
    assert centre.get("/healthz") == (200, "ok\n")
    for unit in units.values():
        assert unit.process.poll() is None
