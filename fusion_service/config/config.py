"""One TOML file -> frozen dataclasses. Every error at once, with file, line and key.

Durations are seconds. `ServiceConfig` is the whole file; `CentreConfig` its table [centre], and what
`FusionCentre` takes. Every field has a default and a line of help, which `example_toml` prints.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.config.toml_text import dotted, key_lines, line_of, toml_value
from schemas import ORIGINS, Ecef, Enu, Frame, Height, Local, Motion, check_name, check_realm, check_space

__all__ = [
    "BusConfig",
    "CentreConfig",
    "ConfigError",
    "DaemonConfig",
    "ServiceConfig",
    "SourceConfig",
    "centre_config",
    "config_hash",
    "example_toml",
    "load_config",
]

T = TypeVar("T")
Problems = list[tuple[tuple[str, ...], str]]
"""What is wrong, with the key where it is."""


class ConfigError(ValueError):
    """A config that cannot be used; `problems` has one line per error."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def _setting(default: Any, read: Callable[[Any], Any], help_text: str) -> Any:
    metadata = {"read": read, "help": help_text}
    if isinstance(default, dict):
        return field(default_factory=dict, metadata=metadata)
    return field(default=default, metadata=metadata)


def _number(low: float, high: float, *, above: bool = False) -> Callable[[Any], float]:
    def read(value: Any) -> float:
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not good or not (low < value if above else low <= value) or not value <= high:
            raise ValueError(f"is {value!r}, must be a number {'above' if above else 'from'} {low:g} to {high:g}")
        return float(value)

    return read


def _whole(low: int, high: int) -> Callable[[Any], int]:
    def read(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"is {value!r}, must be a whole number from {low} to {high}")
        return value

    return read


def _choice(*known: str) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if value not in known:
            raise ValueError(f"is {value!r}, must be one of: {', '.join(known)}")
        return str(value)

    read.__doc__ = " | ".join(known)
    return read


def _rule(value: Any) -> str:
    from fusion_service.rules import RULES

    return _choice(*RULES)(value)


def _mixture_rule(value: Any) -> str:
    from fusion_service.rules.mixtures import MIXTURE_RULES

    return _choice("moments", *MIXTURE_RULES)(value)


def _flag(value: Any) -> bool:
    if type(value) is not bool:
        raise ValueError(f"is {value!r}, must be true or false")
    return value


def _text(value: Any) -> str:
    if type(value) is not str or not value:
        raise ValueError(f"is {value!r}, must be a text")
    return value


def _texts(value: Any) -> tuple[str, ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"is {value!r}, must be a list of texts")
    return tuple(_text(item) for item in value)


def _parsed(check: Callable[[Any], T], read: Callable[[Any], Any] = _text) -> Callable[[Any], T]:
    return lambda value: check(read(value))


def _table(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"is {value!r}, must be a table")
    return dict(value)


def _parts(value: Any) -> dict[str, Any]:
    return {one.name: getattr(value, one.name) for one in fields(value)}


def _build(kind: type[T], value: Any) -> T:
    table = _parts(value) if isinstance(value, kind) else _table(value)
    known = {one.name: one.type for one in fields(kind)}  # type: ignore[arg-type]
    needed = {one.name for one in fields(kind) if one.default is dataclasses.MISSING}  # type: ignore[arg-type]
    if not needed <= set(table) <= set(known):
        raise ValueError(f"has the keys {', '.join(table) or 'none'}, wants: {', '.join(known)}")
    for name, one in table.items():
        if known[name] == "float":
            if not isinstance(one, (int, float)) or isinstance(one, bool):
                raise ValueError(f"{name} is {one!r}, must be a number")
            table[name] = float(one)
        if known[name] == "str" and not isinstance(one, str):
            raise ValueError(f"{name} is {one!r}, must be a text")
    return kind(**table)


def _frame(value: Any) -> Frame | None:
    if value is None:
        return None
    table = {"kind": value.kind, **_parts(value)} if isinstance(value, (Enu, Ecef, Local)) else _table(value)
    kinds: dict[str, type[Any]] = {"enu": Enu, "ecef": Ecef, "local": Local}
    kind = table.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"has kind {kind!r}, must be one of: {', '.join(kinds)}")
    frame: Frame = _build(kinds[kind], table)
    return frame


def _endpoints(value: Any) -> tuple[str, ...]:
    if not (texts := _texts(value)):
        raise ValueError(f"names no hub: write at least one, as in {DEFAULT_ENDPOINT}")
    return tuple(check_endpoint(text) for text in texts)


def _origins(value: Any) -> tuple[str, ...]:
    texts = _texts(value)
    if not texts or not set(texts) <= set(ORIGINS):
        raise ValueError(f"must be a list of some of: {', '.join(ORIGINS)}")
    return texts


