"""What a centre's status says of how all goes, as lines for people, data for scripts, and a list of what is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fusion_service.hints.offsets import offset_doubts
from fusion_service.hints.times import span
from fusion_service.source_words import source_health, state_of
from schemas import GlobalTracks, Status

__all__ = ["Health", "health_of", "linked_shares"]

OLD = 3.5
"""Seconds after which a status should have been followed by another."""
RECENT = 60.0
"""Seconds for which a refusal counts as one of now."""
MOST_LINES = 200


class Health(NamedTuple):
    """Of one centre: lines to be read, data to be processed, and what is wrong, a sentence each."""

    lines: list[str]
    data: dict[str, Any]
    wrong: list[str]


def linked_shares(picture: GlobalTracks) -> dict[str, int]:
    """How many tracks of each source are in global tracks that another source is in too."""
    counts = picture.contributor_counts.astype(np.intp)
    owner = np.repeat(np.arange(len(counts)), counts)
    source = picture.contributor_source.astype(np.intp)
    pairs = np.unique(np.stack([owner, source], axis=1), axis=0) if len(owner) else np.zeros((0, 2), dtype=np.intp)
    several = np.bincount(pairs[:, 0], minlength=len(counts)) > 1
    shared = Counter(source[several[owner]].tolist()) if len(owner) else Counter[int]()
    return {name: shared[k] for k, name in enumerate(picture.sources)}


def health_of(status: Status, picture: GlobalTracks | None, now: int) -> Health:
    """Of a centre by its newest status and picture, at `now`, ns."""
    wrong = _process(status, now)
    shared = linked_shares(picture) if picture is not None else {}
    sources: dict[str, dict[str, Any]] = {}
    lines = []
    for name, said in sorted(status.sources.items()):
        if name == "*":
            lines.append(f"  and {said.get('more')} sources more")
            continue
        faults = _faults(said, now)
        wrong += [f"{name}: {fault}" for fault in faults]
        sources[name] = _data(said, shared.get(name)) | {"wrong": faults}
        lines.append(_line(name, sources[name]))
        lines += [f"      {fault}" for fault in faults]
        lines += [f"      ({one})" for one in source_health(said) if not any(one in fault for fault in faults)]
    apart = offset_doubts(picture) if picture is not None else []
    wrong += apart
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
    head += [f"  note: {note}" for note in status.notes or ()]
    head += [f"  {one}" for one in apart]
    data = {
        "centre": status.source,
        "age": (now - status.sent) / 1e9,
        "uptime": status.uptime,
        "step": status.step,
        "tracks": status.tracks,
        "rates": status.rates,
        "queue": queue,
        "step_time": steps,
        "refused": status.refused,
        "dropped": status.dropped,
        "notes": list(status.notes or ()),
        "standby": status.standby,
        "sources": sources,
        "wrong": wrong,
    }
    return Health([*head, *lines[:MOST_LINES]], data, wrong)


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


def _faults(said: Mapping[str, Any], now: int) -> list[str]:
    """What is wrong with a source."""
    found = []
    if said.get("alive") is False:
        found.append("it is gone: its liveliness token is no more")
    elif said.get("stale") is True and said.get("messages"):
        found.append("it is silent: its newest tracks are stale")
    last = said.get("last_refusal")
    if isinstance(last, Mapping) and last.get("reason") not in ("repeat", "muted"):
        when = last.get("time")
        if isinstance(when, int) and (now - when) / 1e9 < RECENT:
            found.append(f"refused ({last.get('reason')}, {last.get('count')} times): {last.get('said')}")
    doubts = said.get("doubts")
    found += [str(one) for one in doubts] if isinstance(doubts, (list, tuple)) else []
    note = said.get("note")
    found += [note] if isinstance(note, str) and note and said.get("unused") else []
    state, alarms = state_of(said), said.get("alarms")
    if state not in ("", "trusted"):
        found.append(f"it is not trusted ({state}): {said.get('state_why', '')}")
    return [*found, *(str(one) for one in (alarms if isinstance(alarms, (list, tuple)) else ()))]


def _data(said: Mapping[str, Any], shared: int | None) -> dict[str, Any]:
    """A source for scripts: what the status says, and how many of its tracks others share."""
    tracks = said.get("tracks")
    share = shared / tracks if shared is not None and isinstance(tracks, int) and tracks else None
    return {**said, "linked_share": None if share is None else min(share, 1.0)}


def _line(name: str, said: Mapping[str, Any]) -> str:
    """A source in a line."""

    def number(key: str, form: str, words: str) -> str:
        value = said.get(key)
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
        return words.format(format(value, form)) if good else ""

    state = "gone" if said.get("alive") is False else "silent" if said.get("stale") else "there"
    rate = number("rate", ".3g", "{} a second")
    declared = number("declared_period", ".3g", "of one every {} s")
    parts = [
        str(said.get("state") or ""),
        f"{rate} {declared}".strip() if rate else "",
        number("tracks", "d", "{} tracks"),
        number("linked_share", ".0%", "{} shared with others"),
        number("latency", ".3g", "latency {} s"),
        number("clock", "+.2g", "clock {} s"),
        number("gaps", "d", "{} lost"),
    ]
    return f"  {name:<16} {state:<7}" + ", ".join(part for part in parts if part and part != "0 lost")
