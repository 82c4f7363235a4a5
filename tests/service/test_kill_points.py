"""A kill between each two writes to the state folder, and in the midst of each: the ids that were published go on.

No process is killed: before, in and after every write the folder is kept as it is, together with what has been
published by then, and afterwards a service begins from each of these. Whichever source is heard first.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fusion_service.centre import FusionCentre
from fusion_service.config import CentreConfig
from fusion_service.service import files, state
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State
from fusion_service.service.stepping import LastingCentre
from schemas import GlobalTracks
from schemas.messages import CONFIRMED
from tests.centre.worlds import SECOND, START, info, tracks

PERIOD, ROOM = 0.2, 512
SOURCES = ("r1", "r2")
# In each step: what each source tells, targets k at (1000 k, 0) with their local ids.
Told = dict[str, dict[int, int]]


def told(step: int) -> Told:
    """One source begins each target, the other follows; one is told under another number, by the other source, or no
    more."""
    first: dict[int, int] = {0: 1}
    second: dict[int, int] = {0: 1}
    if step >= 2:
        first[3] = 13
    if step >= 4:
        second[3] = 23
    if step >= 5:
        second[6] = 26
    if step >= 6:
        first[6] = 16 if step < 8 else 116
    if step >= 7:
        first[9] = 19
    if step >= 9:
        second[9] = 29
        del first[9]
    if step >= 3:
        first[12] = 32
        if step >= 7:
            del first[12]
    return {"r1": first, "r2": second}


class Point(NamedTuple):
    """A moment at which a kill may come: the folder, and what was published: pictures, and how many steps."""

    folder: dict[str, bytes]
    pictures: tuple[GlobalTracks, ...]
    step: int


def targets(picture: GlobalTracks) -> dict[int, int]:
    numbers = np.rint(picture.means[:, 0] / 1000).astype(int).tolist()
    return dict(zip(numbers, picture.ids.tolist(), strict=True))


class Run:
    """A service without a bus, by a clock of its own."""

    def __init__(self, folder: Path, config: CentreConfig, seqs: Counter[str]) -> None:
        self.counts: Counter[str] = Counter()
        self._seqs = seqs
        desk = OrderDesk(lambda order: None)
        self.lasting = LastingCentre(config, State(folder), desk, BoundedLog(1.0), self.counts, lambda: None)

    def hears(self, second: float, what: Told) -> None:
        for name, some in what.items():
            self._seqs[name] += 1
            means = [[1000.0 * k, 0.0, 0.0, 0.0] for k in some]
            message = tracks(name, second, means, some.values(), seq=self._seqs[name])
            self.lasting.handle(message, START + round(second * SECOND))

    def step(self, second: float) -> GlobalTracks:
        made = self.lasting.step(START + round(second * SECOND))
        assert made is not None
        return made.result.tracks


class Points:
    """Keeps the folder around every write."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.found: list[Point] = []
        self.pictures: list[GlobalTracks] = []
        self.now = 100.0
        self._folder = folder
        patch.setattr("fusion_service.service.stepping.time.monotonic", lambda: self.now)
        patch.setattr(os, "fsync", lambda handle: None)
        for name in ("replace", "unlink", "ftruncate"):
            patch.setattr(os, name, self._around(getattr(os, name)))
        patch.setattr(files, "_write", self._torn(files._write))

    def keep(self) -> None:
        folder = {one.name: one.read_bytes() for one in self._folder.iterdir()} if self._folder.exists() else {}
        if not self.found or folder != self.found[-1].folder or len(self.pictures) != self.found[-1].step:
            self.found.append(Point(folder, tuple(self.pictures), len(self.pictures)))

    def _around(self, act: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            self.keep()
            given = act(*arguments, **named)
            self.keep()
            return given

        return call

    def _torn(self, write: Callable[..., None]) -> Callable[..., None]:
        def call(handle: int, data: bytes, at: int = 0) -> None:
            half = len(data) // 2 // 8 * 8 + 3
            self.keep()
            write(handle, data[:half], at)
            self.keep()
            write(handle, data[half:], at + half)
            self.keep()

        return call


def goes_on(run: Run, point: Point, first: Sequence[str]) -> list[str]:
    """What is wrong with the pictures after `point`, where the sources `first` are heard before the others."""
    seen = {track: target for one in point.pictures for target, track in targets(one).items()}
    over = {track for one in point.pictures for track, _, _ in one.ended}
    last = targets(point.pictures[-1]) if point.pictures else {}
    begin = point.step * PERIOD + 1.5
    wrong: list[str] = []
    for number in range(3):
        second, what = round(begin + PERIOD * number, 3), told(point.step)
        run.hears(second, {name: what[name] for name in (first if number == 0 else SOURCES)})
        shown = targets(picture := run.step(second))
        wrong += [f"{track:x} has ended and is back" for track in shown.values() if track in over]
        over |= {track for track, _, _ in picture.ended}
        wrong += [f"target {k}: {last[k]:x}, then {one:x}" for k, one in shown.items() if last.get(k, one) != one]
        wrong += [f"{one:x} was {seen[one]}, is {k}" for k, one in shown.items() if seen.get(one, k) != k]
        wrong += ["an id of two"] if len(set(shown.values())) < len(shown) else []
        there = {k for name in first for k in what[name]}
        wrong += [f"target {k} is not there" for k in there if k in last and k not in shown]
    return wrong


@pytest.mark.parametrize("confirms", [3, 60], ids=["soon confirmed", "young for long"])
def test_ids_go_on_wherever_between_two_writes_a_kill_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, confirms: int
) -> None:
    config = CentreConfig(
        period=PERIOD, lateness=2.0, coast=3.0, rule="ci",
        confirm_hits=confirms, confirm_within=max(4, confirms), confirm_sources=3,
    )  # fmt: skip
    monkeypatch.setattr(state, "ROOM_BORN", ROOM)
    monkeypatch.setattr(state, "ROOM_ENDED", ROOM)
    folder, seqs = tmp_path / "state", Counter[str]()
    folder.mkdir(mode=0o700)
    points = Points(folder, monkeypatch)
    run = Run(folder, config, seqs)
    for name in SOURCES:
        run.lasting.handle(info(name, period=PERIOD), START)
    for step in range(12):
        points.now += 0.3
        run.hears(step * PERIOD, told(step))
        picture = run.step(step * PERIOD)
        points.keep()
        points.pictures.append(picture)
        points.keep()
        run.lasting.save()
        points.keep()
    assert run.counts["unsaved"] == 0
    assert sum((one.status == CONFIRMED).sum() for one in points.pictures) >= (10 if confirms == 3 else 0)
    found, again = points.found, tmp_path / "again"
    monkeypatch.undo()
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    monkeypatch.setattr(state, "ROOM_BORN", ROOM)
    monkeypatch.setattr(state, "ROOM_ENDED", ROOM)
    wrong: list[str] = []
    for number, point in enumerate(found):
        for first in (("r1",), ("r2",), SOURCES):
            place = again / f"{number}{len(first)}{first[0]}"
            place.mkdir(mode=0o700, parents=True)
            for name, data in point.folder.items():
                (place / name).write_bytes(data)
                (place / name).chmod(0o600)
            said = goes_on(Run(place, config, Counter(seqs)), point, first)
            wrong += [f"point {number}, step {point.step}, {first}: {one}" for one in said]
    print(len(found), "points")
    assert len(found) > 40
    assert not wrong, "\n".join(wrong)


def test_an_id_that_the_checkpoint_has_is_promised_to_nobody() -> None:
    """As where a kill comes after the checkpoint was replaced, and before the notes were cleared."""
    centre = FusionCentre(CentreConfig(period=PERIOD))
    centre.handle(info("r1", period=PERIOD), START)
    centre.handle(tracks("r1", 0.0, [[0.0, 0.0, 0.0, 0.0]], [1]), START)
    [known] = centre.step(START).picture.ids.tolist()
    centre.promise([(("r1", 1, 7), known), (("r1", 1, 8), known + 50)])
    places = [[0.0, 0.0, 0.0, 0.0], [7000.0, 0.0, 0.0, 0.0], [8000.0, 0.0, 0.0, 0.0]]
    centre.handle(tracks("r1", PERIOD, places, [1, 7, 8], seq=1), START)
    shown = targets(centre.step(START + round(PERIOD * SECOND)).picture)
    assert shown[0] == known
    assert shown[8] == known + 50
    assert len(set(shown.values())) == 3