def _maybe(read: Callable[[Any], T]) -> Callable[[Any], T | None]:
    return lambda value: None if value is None else read(value)


_DURATION = _number(0.0, 1e6)
_POSITIVE = _number(0.0, 1e6, above=True)


@dataclass(frozen=True)
class SourceConfig:
    """What is taken for a source that does not say it in its SensorInfo; `override` puts it above that."""

    period: float = _setting(1.0, _POSITIVE, "seconds between its messages")
    motion: Motion = _setting(Motion("cv", 1.0), lambda v: _build(Motion, v), "motion of its tracks")
    may_start: bool = _setting(True, _flag, "its tracks may start global tracks")
    height: Height = _setting(Height(), lambda v: _build(Height, v), "height of what a 2-D source sees, m")
    override: bool = _setting(False, _flag, "use these values even where its SensorInfo says otherwise")
    ignore: bool = _setting(False, _flag, "refuse all it sends (reason: muted)")
    allowed_origins: tuple[str, ...] = _setting(ORIGINS, _origins, "origins taken from it; others are refused")
    identity_trust: float = _setting(0.99, _number(0.5, 1 - 1e-9), "probability that an identity it says is right")
    kind_accuracy: float = _setting(0.8, _number(0, 1 - 1e-9), "probability that a class it says is right")


@dataclass(frozen=True)
class CentreConfig:
    """All that changes a result of `FusionCentre` or `IntensityCentre`."""

    name: str = _setting("centre", _parsed(check_name), "name of this centre in its keys")
    kind: str = _setting("tracks", _choice("tracks", "intensity"), "what it takes from its sources and fuses")
    space: tuple[str, ...] = _setting(
        ("x", "y", "vx", "vy"), _parsed(check_space, _texts), "state space of the picture"
    )
    frame: Frame | None = _setting(None, _frame, "frame of the picture; left out: that of the first source taken")
    clock: str = _setting("wall", _choice("wall", "message"), "step by wall clock, or by the messages' own time")
    period: float = _setting(1.0, _number(0.01, 1e5), "seconds between steps")
    delay: float = _setting(0.5, _DURATION, "wall clock: how far behind now a step is")
    lateness: float = _setting(5.0, _DURATION, "how late a message may be, seconds")
    max_future: float = _setting(2.0, _DURATION, "how far ahead of its reception a message's time may be")
    rule: str = _setting("ci", _rule, "fusion rule (fusion-service rules lists them)")
    rule_options: dict[str, Any] = _setting({}, _table, "options of the rule, e.g. {criterion = 'trace'}")
    mixture_rule: str = _setting("moments", _mixture_rule, "rule for mixtures; moments: as Gaussians, by the rule")
    mixture_options: dict[str, Any] = _setting({}, _table, "options of the mixture rule")
    max_components: int = _setting(8, _whole(1, 100), "components kept of a mixture")
    publish: str = _setting("mixture", _choice("mixture", "mean", "mode"), "how a track that is a mixture goes out")
    memory: str = _setting("restart", _choice("restart", "recursive"), "fuse local tracks only, or the last result too")
    memory_correlation: float = _setting(
        1.0, _number(0, 1), "bound on the correlation of the last result and new tracks"
    )
    motion: Motion = _setting(Motion("cv", 1.0), lambda v: _build(Motion, v), "motion of a global track on its own")
    gate: float = _setting(0.999, _number(0.5, 1 - 1e-9), "probability inside the gate for a new link")
    keep_gate: float = _setting(0.9999, _number(0.5, 1 - 1e-12), "probability inside the gate for a standing link")
    break_after: int = _setting(3, _whole(1, 255), "steps in a row that a link must fail before it is broken")
    merge_after: int = _setting(3, _whole(1, 255), "steps in a row that two global tracks must agree to be merged")
    confirm_hits: int = _setting(2, _whole(1, 64), "steps with new data that confirm a track ...")
    confirm_within: int = _setting(4, _whole(1, 64), "... within so many steps")
    confirm_sources: int = _setting(2, _whole(1, 64), "so many sources in one step confirm a track at once")
    confirm_existence: float = _setting(0.0, _number(0, 1), "existence needed to be confirmed")
    existence: str = _setting("consistent", _choice("consistent", "average", "geometric"), "how existence is fused")
    min_existence: float = _setting(
        0.0, _number(0, 1), "a track of less existence is tentative, or ends without support"
    )
    coast: float = _setting(5.0, _DURATION, "seconds a confirmed track lives on without support")
    fuse_origins: bool = _setting(False, _flag, "fuse live, exercise, simulated and replayed tracks with each other")
    stale_periods: float = _setting(3.0, _number(1, 1e6), "a source (or track) is stale after so many periods")
    intensity_rule: str = _setting(
        "hybrid",
        _choice("aa", "ga", "hybrid"),
        "kind = intensity: mean of the intensities; hybrid: number aa, place ga",
    )
    intensity_cardinality: str = _setting(
        "average", _choice("average", "consistent"), "hybrid: the number of targets in places with the same sources"
    )
    intensity_extract: str = _setting(
        "threshold", _choice("threshold", "rank"), "tracks: components above the threshold, or the round(mass) heaviest"
    )
    intensity_threshold: float = _setting(0.5, _number(0, 1), "weight above which a component is a track")
    intensity_prune: float = _setting(1e-3, _number(0, 1), "weight below which a component is dropped")
    intensity_merge: float = _setting(2.0, _number(0, 100), "d2 below which components of one mixture are merged")
    intensity_components: int = _setting(500, _whole(1, 5000), "components kept at most")
    max_pending: int = _setting(10_000, _whole(1, 10_000_000), "messages held per source for later steps")
    source_defaults: SourceConfig = _setting(SourceConfig(), lambda v: v, "for every source")
    sources: dict[str, SourceConfig] = _setting({}, _table, "by name, over the defaults")

    def source(self, name: str) -> SourceConfig:
        return self.sources.get(name, self.source_defaults)


