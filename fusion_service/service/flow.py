"""How much of one source is taken a second: what is beyond is dropped, as `flow`, before it is read.

Each limit is a bucket that fills at its rate and holds `burst` seconds of it. A message is taken while none is empty,
and may overdraw one: what it holds is known only when it has been read, and is paid for before the next.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from fusion_service.config import FlowConfig, LimitsConfig
from schemas import GlobalTracks, LocalIntensity, LocalTracks, Message, Status

__all__ = ["MAX_NAMES", "Flow"]

MAX_NAMES = 1000
"""Sources that are told apart; all beyond share one account."""
OTHERS = "*"
SWEEP = 1.0
"""Seconds between two looks for accounts that are full again, and can be forgotten."""
NAMED = 5
KINDS = ("messages", "bytes", "tracks")


@dataclass(slots=True)
class _Account:
    """What is left of each of `KINDS`; rates a second, 0 for no limit; at: when it was looked at, s."""

    rates: tuple[float, float, float]
    burst: float
    left: list[float]
    at: float

    def fill(self, now: float) -> None:
        passed, self.at = max(now - self.at, 0.0), max(now, self.at)
        self.left = [
            min(left + rate * passed, rate * self.burst) for left, rate in zip(self.left, self.rates, strict=True)
        ]

    def lacks(self) -> str:
        """What there is nothing left of; empty where there is of all."""
        return next(
            (kind for kind, left, rate in zip(KINDS, self.left, self.rates, strict=True) if left <= 0 < rate), ""
        )

    @property
    def full(self) -> bool:
        return all(rate == 0 or left >= rate * self.burst for left, rate in zip(self.left, self.rates, strict=True))


class Flow:
    """The limits of `config`; clock: seconds that only grow. `takes` may be called from any thread, and returns at
    once."""

    def __init__(self, config: LimitsConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._clock = clock
        self._lock = threading.Lock()
        self._accounts: dict[str, _Account] = {}
        self._swept = float("-inf")
        self._new: Counter[str] = Counter()
        self.total: Counter[str] = Counter()
        """Messages dropped since the start, by source."""
        self.why: dict[str, str] = {}
        """Which limit each of them went beyond last."""

    def limit(self, config: LimitsConfig) -> None:
        """Go on by these limits. Accounts begin anew, full."""
        with self._lock:
            self._config, self._accounts = config, {}

    def takes(self, source: str, size: int) -> bool:
        """Whether a message of so many bytes is taken now."""
        with self._lock:
            now = self._clock()
            name, account = self._account(source, now)
            account.fill(now)
            lacking = account.lacks()
            if lacking:
                name = name if name in self.total or len(self.total) < MAX_NAMES else OTHERS
                self._new[name] += 1
                self.total[name] += 1
                self.why[name] = lacking
                return False
            account.left[0] -= 1
            account.left[1] -= size
        return True

    def read(self, source: str, message: Message) -> None:
        """A message that was taken holds so many tracks, or components of an intensity."""
        if isinstance(message, (LocalTracks, GlobalTracks, LocalIntensity)):
            count = len(message.weights) if isinstance(message, LocalIntensity) else len(message.ids)
            with self._lock:
                self._account(source, self._clock())[1].left[2] -= count

    def news(self) -> dict[str, int]:
        """Messages dropped since this was last asked, by source."""
        with self._lock:
            new, self._new = dict(sorted(self._new.items())), Counter()
        return new

    def told_in(self, status: Status) -> Status:
        """A status with what was dropped, `flow` of each source, and a note that names them."""
        with self._lock:
            total, why = dict(self.total), dict(self.why)
        if not total:
            return status
        sources = dict(status.sources)
        for name, count in total.items():
            if name in sources or len(sources) < MAX_NAMES:
                sources[name] = {**sources.get(name, {}), "flow": count}
        return replace(status, sources=sources, notes=(*(status.notes or ()), in_words(total, why)))

    def line(self, new: dict[str, int]) -> str:
        """What is newly dropped, as `news` says it, in a line."""
        with self._lock:
            return in_words(new, dict(self.why))

    def _account(self, source: str, now: float) -> tuple[str, _Account]:
        name = source if source in self._accounts or self._has_room(now) else OTHERS
        if name not in self._accounts:
            limits: FlowConfig = self._config.sources.get(name, self._config)
            rates = (limits.messages, limits.bytes, limits.tracks)
            self._accounts[name] = _Account(rates, limits.burst, [rate * limits.burst for rate in rates], now)
        return name, self._accounts[name]

    def _has_room(self, now: float) -> bool:
        if len(self._accounts) < MAX_NAMES:
            return True
        if now - self._swept < SWEEP:
            return False
        self._swept = now
        for account in self._accounts.values():
            account.fill(now)
        self._accounts = {name: account for name, account in self._accounts.items() if not account.full}
        return len(self._accounts) < MAX_NAMES


def in_words(counts: dict[str, int], why: dict[str, str]) -> str:
    """So many messages were dropped of each source, the most of them first."""
    most = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    told = ", ".join(f"{count} of {name} ({why.get(name, 'messages')})" for name, count in most[:NAMED])
    more = f" and of {len(most) - NAMED} more" if len(most) > NAMED else ""
    return f"more comes than [limits] allow, messages dropped: {told}{more}"
