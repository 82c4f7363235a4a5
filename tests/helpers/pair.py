"""A centre of two processes, one active and one that stands by, with sensors and a watch that writes all down."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

import schemas
from fusion_service.bus import open_bus
from schemas.messages import BORN, CONFIRMED, GlobalTracks, Status, StepLog
from tests.helpers.processes import Program, eventually
from tests.helpers.scene import COMMAND, CONFIG, SENSOR

__all__ = ["Pair", "Seen", "Watch"]


class Seen(NamedTuple):
    """A picture, whole where it was a delta, and when it came, s."""

    at: float
    picture: GlobalTracks

    @property
    def targets(self) -> dict[int, int]:
        """Target number -> global id of the confirmed tracks."""
        shown = self.picture.status == CONFIRMED
        numbers = np.rint(self.picture.means[shown, 0] / 1000).astype(int).tolist()
        return dict(zip(numbers, self.picture.ids[shown].tolist(), strict=True))


class Watch:
    """All that is published under one hub, in the order of its coming."""

    def __init__(self, endpoint: str, stack: ExitStack) -> None:
        self.pictures: list[Seen] = []
        self.statuses: list[Status] = []
        self.logs: list[StepLog] = []
        self.alive: list[bool] = []
        self._wholes = schemas.Wholes()
        self.bus = stack.enter_context(open_bus([endpoint], wait=60.0))
        self.bus.watch(schemas.global_key("*", "alive"), lambda key, alive: self.alive.append(alive))
        for what in ("tracks", "log", "status"):
            self.bus.subscribe(schemas.global_key("*", what), self._take)

    def _take(self, key: str, data: bytes) -> None:
        message = schemas.decode(data)
        if isinstance(message, GlobalTracks):
            self.pictures.append(Seen(time.monotonic(), self._wholes.of(message) or message))
        elif isinstance(message, Status):
            self.statuses.append(message)
        elif isinstance(message, StepLog):
            self.logs.append(message)

    @property
    def status(self) -> Status | None:
        return self.statuses[-1] if self.statuses else None

    def sees(self, *targets: int) -> bool:
        return bool(self.pictures) and sorted(self.pictures[-1].targets) == sorted(targets)

    def taken_over(self, since: int, timeout: float = 20.0) -> Seen:
        """The first picture of another run than that of number `since` of the pictures."""
        epoch = self.pictures[since].picture.epoch
        found: list[Seen] = []

        def there() -> bool:
            found.extend(one for one in self.pictures[since:] if one.picture.epoch != epoch)
            return bool(found)

        eventually(there, timeout)
        return found[0]

    def ready(self) -> bool:
        """Whether the active one says that another could take over."""
        return self.status is not None and bool(self.status.standby and self.status.standby["ready"])

    def term(self) -> int:
        """Of whoever is active."""
        assert self.status is not None
        assert self.status.term is not None
        return self.status.term

    def names(self) -> dict[int, set[int]]:
        """Every global id that was ever confirmed -> the targets it was shown at."""
        shown: dict[int, set[int]] = {}
        for one in self.pictures:
            for target, track in one.targets.items():
                shown.setdefault(track, set()).add(target)
        return shown

    def faults(self) -> list[str]:
        """What must never be: an id of two targets, one born twice, one that ended and came back, an older run after a
        newer one."""
        found = [f"id {track} of targets {sorted(of)}" for track, of in self.names().items() if len(of) > 1]
        born = [int(one) for log in self.logs for one in log.decisions.track[log.decisions.kind == BORN]]
        found += [f"id {one} born twice" for one in sorted({one for one in born if born.count(one) > 1})]
        ended: set[int] = set()
        epoch = first = 0
        for seen in self.pictures:
            found += [f"id {one} came back" for one in ended.intersection(seen.picture.ids.tolist())]
            ended.update(one for one, _, _ in seen.picture.ended)
            if seen.picture.epoch < epoch:
                late = (seen.picture.sent - first) / 1e9
                found.append(
                    f"a picture of run {seen.picture.epoch} after one of run {epoch}, sent {late:.3f} s after it"
                )
            elif seen.picture.epoch > epoch:
                epoch, first = seen.picture.epoch, seen.picture.sent
        return found


class Pair:
    """Two processes of one centre on hubs (the same, or one each), sensors at rest, and a watch at the first hub."""

    def __init__(self, endpoints: tuple[str, str], folder: Path, stack: ExitStack, centre: str = "") -> None:
        self._stack, self._folder, self._endpoints, self._centre = stack, folder, endpoints, centre
        self._number = 0
        self.programs: list[Program | None] = [None, None]
        self.watch = Watch(endpoints[0], stack)

    def sensor(self, name: str, *targets: int, hub: int = 0, code: str = SENSOR, order: str = "given") -> Program:
        arguments = (self._endpoints[hub], name, order, *map(str, targets))
        program = self._stack.enter_context(Program(code, *arguments))
        assert program.line() == "up"
        return program

    def centre(self, which: int, standby: bool = False, more: str = "") -> Program:
        """Start one of the two; more: settings of its own."""
        config = self._folder / f"centre{which}.toml"
        state = self._folder / f"state{which}"
        text = CONFIG.format(centre=self._centre + more, endpoint=self._endpoints[which], state=state)
        config.write_text(text)
        program = Program(COMMAND, "run", "--config", str(config), *["--standby"] * standby)
        self._stack.callback(lambda: program.__exit__())
        self.programs[which] = program
        return program

    def started(self, *targets: int) -> Self:
        """Both run, the second stands by and could take over; all targets are seen."""
        self.centre(0)
        eventually(lambda: self.watch.sees(*targets), 20)
        self.centre(1, standby=True)
        eventually(self.watch.ready, 20)
        return self

    def active(self) -> int:
        """Which of the two is active, by the parity of its term's node: they are 0 and 1."""
        return self.watch.term() % 4

    def taken_over(self, since: int, timeout: float = 20.0) -> Seen:
        """The first picture of another run than that of number `since` of the pictures, at the first hub."""
        return self.watch.taken_over(since, timeout)
