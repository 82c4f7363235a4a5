"""What the recorder costs: its share of a core and its memory, what the service feels of it, and a day's recording.

python -m benchmarks.recording                     all three tables, some ten minutes
python -m benchmarks.recording --only day          one of: load, service, day

The processes are real ones on a hub on loopback. Times are of this machine under the load that is printed with them.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import schemas
from fusion_service.bus import open_bus
from schemas import Enu, GlobalTracks, LocalTracks, Motion, SensorInfo, encode, global_key, local_key

FRAME = Enu(59.0, 10.5)
SPACE = ("x", "vx", "y", "vy")
CENTRE = "centre"
SECOND = 10**9
TICKS = os.sysconf("SC_CLK_TCK")


class Scans:
    """Scans of `sources` sensors that all see the same `tracks` objects, on straight lines through a square."""

    def __init__(self, sources: int, tracks: int, width: float = 40e3) -> None:
        rng = np.random.default_rng(1)
        self.names = [f"radar{n:02d}" for n in range(sources)]
        self._start = np.concatenate([rng.uniform(-width, width, (tracks, 2)), rng.normal(0, 10, (tracks, 2))], axis=1)
        spread = np.diag([400.0, 1.0, 400.0, 1.0])
        self._covariances = np.repeat(spread[None], tracks, axis=0)
        self._ids = np.arange(1, tracks + 1, dtype=np.uint64)
        self._noise = [rng.normal(0, 20, (tracks, 2)) for _ in range(8 * sources)]

    def means(self, seconds: float, number: int = 0) -> Any:
        x, y, vx, vy = self._start.T
        noise = self._noise[(int(seconds) * len(self.names) + number) % len(self._noise)]
        return np.stack([x + vx * seconds + noise[:, 0], vx, y + vy * seconds + noise[:, 1], vy], axis=1)

    def infos(self, epoch: int) -> Iterator[SensorInfo]:
        for name in self.names:
            yield SensorInfo(
                source=name, epoch=epoch, seq=0, sent=epoch, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
                motion=Motion("cv", 1.0),
            )  # fmt: skip

    def scan(self, number: int, epoch: int, seq: int, time_ns: int, seconds: float) -> LocalTracks:
        return LocalTracks(
            source=self.names[number], epoch=epoch, seq=seq, sent=time_ns, time=time_ns, complete=True, space=SPACE,
            frame=FRAME, ids=self._ids, means=self.means(seconds, number), covariances=self._covariances,
        )  # fmt: skip

    def picture(self, epoch: int, seq: int, time_ns: int, seconds: float) -> GlobalTracks:
        count, sources = len(self._ids), len(self.names)
        return GlobalTracks(
            source=CENTRE, epoch=epoch, seq=seq, sent=time_ns, time=time_ns, step=seq, rule="ci", space=SPACE,
            frame=FRAME, ids=self._ids, status=np.ones(count, dtype=np.uint8), existence=np.ones(count),
            means=self.means(seconds), covariances=self._covariances / 2, updated=np.full(count, time_ns),
            sources=tuple(self.names), contributor_counts=np.full(count, sources, dtype=np.uint16),
            contributor_source=np.tile(np.arange(sources, dtype=np.uint16), count),
            contributor_epoch=np.full(count * sources, epoch, dtype=np.uint64),
            contributor_id=np.repeat(self._ids, sources),
            contributor_influence=np.full(count * sources, 1.0 / sources),
        )  # fmt: skip


# ------------------------------------------------------------------ processes


class Usage(NamedTuple):
    seconds: float
    resident: float


def usage(pid: int) -> Usage:
    """CPU seconds of a process since its start, and its resident memory now, MiB."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    resident = int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    return Usage((int(fields[11]) + int(fields[12])) / TICKS, resident)


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "fusion_service", *arguments]
    one = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield one
    finally:
        one.terminate()
        one.wait(10)


@contextmanager
def hub() -> Iterator[str]:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    with process("hub", "--listen", endpoint):
        yield endpoint


