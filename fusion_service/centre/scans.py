"""Messages of sources before they are tracks: whether their parts belong together, and intensities as scans."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from schemas import FAULTS, LocalIntensity, LocalTracks, Message, SensorInfo

__all__ = ["MAX_PERIOD", "Scan", "as_tracks", "fits", "is_sound", "size_of"]

MAX_PERIOD = 1e5
MAX_WEIGHT = 1e3
"""Expected number in one component of an intensity."""

Scan: TypeAlias = LocalTracks | LocalIntensity


def size_of(message: Message) -> int:
    """How many components it has."""
    return len(message.means) if isinstance(message, (LocalTracks, LocalIntensity)) else 1


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
    lengths = (message.existence, message.updated, message.counts)
    return (
        message.means.shape == (total, n)
        and message.covariances.shape == (total, n, n)
        and all(column is None or len(column) == tracks for column in lengths)
        and (message.weights is None or len(message.weights) == total)
    )


def is_sound(info: SensorInfo) -> bool:
    p, covariance = info.detection_probability, info.position_covariance
    return (
        0 < info.period <= MAX_PERIOD
        and 0 <= info.initiation_delay <= MAX_PERIOD
        and (p is None or 0 <= p <= 1)
        and all(math.isfinite(part) for part in info.position)
        and (covariance is None or bool(np.isfinite(covariance).all()))
    )
