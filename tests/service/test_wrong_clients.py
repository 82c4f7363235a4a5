"""Thirty clients that are wrong, each as newcomers are, on one bus: what an operator reads in the status names the
source, its fault and the remedy, within seconds. A client that is right draws no word."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pytest

from tests.helpers.processes import Hub, eventually, slowness
from tests.helpers.scene import Scene

START = time.time_ns()
FRAME = {"kind": "enu", "lat": 59.0, "lon": 10.0}
SPACE = ["x", "y", "vx", "vy"]
SETTINGS = """frame = {kind = "enu", lat = 59.0, lon = 10.0}
[centre.sources.muted]
ignore = true
[centre.sources.exercise]
allowed_origins = ["live"]
"""
WITHIN = 5.0


def lower(matrix: Any) -> bytes:
    rows, columns = np.tril_indices(len(matrix))
    return np.asarray(matrix, dtype="<f8")[rows, columns].tobytes()


COVARIANCE = np.diag([25.0, 25.0, 4.0, 4.0])


def tracks(name: str, k: int, now: int, **changes: Any) -> dict[str, Any]:
    """One track that moves east at 10 m/s; a change to None takes a field out."""
    place = [1000.0 + 10.0 * (now - START) / 1e9, 500.0, 10.0, 0.0]
    said = {
        "v": 1,
        "type": "local_tracks",
        "source": name,
        "epoch": START,
        "seq": k,
        "sent": now,
        "origin": "live",
        "time": now,
        "complete": True,
        "space": SPACE,
        "frame": FRAME,
        "ids": np.array([1], "<u8").tobytes(),
        "means": np.array(place, "<f8").tobytes(),
        "covs": lower(COVARIANCE),
        **changes,
    }
    return {key: value for key, value in said.items() if value is not None}


def info(name: str, k: int, now: int, **changes: Any) -> dict[str, Any]:
    return {
        "v": 1,
        "type": "sensor_info",
        "source": name,
        "epoch": START,
        "seq": k,
        "sent": now,
        "origin": "live",
        "frame": FRAME,
        "position": [0.0, 0.0, 0.0],
        "period": 0.2,
        "motion": {"kind": "cv", "q": 1.0},
        "initiation_delay": 1.0,
        "may_start": True,
        **changes,
    }


class Wrong(NamedTuple):
    """What a client sends of tracks and of itself as its k-th messages, and what an operator must read of it."""

    reads: str
    tracks: Callable[[str, int, int], Any] = tracks
    info: Callable[[str, int, int], Any] | None = info
    token: bool = True


def means(now: int, *numbers: float) -> bytes:
    return np.array(numbers, "<f8").tobytes()


def with_tracks(reads: str, **changes: Any) -> Wrong:
    """Changes may be functions of now."""

    def made(name: str, k: int, now: int) -> dict[str, Any]:
        return tracks(name, k, now, **{key: one(now) if callable(one) else one for key, one in changes.items()})

    return Wrong(reads, made)


def with_info(reads: str, **changes: Any) -> Wrong:
    return Wrong(reads, info=lambda name, k, now: info(name, k, now, **changes))


def in_order_x_vx(name: str, k: int, now: int) -> dict[str, Any]:
    x = 1000.0 + 10.0 * (now - START) / 1e9
    return tracks(name, k, now, means=means(now, x, 10.0, 500.0, 0.0))


WRONG = {
    "seconds": with_tracks("late by 5. years: is `time` in seconds. it must be ns", time=lambda now: now // 10**9),
    "millis": with_tracks("late by 5. years: is `time` in ms", time=lambda now: now // 10**6),
    "floats": with_tracks(
        "`time`: it is the float .*: is it in seconds.*whole number of ns", time=lambda now: now / 1e9
    ),
    "behind": with_tracks(
        "late and sent as late: its clock is 30 s behind: set its clock by NTP",
        time=lambda now: now - 30 * 10**9,
        sent=lambda now: now - 30 * 10**9,
    ),
    "slow": with_tracks("were sent 8.* s after they hold.*raise lateness", time=lambda now: now - 8 * 10**9),
    "ahead": with_tracks(
        "2 h|120 min ahead of this computer's clock.*local time. times must be UTC",
        time=lambda now: now + 7200 * 10**9,
        sent=lambda now: now + 7200 * 10**9,
    ),
    "gps": with_tracks("18 s ahead.*GPS time", time=lambda now: now + 18 * 10**9, sent=lambda now: now + 18 * 10**9),
    "json": Wrong("payload is JSON: send MessagePack", lambda name, k, now: json.dumps({"source": name}).encode()),
    "version": with_tracks("`v` is nothing: write the whole number 1", v=None),
    "kind": with_tracks('`type` is "LocalTracks": did you mean "local_tracks"', type="LocalTracks"),
    "named": with_tracks('of "radar", its key says "named": make `source` the name', source="radar"),
    "mean": Wrong(
        'no `means`: is it what it calls "mean"',
        lambda name, k, now: {**tracks(name, k, now, means=None), "mean": means(now, 1, 2, 3, 4)},
    ),
    "states": with_tracks('unknown component "pos_x": did you mean "x"', space=["pos_x", "pos_y", "vel_x", "vel_y"]),
    "polar": with_tracks('unknown component "speed": states are Cartesian', space=["x", "y", "speed", "course"]),
    "matrices": with_tracks("whole 4 x 4 matrices: send lower triangles", covs=COVARIANCE.astype("<f8").tobytes()),
    "lists": with_tracks("`means`: it is a list: columns are bytes", means=[1000.0, 500.0, 10.0, 0.0]),
    "singles": with_tracks("`means` has half the numbers.*are they 32 bits", means=np.zeros(4, "<f4").tobytes()),
    "big": with_tracks(
        "big-endian. send <f8",
        means=np.array([1000.0, 500.0, 10.0, 1.0], ">f8").tobytes(),
        covs=lambda now: np.frombuffer(lower(COVARIANCE), "<f8").astype(">f8").tobytes(),
    ),
    "upper": with_tracks(
        "read as the upper triangle: send the lower one",
        covs=lambda now: (
            (COVARIANCE + np.diag([4.0, 4, 1.9], 1) + np.diag([4.0, 4, 1.9], -1))[np.triu_indices(4)]
            .astype("<f8")
            .tobytes()
        ),
    ),
    "still": with_tracks("variance of vx is 0.*leave the component out", covs=lower(np.diag([25.0, 25, 0, 0]))),
    "nan": with_tracks("vx is nan: leave out what is not known", means=means(0, 1, 2, np.nan, 0)),
    "percent": with_tracks("`existence`.*is 95: is it in percent", existence=means(0, 95.0)),
    "swapped": with_tracks("lat is 100 and lon 59: are they swapped", frame={"kind": "enu", "lat": 100.0, "lon": 59.0}),
    "far": with_tracks(
        "km from that of the picture: are lat and lon swapped", frame={**FRAME, "lat": 10.0, "lon": 59.0}
    ),
    "exercise": with_tracks('origin "exercise" is not taken.*allowed_origins', origin="exercise"),
    "muted": with_tracks("config ignores it"),
    "degrees": with_info(
        "azimuth is 90: is it in degrees. angles are in rad",
        coverage={"kind": "sector", "radius": 5000.0, "azimuth": 90.0, "width": 1.0},
    ),
    "hertz": with_info("period is 200 s, but .*is `period` in ms. it must be s", period=200.0),
    "narrow": with_info("coverage holds 0 of its 1 tracks.*is radius in m", coverage={"kind": "disk", "radius": 2.0}),
    "restless": Wrong(
        "epoch changes with every message.*take the time once",
        lambda name, k, now: tracks(name, 0, now, epoch=now),
        lambda name, k, now: info(name, k, now, epoch=now),
    ),
    "twins": Wrong(
        "two publishers have its name|do two publishers have one name",
        lambda name, k, now: tracks(name, k // 2, now, epoch=START + k % 2),
        lambda name, k, now: info(name, k // 2, now, epoch=START + k % 2),
    ),
    "silent": Wrong("no sensor_info came from it.*send one on .../info", info=None),
    "order": Wrong("in the order x, vx, y, vy, not x, y, vx, vy: is space right", in_order_x_vx),
    "untold": Wrong("no liveliness token.*declare one", token=False),
}


class Bus(NamedTuple):
    scene: Scene
    began: float
    read: dict[str, tuple[float, str]]
    """Client -> after how long what was expected of it was read, and what."""


def told(scene: Scene, name: str) -> str:
    """All that the newest status says of the faults of a source."""
    if not scene.seen.statuses:
        return ""
    said = scene.last_status().sources.get(name, {})
    return " | ".join([said.get("last_refusal", {}).get("said", ""), *said.get("doubts", ()), ""])


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """All clients at once, until each was read of, or too long has passed."""
    folder: Path = tmp_path_factory.mktemp("wrong")
    with ExitStack() as stack:
        hub = Hub().start()
        stack.callback(hub.kill)
        scene = Scene(hub, folder, stack)
        scene.service(SETTINGS)
        eventually(lambda: scene.seen.statuses, 30)
        clients = {"right": Wrong("never"), **WRONG}
        out = {
            name: {what: scene.bus.publisher(f"fusion/v1/local/{name}/{what}") for what in ("tracks", "info")}
            for name in clients
        }
        for name, client in clients.items():
            if client.token:
                scene.bus.announce(f"fusion/v1/local/{name}/alive")
        began, k = time.monotonic(), 0
        read: dict[str, tuple[float, str]] = {}
        while time.monotonic() - began < 8 * WITHIN * slowness() and (
            len(read) < len(WRONG) or time.monotonic() - began < 4.0
        ):
            now = time.time_ns()
            for name, client in clients.items():
                for what in ("info", "tracks"):
                    make = getattr(client, what)
                    if make is not None and (what == "tracks" or k % 5 == 0):
                        said = make(name, k, now)
                        out[name][what].put(said if isinstance(said, bytes) else msgpack.packb(said))
            for name, client in WRONG.items():
                if name not in read and re.search(client.reads, told(scene, name)):
                    read[name] = time.monotonic() - began, told(scene, name)
            k += 1
            time.sleep(0.2)
        yield Bus(scene, began, read)


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_client_is_named_with_its_fault_and_the_remedy(bus: Bus, name: str) -> None:
    assert name in bus.read, f"{name}: {told(bus.scene, name)!r}"


def test_there_are_thirty_and_it_takes_five_seconds(bus: Bus) -> None:
    assert len(WRONG) >= 30
    assert np.median([seconds for seconds, _ in bus.read.values()]) < WITHIN * slowness()


def test_a_client_that_is_right_draws_no_word(bus: Bus) -> None:
    assert told(bus.scene, "right").strip(" |") == ""
    assert bus.scene.last_status().sources["right"]["messages"] > 10


def test_a_refusal_is_whole_in_the_status(bus: Bus) -> None:
    last = bus.scene.last_status().sources["seconds"]["last_refusal"]
    assert last["reason"] == "late"
    assert last["field"] == "time"
    assert 10**9 < int(last["value"]) < 10**10
    assert last["count"] > 5
    assert abs(time.time_ns() - last["time"]) < 60e9
