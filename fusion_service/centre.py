"""`FusionCentre`: the whole job with no clock, no thread, no socket.

Everything that changes a result enters by `handle`; `step(time)` takes what is queued with a time up to then,
predicts, links, fuses and returns the global tracks, a log that is enough to make the step again, and status.
Within a step inputs are sorted by (source, epoch, seq) before anything is computed, so the order of arrival
does not matter, and no operation's bits depend on the size of its batch: the same events give the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.checkpoint import pack_state, unpack_state
from fusion_service.config import CentreConfig, centre_config, config_hash
from fusion_service.fusing import fuse_all
from fusion_service.health import step_status
from fusion_service.intake import Event, Intake, Order, Refused, SourceFound, SourceLost
from fusion_service.journal import Journal, start_event
from fusion_service.lifecycle import Picture, empty_picture
from fusion_service.linking import Linker
from fusion_service.presence import existence_now
from fusion_service.publishing import Contributions, live_on, picture_message
from fusion_service.rows import Rows, predict_tracks, usable_rows, write_back
from schemas import GlobalTracks, Status, StepLog
from schemas import messages as words

__all__ = ["FusionCentre", "Order", "Refused", "SourceFound", "SourceLost", "StepResult"]

VERSION = metadata.version("track-fusion-centre")


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one step gives."""

    tracks: GlobalTracks
    log: StepLog
    status: Status


