"""The missions that the demo knows: their clients' commands, the settings of the centre, how they are scored."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fusion_service.errors import DataError, UsageError
from fusion_service.process import data_folder

__all__ = ["AUTOFERRY", "MRCLAM", "THREE_RADARS", "MissionPlan", "plan_mission", "with_faults"]

RANGING = (1, 2)
"""Lidar and radar in the Autoferry files."""
JITTER = 1.5
"""Seconds that the machine may hold a client up, and it is still waited for."""

THREE_RADARS = """\
period = 10.0
frame = {kind = "enu", lat = 59.7138694, lon = -55.2676093}   # collocated with radar 1 (Sharma 6.4)
coast = 25.0
"""
"""Settings of the centre for the simulated radars, as TOML."""

AUTOFERRY = """\
period = 1.0
frame = {kind = "enu", lat = 63.4389029083, lon = 10.39908278, alt = 39.923}   # Piren
coast = 3.0
"""
"""Settings of the centre for the recorded lidar and radar, as TOML."""

MRCLAM = """\
period = 1.0
frame = {kind = "local", name = "mrclam"}
motion = {kind = "cv", q = 1.2e-4}   # 0.06 m/s, another way every 30 s, as the robots declare
manoeuvre = 0.1                      # m/s2: they stop, and go, within a second
coast = 3.0
"""
"""Settings of the centre for the recorded robots, as TOML."""


@dataclass(frozen=True)
class MissionPlan:
    """A mission as the demo flies it. clients: the command of each; centre: its settings, TOML; seconds: how long;
    speed: times real time, unless another is asked for; cutoff, m, every, s: of the scores (None: each step)."""

    name: str
    clients: dict[str, list[str]]
    centre: str
    seconds: float
    speed: float
    cutoff: float
    every: float | None
    lateness: float

    def settings(self, speed: float) -> dict[str, Any]:
        """The centre's settings at so many times real time."""
        return {"lateness": max(self.lateness, JITTER * speed), **tomllib.loads(self.centre)}


def plan_mission(
    scenario: str, *, data: str | None = None, seed: int = 1, tracker: str = "ckf", cameras: bool = False
) -> MissionPlan:
    """The plan of `three-radars` (with `seed` and `tracker`), of `autoferry:N` or `mrclam:6` (from `data`, or
    $FUSION_DATA).

    Raises `UsageError` for any other, for options that do not go with it and where no data are named; `DataError` where
    they are not there.
    """
    kind, _, number = scenario.partition(":")
    if cameras and kind != "autoferry":
        raise UsageError("--cameras goes with --scenario autoferry:N")
    if scenario == "three-radars":
        command = ["simulate", "three-radars", "--tracker", tracker, "--seed", str(seed), "--sensor"]
        sensors = ("radar1", "radar2", "radar3", "truth")
        return MissionPlan(
            scenario, {name: [*command, name] for name in sensors}, THREE_RADARS, 300.0, 10.0, 5000.0, None, 15.0
        )
    if tracker != "ckf":
        raise UsageError("--tracker goes with --scenario three-radars")
    if kind not in ("autoferry", "mrclam") or not number.isdigit():
        raise UsageError(
            f"unknown scenario {scenario!r}: use three-radars, autoferry:N with N one of 2 3 5 13 16, or mrclam:6"
        )
    folder = data_folder(kind, data)
    if folder is None:
        raise UsageError(f"{kind} needs its recordings: give their folder with --data or in FUSION_DATA")
    first = f"scenario{number}_detections.json" if kind == "autoferry" else f"{number}/landmarks.csv"
    if not (folder / first).is_file():
        name = {"autoferry": "Autoferry", "mrclam": "MR.CLAM"}[kind]
        raise DataError(f"no {first} in {folder}: --data names the {name} folder")
    command = ["playback", scenario, "--data", str(folder), "--sensor"]
    if kind == "mrclam":
        robots = (f"robot{n}{suffix}" for suffix in ("", "-self") for n in range(1, 6))
        return MissionPlan(
            scenario, {name: [*command, name] for name in (*robots, "truth")}, MRCLAM, 756.0, 5.0, 1.0, 1.0, 3.0
        )
    clients = {name: [*command, name] for name in ("lidar", "radar", *(("ir", "eo") if cameras else ()), "truth")}
    return MissionPlan(scenario, clients, AUTOFERRY, _seconds(folder / first), 10.0, 20.0, 1.0, 3.0)


def _seconds(path: Path) -> float:
    """From the first scan of a lidar or radar in a file of detections to the last. Raises `DataError`."""
    try:
        records = json.loads(path.read_bytes())
        times = [float(one["time"]) for one in records if one["sensorID"] in RANGING]
        return max(times) - min(times)
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path} is no file of detections: {type(error).__name__}: {error}") from None


def with_faults(plan: MissionPlan, faults: Sequence[str]) -> MissionPlan:
    """The plan with clients made wrong, each as SOURCE:NAME=NUMBER,... says. `UsageError` for a source it has not."""
    clients = {name: list(command) for name, command in plan.clients.items()}
    known = [name for name in clients if name != "truth"]
    for text in faults:
        name, colon, fault = text.partition(":")
        if not colon or name not in known:
            raise UsageError(f"--fault {text}: write SOURCE:NAME=NUMBER,..., SOURCE one of {', '.join(known)}")
        clients[name] += ["--fault", fault]
    return replace(plan, clients=clients)
