"""A whole mission as processes: hub, service, recorder and clients; then a table, a map and a recording.

Nothing here is a special road: the processes are those of the commands, on a free port of loopback, and the
scores are computed from the recording.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion_service.bus import open_bus
from fusion_service.config import centre_config, load_config
from fusion_service.config.settings import change, merge
from fusion_service.config.toml_text import dotted, toml_value
from fusion_service.progress import Progress
from schemas import GlobalTracks, MessageError, decode, global_key, local_key

__all__ = ["DemoError", "run_demo"]

log = logging.getLogger(__name__)

START = 2.5
"""Seconds that the clients have to be up before the mission begins."""
READY = 30.0
JITTER = 1.5
STOP = 5.0


class DemoError(Exception):
    """Why a demo cannot go on, and how to mend it, in one line."""


@dataclass(frozen=True)
class Mission:
    """A scenario as the demo runs it: its clients' commands, the config of the centre, how it is scored."""

    name: str
    clients: dict[str, list[str]]
    centre: str
    seconds: float
    speed: float
    cutoff: float
    every: float | None
    lateness: float

    def settings(self, speed: float) -> dict[str, Any]:
        """The centre's settings; a client that the machine holds up for `JITTER` seconds is still waited for."""
        return {"lateness": max(self.lateness, JITTER * speed), **tomllib.loads(self.centre)}


THREE_RADARS = """\
period = 10.0
frame = {kind = "enu", lat = 59.7138694, lon = -55.2676093}   # collocated with radar 1 (Sharma 6.4)
motion = {kind = "cv", q = 10.0}
coast = 25.0
"""

AUTOFERRY = """\
period = 1.0
frame = {kind = "enu", lat = 63.4389029083, lon = 10.39908278, alt = 39.923}   # Piren
motion = {kind = "cv", q = 0.1}
coast = 3.0
"""


def _mission(scenario: str, data: str | None, seed: int, tracker: str, cameras: bool) -> Mission:
    if scenario == "three-radars":
        if cameras:
            raise DemoError("--cameras goes with --scenario autoferry:N")
        command = ["simulate", "three-radars", "--tracker", tracker, "--seed", str(seed), "--sensor"]
        sensors = ("radar1", "radar2", "radar3", "truth")
        return Mission(
            scenario, {name: [*command, name] for name in sensors}, THREE_RADARS, 300.0, 10.0, 5000.0, None, 15.0
        )
    if tracker != "ckf":
        raise DemoError("--tracker goes with --scenario three-radars")
    kind, _, number = scenario.partition(":")
    if kind != "autoferry" or not number.isdigit():
        raise DemoError(f"unknown scenario {scenario!r}: use three-radars, or autoferry:N with N one of 2 3 5 13 16")
    folder = data or os.environ.get("FUSION_DATA")
    if not folder:
        raise DemoError("autoferry needs its recordings: give their folder with --data or in FUSION_DATA")
    if not (Path(folder) / f"scenario{number}_detections.json").is_file():
        raise DemoError(f"no scenario{number}_detections.json in {folder}: --data names the Autoferry folder")
    command = ["playback", scenario, "--data", str(folder), "--sensor"]
    clients = {name: [*command, name] for name in ("lidar", "radar", *(("ir", "eo") if cameras else ()), "truth")}
    return Mission(scenario, clients, AUTOFERRY, 140.0, 10.0, 20.0, 1.0, 3.0)


