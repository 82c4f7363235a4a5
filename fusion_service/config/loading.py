"""A config from a TOML file, or from a dict of its shape: every error at once, with file, line and key."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fusion_service.config.config import (
    BusConfig,
    CentreConfig,
    ConfigError,
    DaemonConfig,
    FlowConfig,
    LimitsConfig,
    ServiceConfig,
    SourceConfig,
)
from fusion_service.config.correlation import tried
from fusion_service.config.own_rule import with_own_rule
from fusion_service.config.toml_text import dotted, key_lines, line_of
from schemas import Ecef, Motion, centre_source, check_source

__all__ = ["centre_config", "load_config"]

T = TypeVar("T")
Problems = list[tuple[tuple[str, ...], str]]
"""What is wrong, with the key where it is."""


def load_config(path: str | Path) -> ServiceConfig:
    """Read a TOML file. Raises `ConfigError`, which lists every problem as `file:line: key: what`."""
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
    raw = with_own_rule(raw, Path(path).parent, problems)
    known = {one.name: one for one in fields(ServiceConfig)}
    for name in raw:
        if name not in known and name != "security":  # fusion_service.bus reads that
            homes = [table for table in known if hasattr(getattr(ServiceConfig(), table), name)]
            where = f": put it under [{homes[0]}]" if homes else f" (known: {', '.join(known)})"
            problems.append(((name,), f"unknown table{where}"))
    here = BusConfig(security=str(path) if "security" in raw else None)
    config = ServiceConfig(
        centre=_read_centre(raw.get("centre", {}), ("centre",), problems),
        bus=_read(BusConfig, raw.get("bus", {}), ("bus",), problems, here),
        service=_read(DaemonConfig, raw.get("service", {}), ("service",), problems),
        limits=_read_limits(raw.get("limits", {}), ("limits",), problems),
    )
    if problems:
        lines = key_lines(text)
        raise ConfigError([f"{path}:{line_of(lines, key)}: {dotted(key)}: {what}" for key, what in problems])
    return config


def centre_config(raw: CentreConfig | Mapping[str, Any]) -> CentreConfig:
    """A `CentreConfig` from a dict of its shape. Raises `ConfigError`, which lists every problem as `key: what`."""
    if isinstance(raw, CentreConfig):
        return raw
    problems: Problems = []
    config = _read_centre(raw, (), problems)
    if problems:
        raise ConfigError([f"{dotted(key)}: {what}" for key, what in problems])
    return config


def _read(kind: type[T], raw: Any, where: tuple[str, ...], problems: Problems, base: Any = None) -> T:
    if not isinstance(raw, Mapping):
        problems.append((where, f"is {raw!r}, must be a table"))
        return kind()
    known = {one.name: one for one in fields(kind)}  # type: ignore[arg-type]
    values = {} if base is None else {name: getattr(base, name) for name in known}
    for name, value in raw.items():
        if name not in known:
            near = difflib.get_close_matches(str(name)[:64], known, 1)
            meant = f": did you mean {near[0]}?" if near else ""
            problems.append(((*where, str(name)), f"unknown key{meant} (known: {', '.join(known)})"))
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
    sources = _read_sources(
        raw.get("sources", {}), (*where, "sources"), defaults, config.motion or defaults.motion, problems
    )
    if centre_source(config.name) in sources:
        problems.append(((*where, "sources", centre_source(config.name)), "is this centre itself: name another one"))
    problems.extend(((*where, key), what) for key, what in _contradictions(config))
    wrong = {key[len(where)] for key, _ in problems if key[: len(where)] == where and len(key) > len(where)}
    if not wrong & {"rule", "rule_options", "space"}:
        place = "rule_options" if config.rule_options else "rule"
        problems.extend(((*where, place), what) for what in _rule_problems(config))
    return dataclasses.replace(config, source_defaults=defaults, sources=sources)


def _read_limits(raw: Any, where: tuple[str, ...], problems: Problems) -> LimitsConfig:
    given = raw.get("sources", {}) if isinstance(raw, Mapping) else {}
    rest = {name: value for name, value in raw.items() if name != "sources"} if isinstance(raw, Mapping) else raw
    limits = _read(LimitsConfig, rest, where, problems)
    if not isinstance(given, Mapping):
        problems.append(((*where, "sources"), f"is {given!r}, must be a table of tables"))
        return limits
    sources = {
        str(name): _read(FlowConfig, value, (*where, "sources", str(name)), problems, limits)
        for name, value in given.items()
    }
    return dataclasses.replace(limits, sources=sources)


def _read_sources(
    table: Any, where: tuple[str, ...], defaults: SourceConfig, motion: Motion, problems: Problems
) -> dict[str, SourceConfig]:
    if not isinstance(table, Mapping):
        problems.append((where, f"is {table!r}, must be a table of tables"))
        return {}
    sources: dict[str, SourceConfig] = {}
    for name, value in table.items():
        key = (*where, str(name))
        try:
            check_source(str(name))
        except ValueError as error:
            problems.append((key, str(error)))
        base = dataclasses.replace(defaults, motion=motion) if str(name).startswith(centre_source("")) else defaults
        sources[str(name)] = (
            value if isinstance(value, SourceConfig) else _read(SourceConfig, value, key, problems, base)
        )
    return sources


def _contradictions(config: CentreConfig) -> Iterator[tuple[str, str]]:
    """Settings that are good alone and bad together: which one to change, and why."""
    if isinstance(config.frame, Ecef) and "z" not in config.space:
        yield "frame", "an ECEF picture needs x, y and z in the space"
    hits, within = config.confirm_hits, config.confirm_within
    if hits > within:
        yield "confirm_hits", f"is {hits}, more than confirm_within, {within}: nothing would be confirmed"
    if config.keep_gate < config.gate:
        why = "a link would break as soon as it is made"
        yield "keep_gate", f"is {config.keep_gate}, less than gate, {config.gate}: {why}"


def _rule_problems(config: CentreConfig) -> list[str]:
    """Why the centre cannot fuse by this rule and its options: it is tried on one to three unit Gaussians."""
    from fusion_service.rules import RULES, RuleError, fuse_last
    from fusion_service.rules.face.own import loaded

    try:
        rule, few = tried(config.rule, config.rule_options)
    except ValueError as error:
        return [str(error)]
    options = RULES[rule].options
    unknown = [name for name in few if name not in options]
    if unknown:
        known = ", ".join(options) or "none"
        return [f"{rule} has no option {name!r} (known: {known})" for name in unknown]
    n = len(config.space)
    if isinstance(few.get("samples"), int):
        few["samples"] = min(few["samples"], 1000)
    for count in (1, 2, 3):
        mean, covariance = np.zeros((count, n, 1)), np.tile(np.eye(n)[:, :, None], (count, 1, 1, 1))
        try:
            fused = fuse_last(rule, mean, covariance, influence=True, **few)
        except (RuleError, TypeError, ValueError, OverflowError) as error:
            return [f"{config.rule} cannot fuse {count} source{'s' * (count > 1)} here: {error}"]
        if not np.isfinite(fused.covariance).all():
            if own := loaded(rule):
                return [f"{config.rule} cannot fuse {count} sources here: {own.problem}"]
            return [f"{config.rule} cannot fuse {count} source{'s' * (count > 1)} of unit covariance here"]
    return []
