"""Messages of sources made tracks: whether their parts belong together, intensities as scans, and the columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats, constant
from fusion_service.centre.extents import message_extents
from fusion_service.centre.lineage import ALONE, Lineages
from fusion_service.centre.partial import transformed
from fusion_service.centre.tracks import Tracks, no_parts, unlinked
from fusion_service.centre.words import Lexicon
from fusion_service.densities import Mixtures, reduce_mixtures
from schemas import FAULTS, ORIGINS, Frame, GlobalTracks, Height, LocalIntensity, LocalTracks, Message, SensorInfo

__all__ = ["MAX_PERIOD", "Scan", "as_tracks", "fits", "is_sound", "message_tracks", "size_of"]


MAX_PERIOD = 1e5
MAX_WEIGHT = 1e3
"""Expected number in one component of an intensity."""

Scan: TypeAlias = LocalTracks | LocalIntensity
Mask: TypeAlias = NDArray[np.bool_] | None
"""Which tracks of a message; None: all."""


def size_of(message: Message) -> int:
    """How many components it has."""
    return len(message.means) if isinstance(message, (LocalTracks, LocalIntensity, GlobalTracks)) else 1


def as_tracks(message: Scan, faults: NDArray[np.uint8]) -> LocalTracks:
    """An intensity as a complete scan whose ids no other message has; one without a sound component says nothing.
    A weight above `MAX_WEIGHT` is marked in `faults`."""
    if isinstance(message, LocalTracks):
        return message
    faults[(faults == 0) & (message.weights > MAX_WEIGHT)] = FAULTS.index("weights")
    header = {one: getattr(message, one) for one in ("source", "epoch", "seq", "sent", "origin", "lineage")}
    return LocalTracks(
        **header,
        time=message.time,
        complete=not len(faults) or bool((faults == 0).any()),
        space=message.space,
        frame=message.frame,
        height=message.height,
        ids=np.arange(len(faults), dtype=np.uint64) + np.uint64((message.seq % 2**44) << 20),
        existence=message.weights,
        means=message.means,
        covariances=message.covariances,
    )


def fits(message: Scan) -> bool:
    """Whether the arrays of a message that was never encoded belong together."""
    n = len(message.space)
    if isinstance(message, LocalIntensity):
        total = len(message.weights)
        return message.means.shape == (total, n) and message.covariances.shape == (total, n, n)
    tracks = len(message.ids)
    total = tracks if message.counts is None else int(np.sum(message.counts))
    lengths = (message.existence, message.updated, message.counts, message.identity, message.kind, message.kind_p)
    return (
        message.means.shape == (total, n)
        and message.covariances.shape == (total, n, n)
        and all(column is None or len(column) == tracks for column in lengths)
        and (message.weights is None or len(message.weights) == total)
        and _bits_fit(message)
        and _extents_fit(message)
        and _texts_fit(message)
    )


def _texts_fit(message: LocalTracks) -> bool:
    if message.identity is message.kind is None:
        return True
    return {*map(type, (*(message.identity or ()), *(message.kind or ())))} <= {str, type(None)}


def _bits_fit(message: LocalTracks) -> bool:
    if message.track_lineage is None:
        return True
    shape = len(message.ids), -(-len(message.lineage or ()) // 8)
    return message.track_lineage.shape == shape


def _extents_fit(message: LocalTracks) -> bool:
    tracks, covariances = len(message.ids), message.reference_covariances
    if message.extent is message.extent_sigma is covariances is None:
        return True
    columns = (message.extent, message.extent_sigma)
    return all(column is None or column.shape == (tracks, 3) for column in columns) and (
        covariances is None or covariances.shape == (tracks, 2, 2)
    )


def is_sound(info: SensorInfo) -> bool:
    p, covariance, sigma = info.detection_probability, info.position_covariance, info.heading_sigma
    return (
        0 < info.period <= MAX_PERIOD
        and 0 <= info.initiation_delay <= MAX_PERIOD
        and (p is None or 0 <= p <= 1)
        and (sigma is None or 0 <= sigma <= math.pi)
        and all(math.isfinite(part) for part in info.position)
        and (covariance is None or bool(np.isfinite(covariance).all()))
    )


def message_tracks(
    messages: Sequence[LocalTracks],
    sound: Sequence[NDArray[np.bool_]],
    frame: Frame,
    height: Height | None,
    most: int,
    said: Lexicon,
    lineages: Lineages,
) -> Tracks:
    """The sound tracks of messages of one space, frame and height, in `frame`, one after the other; mixtures of
    more than `most` components are reduced. said, lineages: give texts and
    lineages their codes.

    Raises `geodesy.FrameError` where their frame cannot be brought into `frame`.
    """
    first = messages[0]
    some = [None if rows.all() else rows for rows in sound]
    counts = [
        len(rows) if part is None else int(np.count_nonzero(part)) for rows, part in zip(sound, some, strict=True)
    ]
    gaussian = all(message.counts is None or message.weights is None for message in messages)
    if gaussian:
        means = _joined([_some(message.means, rows) for message, rows in zip(messages, some, strict=True)])
        covariances = _joined([_some(message.covariances, rows) for message, rows in zip(messages, some, strict=True)])
    else:
        means, covariances, weights, sizes = (
            _joined(column) for column in zip(*map(_components, messages, sound), strict=True)
        )
        gaussian = bool(sizes.max(initial=1) == 1)
    means, covariances = transformed(means, covariances, first.space, first.frame, frame, first.height or height)
    if gaussian:
        mean, covariance = linalg.to_last(means, 1), linalg.to_last(covariances, 2)
        parts = no_parts(len(mean), len(means))
    else:
        mixtures = Mixtures.from_rows(weights, means, covariances, sizes).normalised()
        if len(mixtures.log_weights) > most:
            mixtures = reduce_mixtures(mixtures, max_components=most)
        mean, covariance = mixtures.moments()
        parts = mixtures.log_weights, mixtures.means, linalg.symmetrise(mixtures.covariances)
    extent = message_extents(messages, sound, mean, frame)
    times = np.repeat(np.array([m.time for m in messages], dtype=np.int64), counts)
    alone = not any(m.lineage for m in messages)
    return Tracks(
        id=_gather([m.ids for m in messages], some, np.uint64),
        time=times,
        mean=mean,
        covariance=linalg.symmetrise(covariance),
        log_weight=parts[0],
        part_mean=parts[1],
        part_covariance=parts[2],
        existence=_optional([m.existence for m in messages], some, counts, np.nan, np.float64),
        updated=_updated(messages, some, times),
        interval=np.zeros(len(times), dtype=np.int64),
        **_told(messages, some, counts, said),
        lineage=constant(len(times), ALONE, np.int32)
        if alone
        else _gather([lineages.of_message(m) for m in messages], some, np.int32),
        extent=extent,
        **unlinked(len(times)),
    )


def _updated(messages: Sequence[LocalTracks], some: Sequence[Mask], times: NDArray[np.int64]) -> NDArray[np.int64]:
    """When each was last measured: not after its own time."""
    if all(m.updated is None for m in messages):
        return times.copy()
    said = [np.full(len(m.ids), m.time) if m.updated is None else m.updated for m in messages]
    return np.asarray(np.minimum(_gather(said, some, np.int64), times))


def _told(
    messages: Sequence[LocalTracks], some: Sequence[Mask], counts: Sequence[int], said: Lexicon
) -> dict[str, NDArray[Any]]:
    """The columns of what the tracks are said to be, and of their origin."""
    identity, kind = (
        [None if texts is None else words.codes(texts) for texts in column]
        for words, column in ((said.identity, [m.identity for m in messages]), (said.kind, [m.kind for m in messages]))
    )
    own = [getattr(m, "track_origin", None) for m in messages]
    usual = [ORIGINS.index(m.origin) for m in messages]
    if len({*usual}) > 1:
        own = [
            np.full(len(m.ids), code, dtype=np.uint8) if column is None else column
            for m, code, column in zip(messages, usual, own, strict=True)
        ]
    return {
        "identity": _optional(identity, some, counts, -1, np.int32),
        "kind": _optional(kind, some, counts, -1, np.int32),
        "kind_p": _optional([m.kind_p for m in messages], some, counts, np.nan, np.float64),
        "origin": _optional(own, some, counts, usual[0], np.uint8),
    }


def _components(message: LocalTracks, sound: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, NDArray[np.intp]]:
    """Means, covariances and weights of the components of the sound tracks, and how many each of these has."""
    if message.counts is None or message.weights is None:
        means, covariances = message.means[sound], message.covariances[sound]
        return means, covariances, np.ones(len(means)), np.ones(len(means), dtype=np.intp)
    counts = message.counts.astype(np.intp)
    rows = np.repeat(sound, counts)
    return message.means[rows], message.covariances[rows], message.weights[rows], counts[sound]


def _optional(
    columns: Sequence[NDArray[Any] | None], some: Sequence[Mask], counts: Sequence[int], usual: float, kind: Any
) -> NDArray[Any]:
    """The column of what messages may leave out: there as usual."""
    if all(column is None for column in columns):
        return constant(sum(counts), usual, kind)
    parts = [
        np.full(count, usual, dtype=kind) if column is None else column if mask is None else column[mask]
        for column, mask, count in zip(columns, some, counts, strict=True)
    ]
    return np.concatenate(parts).astype(kind, copy=False)


def _gather(columns: Sequence[NDArray[Any]], some: Sequence[Mask], kind: Any) -> NDArray[Any]:
    """Always an array of its own: those of a message may not be written."""
    parts = [column if mask is None else column[mask] for column, mask in zip(columns, some, strict=True)]
    return np.concatenate(parts).astype(kind, copy=False)


def _some(column: NDArray[Any], mask: Mask) -> NDArray[Any]:
    """The rows of the mask; the column itself where that is all of them."""
    return column if mask is None else column[mask]


def _joined(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return columns[0] if len(columns) == 1 else np.concatenate(columns)
