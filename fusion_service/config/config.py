"""The settings as frozen dataclasses: `ServiceConfig` is the whole file, `CentreConfig` its table [centre], and what a
centre takes. Durations are seconds.

Every field has a default, what reads it (`fusion_service.config.readers`) and a line of help, which `example_toml`
prints.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT
from fusion_service.compiled import CHOICES
from fusion_service.config.correlation import is_derived, rule_options
from fusion_service.config.readers import (
    DURATION,
    POSITIVE,
    build,
    choice,
    endpoints,
    flag,
    known_statuses,
    maybe,
    number,
    origins,
    parsed,
    read_coverage,
    read_frame,
    read_mixture_rule,
    read_rule,
    table,
    text,
    texts,
    whole,
)
from fusion_service.errors import FusionError
from schemas import ORIGINS, STATUSES, Coverage, Frame, Height, Motion, check_name, check_realm, check_space

__all__ = [
    "BEFORE",
    "BusConfig",
    "CentreConfig",
    "ConfigError",
    "DaemonConfig",
    "FlowConfig",
    "LimitsConfig",
    "ServiceConfig",
    "SourceConfig",
    "config_hash",
]


LATER = (
    *("trigger", "arrival_spacing", "revise", "weights", "compiled", "clock_votes"),
    *("track_components", "message_components", "component_pairs", "forget", "suspend"),
)
"""Settings that came after hashes were recorded; their defaults are what there was before, or `BEFORE` says."""
BEFORE: dict[str, Any] = {
    "revise": 0.0,
    "weights": "best",
    "clock_votes": "all",
    "track_components": 2**16,
    "message_components": 2**24,
    "component_pairs": 2**62,
    "forget": 0.0,
    "suspend": False,
}
"""What stands where recorded settings do not say them."""


class ConfigError(FusionError, ValueError):
    """A config that cannot be used; `problems` has one line per error, which begins with where it is."""

    exit_code: ClassVar[int] = 2
    places: ClassVar[bool] = True

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def _setting(default: Any, read: Callable[[Any], Any], help_text: str) -> Any:
    metadata = {"read": read, "help": help_text}
    if isinstance(default, dict):
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class SourceConfig:
    """What is taken for a source that does not say it in its SensorInfo; `override` puts it above that."""

    period: float = _setting(1.0, POSITIVE, "seconds between its messages")
    motion: Motion = _setting(Motion("cv", 1.0), lambda v: build(Motion, v), "motion of its tracks")
    may_start: bool = _setting(True, flag, "its tracks may start global tracks")
    height: Height = _setting(Height(), lambda v: build(Height, v), "height of what a 2-D source sees, m")
    stale: float | None = _setting(
        None, maybe(POSITIVE), "seconds after which its tracks are stale; left out: stale_periods and lateness"
    )
    coverage: Coverage | None = _setting(
        None, maybe(read_coverage), "its field of view, e.g. {kind = 'disk', radius = 20000}; left out: not known"
    )
    detection_probability: float | None = _setting(
        None, maybe(number(0, 1)), "that an object in its coverage is detected in one scan; left out: not known"
    )
    initiation_delay: float | None = _setting(
        None, maybe(DURATION), "seconds from entry into its coverage to a first track"
    )
    gate: float | None = _setting(
        None, maybe(number(0.5, 1 - 1e-12)), "probability inside the gate for a new link of its tracks; left out: gate"
    )
    false_track: float = _setting(0.1, number(1e-6, 1), "chance that a report of a track of it is of nothing")
    covariance_floor: float = _setting(0.0, DURATION, "sigma added to its positions, m")
    correlation_group: str | None = _setting(
        None, maybe(text), "sources of one group share errors (rule bci, max_correlation); left out: its own"
    )
    registration_sigma: float = _setting(
        0.0, number(0.0, 1e5), "kind = intensity: m, error common to all it reports; SensorInfo: position_covariance"
    )
    reference: bool = _setting(False, flag, "its clock and place are right: others are measured by it")
    polar: bool | None = _setting(None, maybe(flag), "it measures ranges and bearings; left out: by its SensorInfo")
    inflation: float = _setting(1.0, number(0, 1e6, above=True), "factor on its covariances")
    feedback: bool = _setting(False, flag, "its tracker is fed with fused tracks: no tracklets of it")
    override: bool = _setting(False, flag, "use these values even where its SensorInfo says otherwise")
    ignore: bool = _setting(False, flag, "refuse all it sends (reason: muted)")
    allowed_origins: tuple[str, ...] = _setting(ORIGINS, origins, "origins taken from it; others are refused")
    identity_trust: float = _setting(0.99, number(0.5, 1 - 1e-9), "probability that an identity it says is right")
    kind_accuracy: float = _setting(0.8, number(0, 1 - 1e-9), "probability that a class it says is right")


@dataclass(frozen=True)
class CentreConfig:
    """All that changes a result of `FusionCentre` or `IntensityCentre`."""

    name: str = _setting("centre", parsed(check_name), "name of this centre in its keys")
    kind: str = _setting("tracks", choice("tracks", "intensity"), "what it takes from its sources and fuses")
    space: tuple[str, ...] = _setting(("x", "y", "vx", "vy"), parsed(check_space, texts), "state space of the picture")
    frame: Frame | None = _setting(None, read_frame, "frame of the picture; left out: what sources agree on")
    frame_wait: float = _setting(5.0, DURATION, "seconds after which the most supported frame is taken")
    clock: str = _setting("wall", choice("wall", "message"), "step by wall clock, or by the messages' own time")
    clock_votes: str = _setting(
        "auto",
        choice("auto", "configured", "all"),
        "whose messages move the clock of the messages: sources with a table here, or all; auto: those with a table, "
        "where there are any and no certificates",
    )
    trigger: str = _setting(
        "period", choice("period", "arrival"), "step every period, or as soon as a scan is in, at the scan's time"
    )
    arrival_spacing: float = _setting(
        0.002, number(0.0, 10.0), "trigger = arrival: seconds between steps at least; scans that come together are one"
    )
    period: float = _setting(1.0, number(0.01, 1e5), "seconds between steps; trigger = arrival: between full pictures")
    delay: float = _setting(0.5, DURATION, "wall clock: how far behind now a step is")
    lateness: float = _setting(5.0, DURATION, "how late a message may be, seconds")
    revise: float = _setting(
        4.0,
        number(0, 1e6),
        "steps made again for late data, at most, for each step; 0: they are taken as they come",
    )
    max_future: float = _setting(2.0, DURATION, "how far ahead of its reception a message's time may be")
    rule: str = _setting(
        "auto", read_rule, "fusion rule (fusion-service rules lists them), or your own: my_rule.py:fuse"
    )
    rule_options: dict[str, Any] = _setting({}, rule_options, "options of the rule, e.g. {criterion = 'trace'}")
    weights: str = _setting(
        "kept",
        choice("kept", "best"),
        "rules ci, bci, auto, three sources and more: the best weights in every step, or those of the last one kept "
        "while within .1 % of the best",
    )
    mixture_rule: str = _setting("moments", read_mixture_rule, "rule for mixtures; moments: as Gaussians, by the rule")
    mixture_options: dict[str, Any] = _setting({}, table, "options of the mixture rule")
    max_components: int = _setting(8, whole(1, 100), "components kept of a mixture")
    track_components: int = _setting(100, whole(1, 2**16), "a track of more components is refused, with its message")
    message_components: int = _setting(
        50_000, whole(1, 2**24), "so is one of more: its tracks times the most components that one of them has"
    )
    component_pairs: int = _setting(
        250_000,
        whole(0, 2**62),
        "pairs of components compared in one step, at most; beyond, the mixtures of the messages with most of them are "
        "taken by their moments, as Gaussians",
    )
    publish: str = _setting("mixture", choice("mixture", "mean", "mode"), "how a track that is a mixture goes out")
    publish_status: tuple[str, ...] = _setting(
        STATUSES, parsed(known_statuses, texts), "tracks of these go out: tentative, confirmed, coasting"
    )
    publish_region: Coverage | None = _setting(
        None, maybe(read_coverage), "only tracks in it go out; about the origin of the picture's frame; left out: all"
    )
    memory: str = _setting(
        "auto",
        choice("auto", "restart", "recursive", "tracklet"),
        "fuse local tracks only, the last result too, or what their successive versions add; auto: tracklet with rule "
        "auto, else restart",
    )
    memory_correlation: float = _setting(
        1.0, number(0, 1), "bound on the correlation of the last result and new tracks"
    )
    motion: Motion | None = _setting(
        None, maybe(lambda v: build(Motion, v)), "motion of a global track on its own; left out: as its sources declare"
    )
    gate: float = _setting(0.999, number(0.5, 1 - 1e-9), "probability inside the gate for a new link")
    keep_gate: float = _setting(0.9999, number(0.5, 1 - 1e-12), "probability inside the gate for a standing link")
    merge_gate: float = _setting(0.999, number(0.5, 1 - 1e-9), "two global tracks further apart are not the same")
    error_rate: float = _setting(
        1e-3, number(1e-9, 0.2), "rate of wrong decisions about links, exchanges, merges and splits"
    )
    manoeuvre: float = _setting(20.0, number(0, 1e4), "acceleration that targets may show unannounced, m/s2 (1 sigma)")
    unknown_speed: float = _setting(
        100.0, number(0, 1e5), "speed that targets may have of which nobody tells the velocity, m/s (1 sigma)"
    )
    confirm_hits: int = _setting(2, whole(1, 64), "reports with a new measurement that confirm a track ...")
    confirm_within: int = _setting(4, whole(1, 64), "... of so many that were due")
    min_sources: int = _setting(1, whole(1, 255), "sources that a track needs to be confirmed")
    confirm_sources: int = _setting(2, whole(1, 64), "so many sources in one step confirm a track at once")
    confirm_existence: float = _setting(0.0, number(0, 1), "existence needed to be confirmed")
    birth_existence: float = _setting(0.5, number(1e-6, 1 - 1e-6), "existence of a new track before its first report")
    survival: float = _setting(0.99, number(1e-6, 1), "chance that a target without reports is there a second later")
    existence: str = _setting("consistent", choice("consistent", "average", "geometric"), "how existence is fused")
    min_existence: float = _setting(
        0.0, number(0, 1), "a track of less existence is tentative, or ends without support"
    )
    coast: float = _setting(5.0, DURATION, "seconds a confirmed track lives on when its reports are overdue ...")
    coast_periods: float = _setting(3.0, number(0, 1e3), "... or so many of its source's periods, if that is longer")
    stale_periods: float = _setting(
        3.0, number(1, 1e6), "a source (or track) is stale after so many of its own periods, and lateness"
    )
    forget: float = _setting(
        300.0, DURATION, "seconds after which a source that is gone and silent is forgotten; 0: none is, nor rests"
    )
    remember: float = _setting(
        600.0,
        DURATION,
        "seconds for which a stale track's id, link and interval, and a suspended track, are remembered",
    )
    suspend: bool = _setting(
        True, flag, "tracks that only sources silent as a whole could see are suspended, and do not end, after coast"
    )
    intensity_rule: str = _setting(
        "hybrid",
        choice("aa", "ga", "hybrid"),
        "kind = intensity: mean of the intensities; hybrid: number aa, place ga",
    )
    intensity_cardinality: str = _setting(
        "average", choice("average", "consistent"), "hybrid: the number of targets in places with the same sources"
    )
    intensity_extract: str = _setting(
        "threshold", choice("threshold", "rank"), "tracks: components above the threshold, or the round(mass) heaviest"
    )
    intensity_threshold: float = _setting(0.5, number(0, 1), "weight above which a component is a track")
    intensity_count_error: float = _setting(
        0.1, number(1e-9, 0.5), "rate of error at which a place gets another number of tracks than it has"
    )
    intensity_prune: float = _setting(1e-3, number(0, 1), "weight below which a component is dropped")
    intensity_merge: float = _setting(2.0, number(0, 100), "d2 below which components of one mixture are merged")
    intensity_components: int = _setting(500, whole(1, 5000), "components kept at most")
    max_pending: int = _setting(10_000, whole(1, 10_000_000), "messages held per source for later steps")
    supervision: str = _setting(
        "act", choice("off", "watch", "act"), "sources beside each other: not looked at, told, or told and treated"
    )
    supervision_errors: float = _setting(0.001, number(1e-9, 1.0), "rate of false alarms about a sound source, 1/h")
    registration: str = _setting(
        "estimate",
        choice("off", "estimate", "correct"),
        "clock offsets and registration errors of sources: not looked for, told, or told and taken off",
    )
    registration_memory: float = _setting(
        600.0, number(1.0, 1e6), "seconds after which what was seen of them counts for 1/e"
    )
    clock_sigma: float = _setting(1.0, number(0, 1e3), "how far off clocks of sources may be, s (1 sigma)")
    translation_sigma: float = _setting(100.0, number(0, 1e6), "how far off their own places may be, m (1 sigma)")
    heading_sigma: float = _setting(1.0, number(0, 90), "how far their headings may be turned, degrees (1 sigma)")
    range_sigma: float = _setting(100.0, number(0, 1e6), "polar sources: how far off ranges may be, m (1 sigma)")
    scale_sigma: float = _setting(0.001, number(0, 1), "polar sources: error of the scale of ranges (1 sigma)")
    fuse_origins: bool = _setting(False, flag, "fuse live, exercise, simulated and replayed data together")
    source_defaults: SourceConfig = _setting(SourceConfig(), lambda v: v, "for every source")
    sources: dict[str, SourceConfig] = _setting({}, table, "by name, over the defaults; global/NAME: a centre")

    @property
    def follows(self) -> bool:
        """Whether successive versions of local tracks are used, not only the newest."""
        return self.kind == "tracks" and (self.by_tracklets or self.by_derived)

    @property
    def by_tracklets(self) -> bool:
        """Whether filters of the targets' own take tracklets, where they are sound."""
        return self.memory == "tracklet" or (self.memory == "auto" and self.rule == "auto")

    @property
    def by_derived(self) -> bool:
        """Whether cross-covariances of local tracks are derived."""
        return self.rule == "auto" or is_derived(self.rule, self.rule_options)

    def source(self, name: str) -> SourceConfig:
        """The settings of one source: its own, or the defaults."""
        return self.sources.get(name, self.source_defaults)


