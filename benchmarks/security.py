"""What certificates and access control cost: `python -m benchmarks.security`.

Two hubs, each a process: an open one by TCP, one by TLS with certificates of both ends and the rules of the roles for
20 sources. A radar's messages go from a process of its own through a hub to a session that takes them from an `Inbox`,
in turns by either hub within one run. Latency: from before `put` to `take`, at 1 kHz. Load: messages that come in a
second, of those offered, and CPU of the receiving process per message. Line: from before a radar's `tracks`, 20 of them
at 20 Hz, to the picture of a centre that steps on arrival, at a display. A ratio is the median of the rounds' own.

`--rounds N` (5), `--seconds S` of each measurement (1).
"""

from __future__ import annotations

import argparse
import multiprocessing
import multiprocessing.synchronize
import os
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.bus import Inbox, Security, open_bus, read_security
from fusion_service.bus.hub import run_hub
from fusion_service.bus.keyring import Keyring
from fusion_service.config import BusConfig, ServiceConfig, centre_config
from fusion_service.service.daemon import run_service
from schemas import Enu, GlobalTracks, Motion, decode, global_key
from sensor_clients.publisher import TrackPublisher

PARTIES = (("recorder", "rec"), ("centre", "main"), ("viewer", "wall"))
KEY = "fusion/v1/local/radar-1/load"


def free_endpoint() -> str:
    """A port of this machine that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


class World(NamedTuple):
    """A hub, and the certificates at it, none in the open."""

    endpoint: str
    keys: Path | None

    def party(self, name: str) -> Security | None:
        """The security of a party."""
        return None if self.keys is None else read_security(self.keys / name)


class Result(NamedTuple):
    """One-way latencies in ms, messages per second, CPU time of the receiver per message in us."""

    latencies: NDArray[np.float64]
    rate: float
    cost: float


def hub(world: World, stop: multiprocessing.synchronize.Event) -> None:
    run_hub([world.endpoint], stop, world.party("hub"))  # type: ignore[arg-type]


def publish(world: World, size: int, rate: int, seconds: float) -> None:
    """Send the time of sending, padded to `size` bytes, at `rate` Hz, every millisecond its share."""
    padding = bytes(size - 8)
    with open_bus([world.endpoint], security=world.party("source-radar-1")) as bus:
        publisher = bus.publisher(KEY, cache=8)
        time.sleep(0.3)
        begin, number = time.monotonic(), 0
        while (elapsed := time.monotonic() - begin) < seconds:
            while number < elapsed * rate:
                publisher.put(time.monotonic_ns().to_bytes(8, "little") + padding)
                number += 1
            time.sleep(0.001 if rate > 1000 else max(0.0, begin + number / rate - time.monotonic()))
        time.sleep(0.5)


def measure(world: World, size: int, rate: int, seconds: float) -> Result:
    """One measurement."""
    process = multiprocessing.get_context("spawn").Process(target=publish, args=(world, size, rate, seconds))
    inbox: Inbox[bytes] = Inbox(100_000)
    done = threading.Event()
    sent: list[int] = []
    received: list[int] = []

    def consume() -> None:
        while not done.is_set():
            for _, data in inbox.take(0.1):
                received.append(time.monotonic_ns())
                sent.append(int.from_bytes(data[:8], "little"))

    consumer = threading.Thread(target=consume)
    consumer.start()
    with open_bus([world.endpoint], security=world.party("recorder-rec")) as bus:
        bus.subscribe("fusion/v1/**", lambda key, data: inbox.put(key, data, len(data)))
        process.start()
        before = time.process_time()
        process.join()
        cost = time.process_time() - before
    done.set()
    consumer.join()
    return Result((np.array(received) - np.array(sent)) / 1e6, len(received) / seconds, 1e6 * cost / len(received))


def centre(world: World, stop: multiprocessing.synchronize.Event) -> None:
    config = centre_config({"name": "main", "trigger": "arrival", "arrival_spacing": 0.0, "period": 1.0})
    security = None if world.keys is None else str(world.keys / "centre-main")
    bus = BusConfig(connect=(world.endpoint,), security=security)
    run_service(ServiceConfig(centre=config, bus=bus), stop)  # type: ignore[arg-type]


def line(world: World, seconds: float) -> Result:
    """From a radar's scan to the picture that has it, at a display; `rate`: pictures a second."""
    sent: dict[int, int] = {}
    took: list[float] = []
    site = Enu(lat=59.0, lon=10.0)

    def shown(key: str, data: bytes) -> None:
        now = time.monotonic_ns()
        picture = decode(data)
        if isinstance(picture, GlobalTracks) and picture.time in sent:
            took.append((now - sent.pop(picture.time)) / 1e6)

    keys = None if world.keys is None else world.keys / "source-radar-1"
    with (
        open_bus([world.endpoint], security=world.party("viewer-wall")) as bus,
        TrackPublisher("radar-1", connect=world.endpoint, security=keys) as radar,
    ):
        bus.subscribe(global_key("main", "tracks"), shown, history=0)
        radar.info(frame=site, position=(0, 0, 0), period=0.05, motion=Motion("cv", 1.0))
        rng = np.random.default_rng(1)
        begin = np.arange(20.0)[:, None] * [1000.0, 0.0, 0.0, 0.0] + [0.0, 500.0, 5.0, 0.0]
        covariances = np.tile(np.diag([25.0, 25.0, 1.0, 1.0]), (20, 1, 1))
        for number in range(round(20 * (seconds + 0.5))):
            if number == 10:  # the first ones are the beginning of all
                took.clear()
            means = begin + [0.25 * number, 0.0, 0.0, 0.0] + rng.normal(size=(20, 4)) * [5.0, 5.0, 1.0, 1.0]
            at = time.time_ns()
            sent[at] = time.monotonic_ns()
            radar.tracks(
                time=at, space=("x", "y", "vx", "vy"), frame=site, ids=range(20), means=means, covariances=covariances
            )
            time.sleep(0.05)
        time.sleep(0.3)
    return Result(np.array(took), len(took) / seconds, 0.0)


