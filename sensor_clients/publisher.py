"""The kit for a client: publish what a sensor sees, what the sensor is, or (in a simulation) what is true.

It loads NumPy, MessagePack and Zenoh, nothing else.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self, SupportsIndex, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from fusion_service.bus import DEFAULT_ENDPOINT, Bus, BusError, Publisher, open_bus
from fusion_service.bus.security import check_party, maybe_security
from schemas import (
    ORIGINS,
    REALM,
    Coverage,
    Frame,
    Height,
    LocalIntensity,
    LocalTracks,
    MessageError,
    Motion,
    Platform,
    SensorInfo,
    Truth,
    check_name,
    encode,
    local_key,
    truth_key,
)
from schemas.extents import sound_extents, sound_offsets
from sensor_clients.given import (
    all_sound,
    check_densities,
    checked_space,
    densities,
    floats,
    instant,
    lineage_bits,
    maybe,
    objects,
    whole,
)

__all__ = ["TrackPublisher", "TruthPublisher"]


M = TypeVar("M", LocalTracks, LocalIntensity, SensorInfo, Truth)


class _MessagePublisher:
    """One source's session: opens it, fills in the header, numbers the messages of each type."""

    _roles: tuple[str, ...] = ("source", "gateway")

    def __init__(
        self,
        source: str,
        *,
        connect: str | Sequence[str] = DEFAULT_ENDPOINT,
        realm: str = REALM,
        origin: str = "live",
        lineage: Sequence[str] | None = None,
        wait: bool | float = True,
        stop: threading.Event | None = None,
        clock: Callable[[], int] = time.time_ns,
        security: str | Path | None = None,
    ) -> None:
        if origin not in ORIGINS:
            raise ValueError(f"bad origin {origin!r}: one of {' '.join(ORIGINS)}")
        self.source = check_name(source)
        self.realm = realm
        self.epoch = 0
        self._origin = origin
        self._lineage = None if lineage is None else tuple(check_name(name) for name in lineage)
        self._connect = (connect,) if isinstance(connect, str) else tuple(connect)
        self._wait = wait
        self._stop = stop
        self._clock = clock
        self._security = maybe_security(security)
        if self._security is not None:
            check_party(self._security, self._roles, self.source)
        self._lock = threading.Lock()
        self._bus: Bus | None = None
        self._channels: dict[str, tuple[Publisher, int]] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            opening = open_bus(self._connect, wait=self._wait, stop=self._stop, security=self._security)
            bus = stack.enter_context(opening)
            self._opened(bus)
            self._bus, self.epoch = bus, self._clock()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._bus = None
            self._channels.clear()
        self._stack.close()

    def _opened(self, bus: Bus) -> None:
        """What is declared as long as the session is open."""

    @property
    def connected(self) -> bool:
        """Whether the hub is there at this moment. It is waited for and joined again by itself."""
        bus = self._bus
        return bus is not None and bus.connected

    def _send(self, kind: type[M], key: str, cache: int, parts: dict[str, Any]) -> M:
        with self._lock:
            if self._bus is None:
                raise BusError(f"the publisher of {self.source} is not open: use it in a `with` block")
            channel, seq = self._channels.get(key) or (self._bus.publisher(key, cache), 0)
            self._channels[key] = channel, seq
            message = kind(
                source=self.source,
                epoch=self.epoch,
                seq=seq,
                sent=self._clock(),
                origin=self._origin,
                lineage=self._lineage,
                **parts,
            )
            data = encode(message)
            if isinstance(message, LocalTracks | LocalIntensity):
                check_densities(message)
            channel.put(data)
            self._channels[key] = channel, seq + 1
            return message


