"""Mutated messages through a real centre: a world of honest sources, and some that are not, under drawn settings.

No step raises, none takes longer than it may, all that comes out can be written and read, and when those that are not
honest have gone, the picture holds the targets of those that are, wherever it would have held them without the others.
"""

from __future__ import annotations

import dataclasses
import random
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np

import schemas
from fusion_service.centre import Centre, Refused, SourceFound, SourceLost, StepResult, make_centre, source_of
from fusion_service.config import CentreConfig
from tests.centre.test_every_setting import KINDS
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, moved, tracks
from tests.chaos.mutations import BASES, mutated
from tests.chaos.report import Report
from tests.chaos.settings import drawn

__all__ = ["HONEST", "fuzz_centres", "honest", "look", "world"]

HOME = np.array([[60_000.0, 0.0, 5.0, 0.0], [64_000.0, 0.0, 0.0, 5.0], [60_000.0, 9000.0, -4.0, 3.0]])
"""Honest targets, far from what the others tell of."""
HONEST = ("h1", "h2", "h3")
OTHERS = ("a1", "x2")
NEAR = 400.0
"""Metres within which a track is that of a target."""
SLOW = 2.0
"""Processor seconds that a step may take: of three honest targets, and what two others may send between two steps."""
UNIONS = ("cu", "aa")
"""Rules by which a track says all that any of its sources says: should one say "anywhere", so do they."""
QUIET, LOUD, AFTER = 3, 6, 12
"""Seconds without the others, with them, and when they have gone."""
Item = tuple[str, Any, int]
"""Source, message or other event, received."""


class Escape(Exception):
    """What must not happen."""


def fuzz_centres(seed: int, until: float, most: int = 2**62) -> Report:
    """Worlds until `until`, of the monotonic clock, or `most`; the first is of `seed`, the next of `seed + 1`. What
    NumPy warns of is told, not held against them."""
    report = Report("centre")
    worlds, held, slowest, begin = 0, 0, 0.0, time.monotonic()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("default", RuntimeWarning)
        while worlds < most and time.monotonic() < until:
            try:
                count, judged, slow = world(seed + worlds)
            except Escape as error:
                report.escaped(f"world {seed + worlds}: {error}")
            else:
                report.tried, held, slowest = report.tried + count, held + judged, max(slowest, slow)
            worlds += 1
    rate = report.tried / (time.monotonic() - begin)
    report.say(f"{worlds} worlds, {rate:,.0f} messages a second; the slowest step {slowest:.2f} s")
    report.say(f"honest targets held in {held} of {held} where they are without the others")
    for place in sorted({f"{one.message}: {one.filename}:{one.lineno}" for one in warned}):
        report.say(f"NumPy warns: {place}")
    return report


def world(seed: int) -> tuple[int, bool, float]:
    """(Messages, whether there was a picture to hold, seconds of the slowest step). Raises `Escape`."""
    rng = random.Random(seed)
    config = drawn(rng)
    if rng.random() < 0.5:
        config = dataclasses.replace(config, frame=FRAME)
    evil = {second: list(_evil(rng, second)) for second in range(QUIET, QUIET + LOUD)}
    again = rng.random() < 0.5
    try:
        last, slowest = _fly(config, evil, again)
        expected, _ = _fly(config, {}, False)
    except Escape as error:
        raise Escape(f"{error}\n  settings: {_changed(config)}") from None
    wanted = _targets(expected, sure=True)
    if missing := wanted - _targets(last, sure=False):
        raise Escape(f"targets {sorted(missing)} are not in the picture\n  settings: {_changed(config)}")
    return sum(map(len, evil.values())), len(wanted) == len(HOME), slowest


def _fly(config: CentreConfig, evil: dict[int, list[Item]], again: bool) -> tuple[StepResult, float]:
    """A world from its beginning to its end; again: with a centre made from a checkpoint when the others have gone."""
    centre, fault = make_centre(config)
    slowest = 0.0
    for second in range(1, QUIET + LOUD + AFTER):
        now = START + second * SECOND
        if second == QUIET + LOUD and again:
            centre, fault = make_centre(config, centre.checkpoint(), generation=7)
            if fault:
                raise Escape(f"the checkpoint is not read: {fault}")
        for name, event, received in [*evil.get(second, ()), *honest(config, second)]:
            _give(centre, name, event, received)
        begin = time.process_time()
        try:
            result = centre.step(now)
            look(result)
            if second % 4 == 0:
                centre.checkpoint()
        except Exception:
            raise Escape(f"the step at {second} s failed: {traceback.format_exc(limit=-4)}") from None
        slowest = max(slowest, time.process_time() - begin)
        if slowest > SLOW:
            raise Escape(f"the step at {second} s took {slowest:.1f} s of the processor")
    return result, slowest


