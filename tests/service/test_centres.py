"""Centres of centres as operators run them: a hub, three services and their sensors as processes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import schemas
from fusion_service.bus import open_bus
from schemas.messages import GlobalTracks
from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import COMMAND

# Kalman filters of K still targets at (1000 k, 0) each, their steady state; argv: endpoint, name, sigma x, sigma y, K.
TRACKER = """
import sys, time
import numpy as np
from schemas import Enu, Motion
from sensor_clients.publisher import TrackPublisher
endpoint, name, *numbers = sys.argv[1:]
sx, sy, count = float(numbers[0]), float(numbers[1]), int(numbers[2])
rng = np.random.default_rng(sum(map(ord, name)))
spread = np.array([sx, sy, 1.0, 1.0])
with TrackPublisher(name, connect=endpoint, origin="simulated") as publisher:
    publisher.info(frame=Enu(59.0, -55.0), position=(0, 0, 0), period=0.2, motion=Motion("cv", 0.01))
    print("up", flush=True)
    while True:
        means = np.array([[1000.0 * k, 0, 0, 0] for k in range(count)]) + rng.normal(size=(count, 4)) * spread
        publisher.tracks(time=time.time_ns(), space=("x", "y", "vx", "vy"), frame=Enu(59.0, -55.0),
                         ids=range(1, count + 1), means=means, covariances=np.tile(np.diag(spread**2), (count, 1, 1)))
        time.sleep(0.2)
"""
CONFIG = """
[centre]
name = "{name}"
rule = "naive"
period = 0.2
delay = 0.1
lateness = 1.0
coast = 1.0
motion = {{kind = "cv", q = 0.01}}
{sources}
{ignored}
[bus]
connect = ["{endpoint}"]
"""
TARGETS = 12
SENSORS = {"A": (10.0, 40.0), "B": (40.0, 10.0), "C": (30.0, 30.0)}
"""Of each centre one, and its sigmas, m: the others ignore it."""


class Centres:
    """The processes, and the pictures that they publish."""

    def __init__(self, hub: Hub, folder: Path, stack: ExitStack, realm: Mapping[str, Sequence[str]]) -> None:
        self.pictures: dict[str, list[GlobalTracks]] = {name: [] for name in realm}
        self.sensors: dict[str, Program] = {}
        self.services: dict[str, Program] = {}
        bus = stack.enter_context(open_bus([hub.endpoint], wait=60.0))
        bus.subscribe(schemas.global_key("*", "tracks"), self._take)
        for name, others in realm.items():
            own = {f"s{name}"} if name in SENSORS else set()
            text = CONFIG.format(
                name=name,
                endpoint=hub.endpoint,
                sources="\n".join(f'[centre.sources."global/{other}"]' for other in others),
                ignored="\n".join(f"[centre.sources.s{one}]\nignore = true" for one in SENSORS if f"s{one}" not in own),
            )
            path = folder / f"{name}.toml"
            path.write_text(text)
            self.services[name] = stack.enter_context(Program(COMMAND, "run", "--config", str(path)))
            if own:
                sigmas = map(str, SENSORS[name])
                arguments = (hub.endpoint, f"s{name}", *sigmas, str(TARGETS))
                self.sensors[name] = stack.enter_context(Program(TRACKER, *arguments))

    def _take(self, key: str, data: bytes) -> None:
        message = schemas.decode(data)
        if isinstance(message, GlobalTracks) and message.source in self.pictures:
            self.pictures[message.source].append(message)

    def counts(self) -> dict[str, int]:
        return {name: len(some[-1].ids) if some else -1 for name, some in self.pictures.items()}

    def complete(self) -> bool:
        """Every centre tracks every target once, and hears all sensors of the realm."""
        whole = {f"s{name}" for name in self.sensors}
        return all(
            some and len(some[-1].ids) == TARGETS and whole <= set(_in_all(some[-1])) for some in self.pictures.values()
        )


def _in_all(picture: GlobalTracks) -> list[str]:
    """The names in the lineage of every track."""
    assert picture.lineage is not None
    assert picture.track_lineage is not None
    bits = np.unpackbits(picture.track_lineage, axis=1, count=len(picture.lineage), bitorder="little")
    return [picture.lineage[k] for k in np.flatnonzero(bits.all(axis=0)).tolist()]


def worst(pictures: Sequence[GlobalTracks]) -> tuple[float, float, float]:
    """Worst eigenvalue of true over stated position error, its standard error over the targets, and the rmse, m."""
    errors, white = [], []
    for picture in pictures:
        order = np.argsort(picture.means[:, 0])
        error = picture.means[order, :2] - 1000.0 * np.stack([np.arange(TARGETS), np.zeros(TARGETS)], axis=1)
        factor = np.linalg.cholesky(picture.covariances[order, :2, :2])
        white.append(np.linalg.solve(factor, error[:, :, None])[:, :, 0])
        errors.append(error)
    each = np.einsum("sti,stj->tij", np.stack(white), np.stack(white)) / len(white)
    values, vectors = np.linalg.eigh(each.mean(axis=0))
    along = np.einsum("i,tij,j->t", vectors[:, -1], each, vectors[:, -1])
    rmse = float(np.sqrt((np.stack(errors) ** 2).sum(axis=2).mean()))
    return float(values[-1]), float(along.std() / np.sqrt(TARGETS)), rmse


@pytest.fixture(params=["tree", "ring"])
def centres(request: pytest.FixtureRequest, hub: Hub, tmp_path: Path) -> Iterator[Centres]:
    realm: dict[str, tuple[str, ...]] = {"A": (), "B": (), "top": ("A", "B")}
    if request.param == "ring":
        realm = {"A": ("C",), "B": ("A",), "C": ("B",)}
    with ExitStack() as stack:
        made = Centres(hub, tmp_path, stack, realm)
        yield made


def test_three_centres_over_processes(centres: Centres) -> None:
    """In a tree the top has what both branches see; in a ring all have all; all are honest; and nothing outlives its
    sensors."""
    tree = "top" in centres.services
    if tree:
        eventually(lambda: centres.pictures["top"] and set(_in_all(centres.pictures["top"][-1])) >= {"sA", "sB"}, 20)
        eventually(lambda: set(centres.counts().values()) == {TARGETS})
    else:
        eventually(centres.complete, 20)
    begin = {name: len(some) for name, some in centres.pictures.items()}
    eventually(lambda: all(len(some) >= begin[name] + 20 for name, some in centres.pictures.items()))
    for name, some in centres.pictures.items():
        fresh = [picture for picture in some[begin[name] :] if len(picture.ids) == TARGETS]
        assert len(fresh) >= 10, (name, len(fresh), len(some) - begin[name])
        value, error, rmse = worst(fresh)
        print(name, value, error, rmse)
        assert value <= 1.05 + 3 * error, (name, value, error)
        if name == "top" or not tree:
            assert rmse < 25.0, "no better than a sensor alone"
    for program in centres.services.values():
        assert program.running()
    for program in centres.sensors.values():
        program.kill()
    eventually(lambda: set(centres.counts().values()) == {0})
