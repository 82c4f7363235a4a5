"""The messages that cross the bus, as frozen dataclasses of plain values and NumPy arrays.

T tracks, C components (C = T unless `counts` says otherwise), n state components, K contributions.
Times are int nanoseconds UTC, durations float seconds. Arrays are float64 unless a dtype is given.
A message made here is not checked; `schemas.encode` and `schemas.decode` check the structure and
`schemas.check_numbers` the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from schemas.platform import Platform
from schemas.spaces import Coverage, Frame, Height, Motion

__all__ = [
    "APART",
    "BORN",
    "BROKEN",
    "COASTING",
    "COASTING_NOW",
    "CONFIRMED",
    "CONFIRMED_NOW",
    "DECISIONS",
    "DELETED",
    "EXCHANGED",
    "GATE_FAILED",
    "IDENTITY_ORDERED",
    "IDENTITY_TWICE",
    "KEPT",
    "LINKED",
    "MARKS",
    "MERGED",
    "NO_SOURCE",
    "ORIGINS",
    "SPLIT",
    "STATUSES",
    "TENTATIVE",
    "U64",
    "Decisions",
    "Entry",
    "Floats",
    "GlobalTracks",
    "Header",
    "LocalIntensity",
    "LocalTracks",
    "Message",
    "SensorInfo",
    "Status",
    "StepLog",
    "Truth",
]

Floats: TypeAlias = NDArray[np.float64]
U64: TypeAlias = NDArray[np.uint64]
I64: TypeAlias = NDArray[np.int64]
U32: TypeAlias = NDArray[np.uint32]
U16: TypeAlias = NDArray[np.uint16]
U8: TypeAlias = NDArray[np.uint8]

ORIGINS = ("live", "exercise", "simulated", "replay")
STATUSES = ("tentative", "confirmed", "coasting")
TENTATIVE, CONFIRMED, COASTING = range(3)
MARKS = ("apart", "identity_twice", "identity_ordered")
APART, IDENTITY_TWICE, IDENTITY_ORDERED = (1 << bit for bit in range(3))
"""Bits of a global track's marks: of a source in quarantine; its identity is in two places; an operator gave it."""

