"""One mission from start to scores."""

from __future__ import annotations

import json
import os
import shlex
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fusion_service.config import centre_config, load_config
from fusion_service.config.own_rule import is_own_rule, load_from_here
from fusion_service.config.settings import change, merge
from fusion_service.config.toml_text import dotted, toml_value
from fusion_service.demo.crew import Crew, DemoError, client_arguments, free_endpoint, record_arguments
from fusion_service.demo.missions import MissionPlan, plan_mission, with_faults
from fusion_service.demo.viewer import look_on
from fusion_service.progress import Progress
from schemas import GlobalTracks, MessageError, Wholes, decode, global_key, local_key

__all__ = ["START", "run_demo", "write_config"]

START = 2.5
"""Seconds that the clients have to be up before the mission begins."""
READY = 30.0
"""Seconds that service and recorder have to be up."""


class _Watch:
    """What the demo sees of the mission on the bus."""

    def __init__(self) -> None:
        self.tokens: set[str] = set()
        self.shown = 0
        self._wholes = Wholes()
        self.changed = time.monotonic()

    def on_token(self, key: str, alive: bool) -> None:
        (self.tokens.add if alive else self.tokens.discard)(key)

    def on_tracks(self, key: str, data: bytes) -> None:
        try:
            message = decode(data)
        except MessageError:
            return
        if isinstance(message, GlobalTracks) and (whole := self._wholes.of(message)) is not None:
            self.shown, self.changed = int((whole.status > 0).sum()), time.monotonic()


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
    faults: Sequence[str] = (),
    out: Path | None,
    json_path: Path | None,
    stop: threading.Event,
    live: bool = False,
) -> dict[str, Any]:
    """Fly a mission and print its scores; returns what the JSON holds, nothing if it was stopped.

    live: show it in a viewer meanwhile. changes: settings of the centre as KEY=VALUE, above all others; faults:
    SOURCE:NAME=NUMBER,... of clients. Raises
    `UsageError`, `ConfigError` or `DemoError` if it cannot be flown, before anything is written or started;
    `DemoError` and `BusError` if it goes wrong.
    """
    plan = with_faults(plan_mission(scenario, data=data, seed=seed, tracker=tracker, cameras=cameras), faults)
    speed = speed or plan.speed
    options = {"criterion": criterion} if criterion else {}
    settings = {"clock": "message", "rule": rule, "rule_options": options, "memory": memory, **plan.settings(speed)}
    if tracker == "gm-phd":
        settings |= {"kind": "intensity", "rule": "ci", "rule_options": {}}
    for text in changes:
        merge(settings, change(text))
    written = dict(settings)
    if is_own_rule(str(settings["rule"])):
        settings["rule"], written["rule"] = load_from_here(str(settings["rule"]))
    centre = centre_config(settings)
    rule = centre.intensity_rule if centre.kind == "intensity" else centre.rule
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    folder = out or Path("runs") / f"{scenario.replace(':', '-')}-{rule.partition('.py:')[0]}-{stamp}"
    recording = folder / "mission.rrd"
    _check_outputs(recording, json_path)
    folder.mkdir(parents=True, exist_ok=True)
    endpoint = free_endpoint()
    config = write_config(folder, written, endpoint)
    load_config(config)
    takes = plan.seconds / speed + START
    print(
        f"{scenario}: {plan.seconds:.0f} s of mission at {speed:g} times real time, which takes {takes:.0f} s, and a "
        f"few to begin and end; into {folder}",
        flush=True,
    )
    _fly(plan, folder, config, recording, endpoint, speed, stop, live)
    if stop.is_set():
        print(f"stopped; the recording so far: {recording}")
        return {}
    return _report(plan, rule, recording, folder, json_path)


def _check_outputs(recording: Path, json_path: Path | None) -> None:
    if recording.exists():
        raise DemoError(f"{recording} is there already: give another folder with --out")
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        if json_path.is_dir() or not os.access(json_path.parent, os.W_OK):
            raise DemoError(f"cannot write {json_path}: give another file with --json")


def write_config(folder: Path, centre: Mapping[str, Any], endpoint: str) -> Path:
    """Write `centre.toml` into `folder`: the centre's settings, the hub's endpoint, and its state beside it."""
    tables = {"centre": centre, "bus": {"connect": [endpoint]}, "service": {"state": str(folder / "state")}}
    path = folder / "centre.toml"
    path.write_text("".join(map(_toml_table, tables, tables.values())), encoding="utf-8")
    return path


def _toml_table(name: str, table: Mapping[str, Any]) -> str:
    return f"[{name}]\n" + "".join(f"{dotted((key,))} = {toml_value(value)}\n" for key, value in table.items()) + "\n"


def _fly(
    plan: MissionPlan,
    folder: Path,
    config: Path,
    recording: Path,
    endpoint: str,
    speed: float,
    stop: threading.Event,
    live: bool = False,
) -> None:
    from fusion_service.bus import open_bus

    watch = _Watch()
    with ExitStack() as stack:
        crew = stack.enter_context(Crew(folder))
        crew.start("hub", ["fusion_service", "hub", "--listen", endpoint])
        bus = stack.enter_context(open_bus([endpoint], wait=READY, stop=stop))
        bus.watch(global_key("*", "alive"), watch.on_token)
        bus.watch(local_key("*", "alive"), watch.on_token)
        bus.subscribe(global_key("*", "tracks"), watch.on_tracks)
        crew.start("service", ["fusion_service", "run", "--config", str(config)])
        shown = free_endpoint().removeprefix("tcp/") if live else None
        crew.start("record", record_arguments(recording, endpoint, plan.cutoff, plan.every, shown))
        token = global_key(load_config(config).centre.name, "alive")
        _wait(lambda: recording.exists() and token in watch.tokens, crew, stop)
        if shown:
            print(look_on(f"rerun+http://{shown}/proxy"), flush=True)
        begin = time.time() + START
        for name, command in plan.clients.items():
            crew.start(name, client_arguments(command, endpoint, speed, begin))
        clients = tuple(plan.clients)
        with Progress(plan.name) as bar:
            while not stop.wait(0.1) and crew.running(*clients):
                crew.check(*clients)
                bar.show((time.time() - begin) * speed / plan.seconds, f"{watch.shown} tracks")
            deadline = time.monotonic() + 10
            while not stop.wait(0.1) and time.monotonic() < min(deadline, watch.changed + 2.0):
                crew.check(*clients)
        if not stop.is_set():
            crew.check(*clients)
        crew.stop(*clients)
        crew.stop("service")
        crew.stop("record")


def _wait(ready: Callable[[], bool], crew: Crew, stop: threading.Event) -> None:
    deadline = time.monotonic() + READY
    while not stop.wait(0.05) and not ready():
        crew.check()
        if time.monotonic() > deadline:
            raise DemoError(f"service and recorder were not ready within {READY:g} s: their logs are in the folder")


def _report(plan: MissionPlan, rule: str, recording: Path, folder: Path, json_path: Path | None) -> dict[str, Any]:
    from fusion_service.recording import messages
    from fusion_service.review.evaluation import evaluate, format_table
    from fusion_service.review.mission_map import mission_map

    everything = messages(recording)
    scores = evaluate(everything, c=plan.cutoff, every=plan.every)
    result: dict[str, Any] = scores.as_json(plan.name, rule, str(recording))
    print(format_table(scores))
    picture = folder / "map.png"
    mission_map(everything, picture, title=f"{plan.name}, {rule}")
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"scores:    {json_path}")
    print(f"map:       {picture}\nrecording: {recording}   (look at it: rerun {shlex.quote(str(recording))})")
    return result