@dataclass(frozen=True)
class BusConfig:
    """Where the bus is."""

    realm: str = _setting("fusion", _parsed(check_realm), "first part of every key")
    connect: tuple[str, ...] = _setting((DEFAULT_ENDPOINT,), _endpoints, "endpoints of the hub to join")
    queue: int = _setting(10_000, _whole(10, 10_000_000), "messages held between bus and centre")


@dataclass(frozen=True)
class DaemonConfig:
    """How the process behaves."""

    state: str | None = _setting(
        None, _maybe(_text), "folder for ids and checkpoint; left out: ids by clock, no memory"
    )
    status_period: float = _setting(1.0, _number(0.1, 3600), "seconds between status messages")
    log_refusals: float = _setting(1.0, _number(0.0, 1000), "log lines about refusals per second and reason at most")


@dataclass(frozen=True)
class ServiceConfig:
    """The whole file."""

    centre: CentreConfig = CentreConfig()
    bus: BusConfig = BusConfig()
    service: DaemonConfig = DaemonConfig()


def load_config(path: str | Path) -> ServiceConfig:
    """Read a TOML file. `ConfigError` lists every problem as `file:line: key: what`."""
    try:
        text = Path(path).read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: cannot be read: {error}"]) from None
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise ConfigError([f"{path}: not TOML: too deep"]) from None
    except ValueError as error:  # TOMLDecodeError, or a number of too many digits
        raise ConfigError([f"{path}: not TOML: {error}"]) from None
    problems: Problems = []
    known = {one.name: one for one in fields(ServiceConfig)}
    for name in raw:
        if name not in known:
            homes = [table for table in known if hasattr(getattr(ServiceConfig(), table), name)]
            where = f": put it under [{homes[0]}]" if homes else f" (known: {', '.join(known)})"
            problems.append(((name,), f"unknown table{where}"))
    config = ServiceConfig(
        centre=_read_centre(raw.get("centre", {}), ("centre",), problems),
        bus=_read(BusConfig, raw.get("bus", {}), ("bus",), problems),
        service=_read(DaemonConfig, raw.get("service", {}), ("service",), problems),
    )
    if problems:
        lines = key_lines(text)
        raise ConfigError([f"{path}:{line_of(lines, key)}: {dotted(key)}: {what}" for key, what in problems])
    return config


def centre_config(raw: CentreConfig | Mapping[str, Any]) -> CentreConfig:
    """A `CentreConfig` from a dict of its shape. `ConfigError` lists every problem as `key: what`."""
    if isinstance(raw, CentreConfig):
        return raw
    problems: Problems = []
    config = _read_centre(raw, (), problems)
    if problems:
        raise ConfigError([f"{dotted(key)}: {what}" for key, what in problems])
    return config


