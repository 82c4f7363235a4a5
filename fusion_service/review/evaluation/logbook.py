"""A mission's messages, once through: what they say without any truth, and the order of time to read them again.

* A message's place is (time, kind, source, epoch, seq, arrival). `Logbook.tracks` gives tracks in this order; of a
  recording it holds back only what came before its turn, as bytes.
* What came of each source and when: `traffic`, `latency`; what each centre did: `account`.
"""

from __future__ import annotations

import heapq
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from fusion_service.geodesy import FrameError, transform
from fusion_service.labels import Labels
from fusion_service.review.evaluation.account import Account
from fusion_service.review.evaluation.latency import Delays, Latency
from fusion_service.review.evaluation.misses import PlatformPath
from fusion_service.review.evaluation.traffic import Traffic
from fusion_service.review.snapshots import Times, TrackMessage
from schemas import (
    UNKNOWN_SIGMA,
    Frame,
    GlobalTracks,
    Local,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    SensorInfo,
    Status,
    StepLog,
    Truth,
    decode,
)

__all__ = ["Logbook"]


NO_FRAME = Local("none")
"""Of a centre's pictures before it knows a frame."""
AROUND = 3600 * 10**9
"""ns."""
SHOWING_EVERY = 8
"""Messages between calls of `progress`."""


class Logbook:
    """One mission. `Logbook(messages)` of what is in memory, `Logbook.read(path)` of a recording.

    truths; infos: newest of each source; accounts: by centre; traffic: by ("local", "intensity" or "global", name);
    latency: by (kind, name); bad: messages that do not decode, by reason; counts: messages by type; flat: centres
    with a track whose height nobody told; labels: of global tracks, as recordings show them; platforms: by source;
    inputs: a digest of what the sources sent, in any order.
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
        self.flat: set[str] = set()
        self.inputs = 0
        self.labels = Labels()
        self.platforms: dict[str, PlatformPath] = {}
        self.received: tuple[int, int] | None = None
        self.path: Path | None = None
        self._spaces: dict[str, set[tuple[tuple[str, ...], Frame]]] = {}
        self._actors: dict[tuple[str, str], int] = {}
        self._columns = {
            name: array("Q" if name in ("epoch", "seq") else "q") for name in ("actor", "time", "epoch", "seq")
        }
        self._columns["arrival"] = array("q")
        self._spreads: dict[str, array[float]] = {"local": array("d"), "global": array("d")}
        self._delays = Delays()
        self._tracks: dict[int, TrackMessage] = {}
        for arrival, message in enumerate(messages):
            self._note(message, arrival, None)
            if isinstance(message, TrackMessage):
                self._tracks[arrival] = message
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
            yield from (self._tracks[arrival] for arrival in order.tolist())
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
        """Mission time of the first and the last tracks or truth, ns; of a source's, where there is a centre or truth,
        those within `AROUND` of theirs: one wrong clock does not make a mission begin in 1970."""
        sure = [truth.time for truth in self.truths]
        for (kind, _), one in self.traffic.items():
            sure += [one.first, one.last] if kind == "global" else []
        times = np.frombuffer(self._columns["time"], dtype=np.int64)
        if sure:
            times = times[(times >= min(sure) - AROUND) & (times <= max(sure) + AROUND)]
        ends = [*sure, *([int(times.min()), int(times.max())] if len(times) else [])]
        return (min(ends), max(ends)) if ends else None

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
            self._delays.info(message, received)
        elif isinstance(message, LocalIntensity):
            self._note_traffic("intensity", message, len(message.weights), arrival, received)
        elif isinstance(message, LocalTracks | GlobalTracks):
            self._note_tracks(message, arrival, received)
        elif isinstance(message, StepLog):
            self._account(name).log(message)
            if received is not None:
                self._delays.log(message)
        elif isinstance(message, Status):
            account = self._account(name)
            known_status = account.status or message
            account.sources.status(message)
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
        self._delays.densities(message, received)
        if not isinstance(message, GlobalTracks):
            self.inputs = (self.inputs + crc32(message.means.tobytes(), message.time % 2**32)) % 2**64

    def _note_tracks(self, message: TrackMessage, arrival: int, received: int | None) -> None:
        kind, name = "local" if isinstance(message, LocalTracks) else "global", message.source
        self._note_traffic(kind, message, len(message.ids), arrival, received)
        at = [message.space.index(axis) for axis in "xyz" if axis in message.space]
        with np.errstate(all="ignore"):
            variance = message.covariances[:, at, at]
            told = variance < [UNKNOWN_SIGMA.get(message.space[k], np.inf) ** 2 for k in at]
            spread = np.sqrt(np.where(told, variance, 0.0).sum(axis=1) / told.sum(axis=1))
        if len(spread) and np.isfinite(typical := float(np.median(spread))):
            self._spreads[kind].append(typical)
        if isinstance(message, GlobalTracks):
            self._account(name).picture(message)
            self.labels.see(message)
            if not told.all():
                self.flat.add(name)
            first = self.first_pictures.setdefault(name, message)
            if _first(message) < _first(first):
                self.first_pictures[name] = message
        else:
            self._spaces.setdefault(name, set()).add((message.space, message.frame))
            if message.platform is not None:
                path = self.platforms.setdefault(name, PlatformPath([], []))
                path.times.append(message.time)
                path.places.append((message.platform, message.frame))

    def _account(self, centre: str) -> Account:
        return self.accounts.setdefault(centre, Account())

    def _close(self) -> None:
        """Numbers that need all messages."""
        columns = {name: np.frombuffer(column, dtype=column.typecode) for name, column in self._columns.items()}
        for (kind, name), actor in self._actors.items():
            mine = np.flatnonzero(columns["actor"] == actor)
            info = self.infos.get(name) if kind != "global" else None
            period = info.period if info else None
            time, epoch, seq = (columns[one][mine] for one in ("time", "epoch", "seq"))
            self.traffic[kind, name].count(time, epoch, seq, period)
        for name, path in self.platforms.items():
            order = sorted(range(len(path.times)), key=path.times.__getitem__)
            self.platforms[name] = PlatformPath([path.times[k] for k in order], [path.places[k] for k in order])
        self.latency = self._delays.result()
        self._delays = Delays()


def _first(picture: GlobalTracks) -> tuple[bool, int, int]:
    """Sorting key of pictures, those that name no frame last: what a centre says before it knows one."""
    return picture.frame == NO_FRAME and not len(picture.ids), picture.time, picture.epoch
