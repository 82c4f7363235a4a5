"""What a service does while it is flooded: the longest time without a status, and what becomes of honest targets.

    python -m benchmarks.floods [NAME ...]

A hub, a service with `period` .2 and two honest sources of three targets, each a process; then one flood after the
other, each with a service of its own. Printed for each: what was tried, the longest silence of the service from the
beginning of the flood to the end, the longest wait for an answer to a question, seconds from SIGTERM to its end, steps
that failed, and whether all honest targets are in the picture at the end.
"""

from __future__ import annotations

import argparse
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import msgpack
import numpy as np

import schemas
from fusion_service.bus import Bus, BusError, open_bus
from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import COMMAND, CONFIG, SENSOR

__all__ = ["FLOODS", "main"]

FRAME = schemas.Enu(59.0, -55.0)
SPACE = ("x", "y", "vx", "vy")
FLOOD = """
import sys
from benchmarks.floods import FLOODS
from fusion_service.bus import open_bus
with open_bus([sys.argv[1]], wait=10.0) as bus:
    FLOODS[sys.argv[2]](bus)
    print("done", flush=True)
    sys.stdin.readline()
"""
HONEST = {0, 1, 2}


def scan(source: str, count: int, seq: int = 0, components: int = 1) -> schemas.LocalTracks:
    """A scan of `count` tracks far away, all with so many components."""
    now, total = time.time_ns(), count * components
    rng = np.random.default_rng(abs(hash(source)) % 2**32)
    means = np.concatenate([rng.uniform(-1e6, 1e6, (total, 2)), np.zeros((total, 2))], axis=1)
    mixed = components > 1
    return schemas.LocalTracks(
        source=source, epoch=1, seq=seq, sent=now, time=now, complete=True, space=SPACE, frame=FRAME,
        ids=np.arange(1, count + 1, dtype=np.uint64), means=means, covariances=np.tile(np.eye(4) * 25.0, (total, 1, 1)),
        counts=np.full(count, components, dtype=np.uint16) if mixed else None,
        weights=np.full(total, 1.0 / components) if mixed else None,
    )  # fmt: skip


def key(source: str) -> str:
    return schemas.local_key(source, "tracks")


def names(bus: Bus) -> None:
    """1,000 names with one small scan each."""
    for number in range(1000):
        bus.publisher(key(f"n{number}")).put(schemas.encode(scan(f"n{number}", 3)))


def tokens(bus: Bus) -> None:
    """3,000 tokens that come and go."""
    for number in range(3000):
        bus.announce(schemas.local_key(f"t{number}", "alive")).close()


def components(bus: Bus) -> None:
    """Five messages of .9 MB with one track of 8,000 components."""
    for number in range(5):
        bus.publisher(key(f"c{number}")).put(schemas.encode(scan(f"c{number}", 1, components=8000)))


def mixtures(bus: Bus) -> None:
    """Messages of 100 tracks of 80 components."""
    for number in range(5):
        bus.publisher(key(f"x{number}")).put(schemas.encode(scan(f"x{number}", 100, components=80)))