class TrackPublisher(_MessagePublisher):
    """Publishes one source's tracks and what the source is, as a context manager:

        import time
        from schemas import Enu, Motion
        from sensor_clients.publisher import TrackPublisher

        site = Enu(lat=59.30, lon=10.40)
        with TrackPublisher("radar-1", connect="tcp/127.0.0.1:7447") as radar:
            radar.info(frame=site, position=(0, 0, 12), period=2.0, motion=Motion("cv", q=0.5))
            for x in (1200, 1194, 1188):  # your tracker's loop
                radar.tracks(time=time.time_ns(), space=("x", "y"), frame=site, ids=[7], means=[[x, 400]],
                             covariances=[[[25, 0], [0, 25]]])

    source: its name in the key. connect: endpoint or endpoints of the hub. realm: first part of every key.
    origin: live, exercise, simulated or replay. lineage: the sources whose data the tracks contain, if not
    only this one's. wait: for the hub for ever (True), so many seconds, or one try (False); `stop` ends the
    waiting. clock: now, in ns UTC. security: the source's file, or folder, of `fusion-service keys`.

    `{realm}/v1/local/{source}/alive` stands while it is open. Each opening is a new epoch, in which the
    messages of each type are numbered from 0. If the hub goes away, what is published meanwhile is lost but
    for the last eight messages of each type (the last info), which go out when it is back.

    Raises `ValueError` for a bad name, `SecurityError` for certificates that are no good, or another's, `BusError` if
    it cannot connect or is not open, and `schemas.MessageError` (with `reason`), before anything is sent, for what the
    centre would refuse.
    """

    def _opened(self, bus: Bus) -> None:
        bus.announce(local_key(self.source, "alive", self.realm))

    def info(
        self,
        *,
        frame: Frame,
        position: Sequence[float],
        period: float,
        motion: Motion,
        coverage: Coverage | None = None,
        detection_probability: float | None = None,
        initiation_delay: float = 0.0,
        may_start: bool = True,
        position_covariance: ArrayLike | None = None,
        heading_sigma: float | None = None,
        correlation_group: str | None = None,
        feedback: bool | None = None,
        polar: bool | None = None,
    ) -> SensorInfo:
        """Say what this source is (fields: `schemas.SensorInfo`; m, s). Who joins later gets it as well; say it
        again whenever it changes."""
        parts = {
            "frame": frame,
            "position": tuple(floats("position", position, (3,)).tolist()),
            "period": period,
            "motion": motion,
            "coverage": coverage,
            "detection_probability": detection_probability,
            "initiation_delay": initiation_delay,
            "may_start": may_start,
            "position_covariance": maybe(floats, "position_covariance", position_covariance, (3, 3)),
            "heading_sigma": heading_sigma,
            "correlation_group": correlation_group,
            "feedback": feedback,
            "polar": polar,
        }
        return self._send(SensorInfo, local_key(self.source, "info", self.realm), 1, parts)

    def tracks(
        self,
        *,
        time: SupportsIndex,
        space: Sequence[str],
        frame: Frame,
        ids: ArrayLike,
        means: ArrayLike,
        covariances: ArrayLike,
        complete: bool = True,
        counts: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        existence: ArrayLike | None = None,
        updated: ArrayLike | None = None,
        height: Height | None = None,
        identity: Sequence[str | None] | None = None,
        kind: Sequence[str | None] | None = None,
        kind_p: ArrayLike | None = None,
        lineages: Sequence[Sequence[str]] | None = None,
        extent: ArrayLike | None = None,
        extent_sigma: ArrayLike | None = None,
        shape: str | None = None,
        reference: str | None = None,
        reference_covariances: ArrayLike | None = None,
        platform: Platform | None = None,
    ) -> LocalTracks:
        """Publish T tracks that hold at `time` (ns UTC), as Gaussians or mixtures of C components in all.

        space: n component names; ids (T,); means (C, n) and covariances (C, n, n) in `frame`, SI units. One
        component per track unless `counts` (T,) says how many, with `weights` (C,) summing to 1 per track.
        complete: this is all the source has, an id that is not listed is gone (T = 0 is then valid).
        Per track: existence in [0, 1], updated (time of the last measurement, ns), identity ("mmsi:..."), kind, kind_p;
        lineages: of the publisher's lineage the names whose data are in each track; height: where a two-dimensional
        source's tracks are; extent (T, 3): length, width (m) and heading of the long axis (rad, from x to y), NaN where
        not known, with extent_sigma (T, 3) and shape ("ellipse", "box"); reference: what of the object a mean is
        ("centre", "antenna", "nearest", "blob"); reference_covariances (T, 2, 2), m2 in x and y: how far that may lie
        from the centre. platform: where the sensor is then, and how it is turned, if it moves.
        Arrays may be anything NumPy can read. `MessageError` names the track that is unsound.
        """
        names = checked_space(space)
        parts = {
            "time": instant(time),
            "complete": bool(complete),
            "space": names,
            "frame": frame,
            "ids": whole("ids", ids, np.uint64),
            "counts": maybe(whole, "counts", counts, np.uint16),
            "weights": maybe(floats, "weights", weights, (None,)),
            **densities(means, covariances, len(names)),
            "existence": maybe(floats, "existence", existence, (None,)),
            "updated": maybe(whole, "updated", updated, np.int64),
            "height": height,
            "identity": None if identity is None else tuple(identity),
            "kind": None if kind is None else tuple(kind),
            "kind_p": maybe(floats, "kind_p", kind_p, (None,)),
            "platform": platform,
            "track_lineage": None if lineages is None else lineage_bits(lineages, self._lineage or ()),
            **objects(extent, extent_sigma, shape, reference, reference_covariances),
        }
        return self._send(LocalTracks, local_key(self.source, "tracks", self.realm), 8, parts)

    def intensity(
        self,
        *,
        time: SupportsIndex,
        space: Sequence[str],
        frame: Frame,
        weights: ArrayLike,
        means: ArrayLike,
        covariances: ArrayLike,
        height: Height | None = None,
    ) -> LocalIntensity:
        """Publish an intensity (PHD) of C components: weights (C,), whose sum is the expected number, means
        (C, n), covariances (C, n, n); the rest as in `tracks`."""
        names = checked_space(space)
        parts = {
            "time": instant(time),
            "space": names,
            "frame": frame,
            "weights": floats("weights", weights, (None,)),
            **densities(means, covariances, len(names)),
            "height": height,
        }
        return self._send(LocalIntensity, local_key(self.source, "intensity", self.realm), 8, parts)


