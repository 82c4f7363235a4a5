"""A small recording of one global track: it, the local tracks that were part of it, and the true object near it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from fusion_service.densities import moments
from fusion_service.recording import Recorder, read
from fusion_service.recording.parts import unused
from fusion_service.recording.scoring import scoring_of
from fusion_service.recording.survey import key_of
from fusion_service.review.explain.mission import RecordedMission
from schemas import GlobalTracks, LocalTracks, Message, MessageError, StepLog, Truth, decode, encode

__all__ = ["write_view"]

NEAR = 0.1
"""Part of its steps in which a true object must be the nearest one to be shown."""
TICK = 2000
"""Messages that are written at once."""


def write_view(mission: RecordedMission, out: str | Path, stop: Event | None = None) -> int:
    """Write the track of `mission.story` alone into the recording `out`. Returns how many messages it has."""
    stop = stop or Event()
    assert mission.story is not None, "the mission is read with a track"
    near = _near(mission, stop)
    kept = scoring_of(mission.path)._asdict()
    with Recorder(unused(out), realm=mission.centre.realm, focus=mission.story.track, **kept) as recorder:
        for raw in read(mission.path):
            if stop.is_set():
                break
            message = _read(mission, raw.key, raw.data)
            part = None if message is None else _part(mission, message, near)
            if part is not None:
                recorder.handle(raw.key, encode(part), raw.received)
                if recorder.messages % TICK == 0:
                    recorder.tick()
    return recorder.messages


def _read(mission: RecordedMission, text: str, data: bytes) -> Message | None:
    """The message, if it may be about the track."""
    key = key_of(text)
    if key is None or key.realm != mission.centre.realm:
        return None
    if key.scope == "global" and (key.name != mission.centre.name or key.what not in ("tracks", "log")):
        return None
    try:
        return decode(data)
    except MessageError:
        return None


def _part(mission: RecordedMission, message: Message, near: set[int]) -> Message | None:
    """What of a message is about the track; None if nothing is."""
    story = mission.story
    assert story is not None
    sources = {source for source, _, _ in story.links}
    if isinstance(message, GlobalTracks):
        return _global(message, story.track)
    if isinstance(message, StepLog):
        return _log(message, story.track, sources)
    if isinstance(message, Truth):
        rows = np.isin(message.ids, np.array(sorted(near), dtype=np.uint64))
        said = _said(message, rows)
        return replace(message, ids=message.ids[rows], means=message.means[rows], **said) if rows.any() else None
    if message.source not in sources:
        return None
    if isinstance(message, LocalTracks):
        own = [local for source, epoch, local in story.links if (source, epoch) == (message.source, message.epoch)]
        return _local(message, np.isin(message.ids, np.array(own, dtype=np.uint64)))
    return message


def _global(message: GlobalTracks, track: int) -> GlobalTracks:
    rows = message.ids == np.uint64(track)
    parts = np.repeat(rows, message.contributor_counts)
    columns: dict[str, Any] = {name: getattr(message, name)[rows] for name in ("ids", "status", "existence", "updated")}
    columns |= {f"contributor_{name}": getattr(message, f"contributor_{name}")[parts] for name in COLUMNS}
    return replace(
        message,
        **_densities(message, rows),
        **columns,
        **_said(message, rows),
        contributor_counts=message.contributor_counts[rows],
        ended=tuple(one for one in message.ended if track in (one[0], one[2])),
        split_from=tuple(one for one in message.split_from if track in one),
    )


COLUMNS = ("source", "epoch", "id", "influence")
TEXTS = ("identity", "kind", "callsign")
OPTIONAL = ("kind_p", "identity_p", "track_origin", "marks", "number", "track_lineage", "track_rule")
EXTENTS = ("extent", "extent_sigma", "extent_offset", "reference_covariances")


def _said(message: GlobalTracks | LocalTracks | Truth, rows: NDArray[np.bool_]) -> dict[str, Any]:
    """The optional columns that it has, of some of its tracks."""
    found: dict[str, Any] = {}
    for name in (*TEXTS, *OPTIONAL, *EXTENTS):
        column = getattr(message, name, None)
        if column is not None:
            some = (one for one, kept in zip(column, rows.tolist(), strict=True) if kept)
            found[name] = tuple(some) if name in TEXTS else column[rows]
    return found


def _local(message: LocalTracks, rows: NDArray[np.bool_]) -> LocalTracks:
    names = ("existence", "updated")
    columns: dict[str, Any] = {name: getattr(message, name) for name in names if getattr(message, name) is not None}
    return replace(
        message,
        **_densities(message, rows),
        ids=message.ids[rows],
        **_said(message, rows),
        **{name: column[rows] for name, column in columns.items()},
    )


def _densities(message: GlobalTracks | LocalTracks, rows: NDArray[np.bool_]) -> dict[str, Any]:
    """The columns of the densities of some tracks."""
    parts = rows if message.counts is None else np.repeat(rows, message.counts)
    return {
        "means": message.means[parts],
        "covariances": message.covariances[parts],
        "counts": None if message.counts is None else message.counts[rows],
        "weights": None if message.weights is None else message.weights[parts],
    }


def _log(message: StepLog, track: int, sources: set[str]) -> StepLog:
    """The decisions about the track, refusals of its sources, and events without checkpoint and settings."""
    one = message.decisions
    mine = (one.track == np.uint64(track)) | (one.other == np.uint64(track))
    names = ("kind", "track", "source", "epoch", "id", "other", "value")
    left_out = ("checkpoint", "config")
    return replace(
        message,
        taken=tuple(entry for entry in message.taken if entry.source in sources),
        refused=tuple(entry for entry in message.refused if entry.source in sources),
        dropped=tuple(entry for entry in message.dropped if entry.source in sources),
        events=tuple({key: value for key, value in event.items() if key not in left_out} for event in message.events),
        decisions=replace(one, **{name: getattr(one, name)[mine] for name in names}),
    )


def _near(mission: RecordedMission, stop: Event) -> set[int]:
    """The true objects that were nearest to the track in enough of its steps."""
    story = mission.story
    assert story is not None
    newest: dict[str, Truth] = {}
    nearest: Counter[int] = Counter()
    for raw in read(mission.path):
        if stop.is_set():
            break
        message = _read(mission, raw.key, raw.data)
        if isinstance(message, Truth):
            newest[message.source] = message
        elif isinstance(message, GlobalTracks) and (place := _place(message, story.track)) is not None:
            found = [one for truth in newest.values() for one in _distances(truth, message, place)]
            nearest.update([min(found)[1]] if found else [])
    return {target for target, steps in nearest.items() if steps >= NEAR * max(nearest.total(), 1)}


def _place(message: GlobalTracks, track: int) -> NDArray[np.float64] | None:
    rows = np.flatnonzero(message.ids == np.uint64(track))
    if not len(rows):
        return None
    means, _ = moments(message.means, message.covariances, message.weights, message.counts)
    place: NDArray[np.float64] = means[rows[0]][[message.space.index("x"), message.space.index("y")]]
    return place


def _distances(truth: Truth, message: GlobalTracks, place: NDArray[np.float64]) -> list[tuple[float, int]]:
    """Distance (m, horizontal) of each true object from a place in the frame of `message`."""
    own = tuple(name for name in "xyz" if name in truth.space)
    means = truth.means[:, [truth.space.index(name) for name in own]]
    try:
        means, _ = geodesy.transform(means, np.zeros((*means.shape, len(own))), own, truth.frame, message.frame)
    except geodesy.FrameError:
        return []
    apart = np.hypot(*(means[:, :2] - place).T)
    return [(float(d), track) for d, track in zip(apart, truth.ids.tolist(), strict=True) if np.isfinite(d)]
