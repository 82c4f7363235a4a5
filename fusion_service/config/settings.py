"""Settings of a centre as plain values: as a step log records them, and as `--set` changes them.

A plain setting is a key as a config file writes it (`rule`, `rule_options.criterion`, `sources.radar1`) with numbers,
texts, lists and maps as its value; `centre_config` of what `nested` makes of them gives the same config back.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import msgpack
import numpy as np

from fusion_service.config.config import CentreConfig, ConfigError, SourceConfig
from fusion_service.config.toml_text import dotted, toml_value
from schemas import Polygon
from schemas.values import free_map

__all__ = ["change", "known_settings", "merge", "nested", "plain_settings", "recordable"]

MOST_RECORDED = 2**20
"""Bytes of settings above which they are no part of a step log."""


def plain_settings(config: CentreConfig) -> dict[str, Any]:
    """Every setting of `config` that has a value."""
    plain: dict[str, Any] = {}
    for one in fields(config):
        value = getattr(config, one.name)
        if isinstance(value, Mapping):
            for name, item in value.items():
                plain |= _shallow((one.name, str(name)), item)
        elif value is not None:
            plain |= _shallow((one.name,), value)
    return plain


def _shallow(key: tuple[str, ...], value: Any) -> dict[str, Any]:
    """The setting under its key; what would be too deep for an event of a step log, the corners of a polygon and the
    entries of a table in a table, under keys of their own."""
    table = _plain(value)
    if isinstance(value, Mapping):
        return {dotted((*key, name)): part for name, part in table.items()}
    if not isinstance(value, SourceConfig) or not isinstance(value.coverage, Polygon):
        return {dotted(key): table}
    polygon = table.pop("coverage")
    return {dotted(key): table} | {dotted((*key, "coverage", name)): part for name, part in polygon.items()}


def recordable(config: CentreConfig) -> dict[str, Any] | None:
    """The settings as a part of an event of a step log; None where they are too large, or too deep, for one."""
    plain = plain_settings(config)
    try:
        if len(msgpack.packb(plain)) > MOST_RECORDED:
            return None
        free_map({"config": plain})
    except (ValueError, TypeError, OverflowError):
        return None
    return plain


def nested(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Plain settings as the tables of a config. `ValueError` for a key that no config file could hold."""
    tables: dict[str, Any] = {}
    for key, value in plain.items():
        if "\n" in key:
            raise ValueError(f"{key!r} is no key")
        path, rest = [], tomllib.loads(f"{key} = 0")
        while isinstance(rest, dict):
            ((name, rest),) = rest.items()
            path.append(name)
        for name in reversed(path):
            value = {name: value}
        merge(tables, value)
    return tables


def known_settings(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """`tables` without the settings that this version does not know, and their names."""
    known = {one.name for one in fields(CentreConfig)}
    return {key: value for key, value in tables.items() if key in known}, sorted(set(tables) - known)


def change(text: str) -> dict[str, Any]:
    """What KEY=VALUE says, VALUE as TOML writes it, or a text without its quotes. `ConfigError` if it is neither."""
    key, equals, value = text.partition("=")
    if equals and "\n" not in text:
        for one in (value, toml_value(value.strip())):
            try:
                return tomllib.loads(f"{key} = {one}")
            except (ValueError, RecursionError):
                continue
    raise ConfigError([f"--set {text}: write KEY=VALUE, as in --set gate=0.99"])


def merge(into: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Put `more` into a table, and its tables into those that are there."""
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        kind = {"kind": value.kind} if hasattr(value, "kind") else {}
        return kind | {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