@dataclass(frozen=True)
class BusConfig:
    """Where the bus is."""

    realm: str = _setting("fusion", parsed(check_realm), "first part of every key")
    connect: tuple[str, ...] = _setting((DEFAULT_ENDPOINT,), endpoints, "endpoints of the hub to join")
    security: str | None = _setting(
        None, maybe(text), "security file or folder of `fusion-service keys`; left out: this file, if it has [security]"
    )
    queue: int = _setting(10_000, whole(10, 10_000_000), "messages held between bus and centre")


@dataclass(frozen=True)
class DaemonConfig:
    """How the process behaves."""

    state: str | None = _setting(None, maybe(text), "folder for ids and checkpoint; left out: ids by clock, no memory")
    status_period: float = _setting(1.0, number(0.1, 3600), "seconds between status messages")
    log_level: str = _setting("info", choice("debug", "info", "warning", "error"), "what is logged; -v goes before it")
    log_refusals: float = _setting(1.0, number(0.0, 1000), "log lines about refusals per second and reason at most")
    takeover: float = _setting(
        1.0, number(0.2, 60), "seconds without a sign of the active centre after which one that stands by takes over"
    )
    compiled: str = _setting(
        "auto",
        choice(*CHOICES),
        "small matrices by loops that numba compiles, same bits: auto, where it is installed",
    )


