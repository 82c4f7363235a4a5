"""A scene for tests of the service: hub, observer, and processes that a test starts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

import schemas
from fusion_service.bus import Bus, open_bus
from schemas.messages import BORN, CONFIRMED, GlobalTracks, Status, StepLog
from tests.helpers.processes import Hub, Program

COMMAND = "import sys\nfrom fusion_service.cli import main\nraise SystemExit(main(sys.argv[1:]))"

# A sensor at rest that sees some of the targets k at (1000 k, 0); argv: endpoint, name, order of ids, targets.
SENSOR = """
import sys, time
import numpy as np
from schemas import Enu, Motion
from sensor_clients.publisher import TrackPublisher
endpoint, name, order, *targets = sys.argv[1:]
targets = [int(k) for k in targets]
ids = range(1, len(targets) + 1)
ids = list(ids)[::-1] if order == "reversed" else list(ids)
frame, space = Enu(59.0, -55.0), ("x", "y", "vx", "vy")
rng = np.random.default_rng(len(name))
with TrackPublisher(name, connect=endpoint) as publisher:
    publisher.info(frame=frame, position=(0, 0, 0), period=0.2, motion=Motion("cv", 1.0))
    print("up", flush=True)
    while True:
        means = np.array([[1000.0 * k, 0, 0, 0] for k in targets]) + rng.normal(size=(len(targets), 4))
        publisher.tracks(time=time.time_ns(), space=space, frame=frame, ids=ids, means=means,
                         covariances=np.tile(np.diag([25.0, 25.0, 4.0, 4.0]), (len(targets), 1, 1)))
        time.sleep(0.2)
"""

CONFIG = """
[centre]
period = 0.2
delay = 0.1
lateness = 2.0
coast = 2.0
{centre}
[bus]
connect = ["{endpoint}"]
[service]
state = "{state}"
"""


class Observer:
    """Everything that the centre publishes, decoded, in the order of its coming."""

    def __init__(self, bus: Bus) -> None:
        self.pictures: list[GlobalTracks] = []
        self.statuses: list[tuple[float, Status]] = []
        self.logs: list[StepLog] = []
        self._lock = threading.Lock()
        for what in ("tracks", "log", "status"):
            bus.subscribe(schemas.global_key("*", what), self._take)

    def _take(self, key: str, data: bytes) -> None:
        message = schemas.decode(data)
        with self._lock:
            if isinstance(message, GlobalTracks):
                self.pictures.append(message)
            elif isinstance(message, Status):
                self.statuses.append((time.monotonic(), message))
            elif isinstance(message, StepLog):
                self.logs.append(message)

    def confirmed(self) -> dict[int, int]:
        """Target number -> global id in the newest picture."""
        if not self.pictures:
            return {}
        picture = self.pictures[-1]
        shown = picture.status == CONFIRMED
        numbers = np.rint(picture.means[shown, 0] / 1000).astype(int).tolist()
        return dict(zip(numbers, picture.ids[shown].tolist(), strict=True))

    def sees(self, *targets: int) -> Callable[[], bool]:
        return lambda: sorted(self.confirmed()) == sorted(targets)

    def feeders(self, track: int) -> set[str]:
        picture = self.pictures[-1]
        owners = np.repeat(picture.ids, picture.contributor_counts)
        return {picture.sources[k] for k in picture.contributor_source[owners == track]}

    def born(self) -> list[int]:
        return [int(track) for log in self.logs for track in log.decisions.track[log.decisions.kind == BORN]]


class Scene:
    """A hub, an observer, and what a test starts."""

    def __init__(self, hub: Hub, folder: Path, stack: ExitStack) -> None:
        self.endpoint = hub.endpoint
        self.folder = folder
        self._stack = stack
        self.bus = stack.enter_context(open_bus([hub.endpoint], wait=60.0))
        self.seen = Observer(self.bus)
        self.running: Program | None = None

    def start(self, code: str, *arguments: str) -> Program:
        return self._stack.enter_context(Program(code, *arguments))

    def service(self, centre: str = "") -> Program:
        config = self.folder / "centre.toml"
        config.write_text(CONFIG.format(centre=centre, endpoint=self.endpoint, state=self.folder / "state"))
        return self.run(config)

    def run(self, config: Path) -> Program:
        return self.start(COMMAND, "run", "--config", str(config))

    def sensor(self, name: str, *targets: int, order: str = "given") -> Program:
        program = self.start(SENSOR, self.endpoint, name, order, *map(str, targets))
        assert program.line() == "up"
        return program

    def last_status(self) -> Status:
        return self.seen.statuses[-1][1]

    def said_of(self, source: str, what: str) -> object:
        """What the newest status says of a source; None before it says anything."""
        return self.last_status().sources.get(source, {}).get(what) if self.seen.statuses else None


@contextmanager
def opened(hub: Hub, folder: Path) -> Iterator[Scene]:
    with ExitStack() as stack:
        yield Scene(hub, folder, stack)