class Feed(threading.Thread):
    """Publishes the scans of all sources, once a second, evenly over it."""

    def __init__(self, bus: Any, scans: Scans) -> None:
        super().__init__(daemon=True)
        self.stop = threading.Event()
        self.sent = 0
        self._scans = scans
        self._epoch = time.time_ns()
        self._publishers = [bus.publisher(local_key(name, "tracks"), cache=2) for name in scans.names]
        self._infos = [bus.publisher(local_key(name, "info"), cache=1) for name in scans.names]

    def run(self) -> None:
        for publisher, info in zip(self._infos, self._scans.infos(self._epoch), strict=True):
            publisher.put(encode(info))
        begin, count = time.monotonic(), len(self._publishers)
        seq = 0
        while not self.stop.is_set():
            for number, publisher in enumerate(self._publishers):
                due = begin + seq + number / count
                self.stop.wait(max(0.0, due - time.monotonic()))
                now = time.time_ns()
                publisher.put(encode(self._scans.scan(number, self._epoch, seq, now, now / SECOND % 1000)))
                self.sent += 1
            seq += 1


class Heard(NamedTuple):
    """Of the service, over one run: mean and worst step time (s); median and 99th percentile of the time from the
    time of a step to its picture's arrival (s); CPU seconds per second of service and recorder; the recorder's
    resident memory after a third and at the end, MiB; bytes recorded; seconds."""

    step: float
    worst: float
    latency: float
    late: float
    service: float
    recorder: float
    early: float
    resident: float
    size: int
    seconds: float


def run(sources: int, tracks: int, seconds: float, *, record: bool, draw: bool = True) -> Heard:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        endpoint = stack.enter_context(hub())
        bus = stack.enter_context(open_bus([endpoint], wait=20))
        config = folder / "centre.toml"
        config.write_text("[centre]\nperiod = 1.0\n[centre.frame]\nkind = 'enu'\nlat = 59.0\nlon = 10.5\n")
        service = stack.enter_context(process("run", "--config", str(config), "--connect", endpoint))
        path = folder / "a.rrd"
        options = ["--connect", endpoint, "--out", str(path), *([] if draw else ["--no-draw"])]
        recorder = stack.enter_context(process("record", *options)) if record else None
        latencies: list[float] = []
        status: list[Any] = []

        def put(key: str, data: bytes) -> None:
            now = time.time_ns()
            message = schemas.decode(data)
            if isinstance(message, GlobalTracks):
                latencies.append((now - message.time) / SECOND)
            elif message.type == "status":
                status.append(message)

        stack.callback(bus.subscribe(global_key(CENTRE, "tracks").replace("tracks", "*"), put).close)
        while not latencies and not status:
            time.sleep(0.1)
        while recorder is not None and not path.exists():
            time.sleep(0.1)
        feed = Feed(bus, Scans(sources, tracks))
        feed.start()
        time.sleep(5.0)
        latencies.clear()
        begin, before = time.monotonic(), (usage(service.pid), usage(recorder.pid) if recorder else None)
        time.sleep(seconds / 3)
        early = usage(recorder.pid).resident if recorder else 0.0
        time.sleep(2 * seconds / 3)
        spent = time.monotonic() - begin
        after = (usage(service.pid), usage(recorder.pid) if recorder else None)
        feed.stop.set()
        feed.join()
        shares = [(b.seconds - a.seconds) / spent if a and b else 0.0 for a, b in zip(before, after, strict=True)]
        steps = status[-1].step_time
        end = after[1]
        resident = end.resident if end is not None else 0.0
        size = path.stat().st_size if record else 0
        low, high = np.quantile(latencies, [0.5, 0.99]).tolist()
        return Heard(
            steps["mean"], steps["max"], low, high, shares[0], shares[1], early, resident, size, spent + 5.0
        )  # fmt: skip


def load(seconds: float) -> None:
    print(f"\nRecorder as a process, real time, {seconds:g} s each; load average {os.getloadavg()[0]:.1f} before")
    print("| sources x tracks x 1 Hz | drawing | CPU, of one core | memory after a third | at the end | file |")
    print("|---|---|---|---|---|---|")
    for sources, tracks in ((3, 20), (20, 500)):
        for draw in (True, False):
            one = run(sources, tracks, seconds, record=True, draw=draw)
            rate = one.size / one.seconds / 1e3
            print(
                f"| {sources} x {tracks} | {'yes' if draw else 'no'} | {100 * one.recorder:.1f} % "
                f"| {one.early:.0f} MiB | {one.resident:.0f} MiB | {rate:.0f} kB/s |",
                flush=True,
            )