def config_hash(config: CentreConfig) -> str:
    """A short hash of all settings: equal for equal settings."""
    plain = json.dumps(dataclasses.asdict(config), sort_keys=True, default=_plain)
    return hashlib.sha256((plain + str(getattr(config.frame, "kind", ""))).encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else repr(value)


def _read(kind: type[T], raw: Any, where: tuple[str, ...], problems: Problems, base: Any = None) -> T:
    if not isinstance(raw, Mapping):
        problems.append((where, f"is {raw!r}, must be a table"))
        return kind()
    known = {one.name: one for one in fields(kind)}  # type: ignore[arg-type]
    values = {} if base is None else {name: getattr(base, name) for name in known}
    for name, value in raw.items():
        if name not in known:
            problems.append(((*where, str(name)), f"unknown key (known: {', '.join(known)})"))
            continue
        try:
            values[name] = known[name].metadata["read"](value)
        except (ValueError, OverflowError) as error:
            problems.append(((*where, name), str(error)))
    return kind(**values)


def _read_centre(raw: Any, where: tuple[str, ...], problems: Problems) -> CentreConfig:
    if not isinstance(raw, Mapping):
        problems.append((where, f"is {raw!r}, must be a table"))
        return CentreConfig()
    rest = {name: value for name, value in raw.items() if name not in ("source_defaults", "sources")}
    config = _read(CentreConfig, rest, where, problems)
    given = raw.get("source_defaults", {})
    defaults = (
        given if isinstance(given, SourceConfig) else _read(SourceConfig, given, (*where, "source_defaults"), problems)
    )
    sources: dict[str, SourceConfig] = {}
    table = raw.get("sources", {})
    if not isinstance(table, Mapping):
        problems.append(((*where, "sources"), f"is {table!r}, must be a table of tables"))
        table = {}
    for name, value in table.items():
        key = (*where, "sources", str(name))
        try:
            check_name(str(name))
        except ValueError as error:
            problems.append((key, str(error)))
        sources[str(name)] = (
            value if isinstance(value, SourceConfig) else _read(SourceConfig, value, key, problems, defaults)
        )
    if isinstance(config.frame, Ecef) and "z" not in config.space:
        problems.append(((*where, "frame"), "an ECEF picture needs x, y and z in the space"))
    if config.confirm_hits > config.confirm_within:
        what = (
            f"is {config.confirm_hits}, more than confirm_within, {config.confirm_within}: nothing would be confirmed"
        )
        problems.append(((*where, "confirm_hits"), what))
    if config.keep_gate < config.gate:
        what = f"is {config.keep_gate}, less than gate, {config.gate}: a link would break as soon as it is made"
        problems.append(((*where, "keep_gate"), what))
    wrong = {key[len(where)] for key, _ in problems if key[: len(where)] == where and len(key) > len(where)}
    if not wrong & {"rule", "rule_options", "space"}:
        place = "rule_options" if config.rule_options else "rule"
        problems.extend(((*where, place), what) for what in _rule_problems(config))
    return dataclasses.replace(config, source_defaults=defaults, sources=sources)


def _rule_problems(config: CentreConfig) -> list[str]:
    """Why the centre cannot fuse by this rule and its options: it is tried on one to three unit Gaussians."""
    from fusion_service.rules import RULES, RuleError, fuse_last

    options = RULES[config.rule].options
    unknown = [name for name in config.rule_options if name not in options]
    if unknown:
        known = ", ".join(options) or "none"
        return [f"{config.rule} has no option {name!r} (known: {known})" for name in unknown]
    n, few = len(config.space), dict(config.rule_options)
    if isinstance(few.get("samples"), int):
        few["samples"] = min(few["samples"], 1000)
    for count in (1, 2, 3):
        mean, covariance = np.zeros((count, n, 1)), np.tile(np.eye(n)[:, :, None], (count, 1, 1, 1))
        try:
            fused = fuse_last(config.rule, mean, covariance, influence=True, **few)
        except (RuleError, TypeError, ValueError, OverflowError) as error:
            return [f"{config.rule} cannot fuse {count} source{'s' * (count > 1)} here: {error}"]
        if not np.isfinite(fused.covariance).all():
            return [f"{config.rule} cannot fuse {count} source{'s' * (count > 1)} of unit covariance here"]
    return []


def example_toml() -> str:
    """A config with every setting at its default, commented with its help."""
    tables: list[tuple[str, Any]] = [
        ("centre", CentreConfig()),
        ("centre.source_defaults", SourceConfig()),
        ("bus", BusConfig()),
        ("service", DaemonConfig()),
    ]
    lines: list[str] = []
    for name, table in tables:
        lines += [f"[{name}]"]
        for one in fields(table):
            if one.name in ("source_defaults", "sources"):
                continue
            value = getattr(table, one.name)
            text = f"{one.name} = {toml_value(value)}" if value is not None else f"# {one.name} ="
            known = one.metadata["read"].__doc__ or ""
            lines.append(f"{text:<44} # {one.metadata['help']}{f' ({known})' if '|' in known else ''}")
        lines.append("")
    lines += [
        "# [centre.sources.radar1]                  # any key of source_defaults for one source",
        "# override = true",
    ]
    return "\n".join(lines) + "\n"
