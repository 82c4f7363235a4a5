"""A mission's messages, once through: what they say without any truth, and the order of time to read them again.

* A message's place is (time, kind, source, epoch, seq, arrival). `Logbook.tracks` gives tracks in this order; of a
  recording it holds back only what came before its turn, as bytes.
* Delays, not of a replay: "bus", from `sent` to the recorder's `received`; "source" and "centre", from the time of
  the tracks to `sent`; "reaction", from the reception of the last message that a step took to that of its picture. Each
  where most messages show less than `SAME_CLOCK`: a mission played at another time or pace has its own clock.
* A sequence number of an epoch that is missing between the first and the last is a gap; a source that says nothing for
  more than `SILENT` of its periods (declared, else the median interval) is silent.
"""

from __future__ import annotations

import heapq
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.geodesy import FrameError, transform
from fusion_service.linalg import FloatArray
from fusion_service.review.snapshots import Times, TrackMessage
from schemas import (
    Frame,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    SensorInfo,
    Status,
    StepLog,
    Truth,
    decode,
    digest,
)
from schemas.messages import BROKEN, CONFIRMED, GATE_FAILED, KEPT

__all__ = ["Account", "Latency", "Logbook", "Silence", "Traffic"]

StepKey = tuple[str, int, int]
Name = TypeVar("Name")
Value = TypeVar("Value")

SAME_CLOCK = 3600.0
SILENT = 3.0
MOST = 50
"""Silent spans of a source that are kept, the longest."""
HELD = 20_000
"""Receptions remembered until the log of their step comes."""
BINS = 40
SHOWING_EVERY = 8
"""Messages between calls of `progress`."""


class Silence(NamedTuple):
    """A span in which a source said nothing, ns."""

    begin: int
    end: int


class Latency(NamedTuple):
    """n delays, s; counts (BINS,) of a histogram between `edges` (BINS + 1,)."""

    n: int
    median: float
    p95: float
    largest: float
    counts: tuple[int, ...]
    edges: tuple[float, ...]


@dataclass(slots=True, eq=False)
class Traffic:
    """What came of one source, or of one centre's pictures: tracks and messages, the time of the first and the last,
    ns, and the median interval, s; sequence numbers missed; silent spans, the longest first, and their number."""

    messages: int = 0
    tracks: int = 0
    first: int = 0
    last: int = 0
    interval: float = 0.0
    epochs: int = 0
    missing: int = 0
    silent: int = 0
    silences: tuple[Silence, ...] = ()


@dataclass(slots=True, eq=False)
class Account:
    """What a centre's pictures and step logs say of its work.

    rules: those it named. shown: pictures' confirmed tracks by number of their sources. ended: reason -> tracks.
    refused, dropped: (source, reason, "messages" or "tracks") -> how many. kept, failed, broken: source -> links that
    agreed, did not, were cut; innovation: source -> (n, sum of d2) of a link against the fusion of the other sources.
    dimension: of that d2, 0 without pictures. status: the newest, None without.
    """

    rules: Counter[str] = field(default_factory=Counter)
    shown: Counter[int] = field(default_factory=Counter)
    pictures: int = 0
    steps: int = 0
    runs: set[int] = field(default_factory=set)
    dimension: int = 0
    ended: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    dropped: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    kept: Counter[str] = field(default_factory=Counter)
    failed: Counter[str] = field(default_factory=Counter)
    broken: Counter[str] = field(default_factory=Counter)
    innovation: dict[str, tuple[int, float]] = field(default_factory=dict)
    status: Status | None = None


