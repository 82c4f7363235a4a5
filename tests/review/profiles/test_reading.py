"""Profiles: those that are shipped, and every error of a file at once, with its line and key."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fusion_service.review.profiles import ProfileError, load_profile, shipped
from fusion_service.review.profiles.counting import COUNTING
from fusion_service.review.profiles.profile import KINDS
from fusion_service.review.profiles.telling import asked
from tests.docs.pages import ROOT, blocks

WRONG = """\
[profile]
name = "mine"
cutof_m = 30
[[area]]
name = "runway"
polygon_lat_lon_deg = [[10.0, 160.0], [10.1, 160.0], [100.0, 160.0]]
[[area]]
name = "runway"
disk_x_y_m = [0, 0]
[[requirement]]
kind = "updat"
[[requirement]]
kind = "update"
interval_s = -8
share_min = 0.97
area = "runwy"
[[requirement]]
kind = "position_error"
within_m = 12
[[requirement]]
kind = "gap"
longer_than_sec = 5
interval_s = 1
share_max = 1.5
[identities]
seven = 7
"""


def test_all_errors_are_told_at_once_with_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(WRONG)
    with pytest.raises(ProfileError) as told:
        load_profile(str(path))
    problems = told.value.problems
    for wanted in (
        ":3: profile.cutof_m: unknown key: did you mean cutoff_m?",
        ":1: profile: needs source",
        ":6: area[1].polygon_lat_lon_deg: has a latitude beyond 90",
        ":8: area[2].name: is 'runway', a name that is taken",
        ":7: area[2]: needs a disk and its radius_m, or neither",
        ":11: requirement[1].kind: is 'updat': did you mean update?",
        ":14: requirement[2].interval_s: is -8, must be a number above 0",
        ":16: requirement[2].area: is 'runwy', no area of this profile: did you mean runway?",
        ":17: requirement[3]: needs within_m and share_min, or rms_max_m",
        ":22: requirement[4].longer_than_sec: unknown key: did you mean longer_than_s?",
        ":20: requirement[4]: needs longer_than_s",
        ":24: requirement[4].share_max: is 1.5, must be a number from 0 to 1",
        ":26: identities.seven: is 7, must be an identity",
    ):
        assert any(f"{path}{wanted}" in problem for problem in problems), (wanted, problems)
    assert len(problems) == 13


def test_a_file_that_is_no_profile_is_told(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="did you mean en-route"):
        load_profile("en-rout")
    path = tmp_path / "mine.toml"
    path.write_text("[profile\n")
    with pytest.raises(ProfileError, match="not TOML"):
        load_profile(str(path))
    path.write_text('[profile]\nname = "a"\nsource = "b"\nrequirement = 3\n')
    with pytest.raises(ProfileError, match="a profile needs at least one"):
        load_profile(str(path))


def test_the_shipped_ones_say_their_figures_and_where_these_stand() -> None:
    assert set(shipped()) == {"en-route", "manoeuvring-area", "ship-radar"}
    profiles = {name: load_profile(name) for name in shipped()}
    for one in profiles.values():
        assert one.source
        assert all(need.source for need in one.requirements)
    figures = {(name, need.name): asked(need) for name, one in profiles.items() for need in one.requirements}
    assert figures["en-route", "update every 8 s"] == ">= 97 % of 8 s"
    assert figures["en-route", "horizontal position"] == "<= 350 m"
    assert figures["en-route", "false tracks"] == "<= 0.1 %"
    assert figures["manoeuvring-area", "position, 95 %"] == ">= 95 % within 12 m"
    assert figures["manoeuvring-area", "gaps over 5 s"] == "<= 0.0001 % in gaps over 5 s"
    gaps = {name: need.numbers for name, one in profiles.items() for need in one.requirements if need.kind == "gap"}
    assert (gaps["en-route"]["longer_than_s"], gaps["en-route"]["share_max"]) == (16.4, 0.01)
    times = [need.numbers["after_s"] for need in profiles["ship-radar"].requirements if need.kind == "motion_after"]
    assert times == [60.0, 180.0]


def test_the_profile_of_the_docs(tmp_path: Path) -> None:
    (block,) = [one for one in blocks("docs/requirements.md") if one.text.startswith("[profile]")]
    path = tmp_path / "harbour.toml"
    path.write_text(block.text)
    found = load_profile(str(path))
    assert [area.name for area in found.areas] == ["fairway", "inner"]
    assert found.identities == {17: "mmsi:257000000", "tern": "mmsi:257000001"}
    page = (ROOT / "docs/requirements.md").read_text("utf-8")
    for kind, keys in KINDS.items():
        row = re.search(rf"^\| `{kind}` \|.*$", page, re.M)
        assert row is not None
        assert all(f"`{key}`" in row[0] for key, one in keys.keys.items() if one.needed), kind


def test_every_kind_is_counted() -> None:
    assert set(KINDS) == set(COUNTING)