def tracks(bus: Bus) -> None:
    """20 scans of 5,000 tracks."""
    for number in range(20):
        bus.publisher(key(f"b{number % 4}")).put(schemas.encode(scan(f"b{number % 4}", 5000, number // 4)))


def garbage(bus: Bus) -> None:
    """2,000 payloads of 1 MB that are no messages, of 20 names."""
    data = bytes(2**20)
    publishers = [bus.publisher(key(f"g{number}")) for number in range(20)]
    for number in range(2000):
        publishers[number % 20].put(data)


def small(bus: Bus) -> None:
    """200,000 small payloads that are no messages, of 20 names."""
    publishers = [bus.publisher(key(f"s{number}")) for number in range(20)]
    for number in range(200_000):
        publishers[number % 20].put(b"garbage")


def keys(bus: Bus) -> None:
    """100 messages with 200,000 keys."""
    data = msgpack.packb({"v": 1, "type": "local_tracks", **{f"k{one}": 0 for one in range(200_000)}})
    publisher = bus.publisher(key("k1"))
    for _ in range(100):
        publisher.put(data)


def many_names(bus: Bus) -> None:
    """300,000 names of which each sends garbage once."""
    for number in range(300_000):
        bus._session.put(key(f"m{number}"), b"garbage")


def orders(bus: Bus) -> None:
    """5,000 orders."""
    order = msgpack.packb({"what": "mute", "source": "nobody"})
    for _ in range(5000):
        try:
            bus.ask(schemas.global_key("centre", "orders"), order, timeout=5.0)
        except BusError:
            time.sleep(0.01)


def connections(_: Bus) -> None:
    """1,000 connections that say nothing, and 500 sessions that come and go beside them."""
    endpoint = sys.argv[1]  # of the program that a flood is
    host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
    with ExitStack() as stack:
        for _one in range(1000):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=10.0))
        for _one in range(500):
            with open_bus([endpoint], wait=30.0):
                pass


def queries(bus: Bus) -> None:
    """20,000 questions for the picture, of which nobody reads the answers."""
    for _ in range(20_000):
        bus._session.get(schemas.global_key("centre", "picture"), lambda _: None)


FLOODS: dict[str, Callable[[Bus], None]] = {
    one.__name__: one
    for one in (
        *(names, tokens, components, mixtures, tracks, garbage, small, keys, many_names, orders, connections, queries),
    )
}


class Service:
    """The service as a process, what it says in a file; it is killed at the end of the `with` block."""

    def __init__(self, config: Path) -> None:
        command = [sys.executable, "-c", COMMAND, "run", "--config", str(config)]
        with config.with_suffix(".log").open("ab") as said:
            self._process = subprocess.Popen(command, stdout=said, stderr=said)

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def end(self) -> tuple[float, int]:
        """Seconds from SIGTERM to its end, and its exit code."""
        begin = time.monotonic()
        self._process.send_signal(signal.SIGTERM)
        code = self._process.wait(60)
        return time.monotonic() - begin, code


class Watch:
    """When statuses came, and what they said."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.at: list[float] = []
        self.last = b""
        self.picture = b""
        self.answered = 0.0
        self._stop = threading.Event()
        bus.subscribe(schemas.global_key("centre", "status"), self._status)
        bus.subscribe(schemas.global_key("centre", "tracks"), self._tracks)
        self._asking = threading.Thread(target=self._ask, daemon=True)

    def _status(self, _key: str, data: bytes) -> None:
        self.at.append(time.monotonic())
        self.last = data

    def _tracks(self, _key: str, data: bytes) -> None:
        self.picture = data

    def status(self) -> schemas.Status | None:
        message = schemas.decode(self.last) if self.last else None
        return message if isinstance(message, schemas.Status) else None

    def targets(self) -> set[int]:
        """Confirmed tracks at the places of honest targets."""
        message = schemas.decode(self.picture) if self.picture else None
        if not isinstance(message, schemas.GlobalTracks):
            return set()
        near = (message.status == 1) & (abs(message.means[:, 1]) < 50)
        found = np.rint(message.means[near, 0] / 1000)
        return {int(one) for one in found if abs(one) < 10}

    def ask(self) -> None:
        self._asking.start()

    def close(self) -> None:
        self._stop.set()
        self._asking.join()

    def _ask(self) -> None:
        while not self._stop.wait(0.25):
            begin = time.monotonic()
            with suppress(BusError):
                self._bus.ask(schemas.global_key("centre", "orders"), timeout=30.0)
            self.answered = max(self.answered, time.monotonic() - begin)

    def silence(self, begin: float) -> float:
        """Longest time between two of them since `begin`."""
        stamps = [begin, *(at for at in self.at if at > begin), time.monotonic()]
        return float(np.diff(stamps).max())


def flood(name: str, seconds: float, centre: str = "", restart: bool = False) -> str:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        hub = Hub().start()
        stack.callback(hub.kill)
        config = Path(folder) / "centre.toml"
        config.write_text(CONFIG.format(centre=centre, endpoint=hub.endpoint, state=Path(folder) / "state"))
        bus = stack.enter_context(open_bus([hub.endpoint], wait=10.0))
        watch = Watch(bus)
        service = stack.enter_context(Service(config))
        for one in ("r1", "r2"):
            sensor = stack.enter_context(Program(SENSOR, hub.endpoint, one, "given", *map(str, sorted(HONEST))))
            sensor.line()
        eventually(lambda: watch.targets() == HONEST, 30)
        watch.ask()
        begin = time.monotonic()
        sender = stack.enter_context(Program(FLOOD, hub.endpoint, name))
        sender.line(300)
        sent = time.monotonic() - begin
        time.sleep(seconds)
        during = watch.silence(begin)
        sender.kill()
        left = time.monotonic()
        time.sleep(seconds)
        after = watch.silence(left)
        line = f"{name:11} sent in {sent:5.1f} s; silence {during:5.2f} s, senders gone {after:5.2f} s"
        if restart:
            service.kill()
            service = stack.enter_context(Service(config))
            again = time.monotonic()
            count = len(watch.at)
            eventually(lambda: len(watch.at) > count, 60)
            first = time.monotonic() - again
            up = time.monotonic()
            time.sleep(seconds)
            line += f", killed: first after {first:.2f} s, then {watch.silence(up):5.2f} s"
        status = watch.status()
        assert status is not None
        honest = watch.targets() == HONEST
        watch.close()
        ended, code = service.end()
        wanted = ("failed", "failed_turns", "skipped", "max", "busy")
        said = {name: round(status.step_time[name], 2) for name in wanted if status.step_time.get(name)}
        line += (
            f"; answers {watch.answered:.2f} s; end {ended:.2f} s code {code};"
            f" honest {'yes' if honest else 'NO'}; {said}; {(status.memory or 0) >> 20} MiB;"
            f" {len(status.sources)} sources, {len(status.dropped)} dropped; {len(watch.last)} bytes of status"
        )
        return line


def main(argv: list[str] | None = None) -> None:
    """The floods named in the command line, or all."""
    parser = argparse.ArgumentParser(description="floods of a service, and how long it is silent")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(FLOODS))
    parser.add_argument("--seconds", type=float, default=8.0, help="looked at after the flood, and again without it")
    parser.add_argument("--restart", action="store_true", help="then kill and start the service")
    parser.add_argument("--centre", default="", help="more settings of [centre], as TOML")
    args = parser.parse_args(argv)
    for name in args.names or FLOODS:
        print(flood(name, args.seconds, args.centre, args.restart), flush=True)


if __name__ == "__main__":
    main()
