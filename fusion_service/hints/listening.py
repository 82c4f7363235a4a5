"""`Listened`: the messages of one source, one by one, and what in them contradicts itself or what the source says.

Nothing of it is refused; it is what makes tracks useless all the same: a period in ms, an epoch that changes with every
message, two publishers of one name, a coverage that holds none of the tracks. Bounded: a few messages are kept.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import numpy as np

from fusion_service.geodesy import FrameError, transform
from fusion_service.hints import tracks as about
from fusion_service.hints.lateness import late_doubt
from fusion_service.hints.times import clock_words, span, unit_of_time
from schemas import Enu, Frame, LocalIntensity, LocalTracks, Message, SensorInfo

__all__ = ["Listened"]

ENOUGH = 4
"""Messages from which on something is said of their series."""
PATIENCE = 3.0
"""Seconds that a source may take to say what it is."""
KEPT = 32
SPAN = 5 * 10**9
"""ns over which it is looked how tracks move."""
MOST_TIMES = 86400.0
"""Seconds between clocks beyond which a mission is played at its own time."""


class Listened:
    """What was heard of one source. messages: how many with tracks; newest: the newest of them."""

    def __init__(self) -> None:
        self.messages = 0
        self.info: SensorInfo | None = None
        self.newest: about.Glimpse | None = None
        self._before: about.Glimpse | None = None
        self._anchor: about.Glimpse | None = None
        self._first = 0
        self._came: deque[int] = deque(maxlen=KEPT)
        self._held: deque[int] = deque(maxlen=KEPT)
        self._clock: deque[float] = deque(maxlen=KEPT)
        self._epochs: deque[int] = deque(maxlen=KEPT)
        self._seqs: deque[tuple[int, int]] = deque(maxlen=KEPT)

    def heard(self, message: Message, received: int) -> None:
        """A message that could be read came at `received`, ns."""
        self._epochs.append(message.epoch)
        self._clock.append((message.sent - received) / 1e9)
        if isinstance(message, SensorInfo):
            self.info = message
        elif isinstance(message, (LocalTracks, LocalIntensity)):
            self.messages += 1
            self._first = self._first or received
            self._came.append(received)
            self._held.append(message.time)
            self._seqs.append((message.epoch, message.seq))
            if self.newest is None or message.time > self.newest.time or message.epoch != self.newest.epoch:
                self._before, self.newest = self.newest, about.glimpse(message)
                anchor = self._anchor
                if anchor is None or anchor.epoch != message.epoch or message.time - anchor.time > SPAN:
                    self._anchor = self._before

    @property
    def rate(self) -> float | None:
        """Messages with tracks a second, of the newest ones; None before there are enough."""
        if len(self._came) < 3 or self._came[-1] <= self._came[0]:
            return None
        return (len(self._came) - 1) / ((self._came[-1] - self._came[0]) / 1e9)

    @property
    def clock(self) -> float | None:
        """Seconds by which its clock is ahead of ours, or behind (negative), as far as its messages say: the least
        delayed of the newest ones; None where they are of a mission with a clock of its own."""
        ahead = max(self._clock, default=0.0)
        return ahead if self._clock and abs(ahead) < MOST_TIMES else None

    def doubts(self, now: int, frame: Frame | None = None) -> list[str]:
        """What is doubtful, a sentence each, with what mends it. frame: that of the picture, where there is one."""
        with np.errstate(all="ignore"):
            return [one for one in self._doubts(now, frame) if one]

    def lateness(self, period: float, delay: float, lateness: float, again: bool) -> str:
        """What is to be said where all of its newest scans come too late for their steps (see `late_doubt`)."""
        return late_doubt(self._held, self._came, period=period, delay=delay, lateness=lateness, again=again)

    def _doubts(self, now: int, frame: Frame | None) -> list[str]:
        said = [*self._runs(), self._no_info(now), self._period(), self._clocks(now)]
        if self.newest is not None and isinstance(self.newest.frame, Enu) and isinstance(frame, Enu):
            said.append(about.frame_doubt(self.newest.frame, frame))
        if self.newest is not None:
            said += [about.places_doubt(self.newest), about.angles_doubt(self.newest), self._coverage()]
        if self.newest is not None and self._before is not None:
            said.append(about.ids_doubt(self._before, self.newest))
        if self.newest is not None and self._anchor is not None:
            said.append(about.order_doubt(self._anchor, self.newest))
        return said

    def _runs(self) -> list[str]:
        """Epochs and numbers."""
        epochs = list(self._epochs)
        changes = [new for old, new in pairwise(epochs) if new != old]
        if len(epochs) < ENOUGH:
            return []
        if len(changes) >= ENOUGH - 1 and len(set(epochs)) > 0.6 * len(epochs):
            return [
                "its epoch changes with every message, so that no track lives on: take the time once, at the start of "
                "the program, and send it in every message"
            ]
        if len(changes) >= ENOUGH - 1 and len(set(epochs)) <= 3:
            return ["two publishers have its name (two epochs in turns): give each a name of its own"]
        seqs = list(self._seqs)
        if len(seqs) >= ENOUGH and len(set(seqs)) == 1:
            return [f"its seq is always {seqs[0][1]}: count it up with every message"]
        return []

    def _no_info(self, now: int) -> str:
        if self.info is not None or not self.messages or (now - self._first) / 1e9 < PATIENCE:
            return ""
        return (
            "no sensor_info came from it, so that its period, motion and coverage are not known: send one on "
            ".../info at the start; a publisher without a cache must send it again every few seconds"
        )

    def _period(self) -> str:
        rate, info = self.rate, self.info
        if rate is None or info is None or len(self._came) < ENOUGH:
            return ""
        steps = [(new - old) / 1e9 for old, new in pairwise(self._held) if new > old]
        if len(steps) >= ENOUGH - 1 and 0.2 < float(np.median(steps)) / info.period < 5.0:
            return ""  # by their own times: a mission may be played faster
        factor = info.period * rate
        told = f"its period is {info.period:g} s, but its messages come every {span(1 / rate)}"
        if 500.0 < factor < 2000.0:
            return f"{told}: is `period` in ms? it must be s"
        if 0.0005 < factor < 0.002:
            return f"{told}: is `period` a rate in kHz, or its messages late? it must be the seconds between messages"
        if 0.7 < info.period / rate < 1.4 and not 0.3 < factor < 3.0:
            return f"{told}: is `period` the rate in Hz? it must be the seconds between messages"
        return f"{told}: let it declare how often it sends" if factor > 5.0 or factor < 0.2 else ""

    def _clocks(self, now: int) -> str:
        newest = self.newest or self.info
        if newest is None:
            return ""
        for name in ("epoch", "sent"):
            if unit := unit_of_time(getattr(newest, name), now):
                return f"its `{name}` is in {unit}, it seems: it must be ns"
        ahead = self.clock
        if ahead is None or len(self._clock) < ENOUGH or -1.0 < ahead < 0.2:
            return ""
        return f"its clock is {span(ahead)} {'ahead' if ahead > 0 else 'behind'}: {clock_words(ahead)}"

    def _coverage(self) -> str:
        info, newest = self.info, self.newest
        if info is None or newest is None or info.coverage is None or not len(newest.means):
            return ""
        if newest.moves or not np.isfinite(newest.means).all():
            return ""
        axes = [newest.space.index(name) for name in ("x", "y", "z") if name in newest.space]
        means = np.ascontiguousarray(newest.means[:, axes])
        names = tuple(newest.space[k] for k in axes)
        try:
            places, _ = transform(means, np.zeros((len(means), len(axes), len(axes))), names, newest.frame, info.frame)
        except FrameError:
            return ""
        return about.coverage_doubt(info.coverage, places.T, info.position)
