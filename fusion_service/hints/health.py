"""What a centre's status says of how all goes: a row a source, figures, alarms; as lines for people, data for scripts.

`status` prints the lines, `top` draws the rows; what counts as wrong is said here alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from fusion_service.hints.offsets import offset_doubts
from fusion_service.hints.times import span
from fusion_service.source_words import source_health, state_of
from schemas import GlobalTracks, Status

__all__ = ["STATES", "Health", "Row", "health_of", "linked_shares", "row_line"]

OLD = 3.5
"""Seconds after which a status should have been followed by another."""
RECENT = 60.0
"""Seconds for which a refusal counts as one of now."""
MENDED = 10.0
"""Seconds for which a source is taken without another refusal, after which it is well, and was wrong before."""
MOST_LINES = 200
STATES = {
    "gone": "its liveliness token is no more",
    "refused": "it sends, and nothing of it is taken",
    "silent": "it is there, but its newest tracks are stale",
    "unheard": "its token is there, but nothing came of it yet",
    "resting": "it has been silent for long, and costs nothing until it speaks",
    "muted": "an order, or the config, has all that it sends refused",
    "there": "it sends",
}
"""How a source can be, and what that means; the first is the most urgent."""
BENIGN = ("repeat", "muted")
"""Reasons of refusals in which nothing is wrong."""


class Row(NamedTuple):
    """A source. state: one of `STATES`; trust: as supervision says, or ""; rate: messages a second; period: declared,
    s; latency, clock: s; share: of its tracks that others have too; refused: messages and tracks, since the start;
    gaps: lost ones; reason: of its last refusal, where that was lately; faults: what is wrong, a sentence each; more:
    what else is known of it; ignored: its faults do not count."""

    name: str
    state: str
    trust: str
    rate: float | None
    period: float | None
    latency: float | None
    clock: float | None
    tracks: int | None
    share: float | None
    refused: int
    gaps: int
    reason: str
    faults: tuple[str, ...]
    more: tuple[str, ...]
    ignored: bool

    @property
    def urgency(self) -> tuple[int, int, str]:
        """Those that are in trouble sort first, those that rest last."""
        troubled = bool(self.faults) and not self.ignored
        return (0 if troubled else 2 if self.state in ("resting", "muted") else 1), -len(self.faults), self.name


class Health(NamedTuple):
    """Of one centre: lines to be read, data to be processed, what is wrong, a sentence each; its sources, and how many
    more there are."""

    lines: list[str]
    data: dict[str, Any]
    wrong: list[str]
    rows: list[Row]
    beyond: int


def linked_shares(picture: GlobalTracks) -> dict[str, int]:
    """How many tracks of each source are in global tracks that another source is in too."""
    counts = picture.contributor_counts.astype(np.intp)
    owner = np.repeat(np.arange(len(counts)), counts)
    source = picture.contributor_source.astype(np.intp)
    pairs = np.unique(np.stack([owner, source], axis=1), axis=0) if len(owner) else np.zeros((0, 2), dtype=np.intp)
    several = np.bincount(pairs[:, 0], minlength=len(counts)) > 1
    shared = Counter(source[several[owner]].tolist()) if len(owner) else Counter[int]()
    return {name: shared[k] for k, name in enumerate(picture.sources)}


def health_of(status: Status, picture: GlobalTracks | None, now: int, ignored: Sequence[str] = ()) -> Health:
    """Of a centre by its newest status and picture, at `now`, ns. ignored: patterns of names of sources whose faults
    do not count."""
    shared = linked_shares(picture) if picture is not None else {}
    rows, beyond = [], 0
    for name, said in sorted(status.sources.items()):
        if name == "*":
            more = said.get("more")
            beyond = more if isinstance(more, int) else 0
        else:
            rows.append(_row(name, said, shared.get(name), now, any(fnmatchcase(name, one) for one in ignored)))
    apart = offset_doubts(picture) if picture is not None else []
    apart = [one for one in apart if not any(row.ignored and row.name in one for row in rows)]
    wrong = _process(status, now)
    wrong += [f"{row.name}: {fault}" for row in rows if not row.ignored for fault in row.faults]
    wrong += apart
    lines = [line for row in rows for line in _lines(row)] + ([f"  and {beyond} sources more"] if beyond else [])
    said = status.sources
    data = {
        "centre": status.source,
        "age": (now - status.sent) / 1e9,
        "uptime": status.uptime,
        "step": status.step,
        "tracks": status.tracks,
        "rates": status.rates,
        "queue": status.queue,
        "step_time": status.step_time,
        "refused": status.refused,
        "dropped": status.dropped,
        "notes": list(status.notes or ()),
        "standby": status.standby,
        "sources": {row.name: {**said[row.name], **_data(row)} for row in rows},
        "wrong": wrong,
    }
    return Health([*_head(status), *(f"  {one}" for one in apart), *lines[:MOST_LINES]], data, wrong, rows, beyond)


def _head(status: Status) -> list[str]:
    """What there is to say of the centre itself."""
    tracks = ", ".join(f"{count} {name}" for name, count in status.tracks.items()) or "none yet"
    queue, steps = status.queue, status.step_time
    head = [
        f"centre {status.source}: up {span(status.uptime)}, step {status.step}, tracks: {tracks}",
        f"  steps: {steps.get('mean', 0.0) * 1e3:.1f} ms on average, {steps.get('max', 0.0) * 1e3:.1f} ms at most, "
        f"{steps.get('failed', 0.0):.0f} failed, {steps.get('skipped', 0.0):.0f} skipped"
        + (f"; the picture is {span(steps['latency'])} old when it goes out" if "latency" in steps else ""),
        f"  queue: {queue.get('waiting', 0)} of {queue.get('capacity', 0)} waiting, {queue.get('high_water', 0)} at "
        f"most; {status.rates.get('messages', 0.0):.1f} messages a second; refused {sum(status.refused.values())}, "
        f"dropped {sum(status.dropped.values())}",
    ]
    standby = status.standby or {}
    if standby.get("there"):
        head.append(f"  {standby['there']} stand by, {standby.get('ready', 0)} ready")
    return head + [f"  note: {note}" for note in status.notes or ()]


def _process(status: Status, now: int) -> list[str]:
    """What is wrong with the process of the centre."""
    steps, age = status.step_time, (now - status.sent) / 1e9
    found = []
    if age > OLD:
        found.append(f"the newest status of {status.source} is {span(age)} old: is the service held up?")
    if age < -OLD:
        found.append(f"the clock of {status.source} is {span(age)} ahead of this computer's")
    if "overload" in steps:
        found.append(f"{status.source} is behind for {span(steps['overload'])}: more comes than it can work off")
    if "busy" in steps:
        found.append(f"the loop of {status.source} is at one thing for {span(steps['busy'])}")
    found += [
        f"{status.source}: {steps[name]:.0f} {words}"
        for name, words in (
            ("failed", "steps have failed: see its log"),
            ("failed_turns", "turns of its loop have failed: see its log"),
            ("unsaved", "checkpoints could not be saved: is the disk full?"),
        )
        if steps.get(name)
    ]
    return found


def _row(name: str, said: Mapping[str, Any], shared: int | None, now: int, ignored: bool) -> Row:
    tracks = said.get("tracks")
    tracks = tracks if isinstance(tracks, int) and not isinstance(tracks, bool) else None
    last, refused = said.get("last_refusal"), said.get("refused")
    recent = isinstance(last, Mapping) and isinstance(when := last.get("time"), int) and (now - when) / 1e9 < RECENT
    newest = last if recent and isinstance(last, Mapping) and not _mended(last) else {}
    state = _state(said, newest)
    faults = _faults(said, state, newest)
    counts = [one for one in refused.values() if isinstance(one, int)] if isinstance(refused, Mapping) else []
    return Row(
        name,
        state,
        state_of(said),
        _number(said, "rate"),
        _number(said, "declared_period"),
        _number(said, "latency"),
        _number(said, "clock"),
        tracks,
        min(shared / tracks, 1.0) if shared is not None and tracks else None,
        sum(counts) or (_count(last) if isinstance(last, Mapping) else 0),
        round(_number(said, "gaps") or 0),
        str(newest.get("reason", "")),
        tuple(faults),
        tuple(one for one in _more(said, state, now if recent else None) if not any(one in fault for fault in faults)),
        ignored,
    )


def _mended(last: Mapping[str, Any]) -> bool:
    """Whether a source has been well since its last refusal, for long enough to say so."""
    well, when = last.get("well"), last.get("time")
    return isinstance(well, int) and isinstance(when, int) and (well - when) / 1e9 >= MENDED


def _state(said: Mapping[str, Any], last: Mapping[str, Any]) -> str:
    """Which of `STATES` a source is in. last: its last refusal, if that was lately and it is not well since."""
    if said.get("alive") is False:
        return "gone"
    if said.get("muted") is True:
        return "muted"
    if said.get("alive") is True and not said.get("messages") and not said.get("last_refusal"):
        return "unheard"
    if last and (said.get("stale") or not said.get("messages")):
        return "refused"
    if said.get("resting") is True:
        return "resting"
    return "silent" if said.get("stale") and said.get("messages") else "there"


def _faults(said: Mapping[str, Any], state: str, last: Mapping[str, Any]) -> list[str]:
    """What is wrong with a source. last: its last refusal, if that was lately and it is not well since."""
    found = []
    if state == "gone":
        found.append("it is gone: its liveliness token is no more")
    if last and last.get("reason") not in BENIGN:
        found.append(f"refused ({last.get('reason')}, {_times(last)}): {last.get('said')}")
    if state == "silent" or (state == "resting" and said.get("messages")):
        found.append("it is silent: its newest tracks are stale" + "; it rests" * (state == "resting"))
    elif state == "unheard":
        found.append("its token is there, but no message of it came: on which keys does it publish?")
    doubts = said.get("doubts")
    found += [str(one) for one in doubts] if isinstance(doubts, (list, tuple)) else []
    note = said.get("note")
    found += [note] if isinstance(note, str) and note and said.get("unused") else []
    trust, alarms = state_of(said), said.get("alarms")
    if trust not in ("", "trusted"):
        found.append(f"it is not trusted ({trust}): {said.get('state_why', '')}")
    return [*found, *(str(one) for one in (alarms if isinstance(alarms, (list, tuple)) else ()))]


def _more(said: Mapping[str, Any], state: str, now: int | None) -> list[str]:
    """What else is known of a source that a person should read. now: ns, where its last refusal was lately."""
    last, lines = said.get("last_refusal"), []
    if isinstance(last, Mapping) and last.get("reason") in BENIGN:
        lines.append(f"refused ({last.get('reason')}, {_times(last)}): {last.get('said')}")
    elif now is not None and isinstance(last, Mapping) and _mended(last):
        before = f"refused until {span((now - last['time']) / 1e9)} ago ({last.get('reason')}, {_times(last)})"
        lines.append(f"well since; {before}: {last.get('said')}")
    return [*([STATES[state]] if state in ("resting", "muted") else []), *lines, *source_health(said)]


def _times(last: Mapping[str, Any]) -> str:
    count = _count(last)
    return "once" if count == 1 else f"{count} times"


def _count(last: Mapping[str, Any]) -> int:
    count = last.get("count")
    return count if isinstance(count, int) and not isinstance(count, bool) else 1


def _number(said: Mapping[str, Any], key: str) -> float | None:
    value = said.get(key)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        return None
    return float(value)


def _data(row: Row) -> dict[str, Any]:
    """What a row adds to what the status says of a source, for scripts."""
    return {"is": row.state, "linked_share": row.share, "wrong": list(row.faults), "ignored": row.ignored}


def _lines(row: Row) -> list[str]:
    """A source in lines: how it is, what is wrong with it, and what else there is to know."""
    ignored = " (ignored)" if row.ignored and row.faults else ""
    return [
        f"  {row_line(row)}{ignored}",
        *(f"      {fault}" for fault in row.faults if not row.ignored),
        *(f"      ({one})" for one in row.more),
    ]


def row_line(row: Row) -> str:
    """A source in a line."""

    def number(value: float | None, form: str, words: str) -> str:
        return "" if value is None else words.format(format(value, form))

    rate = number(row.rate, ".3g", "{} a second")
    period = number(row.period, ".3g", "of one every {} s")
    parts = [
        row.trust,
        f"{rate} {period}".strip() if rate else "",
        number(row.tracks, "d", "{} tracks"),
        number(row.share, ".0%", "{} shared with others"),
        "" if row.latency is None else f"latency {span(row.latency)}",
        number(row.clock, "+.2g", "clock {} s"),
        f"{row.refused} refused" if row.refused else "",
        f"{row.gaps} lost" if row.gaps else "",
    ]
    return f"{row.name:<16} {row.state:<8}" + ", ".join(part for part in parts if part)
