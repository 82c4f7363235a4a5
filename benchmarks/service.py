"""The whole line under load, hub, clients, service and a sink as processes: `python -m benchmarks.service`.

    python -m benchmarks.service --sources 4 --tracks 5000 --overlap 2 --seconds 60
    python -m benchmarks.service --sources 3 --tracks 20 --overlap 3 --set trigger=arrival --set rule=ci
    python -m benchmarks.service --sources 4 --tracks 5000 --burst 20:10:1.5

Sources publish scans of tracks with unequal covariances (`benchmarks.load`) at the times these hold; the sink, which
is this process, notes when each picture comes. Told are: updates offered and taken a second; from the publication of
a scan to the arrival of the first picture that has it (by the step log): p50, p90, p99 and the largest; steps that
were skipped; CPU of each process and of the rest of the machine; bytes; memory of the service at the beginning, after
each quarter and at the end, and what of it are no pages of files; and of the pictures at the sink, whether every target
was in each once: a global track within `NEAR` sigmas of its truth, and no second one. The floor is the least that could
be done with the same bytes: unpack them, fuse once by `naive` in one batch, pack the result, timed in this run before
the load begins; the ratio is the service's CPU a step beside it. The first `WARM` seconds do not count.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import schemas
from benchmarks.load import FRAME, SPACE, Load, floor, scans
from benchmarks.sink import Sink
from fusion_service.bus import open_bus
from fusion_service.bus.hub import run_hub
from fusion_service.config import load_config
from fusion_service.demo.crew import free_endpoint
from fusion_service.service.daemon import run_service

__all__ = ["Burst", "Report", "Way", "measure", "setting"]

WARM = 3.0
QUARTERS = 4
DRAIN = 3.0
"""Seconds for what is under way at the end."""
TICKS = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Burst:
    """From `begin` s for `seconds` s, scans come `factor` times as often."""

    begin: float
    seconds: float
    factor: float

    @classmethod
    def read(cls, text: str) -> Burst:
        """BEGIN:SECONDS:FACTOR."""
        begin, seconds, factor = (float(part) for part in text.split(":"))
        return cls(begin, seconds, factor)

    def times(self, rate: float, seconds: float) -> Iterator[float]:
        """Of the scans, s since the first."""
        at = 0.0
        while at < seconds:
            yield at
            at += 1.0 / rate / (self.factor if self.begin <= at < self.begin + self.seconds else 1.0)


@dataclass(frozen=True, slots=True)
class Way:
    """What is run: the load, for `seconds`, under these settings of `[centre]`."""

    load: Load
    seconds: float = 20.0
    centre: Mapping[str, Any] = field(default_factory=dict)
    burst: Burst = Burst(0.0, 0.0, 1.0)

    def config(self, endpoint: str, folder: Path) -> str:
        """The config file of the service, its text."""
        period = 1.0 / self.load.rate
        frame = f"frame = {{ kind = 'enu', lat = {FRAME.lat}, lon = {FRAME.lon} }}"
        known = {"period": period, "delay": 0.0, "max_future": 10.0, "space": list(SPACE), **self.centre}
        lines = ["[centre]", frame, *(f"{key} = {json.dumps(value)}" for key, value in known.items())]
        for number in range(self.load.sources):
            lines += [f"[centre.sources.load-{number + 1:02d}]", "override = true", f"period = {period}"]
        lines += ["[bus]", f"connect = ['{endpoint}']", "[service]", f"state = '{folder}'", "status_period = 1.0"]
        return "\n".join(lines) + "\n"


@dataclass(slots=True)
class Report:
    """What came out; times in ms. scans: sent from the first to the last, and heard, those that a step took."""

    offered: float = 0.0
    taken: float = 0.0
    scans: int = 0
    heard: int = 0
    latency: dict[str, float] = field(default_factory=dict)
    pictures: int = 0
    skipped: float = 0.0
    step: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)
    others: float = 0.0
    floor: float = 0.0
    ratio: float = float("nan")
    bytes_in: float = 0.0
    bytes_out: float = 0.0
    memory: tuple[float, ...] = ()
    own: tuple[float, ...] = ()
    missing: int = 0
    doubled: int = 0
    mixed: int = 0
    looked: int = 0
    uneven: int = 0
    lost: dict[str, int] = field(default_factory=dict)

    def told(self) -> str:
        """In lines."""
        whole = (
            f"{self.uneven} pictures with another number of tracks than there are targets; "
            f"of {self.looked} looked at: {self.missing} targets missing, {self.doubled} doubled, "
            f"{self.mixed} tracks of several or away"
        )
        cpu = ", ".join(f"{name} {share:.2f}" for name, share in self.cpu.items())
        return "\n".join(
            (
                f"  updates/s offered {self.offered:,.0f}, taken {self.taken:,.0f}; lost {self.lost or 'nothing'}",
                "  publication to picture, ms: " + ", ".join(f"{k} {v:.1f}" for k, v in self.latency.items()),
                f"  {self.pictures} pictures, {self.skipped:.0f} steps skipped; step ms "
                + ", ".join(f"{k} {v:.1f}" for k, v in self.step.items()),
                f"  {whole}",
                f"  cores: {cpu}; other processes {self.others:.2f}",
                f"  service {self.ratio:.1f} x the floor of {self.floor:.1f} ms a scan of all",
                f"  MB/s in {self.bytes_in:.1f}, out {self.bytes_out:.1f}; memory of the service, MB: "
                + " -> ".join(f"{one:.0f}" for one in self.memory)
                + " (its own: "
                + " -> ".join(f"{one:.0f}" for one in self.own)
                + ")",
            )
        )


def _hub(endpoint: str, stop: threading.Event) -> None:
    run_hub([endpoint], stop)


def _service(path: str, stop: threading.Event) -> None:
    run_service(load_config(path), stop)


def _clients(endpoint: str, way: Way, begin: multiprocessing.Queue[Any], sent: multiprocessing.Queue[Any]) -> None:
    """All sources: a scan of each at its time, their phases spread over the time between two; when each was published,
    and how many bytes. Says that it is there, and is told when to begin."""
    load, world = way.load, way.load.world()
    note: list[tuple[str, int, int, int]] = []
    with open_bus([endpoint]) as bus:
        out = [bus.publisher(schemas.local_key(f"load-{s + 1:02d}", "tracks"), cache=4) for s in range(load.sources)]
        for s in range(load.sources):
            bus.announce(schemas.local_key(f"load-{s + 1:02d}", "alive"))
        sent.put([])
        start = begin.get(timeout=60.0)
        for number, at in enumerate(way.burst.times(load.rate, way.seconds)):
            for s in range(load.sources):
                due = start + round((at + s / load.sources / load.rate) * 1e9)
                data = schemas.encode(message := world.at(s, number, due, start))
                if (wait := (due - time.time_ns()) / 1e9) > 0:
                    time.sleep(wait)
                note.append((message.source, message.seq, time.time_ns(), len(data)))
                out[s].put(data)
        time.sleep(DRAIN)
    sent.put(note)


def _ticks(pid: int) -> float:
    """CPU seconds of a process; of 0, of the machine's cores."""
    if pid:
        parts = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(parts[11]) + int(parts[12])) / TICKS
    user, nice, system, _idle, _wait, irq, soft = (int(x) for x in Path("/proc/stat").read_text().split()[1:8])
    return (user + nice + system + irq + soft) / TICKS


