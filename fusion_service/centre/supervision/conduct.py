"""Spoofed or stuck sources: alarms with their evidence.

    stuck           tracks repeat to the bit (see `moves`), new versions with new measurements, though they claim a
                    speed that would have taken them further than three sigma; or all tracks of a source do, two at
                    least, from one moment on, each of which was new every time before. One alone may be of an object
                    that stops, seen by a sensor that rounds; a ship at anchor says what it is, and is not counted
    jump            the tracks of a source jump together, or a track that says what it is jumps, or one again and again.
                    Of those that do not say what they are only such as were there for a while: numbers are used again
    unseen          a track that only this source has, though two others at least cover the place and have missed it
                    beyond doubt (their scans without it: 10^-6 and less)
    identity-twice  the source has one identity in two places
    two-runs        two runs of one source speak at once: every other message is older than the last
    older-run       the same, of which one says that it began earlier: what it sends is refused (old-epoch)

Alarms change no result by themselves: they stand in log and status. Only a source that is `stuck` as a whole is out,
and one that `jumped` as a whole is registered anew (see `supervisor`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Ints, from_bytes, to_bytes
from fusion_service.centre.existence import Entries
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.sources import Source
from fusion_service.centre.stated_registration import shift_of
from fusion_service.centre.supervision.crowd import COLUMNS, Seen, Told, counted, seen_together
from fusion_service.centre.supervision.moves import Moves, Snapshot, moves
from fusion_service.centre.supervision.warnings import HOLD, Warnings
from fusion_service.centre.words import NONE

__all__ = ["Conduct"]

FEW = 5
"""New versions in a row that are as before, to the bit."""
VARIED = 10
"""New versions of a track in a row that were not, for it to be one that varies."""
AGAIN = 3
"""Jumps of one track, or new data of a pair with one identity, that raise an alarm."""
TOGETHER = 0.8
"""Share of the tracks of a source that jump when the source does."""
FAR = 50.0
"""d2 of two places from which one identity is twice."""
DOUBT = float(np.log(1e6))
SEEN = 20.0
"""Seconds for which a source has reported what nobody else sees: what comes of clutter is gone by then."""
MOST_TWICE = 50
REFUSED = "older-run"
NOBODY: Bools = np.zeros(0, dtype=np.bool_)


@dataclass(slots=True)
class _Record:
    """Of one source. columns, each (T,) by id: repeats in a row, versions that varied, time of the first version of
    those that repeat, jumps within the last seconds, time of the last of them. twice: new data of identities in two
    places. old: messages of an older run, and reordered ones, in the last seconds, of how many."""

    columns: dict[str, NDArray[Any]] = field(
        default_factory=lambda: {name: np.zeros(0, kind) for name, kind in COLUMNS.items()}
    )
    twice: dict[str, int] = field(default_factory=dict)
    old: float = 0.0
    reordered: float = 0.0
    messages: float = 0.0
    counted: list[int] = field(default_factory=lambda: [0, 0])
    time: int = -1


class Conduct:
    """How every source behaves."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._records: dict[str, _Record] = {}
        self._before: dict[str, Snapshot] = {}
        self._refused: dict[str, int] = {}
        self._alone: dict[int, int] = {}
        self._warnings = Warnings()
        self._places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]

    def observe(self, rows: Rows, names: tuple[str, ...], time: int, journal: Journal) -> None:
        """Look at what came in with the step at `time`, ns."""
        if self._intake.config.supervision == "off":
            return
        self._records = {name: self._records.get(name, _Record()) for name in names}
        self._refused = {name: self._refused[name] for name in names if name in self._refused}
        came = {name: told for name in names if (told := self._told(name)) is not None}
        hold = int(HOLD * 1e9)
        seen = seen_together([*came.values()], self._intake.frame, self._intake.config, time, hold, VARIED, FEW)
        faded: dict[float, float] = {}
        for name in names:
            source, record = self._intake.sources[name], self._records[name]
            if name in came:
                one = seen.get(name) or self._alone_seen(came[name], time)
                record.columns = one.counts
                if one.moves is not None:
                    self._stuck_and_jumps(source, one, time, journal)
                if one.moves is not None and one.named:
                    self._twice(source, record, one.moves, time, journal)
                else:
                    record.twice = {}
            self._runs(source, record, time, journal, faded)
        self._snapshot()

    def _told(self, name: str) -> Told | None:
        """A source that told of its tracks in this step, and has before."""
        source, before = self._intake.sources[name], self._before.get(name)
        if not source.arrived or before is None or before.tracks is source.tracks:
            return None
        shift = shift_of(self._intake, source)
        some = [] if shift is None else [float(shift[k, k]) for k in self._places]
        sigma = float(np.sqrt(max(some))) if some else 0.0
        return Told(source, before, self._records[name].columns, sigma)

    def _alone_seen(self, told: Told, time: int) -> Seen:
        """What a source did that is not as it was."""
        source, old = told.source, told.counts
        tracks = source.tracks
        if not len(tracks.id) and not len(old["id"]):
            return Seen(None, old, NOBODY, False)
        found = moves(told.before, source, self._intake.frame, told.shift, self._intake.config)
        new = {name: np.zeros(len(tracks.id), kind) for name, kind in COLUMNS.items()}
        new["id"] = tracks.id
        if np.array_equal(old["id"], tracks.id):
            new = {name: column.copy() for name, column in old.items()}
        elif len(old["id"]):
            place = np.minimum(np.searchsorted(old["id"], tracks.id), len(old["id"]) - 1)
            known = old["id"][place] == tracks.id
            for name in COLUMNS:
                new[name][known] = old[name][place[known]]
        first = told.before.tracks.time[found.was]
        jumped = counted(new, found.at, found, first, tracks.identity, time, int(HOLD * 1e9), VARIED)
        return Seen(found, new, jumped, bool((tracks.identity != NONE).any()))

    def _snapshot(self) -> None:
        self._before = {name: Snapshot.of(one, self._intake.frame) for name, one in self._intake.sources.items()}

    def _stuck_and_jumps(self, source: Source, seen: Seen, time: int, journal: Journal) -> None:
        found, new = seen.moves, seen.counts
        assert found is not None
        if (new["repeats"][found.at] >= FEW).any():
            self._stuck(source, new, found, time, journal)
        if seen.jumped.any():
            self._jumped(source, new, found._replace(jumped=seen.jumped), time, journal)

    def _stuck(
        self, source: Source, new: dict[str, NDArray[Any]], found: Moves, time: int, journal: Journal
    ) -> None:  # fmt: skip
        tracks, at = source.tracks, found.at
        repeats, seconds = new["repeats"][at], (tracks.time[at] - new["since"][at]) / 1e9
        travelled = found.speed * seconds
        claims = (repeats >= FEW) & (travelled > 3.0 * found.sigma)
        if claims.any():
            worst = int(np.flatnonzero(claims)[travelled[claims].argmax()])
            numbers = {"count": int(claims.sum()), "among": len(at), "id": int(tracks.id[at[worst]]),
                       "seconds": float(seconds[worst]), "speed": float(found.speed[worst])}  # fmt: skip
            sentence = (
                f"{numbers['count']} of its {len(at)} tracks repeat to the bit (track {numbers['id']} for "
                f"{seconds[worst]:.0f} s at {found.speed[worst]:.1f} m/s): is the feed frozen?"
            )
            self._warnings.raised((source.name, "stuck", ""), time, numbers, sentence, journal)
            return
        counted = at[tracks.identity[at] == NONE]
        frozen = (new["varied"][counted] >= VARIED) & (new["since"][counted] == new["since"][counted[:1]])
        if len(counted) > 1 and frozen.all() and (repeats >= FEW).all():
            numbers = {"count": len(at), "among": len(at), "seconds": float(seconds.max())}
            sentence = (
                f"all its {len(at)} tracks repeat to the bit for {seconds.max():.0f} s, and varied before: "
                f"is the feed frozen?"
            )
            self._warnings.raised((source.name, "stuck", ""), time, numbers, sentence, journal)

    def _jumped(
        self, source: Source, new: dict[str, NDArray[Any]], found: Moves, time: int, journal: Journal
    ) -> None:  # fmt: skip
        tracks, some = source.tracks, np.flatnonzero(found.jumped)
        count, whole = len(some), len(found.at)
        away = float(np.sort(found.away[some])[count // 2])
        if count > 1 and count >= TOGETHER * whole:
            numbers: dict[str, Any] = {"count": count, "among": whole, "metres": away}
            sentence = f"{count} of its {whole} tracks jumped at once, by {away:.0f} m: its place, clock or numbers?"
            self._warnings.raised((source.name, "jump", ""), time, numbers, sentence, journal)
            return
        named = tracks.identity[found.at[some]] != NONE
        often = new["jumps"][found.at[some]] >= AGAIN
        for k in some[named | often][:MOST_TWICE].tolist():
            number, metres = int(tracks.id[found.at[k]]), float(found.away[k])
            sentence = f"its track {number} jumped by {metres:.0f} m, further than anything moves"
            numbers = {"id": number, "metres": metres, "jumps": int(new["jumps"][found.at[k]])}
            self._warnings.raised((source.name, "jump", str(number)), time, numbers, sentence, journal)

    def _twice(self, source: Source, record: _Record, found: Moves, time: int, journal: Journal) -> None:
        """One identity in two tracks of one source, neither overdue, and one with new data."""
        tracks = source.tracks
        recent = source.last - tracks.time <= tracks.interval + tracks.interval // 2
        named = np.flatnonzero((tracks.identity != NONE) & recent)
        code = tracks.identity[named]
        order = np.argsort(code, kind="stable")
        same = np.flatnonzero(code[order][1:] == code[order][:-1])[:MOST_TWICE]
        seen: dict[str, int] = {}
        if len(same):
            one, two = named[order][same], named[order][same + 1]
            places = [source.space.index(axis) for axis in ("x", "y", "z") if axis in source.space]
            some = np.ix_(places, places)
            spread = tracks.covariance[some][..., one] + tracks.covariance[some][..., two]
            offset = tracks.mean[places][:, one] - tracks.mean[places][:, two]
            far = linalg.quadratic(spread, offset)
            metres = np.sqrt((offset * offset).sum(axis=0))
            texts = self._intake.said.identity.said(tracks.identity[one])
            for k in np.flatnonzero(far > FAR).tolist():
                text = texts[k] or ""
                new = bool(np.isin([one[k], two[k]], found.at).any())
                seen[text] = record.twice.get(text, 0) + new
                if new and seen[text] >= AGAIN:
                    ids = [int(tracks.id[one[k]]), int(tracks.id[two[k]])]
                    numbers = {"identity": text, "ids": ids, "metres": float(metres[k])}
                    sentence = f"it has {text} twice: its tracks {ids[0]} and {ids[1]}, {metres[k]:.0f} m apart"
                    self._warnings.raised((source.name, "identity-twice", text), time, numbers, sentence, journal)
        record.twice = seen

    def _runs(self, source: Source, record: _Record, time: int, journal: Journal, faded: dict[float, float]) -> None:
        """Whether two runs of one source speak at once: counts of the last seconds, forgotten with time constant
        `HOLD`; faded: what is left of them by the seconds that have gone."""
        known = journal.refused_of.get(source.name)
        refused = 0 if known is None else known["old-epoch"]
        more = refused - self._refused.get(source.name, refused)
        self._refused[source.name] = refused
        gone = max(time - record.time, 0) / 1e9 if record.time >= 0 else 0.0
        if gone not in faded:
            faded[gone] = float(np.exp(-gone / HOLD))
        stays = faded[gone]
        messages, reordered = (
            max(now - was, 0) for now, was in zip((source.messages, source.reordered), record.counted, strict=True)
        )
        record.counted, record.time = [source.messages, source.reordered], time
        record.old = record.old * stays + more
        record.reordered, record.messages = record.reordered * stays + reordered, record.messages * stays + messages
        if more and record.old >= AGAIN and source.last >= 0:
            sentence = "an older run of it goes on beside the newer one: do two clients have its name?"
            numbers = {"refused": round(record.old, 3)}
            self._warnings.raised((source.name, REFUSED, ""), time, numbers, sentence, journal)
        elif reordered and record.reordered >= FEW and record.reordered >= 0.4 * record.messages:
            sentence = "every other message of it is older than the last: do two clients have its name?"
            numbers = {"reordered": round(record.reordered, 3), "messages": round(record.messages, 3)}
            self._warnings.raised((source.name, "two-runs", ""), time, numbers, sentence, journal)

    def judge_existence(self, rows: Rows, picture: Picture, entries: Entries, time: int, journal: Journal) -> None:
        """After existence was brought to the step at `time`, ns: tracks of one source that others deny; and alarms
        that are over."""
        if self._intake.config.supervision == "off":
            return
        for at, name, doubt, others in self._denied(rows, picture, entries):
            track = int(picture.id[at])
            numbers = {"track": track, "evidence": round(doubt, 3), "others": others}
            begun = self._alone.get(track, time)
            if time - begun >= SEEN * 1e9:
                sentence = f"only it has track {track}, which {others} others should see and do not"
                self._warnings.raised((name, "unseen", str(track)), time, numbers, sentence, journal)
        self._warnings.settle(time, journal)

    def _denied(self, rows: Rows, picture: Picture, entries: Entries) -> list[tuple[int, str, float, int]]:
        """Global tracks (their place) of one source alone, that other sources have missed: how surely, and how many
        of these there are."""
        if len(entries.by_source) < 2:
            self._alone = {}
            return []
        names = self._intake.names()
        inside = rows.linked()
        count = len(picture.id)
        at = picture.find(rows.tracks.link[inside])
        low, high = np.full(count, len(names)), np.full(count, -1)
        np.minimum.at(low, at, rows.source[inside])
        np.maximum.at(high, at, rows.source[inside])
        alone = (low == high) & (high >= 0)
        if not alone.any():
            self._alone = {}
            return []
        total, others = np.zeros(count), np.zeros(count, dtype=np.intp)
        for number, name in enumerate(names):
            if name in entries.by_source:
                since, missed = entries.of(name, picture)
                other = (low != number) & (since >= 0)
                total = total + np.where(other, missed, 0.0)
                others += other & (missed < 0)
        sure: Ints = np.flatnonzero(alone & (others > 1) & (total <= -DOUBT))
        born = dict(zip(picture.id[sure].tolist(), picture.born[sure].tolist(), strict=True))
        self._alone = {track: min(self._alone.get(track, time), time) for track, time in born.items()}
        return [(int(k), names[int(low[k])], float(total[k]), int(others[k])) for k in sure.tolist()]

    def jumped(self, name: str, time: int) -> bool:
        """Whether all its tracks jumped in the step at `time`, ns, and did not just before."""
        return self._warnings.begun((name, "jump", "")) == time

    def stuck(self, name: str) -> str:
        """What an alarm says of a source that is stuck as a whole; "" where none stands."""
        return self._warnings.sentence((name, "stuck", ""))

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        return {"alarms": self._warnings.of(name)}

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing was seen later."""
        self._warnings.rebase(time)
        for record in self._records.values():
            record.time = min(record.time, time)
            for name in ("since", "last"):
                record.columns[name] = np.minimum(record.columns[name], time)
        self._alone = {track: min(since, time) for track, since in self._alone.items()}
        self._snapshot()

    def packed(self) -> dict[str, Any]:
        """As plain values. What the tables of sources hold is in the checkpoint already."""
        records = {
            name: [
                [to_bytes(one.columns[column]) for column in COLUMNS], one.twice, one.old, one.reordered, one.messages,
                one.counted, one.time,
            ]
            for name, one in sorted(self._records.items())
        }  # fmt: skip
        return {"records": records, "alone": sorted(self._alone.items()), "warnings": self._warnings.packed()}

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave."""
        for name, (columns, *rest) in packed.get("records", {}).items():
            read = (from_bytes(one, np.zeros(0, kind)) for one, kind in zip(columns, COLUMNS.values(), strict=True))
            self._records[str(name)] = _Record(dict(zip(COLUMNS, read, strict=True)), *rest)
        self._refused = dict.fromkeys(self._records, 0)
        self._alone = {int(track): int(since) for track, since in packed.get("alone", [])}
        self._warnings.restore(packed.get("warnings", []))
        self._snapshot()