DECISIONS = (
    "linked",
    "kept",
    "broken",
    "gate_failed",
    "merged",
    "split",
    "born",
    "confirmed",
    "coasting",
    "deleted",
    "exchanged",
)
LINKED, KEPT, BROKEN, GATE_FAILED, MERGED, SPLIT, BORN, CONFIRMED_NOW, COASTING_NOW, DELETED, EXCHANGED = range(11)
NO_SOURCE = 65535
"""The `source` of a decision that concerns no local track."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Header:
    """What every message carries.

    source: the name in the key (a centre's name for what a centre publishes). epoch: when this run of the
    source began, ns. seq: +1 per message of one type within an epoch. sent: when it was sent, ns.
    origin: one of `ORIGINS`. lineage: the sources whose data it contains; None means `source` alone.

    The bits of track_lineage (T, ceil(L/8)) u8, in tracks of both kinds, say which of the L names of `lineage` each
    track contains: name k is bit k % 8 of byte k // 8; None means all of them.
    """

    type: ClassVar[str]
    source: str
    epoch: int
    seq: int
    sent: int
    origin: str = "live"
    lineage: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalTracks(Header):
    """Tracks of one source at one time. `complete`: an id that is not listed is gone.

    ids (T,) u64; means (C, n); covariances (C, n, n), symmetric; counts (T,) u16 components per track and
    weights (C,) summing to 1 per track, both None for one component each; existence (T,) in [0, 1];
    updated (T,) i64 time of the last measurement; identity, kind: a text or None per track; kind_p (T,).
    extent (T, 3): full length and width, m, and heading of the long axis, rad, in `frame`, NaN where not known (see
    `extents`), extent_sigma (T, 3) their standard deviations; shape, of all: one of `SHAPES`, None: the first;
    reference: what of an object the means are, one of `REFERENCES`, None: the first; reference_covariances (T, 2, 2),
    m2, in x and y: how far that may lie from the object's centre, the same from report to report.
    platform: where the sensor is then, and how it is turned, if it moves.
    """

    type: ClassVar[str] = "local_tracks"
    time: int
    complete: bool
    space: tuple[str, ...]
    frame: Frame
    ids: U64
    means: Floats
    covariances: Floats
    counts: U16 | None = None
    weights: Floats | None = None
    existence: Floats | None = None
    updated: I64 | None = None
    height: Height | None = None
    identity: tuple[str | None, ...] | None = None
    kind: tuple[str | None, ...] | None = None
    kind_p: Floats | None = None
    track_lineage: U8 | None = None
    extent: Floats | None = None
    extent_sigma: Floats | None = None
    shape: str | None = None
    reference: str | None = None
    reference_covariances: Floats | None = None
    platform: Platform | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalIntensity(Header):
    """An intensity (PHD) as a weighted Gaussian mixture: the mass of `weights` (C,) is the expected number."""

    type: ClassVar[str] = "local_intensity"
    time: int
    space: tuple[str, ...]
    frame: Frame
    weights: Floats
    means: Floats
    covariances: Floats
    height: Height | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorInfo(Header):
    """What a source says of itself: where it is, how often it reports, what it covers.

    position (x, y, z) in `frame`, m, and its covariance (3, 3); period, initiation_delay in seconds;
    detection_probability in [0, 1] inside `coverage`; may_start: its tracks may start global tracks;
    correlation_group: sources of one group share errors (one navigation system, say); feedback: its tracker is fed
    with fused tracks, so that its tracks hold what others have measured; heading_sigma: rad, of an error that turns all
    its tracks about its position alike; polar: it measures ranges and bearings, so that its ranges may be off.
    """

    type: ClassVar[str] = "sensor_info"
    frame: Frame
    position: tuple[float, float, float]
    period: float
    motion: Motion
    coverage: Coverage | None = None
    detection_probability: float | None = None
    initiation_delay: float = 0.0
    may_start: bool = True
    position_covariance: Floats | None = None
    heading_sigma: float | None = None
    correlation_group: str | None = None
    feedback: bool | None = None
    polar: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalTracks(Header):
    """The fused picture after one step: tracks as in `LocalTracks`, and where each came from.

    status (T,) u8 index into `STATUSES`; updated (T,) i64 time of the newest data in it; sources: names
    that the contributions index; contributor_counts (T,) u16 says how many of the K contributions each
    track has: source (index, u16), epoch and local id (u64), influence trace(K_i)/n of the gain K_i.
    ended: (id, reason, id of the track that replaces it or None); split_from: (new id, old id).
    rules: the ways that tracks were fused by, and track_rule (T,) u8 the index of each track's.
    identity, kind: what it is, a text or None per track, with the probabilities identity_p and kind_p (T,);
    track_origin (T,) u8 index into `ORIGINS`; marks (T,) u8, bits of `MARKS`; number (T,) u32 and callsign: how
    an operator has named it (0, None: not). extent, extent_sigma (T, 3), shape: fused, as in `LocalTracks`.
    delta: these are only the tracks that have changed since the last picture (see `schemas.merged`); None: all.
    revised: time, ns, of the earliest step that was made again before this one, for data that came late; None: none.
    """

    type: ClassVar[str] = "global_tracks"
    time: int
    step: int
    rule: str
    space: tuple[str, ...]
    frame: Frame
    ids: U64
    status: U8
    existence: Floats
    means: Floats
    covariances: Floats
    updated: I64
    sources: tuple[str, ...]
    contributor_counts: U16
    contributor_source: U16
    contributor_epoch: U64
    contributor_id: U64
    contributor_influence: Floats
    counts: U16 | None = None
    weights: Floats | None = None
    ended: tuple[tuple[int, str, int | None], ...] = ()
    split_from: tuple[tuple[int, int], ...] = ()
    rules: tuple[str, ...] | None = None
    track_rule: U8 | None = None
    identity: tuple[str | None, ...] | None = None
    identity_p: Floats | None = None
    kind: tuple[str | None, ...] | None = None
    kind_p: Floats | None = None
    track_origin: U8 | None = None
    marks: U8 | None = None
    number: U32 | None = None
    callsign: tuple[str | None, ...] | None = None
    track_lineage: U8 | None = None
    extent: Floats | None = None
    extent_sigma: Floats | None = None
    shape: str | None = None
    delta: bool | None = None
    revised: int | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """One message as a step log names it: `hash` is `schemas.digest`; `count` tracks concerned, 0: the whole."""

    source: str
    epoch: int
    seq: int
    hash: int
    reason: str = ""
    count: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """Decisions of one step as K rows: kind u8 (index into `DECISIONS`), track u64 (global id),
    source u16 (index into the log's `sources`, or `NO_SOURCE`), epoch u64, id u64 (local id), other u64
    (another global id, 0: none), value f64 (the statistic it rests on, NaN where there is none)."""

    kind: U8
    track: U64
    source: U16
    epoch: U64
    id: U64
    other: U64
    value: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepLog(Header):
    """What one step took, refused and dropped, and every decision: enough to make the step again."""

    type: ClassVar[str] = "step_log"
    step: int
    time: int
    config_hash: str
    version: str
    taken: tuple[Entry, ...]
    refused: tuple[Entry, ...]
    dropped: tuple[Entry, ...]
    events: tuple[dict[str, Any], ...]
    sources: tuple[str, ...]
    decisions: Decisions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Status(Header):
    """Health of a centre. Counters grow since its start; `sources` maps a name to its own small map;
    `notes` are sentences about the centre that an operator should read; `road`: what small matrices are computed by;
    `term`: the term under which the process holds the centre's name, and `standby`: of those that stand by for it, how
    many are `there`, and `ready` to take over."""

    type: ClassVar[str] = "status"
    time: int
    step: int
    uptime: float
    rates: dict[str, float]
    queue: dict[str, int]
    refused: dict[str, int]
    dropped: dict[str, int]
    sources: dict[str, dict[str, Any]]
    tracks: dict[str, int]
    step_time: dict[str, float]
    memory: int | None = None
    notes: tuple[str, ...] | None = None
    road: str | None = None
    term: int | None = None
    standby: dict[str, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth(Header):
    """True states of T objects (simulation and playback): ids (T,) u64, means (T, n).

    extent (T, 3) and shape of their hulls as in `LocalTracks`; extent_offset (T, 2): where the state's place lies from
    the centre of the hull, m along its heading and to the left of it; None, or NaN: in the centre.
    """

    type: ClassVar[str] = "truth"
    time: int
    space: tuple[str, ...]
    frame: Frame
    ids: U64
    means: Floats
    extent: Floats | None = None
    extent_offset: Floats | None = None
    shape: str | None = None


Message: TypeAlias = LocalTracks | LocalIntensity | SensorInfo | GlobalTracks | StepLog | Status | Truth