def _give(centre: Centre, name: str, event: Any, received: int) -> None:
    """As the service does."""
    if isinstance(event, bytes):
        try:
            event = schemas.decode(event)
        except schemas.MessageError as error:
            event = Refused(name, error.reason)
        else:
            event = event if source_of(event) == name else Refused(name, "source")
    centre.handle(event, received)


def look(result: StepResult) -> None:
    """What comes out is written, and read as it was."""
    for message in (result.tracks, result.log, result.status, result.picture):
        data = schemas.encode(message)
        if schemas.encode(schemas.decode(data)) != data:
            raise Escape(f"the {message.type} is read as something else")


def honest(config: CentreConfig, second: int) -> Iterator[Item]:
    """What the honest sources say within a second."""
    now = START + second * SECOND
    for number, name in enumerate(HONEST):
        if second == 1:
            yield name, SourceFound(name), now
            coverage = schemas.Disk(200_000.0)
            yield name, info(name, coverage=coverage, detection_probability=0.9), now
        rng = np.random.default_rng([second, number])
        means = moved(HOME, second - 0.1) + rng.normal(size=HOME.shape) * [10.0, 10.0, 1.0, 1.0]
        one = tracks(name, second - 0.1, means, sigma=np.array([10.0, 10.0, 1.0, 1.0]))
        yield name, as_intensity(one) if config.kind == "intensity" else one, now


def as_intensity(one: schemas.LocalTracks) -> schemas.LocalIntensity:
    """The same as an intensity."""
    return schemas.LocalIntensity(
        source=one.source, epoch=one.epoch, seq=one.seq, sent=one.sent, time=one.time, space=SPACE, frame=FRAME,
        weights=np.full(len(one.means), 0.9), means=one.means, covariances=one.covariances,
    )  # fmt: skip


def _evil(rng: random.Random, second: int) -> Iterator[Item]:
    """What the others send within a second: their own messages, and any others, changed; tokens that come and go."""
    now = START + second * SECOND
    kinds = list(KINDS.values())
    for _ in range(rng.choice((5, 50, 100, 200))):
        name = rng.choice(OTHERS)
        received = now - rng.choice((0, 0, SECOND // 2, 3 * SECOND))
        chance = rng.random()
        if chance < 0.03:
            yield name, rng.choice((SourceFound, SourceLost))(name), received
            continue
        base = _message(rng, kinds, name, second) if chance < 0.75 else _golden(rng, name, second)
        yield name, base if isinstance(base, bytes) else mutated(rng, base), received


def _message(rng: random.Random, kinds: list[Callable[..., Any]], name: str, second: int) -> dict[str, Any]:
    """A message that would be sound, as a map."""
    made: Any
    if rng.random() < 0.2:
        made = info(name, seq=rng.choice((0, second, 1000 + second)))
    else:
        made = rng.choice(kinds)(name, second - rng.choice((0.1, 0.5, 1.0, 2.5)))
    raw: dict[str, Any] = msgpack.unpackb(schemas.encode(made))
    raw["seq"] = rng.choice((second, second + 100, rng.randrange(1000)))
    return raw


def _golden(rng: random.Random, name: str, second: int) -> dict[str, Any]:
    """A golden message of any type, as if sent now by that source."""
    raw = dict(rng.choice(list(BASES.values())))
    raw |= {"source": name, "seq": rng.randrange(1000), "epoch": rng.choice((1, 1, 2))}
    if "time" in raw:
        raw["time"] = START + second * SECOND - rng.choice((1, 5)) * SECOND // 10
    return raw


def _targets(result: StepResult, sure: bool) -> set[int]:
    """Which of the honest targets are in the picture; sure: by tracks that say where to `NEAR` / 4 (settings may say
    that honest sources are off by kilometres, and then anything is believed of them)."""
    picture = result.picture
    if picture.frame != FRAME or not len(picture.ids):
        return set()
    at = [picture.space.index(axis) for axis in ("x", "y")]
    there = moved(HOME, (picture.time - START) / SECOND)[:, :2]
    off = picture.means[:, None, at] - there
    near = np.linalg.norm(off, axis=2) < NEAR
    if not sure and picture.rule in UNIONS:
        near |= (off**2 < 25.0 * picture.covariances[:, None, at, at]).all(axis=2)
    if sure:
        near &= (picture.covariances[:, at, at].max(axis=1) < (NEAR / 4) ** 2)[:, None]
    return set(np.flatnonzero(near.any(axis=0)).tolist())


def _changed(config: CentreConfig) -> dict[str, Any]:
    """Settings that are not as ever."""
    plain = CentreConfig()
    return {
        one.name: getattr(config, one.name)
        for one in dataclasses.fields(config)
        if getattr(config, one.name) != getattr(plain, one.name)
    }