def _resident(pid: int) -> tuple[float, float]:
    """Memory that a process has, MB, and what of it is its own: no pages of files, none shared."""
    _, resident, shared = (int(pages) for pages in Path(f"/proc/{pid}/statm").read_text().split()[:3])
    return resident * PAGE / 2**20, (resident - shared) * PAGE / 2**20


@contextmanager
def _running(context: Any, target: Any, *arguments: Any) -> Iterator[Any]:
    stop = context.Event()
    process = context.Process(target=target, args=(*arguments, stop))
    process.start()
    try:
        yield process
    finally:
        stop.set()
        process.join(10)
        if process.is_alive():
            process.kill()
            process.join()


def measure(way: Way) -> Report:
    """Run it."""
    report = Report(floor=1e3 * floor(scans(way.load), way.load.overlap))
    context = multiprocessing.get_context("spawn")
    endpoint, sink = free_endpoint(), Sink(way.load, way.seconds, WARM)
    begin: multiprocessing.Queue[Any] = context.Queue()
    sent: multiprocessing.Queue[Any] = context.Queue()
    there = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "service.toml"
        path.write_text(way.config(endpoint, Path(folder) / "state"))
        with (
            _running(context, _hub, endpoint) as hub,
            sink,
            open_bus([endpoint], wait=20.0) as bus,
            _running(context, _service, str(path)) as service,
        ):
            for what in ("tracks", "log", "status"):
                bus.subscribe(schemas.global_key("centre", what), sink.note)
            bus.watch(schemas.global_key("centre", "alive"), lambda _key, alive: there.set() if alive else None)
            clients = context.Process(target=_clients, args=(endpoint, way, begin, sent))
            clients.start()
            try:
                sent.get(timeout=60.0)
                if not there.wait(60.0):
                    raise RuntimeError("the service does not start")
                sink.start = start = (time.time_ns() // 10**9 + 1) * 10**9
                begin.put(start)
                _watch(report, way, start, {"service": service, "hub": hub, "clients": clients})
                notes = sent.get(timeout=way.seconds + 60)
            finally:
                clients.join(30)
                if clients.is_alive():
                    clients.kill()
    _evaluated(report, way, start, notes, sink)
    return report


def _watch(report: Report, way: Way, start: int, processes: Mapping[str, Any]) -> None:
    """CPU and memory from `WARM` seconds after the start to the end."""
    time.sleep(max(0.0, start / 1e9 + WARM - time.time()))
    pids = {name: process.pid for name, process in processes.items()} | {"sink": os.getpid()}
    before, machine, begin = {name: _ticks(pid) for name, pid in pids.items()}, _ticks(0), time.monotonic()
    resident, end = [_resident(pids["service"])], start / 1e9 + way.seconds - 0.2
    for left in range(QUARTERS - 1, -1, -1):
        time.sleep(max(0.0, end - (end - start / 1e9 - WARM) * left / QUARTERS - time.time()))
        resident.append(_resident(pids["service"]))
    span = time.monotonic() - begin
    report.cpu = {name: (_ticks(pid) - before[name]) / span for name, pid in pids.items()}
    report.others = (_ticks(0) - machine) / span - sum(report.cpu.values())
    report.memory, report.own = zip(*resident, strict=True)
    scans = span * way.load.rate
    report.ratio = 1e3 * report.cpu["service"] * span / scans / report.floor


def _evaluated(report: Report, way: Way, start: int, notes: list[tuple[str, int, int, int]], sink: Sink) -> None:
    begin = start + round(WARM * 1e9)
    when = {(source, seq): at for source, seq, at, _ in notes}
    waits = [
        (sink.arrived[time] - at) / 1e6
        for time, source, seq in sink.taken
        if (at := when.get((source, seq), 0)) >= begin and time in sink.arrived
    ]
    offered = [size for _, _, at, size in notes if at >= begin]
    span, mean = max(way.seconds - WARM, 1e-9), way.load.targets * way.load.overlap / way.load.sources
    report.offered, report.taken = len(offered) * mean / span, len(waits) * mean / span
    if waits:
        marks = np.percentile(waits, (50, 90, 99, 100)).tolist()
        report.latency = dict(zip(("p50", "p90", "p99", "max"), marks, strict=True))
    report.lost = dict(sink.lost)
    report.scans, report.heard = len(notes), len({(source, seq) for _, source, seq in sink.taken} & set(when))
    report.bytes_in = sum(offered) / span / 1e6
    out = [(size, count) for at, size, count in sink.sizes if at >= begin]
    report.bytes_out = sum(size for size, _ in out) / span / 1e6
    report.pictures, report.uneven = len(out), sink.uneven
    if sink.statuses:
        report.skipped = sink.statuses[-1].step_time.get("skipped", 0.0)
        steps = [1e3 * one.step_time["last"] for one in sink.statuses if one.sent >= begin]
        report.step = {"median": float(np.median(steps or [np.nan])), "max": 1e3 * sink.statuses[-1].step_time["max"]}
    report.looked, report.missing, report.doubled, report.mixed = sink.looked, sink.missing, sink.doubled, sink.mixed


def setting(text: str) -> tuple[str, Any]:
    """KEY=VALUE, the value as JSON where it is."""
    key, _, rest = text.partition("=")
    try:
        return key, json.loads(rest)
    except ValueError:
        return key, rest


def main() -> None:
    """Read the options, run, and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", type=int, default=3)
    parser.add_argument("--tracks", type=int, default=1000, help="of each source")
    parser.add_argument("--overlap", type=int, default=3, help="sources that see a target")
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second of each source, and steps")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--burst", type=Burst.read, default=Burst(0.0, 0.0, 1.0), help="BEGIN:SECONDS:FACTOR")
    parser.add_argument("--set", type=setting, action="append", default=[], help="KEY=VALUE under [centre]")
    given = parser.parse_args()
    load = Load(given.sources, given.tracks, given.overlap, given.rate)
    way = Way(load, given.seconds, dict(given.set), given.burst)
    print(f"{load.sources} sources x {load.tracks} tracks at {load.rate:g} Hz, each target by {load.overlap}: "
          f"{load.updates:,.0f} updates/s; {way.centre or 'defaults'}; load {os.getloadavg()[0]:.2f}")  # fmt: skip
    for _ in range(given.runs):
        print(measure(way).told(), flush=True)


if __name__ == "__main__":
    main()