def service(seconds: float) -> None:
    print(f"\nThe service with and without a recorder, {seconds:g} s each, in turn")
    print("| sources x tracks | recorder | step, mean | worst | picture after its time, median | 99 % | load average |")
    print("|---|---|---|---|---|---|---|")
    for sources, tracks in ((3, 20), (20, 100)):
        for record in (False, True, False, True):
            before = os.getloadavg()[0]
            one = run(sources, tracks, seconds, record=record)
            print(
                f"| {sources} x {tracks} | {'yes' if record else 'no'} | {1e3 * one.step:.1f} ms "
                f"| {1e3 * one.worst:.1f} ms | {1e3 * one.latency:.0f} ms | {1e3 * one.late:.0f} ms | {before:.1f} |",
                flush=True,
            )


DAY = """
import json, resource, sys, time
from pathlib import Path
from benchmarks.recording import Scans, CENTRE, SECOND
from fusion_service.recording import Recorder, Rotation, read
from schemas import encode, global_key, local_key
mode, path, seconds, sources, tracks = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:6])
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
if mode == "read":
    import rerun.chunk
    begin, count = time.monotonic(), 0
    for part in sorted(Path(path).iterdir()) if Path(path).is_dir() else [Path(path)]:
        len(rerun.chunk.RrdReader(part).store())
    opened, begin = time.monotonic() - begin, time.monotonic()
    for raw in read(path):
        count += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": time.monotonic() - begin, "messages": count, "memory": peak, "opened": opened}))
    sys.exit()
scans, start = Scans(sources, tracks), 1_790_000_000 * SECOND
rotation = Rotation(size=200_000_000) if "parts" in mode else None
spent, memory = 0.0, []
used = 0.0
with Recorder(path, draw="bare" not in mode, rotation=rotation) as recorder:
    for info in scans.infos(start):
        recorder.handle(local_key(info.source, "info"), encode(info), start)
    for second in range(seconds):
        now = start + second * SECOND
        coded = [
            (local_key(name, "tracks"), encode(scans.scan(number, start, second, now, float(second))))
            for number, name in enumerate(scans.names)
        ]
        coded.append((global_key(CENTRE, "tracks"), encode(scans.picture(start, second, now, float(second)))))
        begin = time.process_time()
        for key, data in coded:
            recorder.handle(key, data, now)
        if second % 10 == 9:
            recorder._drawn_last = -1e9  # as often as in real time: every ten seconds
        recorder.tick()
        used += time.process_time() - begin
        if second % 100 == 99:
            memory.append(resident())
begin = time.process_time()
size = sum(p.stat().st_size for p in Path(path).iterdir()) if rotation else Path(path).stat().st_size
parts = len(list(Path(path).iterdir())) if rotation else 1
print(json.dumps({"used": used, "memory": memory, "size": size, "parts": parts, "messages": recorder.messages}))
"""


def day(seconds: int, sources: int, tracks: int) -> None:
    import json

    times = 86400 / seconds
    print(
        f"\n{sources} sources x {tracks} tracks x 1 Hz and the picture every second: {seconds} s of messages as fast "
        f"as it goes, a day is {times:g} times as much; load average {os.getloadavg()[0]:.1f}"
    )
    print(
        "| | CPU per second of mission | measured | a day | memory at 10 % | at the end | index opened "
        "| all messages read |"
    )
    print("|---|---|---|---|---|---|---|---|")
    names = {"drawn": "one file", "bare": "one file, --no-draw", "drawn-parts": "parts of 200 MB"}
    for mode, name in names.items():
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/mission" + ("" if "parts" in mode else ".rrd")
            shape = [str(seconds), str(sources), str(tracks)]
            done = json.loads(_python(DAY, mode, path, *shape))
            back = json.loads(_python(DAY, "read", path, *shape))
            assert back["messages"] == done["messages"]
            memory = done["memory"]
            print(
                f"| {name} | {1e3 * done['used'] / seconds:.1f} ms | {done['size'] / 1e6:.0f} MB in {done['parts']} "
                f"| {times * done['size'] / 1e9:.1f} GB | {memory[len(memory) // 10]:.0f} MiB | {memory[-1]:.0f} MiB "
                f"| {back['opened']:.2f} s | {back['seconds']:.1f} s, {back['memory']:.0f} MiB |",
                flush=True,
            )


def _python(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("load", "service", "day"), help="one table")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run with real processes (default 60)")
    parser.add_argument("--mission", type=int, default=3600, help="seconds of messages for the day (default 3600)")
    args = parser.parse_args()
    if args.only in (None, "load"):
        load(args.seconds)
    if args.only in (None, "service"):
        service(args.seconds)
    if args.only in (None, "day"):
        day(args.mission, 5, 100)


if __name__ == "__main__":
    main()
