"""Steps with and without fresh data, of every kind of source, under every value of every enumerated setting: none
fails, and there is a picture. The settings are those of the config's own table, so that a new one is covered."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, SourceFound, SourceLost, make_centre
from fusion_service.config import CentreConfig, SourceConfig, centre_config
from fusion_service.config.readers import flag, read_mixture_rule, read_rule
from fusion_service.geodesy import transform
from fusion_service.rules import MIXTURE_RULES, RULES
from schemas.platform import Platform
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, moved, tracks

LONG = ("x", "y", "z", "vx", "vy", "vz")
TARGETS = np.array([[0.0, 0.0, 5.0, 0.0], [4000.0, 0.0, 0.0, 5.0], [0.0, 9000.0, -4.0, 3.0]])
NEEDED: dict[str, dict[str, Any]] = {"bar-shalom-campo": {"cross": "derived"}, "bci": {"max_correlation": 0.5}}
"""Options without which a rule cannot be used."""
Message = schemas.LocalTracks | schemas.LocalIntensity


def values(one: dataclasses.Field[Any]) -> list[Any]:
    """The values of a setting that is one of a few; none of one that is a number, say."""
    read = one.metadata["read"]
    if read is flag:
        return [True, False]
    if read is read_rule:
        return [*RULES, "auto"]
    if read is read_mixture_rule:
        return ["moments", *MIXTURE_RULES]
    if getattr(read, "__qualname__", "").startswith("choice."):
        return str(read.__doc__).split(" | ")
    return []


def cases() -> Iterator[tuple[str, dict[str, Any]]]:
    """The defaults, and every other value of every setting, each beside the defaults."""
    yield "defaults", {}
    usual, source = CentreConfig(), SourceConfig()
    for one in dataclasses.fields(CentreConfig):
        for value in values(one):
            if value == getattr(usual, one.name):
                continue
            table = {one.name: value}
            if one.name == "rule" and value in NEEDED:
                table["rule_options"] = NEEDED[value]
            yield f"{one.name}={value}", table
    for one in dataclasses.fields(SourceConfig):
        for value in values(one):
            if value == getattr(source, one.name):
                continue
            yield f"source.{one.name}={value}", {"source_defaults": {one.name: value}}


def scan(name: str, second: float, **changes: Any) -> schemas.LocalTracks:
    rng = np.random.default_rng([round(second), sum(name.encode())])
    means = moved(TARGETS, second) + rng.normal(size=TARGETS.shape) * [10.0, 10.0, 1.0, 1.0]
    return tracks(name, second, means, sigma=np.array([10.0, 10.0, 1.0, 1.0]), **changes)


def mixed(name: str, second: float, spread: tuple[float, float] = (30.0, 30.0)) -> schemas.LocalTracks:
    """Two components a track, apart along a line."""
    one = scan(name, second)
    d = np.array([*spread, 0.0, 0.0])
    means = (one.means[:, None] + np.stack([-d, d])).reshape(-1, 4)
    count = len(one.ids)
    return dataclasses.replace(
        one,
        means=means,
        covariances=np.repeat(one.covariances, 2, axis=0),
        counts=np.full(count, 2, np.uint16),
        weights=np.full(2 * count, 0.5),
    )


def long(name: str, second: float, frame: schemas.Frame) -> schemas.LocalTracks:
    """The same with height, in another frame."""
    one = scan(name, second)
    at = [LONG.index(axis) for axis in SPACE]
    means = np.zeros((len(one.means), 6))
    means[:, at] = one.means
    covariances = np.tile(np.diag([100.0, 100.0, 100.0, 1.0, 1.0, 1.0]), (len(means), 1, 1))
    means, covariances = transform(means, covariances, LONG, FRAME, frame)
    return dataclasses.replace(one, space=LONG, frame=frame, means=means, covariances=covariances)


def partial(name: str, second: float) -> schemas.LocalTracks:
    one = scan(name, second)
    return dataclasses.replace(
        one, space=("x", "y"), means=one.means[:, :2].copy(), covariances=one.covariances[:, :2, :2].copy()
    )


def intensity(name: str, second: float) -> schemas.LocalIntensity:
    one = scan(name, second)
    return schemas.LocalIntensity(
        source=name, epoch=1, seq=one.seq, sent=START, time=one.time, space=SPACE, frame=FRAME,
        weights=np.full(len(one.means), 0.9), means=one.means, covariances=one.covariances,
    )  # fmt: skip


def moving(name: str, second: float) -> schemas.LocalTracks:
    platform = Platform((10.0 * second, 0.0, 0.0), np.eye(3), 0.1, 0.01)
    return dataclasses.replace(scan(name, second), platform=platform)


def extended(name: str, second: float) -> schemas.LocalTracks:
    return scan(name, second, extent=np.tile([40.0, 8.0, 0.5], (len(TARGETS), 1)), shape="box")


KINDS: dict[str, Callable[[str, float], Message]] = {
    "gaussian": lambda name, second: scan(name, second, existence=np.full(len(TARGETS), 0.9)),
    "ecef": lambda name, second: long(name, second, schemas.Ecef()),
    "mixture": mixed,
    "intensity": intensity,
    "partial": partial,
    "extent": extended,
    "bearings": lambda name, second: mixed(name, second, (800.0, 0.0)),
    "platform": moving,
    "silent": scan,
    "local": lambda name, second: scan(name, second, frame=schemas.Local("yard")),
    "elsewhere": lambda name, second: long(name, second, schemas.Enu(59.1, -55.1)),
}
UNFIT = ("local",)
UNKNOWN = ("silent",)
"""That never say what they are."""


def fly(table: dict[str, Any], kinds: list[str]) -> list[int]:
    """Tracks in the picture after every step, with data in all but each third, and none at all in the last ones."""
    made, fault = make_centre(centre_config({"lateness": 1.0, "frame_wait": 1.0, **table}))
    assert not fault
    shown = []
    for second in range(1, 7):
        now = START + second * SECOND
        for number, kind in enumerate(kinds):
            name = f"{number:02d}-{kind}"
            if second == 1:
                made.handle(SourceFound(name), now)
                if kind not in UNKNOWN:
                    frame = schemas.Local("yard") if kind == "local" else FRAME
                    coverage = schemas.Disk(20_000.0)
                    made.handle(info(name, frame=frame, coverage=coverage, detection_probability=0.9), now)
            if second == 5:
                made.handle(SourceLost(name), now)
            if second % 3 and (second + number) % 4:
                made.handle(KINDS[kind](name, second - 0.1), now)
        result = made.step(now)
        schemas.encode(result.tracks)
        schemas.encode(result.log)
        schemas.encode(result.status)
        shown.append(len(result.picture.ids))
    assert make_centre(made.config, made.checkpoint())[1] == ""
    return shown


@pytest.mark.parametrize(("table"), [pytest.param(table, id=name) for name, table in cases()])
def test_every_value_of_every_setting_makes_a_picture(table: dict[str, Any]) -> None:
    shown = fly(table, [*KINDS, "gaussian"])
    expected = table.get("source_defaults") != {"ignore": True}
    assert (max(shown[2:]) >= len(TARGETS)) is expected or table.get("kind") == "intensity", shown
    if table.get("kind") == "intensity":
        assert max(shown) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_source_alone_makes_a_picture(kind: str) -> None:
    tables: list[dict[str, Any]] = [{"existence": "geometric"}, {"space": list(LONG)}]
    for table in tables if kind != "intensity" else [{"kind": "intensity"}, {}]:
        shown = fly(table, [kind, kind])
        fits = (kind == "intensity") is ("kind" in table) or (kind == "ecef" and "space" not in table)
        if fits and kind != "ecef":
            assert max(shown) >= len(TARGETS), (table, shown)


def test_an_ecef_source_first_does_not_keep_others_from_the_picture() -> None:
    for order in (["ecef", "gaussian", "partial"], ["ecef", "ecef", "gaussian"], ["local", "gaussian", "gaussian"]):
        shown = fly({}, order)
        assert max(shown) >= len(TARGETS), (order, shown)


def test_the_settings_are_found_in_the_table_of_the_config() -> None:
    names = {name.split("=")[0] for name, _ in cases()}
    assert {"kind", "memory", "existence", "rule", "mixture_rule", "supervision", "source.ignore"} <= names
    assert len([*cases()]) > 40
    assert isinstance(make_centre(CentreConfig())[0], FusionCentre)
