"""The whole product as processes: hub, service, two sensors of three targets, recorder; and one who watches.

All run the commands as users do. `Watch` sees what comes on the bus from a session of its own, which stays when the
hub is away.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import numpy as np

import schemas
from fusion_service.bus import Bus, open_bus
from tests.helpers.processes import eventually, free_endpoint
from tests.helpers.scene import SENSOR

__all__ = ["COMMAND", "TARGETS", "Process", "Product", "Watch", "product"]

TARGETS = (0, 1, 2)
COMMAND = ("-m", "fusion_service")
CONFIG = """
[centre]
period = 0.2
delay = 0.1
lateness = 2.0
{centre}
[bus]
connect = ["{endpoint}"]
[service]
state = "{state}"
compiled = "off"
"""


class Process:
    """A program, what it says in a file, started again at will; killed at the end."""

    def __init__(self, log: Path, *command: str, environment: dict[str, str] | None = None) -> None:
        self.log = log
        self._command = [sys.executable, *command]
        self._environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})}
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start it; what it says is added to its log."""
        with self.log.open("ab") as said:
            self._process = subprocess.Popen(
                self._command, stdout=said, stderr=said, stdin=subprocess.PIPE, env=self._environment
            )

    def tell(self, line: str) -> None:
        """A line for its standard input."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def kill(self) -> None:
        """kill -9."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process = None

    def freeze(self, seconds: float) -> None:
        """SIGSTOP, and SIGCONT so much later."""
        os.kill(self.pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(self.pid, signal.SIGCONT)

    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def end(self, number: signal.Signals = signal.SIGTERM, timeout: float = 60.0) -> tuple[int, float]:
        """End it by a signal: its exit code, and how many seconds it took."""
        assert self._process is not None
        begin = time.monotonic()
        self._process.send_signal(number)
        code = self._process.wait(timeout)
        took = time.monotonic() - begin
        self.kill()
        return code, took

    def memory(self) -> int:
        """Resident memory, KiB."""
        text = Path(f"/proc/{self.pid}/status").read_text()
        return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS"))


class Watch:
    """What the centre says, and which ids it has used for what."""

    def __init__(self, bus: Bus) -> None:
        self._lock = threading.Lock()
        self._picture: schemas.GlobalTracks | None = None
        self.statuses: list[float] = []
        self.pictures: list[float] = []
        self.status: schemas.Status | None = None
        self.targets_of: dict[int, set[int]] = {}
        """Of every id that was seen confirmed: the targets that it stood for."""
        self.ended: set[int] = set()
        self.returned: set[int] = set()
        """Ids that were there after they had ended."""
        for what in ("tracks", "status"):
            bus.subscribe(schemas.global_key("centre", what), self._take)

    def _take(self, _key: str, data: bytes) -> None:
        message = schemas.decode(data)
        with self._lock:
            if isinstance(message, schemas.Status):
                self.statuses.append(time.monotonic())
                self.status = message
            elif isinstance(message, schemas.GlobalTracks):
                self.pictures.append(time.monotonic())
                self._picture = message
                self.returned |= self.ended & set(message.ids.tolist())
                self.ended |= {int(one) for one, _, _ in message.ended}
                for number, track in self._confirmed(message).items():
                    self.targets_of.setdefault(track, set()).add(number)

    @staticmethod
    def _confirmed(picture: schemas.GlobalTracks) -> dict[int, int]:
        """Of tracks that say where they are, to 100 m: one of which nothing is heard may be anywhere."""
        off = picture.means[:, :2] - np.rint(picture.means[:, :2] / [1000.0, np.inf]) * [1000.0, 0.0]
        sure = picture.covariances[:, [0, 1], [0, 1]].max(axis=1, initial=0.0) < 100.0**2
        shown = (picture.status == 1) & sure & (abs(off).max(axis=1, initial=0.0) < 100.0)
        numbers = np.rint(picture.means[shown, 0] / 1000).astype(int).tolist()
        return dict(zip(numbers, picture.ids[shown].tolist(), strict=True))

    def confirmed(self) -> dict[int, int]:
        """Target -> id in the newest picture."""
        with self._lock:
            return self._confirmed(self._picture) if self._picture is not None else {}

    def whole(self, since: float = 0.0) -> bool:
        """Whether the newest picture has the targets and no other, and came after `since`."""
        return bool(self.pictures) and self.pictures[-1] > since and tuple(sorted(self.confirmed())) == TARGETS

    def silence(self, begin: float) -> float:
        """Longest time between two statuses since `begin`, until now."""
        stamps = [begin, *(at for at in self.statuses if at > begin), time.monotonic()]
        return float(np.diff(stamps).max())

    def first(self, since: float) -> float:
        """Seconds from `since` to the first status after it; infinite where there is none."""
        return next((at - since for at in self.statuses if at > since), float("inf"))


class Product:
    """Everything that runs. Names: hub, service, recorder, r1, r2."""

    def __init__(self, folder: Path, stack: ExitStack, centre: str, program: tuple[str, ...]) -> None:
        self.folder = folder
        self.endpoint = free_endpoint()
        self._stack = stack
        config = folder / "centre.toml"
        config.write_text(CONFIG.format(centre=centre, endpoint=self.endpoint, state=folder / "state" / "of"))
        self.processes: dict[str, Process] = {}
        self.add("hub", *COMMAND, "hub", "--listen", self.endpoint)
        self.add("service", *program, "run", "--config", str(config))
        self.add("recorder", *COMMAND, "record", "--connect", self.endpoint, "--out", f"{folder / 'recorded'}/")
        for name in ("r1", "r2"):
            self.add(name, "-c", SENSOR, self.endpoint, name, "given", *map(str, TARGETS))

    def add(self, name: str, *command: str) -> None:
        """A program under a name, not started."""
        self.processes[name] = Process(self.folder / f"{name}.log", *command)
        self._stack.callback(self.processes[name].kill)

    def start(self, *names: str) -> None:
        for name in names:
            self.processes[name].start()

    def __getitem__(self, name: str) -> Process:
        return self.processes[name]

    def watch(self) -> Watch:
        """Begin to watch; the hub must be up."""
        self.bus = self._stack.enter_context(open_bus([self.endpoint], wait=30.0))
        return Watch(self.bus)


@contextmanager
def product(*names: str, centre: str = "", program: tuple[str, ...] = COMMAND) -> Iterator[tuple[Product, Watch]]:
    """The processes of these names, up; where a service and sensors are among them, with their picture whole."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        one = Product(Path(folder), stack, centre, program)
        one.start("hub")
        watch = one.watch()
        one.start(*(name for name in names if name != "hub"))
        if "service" in names and "r1" in names:
            eventually(watch.whole, 90)
        elif "service" in names:
            eventually(lambda: watch.statuses, 90)
        yield one, watch