class FusionCentre:
    """Associates and fuses the tracks of many sources into one picture.

    config: a `CentreConfig`, or a dict of the same shape ({} gives the defaults; `ConfigError` says all that
    is wrong). checkpoint: what `checkpoint()` gave before. generation: the upper half of the ids given from
    now on; a new one for every start keeps ids from ever being used again (a checkpoint alone goes on in its
    own generation). epoch: start of this run, ns, for the header of what it publishes.
    """

    def __init__(
        self,
        config: CentreConfig | Mapping[str, Any],
        checkpoint: bytes | None = None,
        *,
        generation: int | None = None,
        epoch: int = 0,
    ) -> None:
        self.config = centre_config(config)
        self.config_hash = config_hash(self.config)
        self.epoch = epoch
        self._n = len(self.config.space)
        self._intake = Intake(self.config)
        self._picture = empty_picture(self._n)
        self._linker = Linker(self.config)
        self._step = 0
        self._published = 0
        self._time = -1
        self._journal = Journal(self.config.name, self.config_hash, VERSION)
        if checkpoint is not None:
            self._restore(checkpoint)
        if generation is not None:
            self._linker.next_id = (generation << 32) + 1
        self._journal.event(start_event(self.config, epoch, generation, checkpoint))

    @property
    def time(self) -> int:
        """Time of the newest step, ns; -1 before the first."""
        return self._time

    def handle(self, event: Event, received: int) -> None:
        """Queue a message or another event for the next step; `received` is when it came, ns. Never raises
        for what a message contains: it is checked, and refused with a reason, in the step."""
        self._intake.put(event, received)

    def step(self, time: int) -> StepResult:
        """Make the step at `time`, ns, which must be after the last. `ValueError` if it is not."""
        if time <= self._time:
            raise ValueError(f"a step at {time} is not after the last, at {self._time}")
        self._step += 1
        journal = self._journal
        orders = self._intake.admit(time, self._time, journal)
        self._obey(orders)
        self._time = time
        rows = usable_rows(self._intake, time, journal)
        names = self._intake.names()
        journal.name_sources(names)
        self._associate(rows, time)
        self._picture, influence = fuse_all(rows, self._predicted(time), time, self.config, journal)
        self._live(rows, time)
        write_back(rows, self._intake)
        tracks = self._publish(rows, influence)
        log = journal.write(self.epoch, self._published, self._step, time)
        self._published += 1
        status = step_status(self._intake, journal, log, self._numbers(), self.refusals())
        return StepResult(tracks, log, status)

    def refusals(self) -> dict[str, int]:
        """Refusals by reason since the start, those included that no step has told yet."""
        return dict(sorted((self._journal.refused + self._intake.waiting_refusals()).items()))

    def checkpoint(self) -> bytes:
        """The whole state but what is queued, as versioned MessagePack: a centre made from it goes on as this one."""
        return pack_state(
            self.config_hash,
            {
                "space": list(self.config.space),
                "step": self._step,
                "time": self._time,
                "next_id": self._linker.next_id,
                "agreeing": [[a, b, count] for (a, b), count in sorted(self._linker.agreeing.items())],
            },
            self._intake,
            self._picture,
        )

    def _restore(self, blob: bytes) -> None:
        state, picture = unpack_state(blob, self._intake, self.config.space)
        self._step, self._time, self._linker.next_id = state["step"], state["time"], state["next_id"]
        self._linker.agreeing = state["agreeing"]
        self._picture = picture

    def _obey(self, orders: list[Order]) -> None:
        doomed = [order.track for order in orders if order.what == "delete" and order.track is not None]
        doomed = [track for track in doomed if 0 < track < 2**64]
        if doomed:
            gone = np.isin(self._picture.id, np.array(doomed, dtype=np.uint64))
            for track in self._picture.id[gone].tolist():
                self._journal.end(track, "ordered", None)
            self._relink(dict.fromkeys(self._picture.id[gone].tolist(), 0))
            self._picture = self._picture.take(~gone)

    def _relink(self, new: dict[int, int]) -> None:
        """Change the links of all tables: {old global id: new one, or 0}."""
        if not new:
            return
        old = np.array(sorted(new), dtype=np.uint64)
        to = np.array([new[track] for track in old.tolist()], dtype=np.uint64)
        for source in self._intake.sources.values():
            link = source.tracks.link
            at = np.minimum(np.searchsorted(old, link), len(old) - 1)
            source.tracks = replace(source.tracks, link=np.where(old[at] == link, to[at], link))

    def _associate(self, rows: Rows, time: int) -> None:
        linker, journal = self._linker, self._journal
        linker.check(rows, journal)
        now = self._predicted(time)
        self._picture, agreements = linker.link(rows, self._picture, now, self._step, time, journal)
        merged = linker.merge(rows, agreements, self._step, journal)
        self._relink(merged)
        if merged:
            gone = np.isin(self._picture.id, np.array(list(merged), dtype=np.uint64))
            self._picture = self._picture.take(~gone)

    def _predicted(self, time: int) -> Picture:
        picture, config = self._picture, self.config
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        return predict_tracks(picture, config.motion, config.space, config.space, dt)

    def _live(self, rows: Rows, time: int) -> None:
        tracks, picture, linked = rows.tracks, self._picture, rows.linked()
        at = picture.find(tracks.link[linked])
        support = np.bincount(at, minlength=len(picture.id))
        updated = picture.updated.copy()
        np.maximum.at(updated, at, tracks.updated[linked])
        newest = np.full(len(picture.id), -1, dtype=np.int64)
        np.maximum.at(newest, at, tracks.time[linked])
        fresh = newest > picture.seen
        existence = existence_now(rows, picture, fresh, self._intake, time)
        seen = np.maximum(picture.seen, newest)
        picture = replace(picture, updated=updated, existence=existence, seen=seen)
        picture, ended = live_on(picture, time, support, fresh, self.config, self._journal)
        self._relink(dict.fromkeys(picture.id[ended].tolist(), 0))
        self._picture = picture.take(~ended)

    def _publish(self, rows: Rows, influence: NDArray[np.float64]) -> GlobalTracks:
        picture, tracks, linked = self._picture, rows.tracks, rows.linked()
        linked = linked[np.argsort(tracks.link[linked], kind="stable")]
        counts = np.bincount(picture.find(tracks.link[linked]), minlength=len(picture.id))
        contributions = Contributions(
            counts, rows.source[linked], rows.epoch[linked], tracks.id[linked], influence[linked]
        )
        return picture_message(
            picture,
            self._intake,
            self._journal,
            contributions,
            epoch=self.epoch,
            seq=self._published,
            step=self._step,
            time=self._time,
            rule=self.config.rule,
        )

    def _numbers(self) -> dict[str, int]:
        kinds = Counter(self._picture.status.tolist())
        return {name: kinds.get(code, 0) for code, name in enumerate(words.STATUSES)}
