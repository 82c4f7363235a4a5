"""Config files: every error at once, with file, line and key; defaults that explain themselves."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import pytest

import schemas
from fusion_service.config import (
    CentreConfig,
    ConfigError,
    ServiceConfig,
    SourceConfig,
    centre_config,
    config_hash,
    example_toml,
    load_config,
)
from fusion_service.config.correlation import group_bounds
from fusion_service.rules import RULES


def load(folder: Path, text: str) -> ServiceConfig:
    path = folder / "centre.toml"
    path.write_text(text)
    return load_config(path)


def test_an_empty_file_is_all_defaults(tmp_path: Path) -> None:
    assert load(tmp_path, "") == ServiceConfig()
    assert centre_config({}) == CentreConfig()


def test_the_example_is_the_defaults(tmp_path: Path) -> None:
    assert load(tmp_path, example_toml()) == ServiceConfig()
    assert set(tomllib.loads(example_toml())) == {"centre", "bus", "service", "limits"}


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
    assert "unknown key: did you mean space? (known: " in told[f"{path}:4"]
    assert "'warp'" in told[f"{path}:5"]
    assert "centre.sources.radar1.motion: motion cv needs q" in told[f"{path}:9"]


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"rule_options": {"colour": 1}}, "auto has no option 'colour' (known: "),
        ({"rule": 7}, "must be one of"),
        ({"rule": "cii"}, ": did you mean ci?"),
        ({"rule": "my_rule.py"}, "say which function of it, as in my_rule.py:fuse"),
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


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ('[centre]\nframe = {kind = ["enu"], lat = 1, lon = 2}\n', 2, "centre.frame: has kind ['enu'], must be one of"),
        ('[centre]\nmotion = {kind = "cv", q = "1"}\n', 2, "centre.motion: q is '1', must be a number"),
        ('[centre]\nmotion = {kind = "warp", q = 1}\n', 2, "centre.motion: unknown motion 'warp' (known: cv, ct, ca, "),
        ('[centre]\nmotion = {kind = "ou", sigma = 1}\n', 2, "centre.motion: motion ou needs tau, at least 1e-06 s"),
        ('[centre]\nmotion = {kind = "ou", q = 1, tau = 9}\n', 2, "motion ou takes sigma, tau, q_turn, not q"),
        ('[centre]\nmotion = {kind = "singer", tau = 9}\n', 2, "motion singer needs sigma, more than 0"),
        ('[centre]\nmotion = {kind = "still", q = -1}\n', 2, "centre.motion: q is -1.0, not a number from 0"),
        ('[centre]\nframe = {kind = "enu", lat = "59", lon = 1}\n', 2, "centre.frame: lat is '59', must be a number"),
        ('[centre]\nframe = {kind = "local", name = 3}\n', 2, "centre.frame: name is 3, must be a text"),
        (f"[centre]\nperiod = 1{'0' * 400}\n", 2, "centre.period: "),
        ("# a\u2028b\x85c\r\n[centre]\r\nperiod = -1\r\n", 3, "centre.period"),
        ("\ufeff[centre]\nperiod = -1\n", 2, "centre.period"),
        ('[centre]\n[centre.sources."radar.1"]\nperiod = -1\n', 3, 'centre.sources."radar.1".period'),
        ("centre.sources.'radar.1'.period = -1\n", 1, 'centre.sources."radar.1".period'),
        ("[centre]\nconfirm_hits = 5\nconfirm_within = 4\n", 2, "more than confirm_within, 4"),
        ("[centre]\ngate = 0.9999\nkeep_gate = 0.9\n", 3, "less than gate, 0.9999"),
        ("[bus]\nconnect = []\n", 2, "bus.connect: names no hub"),
        ('[bus]\nconnect = ["127.0.0.1:7447"]\n', 2, "bus.connect: '127.0.0.1:7447' is not an endpoint"),
    ],
)
def test_the_line_and_what_is_wrong_there(tmp_path: Path, text: str, line: int, words: str) -> None:
    (tmp_path / "centre.toml").write_bytes(text.encode())
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "centre.toml")
    (problem,) = caught.value.problems
    assert problem.startswith(f"{tmp_path / 'centre.toml'}:{line}: ")
    assert words in problem


@pytest.mark.parametrize("text", ["a = " + "[" * 5000 + "]" * 5000, "[centre]\nmax_pending = " + "9" * 5000])
def test_what_no_parser_can_take_is_no_toml(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="not TOML"):
        load(tmp_path, text)


def bounds(**table: object) -> dict[str, object]:
    """A config of `bci` with bounds between groups."""
    return {"rule": "bci", "rule_options": {"max_correlation": table}}


@pytest.mark.parametrize(
    ("raw", "key", "words"),
    [
        ({"rule_options": {"criterion": "best"}}, "rule_options", "criterion 'best': one of det, trace"),
        ({"rule": "bci", "rule_options": {"max_correlation": 7}}, "rule_options", "must lie between 0 and 1"),
        ({"rule": "bci", "rule_options": {"max_correlation": [[1, 0], [0, 1]]}}, "rule_options", "has shape (2, 2)"),
        ({"rule_options": {"scales": [1.0, 1.0]}}, "rule_options", "4 positive numbers"),
        ({"rule": "hmd-s", "rule_options": {"seed": "x"}}, "rule_options", "seed 'x': a whole number"),
        ({"rule": "bar-shalom-campo"}, "rule", 'needs rule_options = {cross = "derived"}'),
        ({"rule": "bar-shalom-campo", "rule_options": {"cross": "known"}}, "rule_options", "not 'known'"),
        ({"rule": "bar-shalom-campo", "rule_options": {"a": 1, "cross": "derived"}}, "rule_options", "no option 'a'"),
        ({"rule": "bci", "rule_options": {"max_correlation": "guessed"}}, "rule_options", "not an array of numbers"),
        (bounds(within=1.5), "rule_options", "max_correlation.within is 1.5, must be a number from 0 to 1"),
        (bounds(beyond=0.5), "rule_options", "max_correlation has no key 'beyond'"),
        (bounds(pairs={"a": 1}), "rule_options", "max_correlation.pairs is"),
        (bounds(pairs=[{"groups": ["a"], "bound": 0.5}]), "rule_options", "wants {groups"),
        (bounds(pairs=[{"groups": ["a", 3], "bound": 0.5}]), "rule_options", "a group is 3, must be a text"),
        (bounds(pairs=[{"groups": ["a", "b"], "bound": "x"}]), "rule_options", "bound is 'x'"),
        (bounds(pairs=2 * [{"groups": ["a", "b"], "bound": 1}]), "rule_options", "names a and b twice"),
    ],
)
def test_a_rule_that_could_not_fuse_in_the_centre_is_told(raw: dict[str, object], key: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        centre_config(raw)
    (problem,) = caught.value.problems
    assert problem.startswith(f"{key}: ")
    assert words in problem


def test_bounds_between_groups_are_read(tmp_path: Path) -> None:
    config = load(
        tmp_path,
        '[centre]\nrule = "bci"\n[centre.rule_options.max_correlation]\nbetween = 0.2\n'
        'pairs = [{groups = ["shore", "nav"], bound = 0.5}, {groups = ["nav", "nav"], bound = 0.9}]\n',
    ).centre
    table = group_bounds(config.rule_options)
    assert table is not None
    asked = [("nav", "shore"), ("shore", "nav"), ("nav", "nav"), ("shore", "shore"), ("nav", "x"), ("x", "x")]
    assert [table.of(*pair) for pair in asked] == [0.5, 0.5, 0.9, 1.0, 0.2, 1.0]
    assert group_bounds({}) is None
    assert centre_config({"rule": "bci", "rule_options": {"max_correlation": "derived"}}).rule == "bci"
    assert centre_config({"rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}}).rule == "bar-shalom-campo"


def test_every_other_rule_can_be_chosen_in_four_and_in_nine_dimensions() -> None:
    for rule in set(RULES) - {"bar-shalom-campo"}:
        for space in (("x", "y", "vx", "vy"), ("x", "vx", "ax", "y", "vy", "ay", "z", "vz", "az")):
            assert centre_config({"rule": rule, "space": space}).rule == rule


def test_a_key_outside_its_table_is_told_where_it_belongs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, 'rule = "ci"\nrealm = "x"\n')
    assert "put it under [centre]" in caught.value.problems[0]
    assert "put it under [bus]" in caught.value.problems[1]


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
    assert config_hash(base) == config_hash(centre_config({"rule": "auto"}))
    changed = [
        centre_config({"rule": "naive"}),
        centre_config({"frame": {"kind": "enu", "lat": 1.0, "lon": 2.0}}),
        centre_config({"frame": {"kind": "local", "name": "dock"}}),
        centre_config({"sources": {"r1": {"period": 3.0}}}),
        dataclasses.replace(base, motion=schemas.Motion("ct", 1.0)),
    ]
    hashes = [config_hash(config) for config in [base, *changed]]
    assert len(set(hashes)) == len(hashes)


def test_the_hash_covers_every_field() -> None:
    base = CentreConfig()
    other: Any = object()
    changed = [dataclasses.replace(base, **{one.name: other}) for one in dataclasses.fields(CentreConfig)]
    for one in dataclasses.fields(SourceConfig):
        source = dataclasses.replace(base.source_defaults, **{one.name: other})
        changed += [dataclasses.replace(base, source_defaults=source), dataclasses.replace(base, sources={"a": source})]
    hashes = [config_hash(config) for config in [base, *changed]]
    assert len(set(hashes)) == len(hashes)


def test_the_hash_is_the_same_for_a_whole_number_and_the_same_number_with_a_point() -> None:
    whole, point = ({"motion": {"kind": "cv", "q": q}, "period": q} for q in (2, 2.0))
    assert config_hash(centre_config(whole)) == config_hash(centre_config(point))