@dataclass(frozen=True)
class FlowConfig:
    """How much is taken of one source; 0: any."""

    messages: float = _setting(
        5e3, number(0, 1e9), "messages a second from one source; what is beyond any limit is dropped (flow); 0: none is"
    )
    bytes: float = _setting(1e8, number(0, 1e12), "bytes a second")
    tracks: float = _setting(1e6, number(0, 1e12), "tracks a second, or components of intensities")
    burst: float = _setting(2.0, number(0.01, 3600), "seconds of all this that may come at once")


@dataclass(frozen=True)
class LimitsConfig(FlowConfig):
    """The same for each source, but for those named."""

    sources: dict[str, FlowConfig] = _setting({}, table, "by name, over the others")


@dataclass(frozen=True)
class ServiceConfig:
    """The whole file."""

    centre: CentreConfig = CentreConfig()
    bus: BusConfig = BusConfig()
    service: DaemonConfig = DaemonConfig()
    limits: LimitsConfig = LimitsConfig()


def config_hash(config: CentreConfig) -> str:
    """A short hash of all settings: equal for equal settings. Those of `LATER` count where they are not as
    ever."""
    settings = dataclasses.asdict(config)
    for one in dataclasses.fields(config):
        if one.name in LATER and settings[one.name] == BEFORE.get(one.name, one.default):
            del settings[one.name]
    plain = json.dumps(settings, sort_keys=True, default=_plain)
    return hashlib.sha256((plain + str(getattr(config.frame, "kind", ""))).encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else repr(value)