class Logbook:
    """One mission. `Logbook(messages)` of what is in memory, `Logbook.read(path)` of a recording.

    truths; infos: newest of each source; accounts: by centre; traffic: by ("local", "intensity" or "global", name);
    latency: by (kind, name); bad: messages that do not decode, by reason; counts: messages by type.
    """

    def __init__(self, messages: Iterable[Message] = ()) -> None:
        self.truths: list[Truth] = []
        self.infos: dict[str, SensorInfo] = {}
        self.accounts: dict[str, Account] = {}
        self.traffic: dict[tuple[str, str], Traffic] = {}
        self.latency: dict[tuple[str, str], Latency] = {}
        self.bad: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.origins: Counter[str] = Counter()
        self.first_pictures: dict[str, GlobalTracks] = {}
        self.received: tuple[int, int] | None = None
        self.path: Path | None = None
        self._spaces: dict[str, set[tuple[tuple[str, ...], Frame]]] = {}
        self._actors: dict[tuple[str, str], int] = {}
        self._columns = {
            name: array("Q" if name in ("epoch", "seq") else "q") for name in ("actor", "time", "epoch", "seq")
        }
        self._columns["arrival"] = array("q")
        self._spreads: dict[str, array[float]] = {"local": array("d"), "global": array("d")}
        self._delays: dict[tuple[str, str], array[float]] = {}
        self._came: dict[StepKey, int] = {}
        self._infos_came: dict[int, int] = {}
        """By digest: every type of a source's messages has sequence numbers of its own."""
        self._taken: dict[tuple[str, int, int], tuple[int | None, int | None]] = {}
        self._held: dict[int, TrackMessage] = {}
        for arrival, message in enumerate(messages):
            self._note(message, arrival, None)
            if isinstance(message, TrackMessage):
                self._held[arrival] = message
        self._close()

    @classmethod
    def read(cls, path: Path, progress: Callable[[int], None] = lambda _: None) -> Logbook:
        """Of a recording, read once; raises what `recording.read` raises. progress: called with the bytes so far."""
        from fusion_service.recording import read

        book = cls()
        book.path, size = path, 0
        for raw in read(path):
            size += len(raw.data)
            if raw.arrival % SHOWING_EVERY == 0:
                progress(size)
            low, high = book.received or (raw.received, raw.received)
            book.received = min(low, raw.received), max(high, raw.received)
            try:
                book._note(decode(raw.data), raw.arrival, raw.received)
            except MessageError as error:
                book.bad[error.reason] += 1
        book._close()
        return book

    def tracks(self, wanted: Callable[[str, str], bool] = lambda kind, name: True) -> Iterator[TrackMessage]:
        """Tracks of the sources ("local") and centres ("global") that are `wanted`, in the order of their places."""
        order, kept = self._order(wanted)
        if self.path is None:
            yield from (self._held[arrival] for arrival in order.tolist())
            return
        from fusion_service.recording import read

        place = np.full(int(kept.max(initial=-1)) + 1, -1)
        place[order] = np.arange(len(order))
        waiting: list[tuple[int, bytes]] = []
        following = 0
        for raw in read(self.path):
            if raw.arrival < len(place) and (turn := int(place[raw.arrival])) >= 0:
                heapq.heappush(waiting, (turn, raw.data))
            while waiting and waiting[0][0] == following:
                yield decode(heapq.heappop(waiting)[1])  # type: ignore[misc]
                following += 1

    def times(self, centres: Iterable[str]) -> Times:
        """The times of these centres' pictures, each once."""
        chosen = [self._actors["global", name] for name in centres if ("global", name) in self._actors]
        actor, time = (np.frombuffer(self._columns[name], dtype=np.int64) for name in ("actor", "time"))
        return np.unique(time[np.isin(actor, chosen)])

    def cutoff(self, spreads: float) -> float:
        """`spreads` times the median over the pictures (without them, over all local tracks) of the median standard
        deviation of a position, rounded up to 1, 2 or 5 times a power of ten, m; 1 where there are no tracks."""
        typical = self._spreads["global"] or self._spreads["local"]
        wanted = spreads * float(np.median(typical)) if typical else 0.0
        if not 0 < wanted < 1e12:
            return 1.0
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(next(step * power for step in (1, 2, 5, 10) if step * power >= wanted * (1 - 1e-9)))

    def unreachable(self, source: str, frame: Frame, axes: tuple[str, ...]) -> str | None:
        """Why tracks of `source` cannot be brought into `frame` with `axes`; None if they can."""
        for space, own in sorted(self._spaces[source], key=repr):
            try:
                transform(np.zeros((1, len(space))), np.zeros((1, len(space), len(space))), space, own, frame)
            except FrameError as error:
                return str(error)
            if not set(axes) <= set(space):
                return f"its tracks have no z (their space: {' '.join(space)})"
        return None

    def default_space(self) -> tuple[Frame, tuple[str, ...]] | None:
        """The frame and space of the first source in the alphabet; None without tracks of a source."""
        for name in self.sources:
            space, frame = min(self._spaces[name], key=repr)
            return frame, space
        return None

    @property
    def sources(self) -> list[str]:
        """Names of the sources of tracks, sorted."""
        return sorted(name for kind, name in self._actors if kind == "local")

    @property
    def centres(self) -> list[str]:
        """Names of the centres, sorted."""
        return sorted(name for kind, name in self._actors if kind == "global")

    @property
    def span(self) -> tuple[int, int] | None:
        """Mission time of the first and the last tracks or truth, ns."""
        times = [one.first for one in self.traffic.values()] + [one.last for one in self.traffic.values()]
        times += [truth.time for truth in self.truths]
        return (min(times), max(times)) if times else None

    def _order(self, wanted: Callable[[str, str], bool]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Arrival numbers of what is wanted in the order of places, and as they came."""
        columns = {name: np.frombuffer(column, dtype=column.typecode) for name, column in self._columns.items()}
        names = list(self._actors)
        rank = np.argsort(sorted(range(len(names)), key=lambda index: names[index]))
        mine = np.array([wanted(*name) for name in names], dtype=np.bool_)
        rows = np.flatnonzero(mine[columns["actor"]]) if names else np.zeros(0, dtype=np.intp)
        keys = [columns[name][rows] for name in ("arrival", "seq", "epoch")]
        by = np.lexsort([*keys, rank[columns["actor"][rows]] if names else rows, columns["time"][rows]])
        return columns["arrival"][rows][by], columns["arrival"][rows]

    def _note(self, message: Message, arrival: int, received: int | None) -> None:
        self.counts[message.type] += 1
        name = message.source
        if isinstance(message, Truth):
            self.truths.append(message)
        elif isinstance(message, SensorInfo):
            known = self.infos.get(name, message)
            self.infos[name] = max(known, message, key=lambda info: (info.epoch, info.seq))
            if received is not None:
                _remember(self._infos_came, digest(message), received)
        elif isinstance(message, LocalIntensity):
            self._note_traffic("intensity", message, len(message.weights), arrival, received)
        elif isinstance(message, LocalTracks | GlobalTracks):
            self._note_tracks(message, arrival, received)
        elif isinstance(message, StepLog):
            self._note_log(message, received)
        elif isinstance(message, Status):
            account = self.accounts.setdefault(name, Account())
            known_status = account.status or message
            account.status = max(known_status, message, key=lambda one: (one.epoch, one.seq))

    def _note_traffic(
        self, kind: str, message: TrackMessage | LocalIntensity, size: int, arrival: int, received: int | None
    ) -> None:
        name = message.source
        actor = self._actors.setdefault((kind, name), len(self._actors))
        place = {"actor": actor, "time": message.time, "epoch": message.epoch, "seq": message.seq, "arrival": arrival}
        for column, value in place.items():
            self._columns[column].append(value)
        self.traffic.setdefault((kind, name), Traffic()).tracks += size
        self.origins[message.origin] += 1
        if _by_a_clock(message):
            self._delay("centre" if kind == "global" else "source", name, message.sent - message.time)
            if received is not None:
                self._delay("bus", name, received - message.sent)
        if received is not None and kind != "global":
            _remember(self._came, (name, message.epoch, message.seq), received)

    def _note_tracks(self, message: TrackMessage, arrival: int, received: int | None) -> None:
        kind, name = "local" if isinstance(message, LocalTracks) else "global", message.source
        self._note_traffic(kind, message, len(message.ids), arrival, received)
        at = [message.space.index(axis) for axis in "xyz" if axis in message.space]
        with np.errstate(all="ignore"):
            spread = np.sqrt(message.covariances[:, at, at].mean(axis=1))
        if len(spread) and np.isfinite(typical := float(np.median(spread))):
            self._spreads[kind].append(typical)
        if isinstance(message, GlobalTracks):
            self._note_picture(message)
            if received is not None and _by_a_clock(message):
                self._react((name, message.epoch, message.step), picture=received)
        else:
            self._spaces.setdefault(name, set()).add((message.space, message.frame))

    def _note_picture(self, message: GlobalTracks) -> None:
        account = self.accounts.setdefault(message.source, Account())
        account.rules[message.rule] += 1
        account.pictures += 1
        account.dimension = len(message.space)
        account.runs.add(message.epoch)
        account.shown.update(message.contributor_counts[message.status == CONFIRMED].tolist())
        account.ended.update(reason for _, reason, _ in message.ended)
        first = self.first_pictures.setdefault(message.source, message)
        if (message.time, message.epoch) < (first.time, first.epoch):
            self.first_pictures[message.source] = message

    def _note_log(self, message: StepLog, received: int | None) -> None:
        account = self.accounts.setdefault(message.source, Account())
        account.steps += 1
        account.runs.add(message.epoch)
        for counter, entries in ((account.refused, message.refused), (account.dropped, message.dropped)):
            for entry in entries:
                what = "tracks" if entry.count else "messages"
                counter[entry.source, entry.reason, what] += entry.count or 1
        made = message.decisions
        for index, source in enumerate(message.sources):
            mine = made.source == index
            kinds = np.bincount(made.kind[mine], minlength=GATE_FAILED + 1)
            account.kept[source] += int(kinds[KEPT])
            account.failed[source] += int(kinds[GATE_FAILED])
            account.broken[source] += int(kinds[BROKEN])
            value = made.value[mine & ((made.kind == KEPT) | (made.kind == GATE_FAILED))]
            value = value[np.isfinite(value)]
            n, total = account.innovation.get(source, (0, 0.0))
            account.innovation[source] = n + len(value), total + float(value.sum())
        if received is not None:
            came = [
                self._infos_came.get(one.hash) or self._came.get((one.source, one.epoch, one.seq))
                for one in message.taken
            ]
            newest = max((time for time in came if time is not None), default=None)
            if newest is not None:
                self._react((message.source, message.epoch, message.step), taken=newest)

    def _react(self, step: tuple[str, int, int], picture: int | None = None, taken: int | None = None) -> None:
        """Picture and log of a step come one after the other, in either order."""
        other = self._taken.pop(step, None)
        if other is None:
            _remember(self._taken, step, (picture, taken))
            return
        picture, taken = picture or other[0], taken or other[1]
        if picture is not None and taken is not None:
            self._delay("reaction", step[0], picture - taken)

    def _delay(self, kind: str, name: str, delay: int) -> None:
        self._delays.setdefault((kind, name), array("d")).append(delay / 1e9)

    def _close(self) -> None:
        """Numbers that need all messages."""
        columns = {name: np.frombuffer(column, dtype=column.typecode) for name, column in self._columns.items()}
        for (kind, name), actor in self._actors.items():
            mine = np.flatnonzero(columns["actor"] == actor)
            info = self.infos.get(name) if kind != "global" else None
            period = info.period if info else None
            time, epoch, seq = (columns[one][mine] for one in ("time", "epoch", "seq"))
            _fill(self.traffic[kind, name], time, epoch, seq, period)
        for key, delays in self._delays.items():
            values = np.frombuffer(delays, dtype=np.float64)
            if abs(float(np.median(values))) < SAME_CLOCK:
                self.latency[key] = _latency(values)
        self._delays, self._came, self._infos_came, self._taken = {}, {}, {}, {}


def _by_a_clock(message: TrackMessage | LocalIntensity) -> bool:
    """Whether `sent` is of a clock: a centre that only replays a mission has none, and says the time of the step."""
    return not (isinstance(message, GlobalTracks) and message.sent == message.time)


def _remember(known: dict[Name, Value], name: Name, value: Value) -> None:
    """The newest so many; what has waited longest for what belongs to it is forgotten."""
    known[name] = value
    if len(known) > HELD:
        del known[next(iter(known))]


def _fill(traffic: Traffic, time: Times, epoch: NDArray[np.uint64], seq: Times, period: float | None) -> None:
    times = np.unique(time)
    steps = np.diff(times)
    traffic.messages, traffic.first, traffic.last = len(time), int(times[0]), int(times[-1])
    traffic.interval = float(np.median(steps)) / 1e9 if len(steps) else 0.0
    for run in np.unique(epoch):
        numbers = np.unique(seq[epoch == run])
        traffic.missing += int(numbers[-1]) - int(numbers[0]) + 1 - len(numbers)
        traffic.epochs += 1
    wide = np.flatnonzero(steps > SILENT * 1e9 * (period or traffic.interval)) if len(steps) else steps
    traffic.silent = len(wide)
    longest = wide[np.argsort(-steps[wide], kind="stable")][:MOST]
    traffic.silences = tuple(Silence(int(times[at]), int(times[at + 1])) for at in longest.tolist())


def _latency(delays: FloatArray) -> Latency:
    median, p95 = np.quantile(delays, (0.5, 0.95)).tolist()
    top = max(float(np.quantile(delays, 0.99)), float(delays.min()) + 1e-6)
    counts, edges = np.histogram(np.minimum(delays, top), bins=BINS)
    return Latency(
        len(delays), median, p95, float(delays.max()), tuple(counts.tolist()), tuple(float(edge) for edge in edges)
    )
