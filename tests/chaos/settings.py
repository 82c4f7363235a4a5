"""Settings of a centre by chance: values of the config's own table, several at once."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

from fusion_service.config import CentreConfig, ConfigError, SourceConfig, centre_config
from tests.centre.test_every_setting import LONG, NEEDED, values
from tests.centre.worlds import SPACE

__all__ = ["drawn"]

NUMBERS = (0, 0.01, 0.1, 0.5, 0.9, 0.999, 1, 2, 3, 8, 20, 64, 100, 600, 1000, 50_000, 1e5, 2**62)
SPACES = (
    SPACE,
    SPACE,
    SPACE,
    LONG,
    ("x", "y"),
    ("x", "vx", "ax", "y", "vy", "ay"),
    ("x", "y", "vx", "vy", "turn_rate"),
)
MOTIONS = ({"kind": "cv", "q": 1.0}, {"kind": "cv", "q": 1e4}, {"kind": "still"}, {"kind": "ca", "q": 0.1})
LEAST = {"intensity_components": 64}
"""Below, others take the room of honest ones, as they may."""
APART = {"name", "space", "motion", "ignore", "source_defaults", "sources", "rule", "memory", "period", "max_future"}
"""Settings that are drawn by themselves, or left alone."""


def drawn(rng: random.Random) -> CentreConfig:
    """Settings that the config takes: a rule and a memory always, of the rest one in eight."""
    while True:
        try:
            return centre_config(_table(rng))
        except ConfigError:
            continue


def _table(rng: random.Random) -> dict[str, Any]:
    fields = {one.name: one for one in dataclasses.fields(CentreConfig)}
    table: dict[str, Any] = {one: rng.choice(values(fields[one])) for one in ("rule", "memory")}
    if table["rule"] in NEEDED:
        table["rule_options"] = NEEDED[table["rule"]]
    if rng.random() < 0.3:
        table["space"] = list(rng.choice(SPACES))
    if rng.random() < 0.2:
        table["motion"] = rng.choice(MOTIONS)
    table |= _some(rng, CentreConfig)
    table["source_defaults"] = _some(rng, SourceConfig)
    return table


def _some(rng: random.Random, kind: type[CentreConfig] | type[SourceConfig]) -> dict[str, Any]:
    some: dict[str, Any] = {}
    for one in dataclasses.fields(kind):
        if one.name in APART or rng.random() > 0.125:
            continue
        choices = values(one) or [number for number in NUMBERS if _taken(one, number)]
        choices = [value for value in choices if not value < LEAST.get(one.name, value)]
        if choices:
            some[one.name] = rng.choice(choices)
    return some


def _taken(one: dataclasses.Field[Any], value: Any) -> bool:
    try:
        return one.metadata["read"](value) is not None
    except (ValueError, TypeError, AttributeError):
        return False