class Crew:
    """The processes of a demo, each with a log file in `folder`. Leaving the context ends them all."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """`python -m ...` in a group of its own, so that Ctrl-C at the terminal reaches only the demo."""
        with open(self._folder / f"{name}.log", "wb") as output:
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def check(self, *allowed: str) -> None:
        """`DemoError` if one has failed, or ended without being one of `allowed`."""
        for name, process in self._processes.items():
            code = process.poll()
            if code is not None and (code != 0 or name not in allowed):
                raise DemoError(f"{name} ended with code {code}: {self._last_line(name)}")

    def running(self, *names: str) -> bool:
        """Whether any of them still runs."""
        return any(self._processes[name].poll() is None for name in names)

    def stop(self, *names: str) -> None:
        """End them together: SIGINT, and SIGKILL for what is not gone in time."""
        chosen = [self._processes[name] for name in names or tuple(self._processes)]
        for process in chosen:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + STOP
        for process in chosen:
            try:
                process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _last_line(self, name: str) -> str:
        lines = (self._folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class Watch:
    """What the demo sees of the mission on the bus."""

    def __init__(self) -> None:
        self.tokens: set[str] = set()
        self.first = self.last = 0
        self.shown = 0
        self.changed = time.monotonic()

    def on_token(self, key: str, alive: bool) -> None:
        (self.tokens.add if alive else self.tokens.discard)(key)

    def on_tracks(self, key: str, data: bytes) -> None:
        try:
            message = decode(data)
        except MessageError:
            return
        if isinstance(message, GlobalTracks):
            self.first = self.first or message.time
            self.last, self.shown, self.changed = message.time, int((message.status > 0).sum()), time.monotonic()


def run_demo(
    *,
    scenario: str,
    rule: str,
    criterion: str | None,
    memory: str,
    changes: Sequence[str] = (),
    data: str | None,
    speed: float | None,
    seed: int,
    tracker: str = "ckf",
    cameras: bool = False,
    out: Path | None,
    json_path: Path | None,
    stop: threading.Event,
) -> dict[str, Any]:
    """Run a mission and print its scores; returns what the JSON holds. `ConfigError` or `DemoError` if it cannot
    be run, before anything is written or started."""
    mission = _mission(scenario, data, seed, tracker, cameras)
    speed = speed or mission.speed
    options = {"criterion": criterion} if criterion else {}
    settings = {"clock": "message", "rule": rule, "rule_options": options, "memory": memory, **mission.settings(speed)}
    if tracker == "gm-phd":
        settings |= {"kind": "intensity", "rule": "ci", "rule_options": {}}
    for text in changes:
        merge(settings, change(text))
    centre = centre_config(settings)
    rule = centre.intensity_rule if centre.kind == "intensity" else centre.rule
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    folder = out or Path("runs") / f"{scenario.replace(':', '-')}-{rule}-{stamp}"
    recording = folder / "mission.rrd"
    if recording.exists():
        raise DemoError(f"{recording} is there already: give another folder with --out")
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        if json_path.is_dir() or not os.access(json_path.parent, os.W_OK):
            raise DemoError(f"cannot write {json_path}: give another file with --json")
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / "centre.toml"
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    tables = {"centre": settings, "bus": {"connect": [endpoint]}, "service": {"state": str(folder / "state")}}
    config.write_text("".join(map(_toml_table, tables, tables.values())), encoding="utf-8")
    load_config(config)
    print(f"{scenario}: {mission.seconds:g} s of mission at {speed:g} times real time, into {folder}", flush=True)
    _fly(mission, folder, config, recording, endpoint, speed, stop)
    if stop.is_set():
        print(f"stopped; the recording so far: {recording}")
        return {}
    return _report(mission, rule, recording, folder, json_path)


def _toml_table(name: str, table: Mapping[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{dotted((key,))} = {toml_value(value)}\n" for key, value in table.items()) + "\n"


def _fly(
    mission: Mission, folder: Path, config: Path, recording: Path, endpoint: str, speed: float, stop: threading.Event
) -> None:
    watch = Watch()
    with ExitStack() as stack:
        crew = stack.enter_context(Crew(folder))
        crew.start("hub", ["fusion_service", "hub", "--listen", endpoint])
        bus = stack.enter_context(open_bus([endpoint], wait=READY, stop=stop))
        bus.watch(global_key("*", "alive"), watch.on_token)
        bus.watch(local_key("*", "alive"), watch.on_token)
        bus.subscribe(global_key("*", "tracks"), watch.on_tracks)
        crew.start("service", ["fusion_service", "run", "--config", str(config)])
        cutoff = ["--cutoff", str(mission.cutoff)]
        crew.start("record", ["fusion_service", "record", "--out", str(recording), "--connect", endpoint, *cutoff])
        token = global_key(load_config(config).centre.name, "alive")
        _wait(lambda: recording.exists() and token in watch.tokens, crew, stop)
        begin = time.time() + START
        for name, command in mission.clients.items():
            timing = ["--connect", endpoint, "--speed", str(speed), "--start-at", f"{begin:.3f}"]
            crew.start(name, ["sensor_clients", *command, *timing])
        clients = tuple(mission.clients)
        with Progress(mission.name) as bar:
            while not stop.wait(0.1) and crew.running(*clients):
                crew.check(*clients)
                bar.show((time.time() - begin) * speed / mission.seconds, f"{watch.shown} tracks")
            deadline = time.monotonic() + 10
            while not stop.wait(0.1) and time.monotonic() < min(deadline, watch.changed + 2.0):
                crew.check(*clients)
        crew.check(*clients) if not stop.is_set() else None
        crew.stop(*clients)
        crew.stop("service")
        crew.stop("record")


def _wait(ready: Any, crew: Crew, stop: threading.Event) -> None:
    deadline = time.monotonic() + READY
    while not stop.wait(0.05) and not ready():
        crew.check()
        if time.monotonic() > deadline:
            raise DemoError(f"service and recorder were not ready within {READY:g} s: their logs are in the folder")


def _report(mission: Mission, rule: str, recording: Path, folder: Path, json_path: Path | None) -> dict[str, Any]:
    from fusion_service.recording import messages
    from fusion_service.review.evaluation import evaluate, format_table
    from fusion_service.review.mission_map import mission_map

    everything = messages(recording)
    scores = evaluate(everything, c=mission.cutoff, every=mission.every)
    result: dict[str, Any] = scores.as_json(mission.name, rule, str(recording))
    print(format_table(scores))
    picture = folder / "map.png"
    mission_map(everything, picture, title=f"{mission.name}, {rule}")
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"scores:    {json_path}")
    print(f"map:       {picture}\nrecording: {recording}   (look at it: rerun {recording})")
    return result


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