class TruthPublisher(_MessagePublisher):
    """Publishes what is true in a scenario, for the record and for scores. Arguments as in `TrackPublisher`;
    the scenario's name stands for the source's, and the certificate is that of a scenario."""

    _roles = ("scenario",)

    def truth(
        self,
        *,
        time: SupportsIndex,
        space: Sequence[str],
        frame: Frame,
        ids: ArrayLike,
        means: ArrayLike,
        extent: ArrayLike | None = None,
        extent_offset: ArrayLike | None = None,
        shape: str | None = None,
    ) -> Truth:
        """Publish the true states `means` (T, n) of the objects `ids` (T,) at `time` (ns UTC) in `frame`; extent (T, 3)
        and shape of their hulls as in `TrackPublisher.tracks`, extent_offset (T, 2) of the state's place from the
        hull's centre, m along its heading and to the left of it.
        Raises `MessageError` for what cannot be sent, `BusError` if it is not open."""
        names = checked_space(space)
        states = floats("means", means, (None, len(names)))
        if not np.isfinite(states).all():
            raise MessageError("not-finite", "a true mean is not finite")
        number = whole("ids", ids, np.uint64)
        hull = maybe(floats, "extent", extent, (None, 3))
        offset = maybe(floats, "extent_offset", extent_offset, (None, 2))
        if not (all_sound(sound_extents, hull) and all_sound(sound_offsets, offset)):
            raise MessageError("extent", "an extent or its offset is not sound")
        parts = {"time": instant(time), "space": names, "frame": frame, "ids": number, "means": states}
        parts |= {"extent": hull, "extent_offset": offset, "shape": shape}
        return self._send(Truth, truth_key(self.source, self.realm), 8, parts)
