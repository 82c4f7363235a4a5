"""What the bus costs beside bare Zenoh: `python -m benchmarks.bus`.

Everything goes through a hub in a process of its own. `bare` is a Zenoh publisher and a subscriber whose
callback appends to a list; `ours` is `Bus.publisher` and `Bus.subscribe` into an `Inbox` that a thread
empties. The two are measured in turns within one run; the publisher is a process of its own.

Latency: one way, publisher's put to the callback (bare) or to what `take` returns (ours), at 1 kHz.
Load: messages that arrive per second of those offered per second, and what one costs the process that
receives it, all its threads together. Bare, what a full link drops is gone; ours asks for it again.
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray

from fusion_service.bus import Inbox, open_bus
from fusion_service.bus.hub import run_hub

SECONDS = 1.0
ROUNDS = 3
KEY = "benchmark/v1/local/radar-1/tracks"


@contextmanager
def bare_session(endpoint: str) -> Iterator[zenoh.Session]:
    """A plain client of the hub."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 10_000,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def hub(endpoint: str, stop: threading.Event) -> None:
    run_hub([endpoint], stop)


def publish(endpoint: str, ours: bool, size: int, rate: int) -> None:
    """Send the time of sending, padded to `size` bytes, for `SECONDS` at `rate` Hz, every millisecond its share."""
    padding = bytes(size - 8)

    def run(put: Callable[[bytes], object]) -> None:
        begin = time.monotonic()
        number = 0
        while (elapsed := time.monotonic() - begin) < SECONDS:
            while number < elapsed * rate:
                put(time.monotonic_ns().to_bytes(8, "little") + padding)
                number += 1
            time.sleep(0.001 if rate > 1000 else max(0.0, begin + number / rate - time.monotonic()))
        time.sleep(0.5)

    if ours:
        with open_bus([endpoint]) as bus:
            run(bus.publisher(KEY, cache=8).put)
    else:
        with bare_session(endpoint) as session:
            run(session.declare_publisher(KEY).put)


class Result(NamedTuple):
    """One-way latencies in ms, messages per second, and CPU time of the receiver per message in us."""

    latencies: NDArray[np.float64]
    rate: float
    cost: float


def measure(endpoint: str, ours: bool, size: int, rate: int) -> Result:
    sent: list[int] = []
    received: list[int] = []

    def note(data: bytes) -> None:
        received.append(time.monotonic_ns())
        sent.append(int.from_bytes(data[:8], "little"))

    before = time.process_time()
    process = multiprocessing.get_context("spawn").Process(target=publish, args=(endpoint, ours, size, rate))
    if ours:
        inbox: Inbox[bytes] = Inbox(10_000)
        done = threading.Event()

        def consume() -> None:
            while not done.is_set():
                for _, data in inbox.take(0.1):
                    note(data)

        consumer = threading.Thread(target=consume)
        consumer.start()
        with open_bus([endpoint]) as bus:
            bus.subscribe("benchmark/**", lambda key, data: inbox.put(key, data, len(data)))
            process.start()
            process.join()
        done.set()
        consumer.join()
    else:
        with bare_session(endpoint) as session:
            session.declare_subscriber("benchmark/**", lambda sample: note(bytes(sample.payload)))
            process.start()
            process.join()
    cost = time.process_time() - before
    return Result((np.array(received) - np.array(sent)) / 1e6, len(received) / SECONDS, 1e6 * cost / len(received))


def compare(endpoint: str, size: int, rate: int, figures: dict[str, Callable[[Result], float]]) -> None:
    """Print the median of each figure over `ROUNDS`, bare and ours taken in turns."""
    results: dict[bool, list[Result]] = {False: [], True: []}
    for _ in range(ROUNDS):
        for ours in (False, True):
            results[ours].append(measure(endpoint, ours, size, rate))
    for name, figure in figures.items():
        bare, our = (statistics.median(map(figure, results[ours])) for ours in (False, True))
        print(f"{size:7} {rate:8}  {name:22} {bare:9.3f} {our:9.3f} {our / bare:6.2f}", flush=True)


def main() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    spawn = multiprocessing.get_context("spawn")
    stop = spawn.Event()
    router = spawn.Process(target=hub, args=(endpoint, stop))
    router.start()
    try:
        print(f"{'bytes':>7} {'offered':>8}  {'':22} {'bare':>9} {'ours':>9} {'ratio':>6}")
        latency: dict[str, Callable[[Result], float]] = {
            "latency p50, ms": lambda result: float(np.percentile(result.latencies, 50)),
            "latency p99, ms": lambda result: float(np.percentile(result.latencies, 99)),
        }
        for size in (200, 2000, 20_000):
            compare(endpoint, size, 1000, latency)
        load: dict[str, Callable[[Result], float]] = {
            "messages/s": lambda result: result.rate,
            "CPU per message, us": lambda result: result.cost,
        }
        for size, rate in ((200, 20_000), (2000, 20_000), (2000, 80_000), (20_000, 10_000)):
            compare(endpoint, size, rate, load)
    finally:
        stop.set()
        router.join(5)
        if router.is_alive():
            router.kill()


if __name__ == "__main__":
    main()