def compare(
    worlds: tuple[World, World],
    size: int,
    rate: int,
    figures: dict[str, Callable[[Result], float]],
    how: argparse.Namespace,
) -> None:
    """Print the median of each figure, plain and secured taken in turns, and that of their ratios."""
    rounds = [
        [measure(world, size, rate, how.seconds) if size else line(world, 2 * how.seconds) for world in worlds]
        for _ in range(how.rounds)
    ]
    for name, figure in figures.items():
        pairs = [(figure(plain), figure(secured)) for plain, secured in rounds]
        plain, secured = (statistics.median(column) for column in zip(*pairs, strict=True))
        ratio = statistics.median(b / a for a, b in pairs)
        print(f"{size:7} {rate:8}  {name:22} {plain:9.3f} {secured:9.3f} {ratio:6.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0)
    how = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        keys = Path(folder) / "keys"
        list(Keyring(keys).change([*PARTIES, *(("source", f"radar-{i}") for i in range(1, 21))]))
        worlds = World(free_endpoint(), None), World(free_endpoint(), keys)
        stop = spawn.Event()
        hubs = [spawn.Process(target=what, args=(world, stop)) for world in worlds for what in (hub, centre)]
        for one in hubs:
            one.start()
        try:
            print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
            print(f"{'bytes':>7} {'offered':>8}  {'':22} {'plain':>9} {'secured':>9} {'ratio':>6}")
            latency: dict[str, Callable[[Result], float]] = {
                "latency p50, ms": lambda result: float(np.percentile(result.latencies, 50)),
                "latency p99, ms": lambda result: float(np.percentile(result.latencies, 99)),
            }
            for size in (200, 2000, 20_000):
                compare(worlds, size, 1000, latency, how)
            compare(worlds, 0, 20, {f"line {name}": figure for name, figure in latency.items()}, how)
            load: dict[str, Callable[[Result], float]] = {
                "messages/s": lambda result: result.rate,
                "CPU per message, us": lambda result: result.cost,
            }
            for size, rate in ((200, 10_000), (2000, 10_000), (2000, 40_000), (20_000, 4_000)):
                compare(worlds, size, rate, load, how)
        finally:
            stop.set()
            for one in hubs:
                one.join(5)
                if one.is_alive():
                    one.kill()


if __name__ == "__main__":
    main()
