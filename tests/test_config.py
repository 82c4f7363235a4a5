"""Config files: every error at once, with file, line and key; defaults that explain themselves."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

import pytest

import schemas
from fusion_service.config import (
    CentreConfig,
    ConfigError,
    ServiceConfig,
    centre_config,
    config_hash,
    example_toml,
    load_config,
)


def load(folder: Path, text: str) -> ServiceConfig:
    path = folder / "centre.toml"
    path.write_text(text)
    return load_config(path)


def test_an_empty_file_is_all_defaults(tmp_path: Path) -> None:
    assert load(tmp_path, "") == ServiceConfig()
    assert centre_config({}) == CentreConfig()


def test_the_example_is_the_defaults(tmp_path: Path) -> None:
    assert load(tmp_path, example_toml()) == ServiceConfig()
    assert set(tomllib.loads(example_toml())) == {"centre", "bus", "service"}


def test_every_error_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    text = """\
[centre]
rule = "magic"
period = -1.0
spce = ["x"]
space = ["x", "y", "warp"]
frame = {kind = "enu", lat = 95.0, lon = 0.0}

[centre.sources.radar1]
motion = {kind = "cv"}
period = true

[bus]
realm = "a b"
[extra]
x = 1
"""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    path = tmp_path / "centre.toml"
    told = {problem.split(": ", 2)[0]: problem for problem in caught.value.problems}
    assert {f"{path}:{line}" for line in (2, 3, 4, 5, 6, 9, 10, 13, 14)} == set(told)
    assert "must be one of: " in told[f"{path}:2"]
    assert "unknown key (known: " in told[f"{path}:4"]
    assert "'warp'" in told[f"{path}:5"]
    assert "centre.sources.radar1.motion: has the keys kind, wants: kind, q, q_turn" in told[f"{path}:9"]


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"rule_options": {"colour": 1}}, "ci has no option 'colour' (known: "),
        ({"rule": 7}, "must be one of"),
        ({"frame": {"kind": "ecef"}}, "an ECEF picture needs x, y and z"),
        ({"sources": {"bad name": {}}}, "bad name"),
        ({"sources": 3}, "must be a table of tables"),
        ({"gate": float("nan")}, "must be a number from 0.5"),
        ({"confirm_hits": 2.0}, "must be a whole number"),
        ({"source_defaults": {"height": {"value": 0, "sigma": -1}}}, "height sigma"),
    ],
)
def test_what_is_wrong_is_said(raw: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        centre_config(raw)
    assert words in str(caught.value)


def test_not_toml_and_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"not TOML: .*line 2"):
        load(tmp_path, "[centre]\nrule = = 1\n")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "nowhere.toml")


def test_a_source_takes_the_defaults_that_it_does_not_change() -> None:
    config = centre_config({"source_defaults": {"period": 7.0}, "sources": {"r1": {"may_start": False}}})
    assert config.source("r1").period == 7.0
    assert not config.source("r1").may_start
    assert config.source("other").may_start


def test_the_hash_tells_configs_apart_and_only_them() -> None:
    base = centre_config({})
    assert config_hash(base) == config_hash(centre_config({"rule": "ci"}))
    changed = [
        centre_config({"rule": "naive"}),
        centre_config({"frame": {"kind": "enu", "lat": 1.0, "lon": 2.0}}),
        centre_config({"frame": {"kind": "local", "name": "dock"}}),
        centre_config({"sources": {"r1": {"period": 3.0}}}),
        dataclasses.replace(base, motion=schemas.Motion("ct", 1.0)),
    ]
    hashes = [config_hash(config) for config in [base, *changed]]
    assert len(set(hashes)) == len(hashes)
