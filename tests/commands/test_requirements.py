"""`fusion-service evaluate --profile` and `--reference` on a recorded mission: words, JSON, page and exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.recording import Recorder
from fusion_service.review.profiles import shipped
from schemas import Truth
from tests.recording.mission import mission

PROFILE = """
[profile]
name = "radars"
source = "a test"
note = "of three radars"
cutoff_m = 500

[[area]]
name = "north"
polygon_x_y_m = [[-1e6, 0.0], [1e6, 0.0], [1e6, 1e6], [-1e6, 1e6]]

[[requirement]]
kind = "position_error"
rms_max_m = 400.0

[[requirement]]
kind = "detection"
name = "seen <in> the north"
area = "north"
share_min = 0.5
"""
MORE = """
[[requirement]]
kind = "gap"
longer_than_s = 5.0
interval_s = 1.0
share_max = 1e-6

[[requirement]]
kind = "position_error"
name = "exact"
rms_max_m = 0.001
unverified = "made up"
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A mission, and the same without truth."""
    folder = tmp_path_factory.mktemp("requirements")
    paths = folder / "flown.rrd", folder / "blind.rrd"
    for path in paths:
        with Recorder(path, draw=False) as recorder:
            for sent in mission(40):
                if path.stem == "flown" or not isinstance(sent.message, Truth):
                    recorder.handle(sent.key, sent.data, sent.received)
    return paths


def test_what_is_kept_to_passes_and_a_rare_rate_is_not_shown(
    flown: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profile = tmp_path / "radars.toml"
    profile.write_text(PROFILE)
    assert main(["evaluate", str(flown[0]), "--profile", str(profile)]) == 0
    assert "radars: 2 passed" in capsys.readouterr().out
    profile.write_text(PROFILE + MORE)
    out, page = tmp_path / "scores.json", tmp_path / "report.html"
    files = ["--json", str(out), "--html", str(page)]
    assert main(["evaluate", str(flown[0]), "--profile", str(profile), *files]) == 1
    said = capsys.readouterr()
    assert "radars: 2 passed, 1 failed, 1 not shown" in said.err
    assert "gap: at 95 % confidence at most" in said.out
    assert "2,995,731 samples without one would show it" in said.out
    assert "exact: not kept by target" in said.out
    assert "exact: figure not verified: made up" in said.out
    (told,) = json.loads(out.read_text())["requirements"]
    assert told["verdict"] == "failed"
    assert [one["verdict"] for one in told["requirements"]] == ["passed", "passed", "not shown", "failed"]
    assert set(told["requirements"][0]["targets"]) == set("12345")
    html = page.read_text()
    assert "Requirements: radars" in html
    assert "seen &lt;in&gt; the north" in html
    assert "<in>" not in html


def test_without_truth_the_smoothed_reference_takes_its_place(
    flown: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = str(flown[1])
    profile = tmp_path / "radars.toml"
    profile.write_text(PROFILE)
    assert main(["evaluate", blind, "--profile", str(profile)]) == 1
    assert "no truth to score against" in capsys.readouterr().err
    assert main(["evaluate", blind, "--profile", str(profile), "--reference", "smoothed"]) == 0
    assert "against a reference smoothed from all sources" in capsys.readouterr().out
    assert main(["evaluate", blind, "--reference", "each"]) == 0
    lines = capsys.readouterr().out.splitlines()
    table = lines[next(k for k, line in enumerate(lines) if "smoothed from all others" in line) :]
    assert [line.split()[0] for line in table[2:5]] == ["radar1", "radar2", "radar3"]
    assert main(["evaluate", blind, "--reference", "without:radar9"]) == 1
    assert "there are: radar1, radar2, radar3" in capsys.readouterr().err
    assert main(["evaluate", blind, "--reference", "best"]) == 2
    assert main(["evaluate"]) == 2


def test_targets_that_have_names_are_called_by_them(
    flown: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truth from a table of names: in words, on the page, in JSON, and under [identities]."""
    table, profile = tmp_path / "gps.csv", tmp_path / "radars.toml"
    lines = ["time,id,x,y"]
    for sent in mission(40):
        if isinstance(sent.message, Truth):
            at = [sent.message.space.index(name) for name in "xy"]
            for one, state in zip(sent.message.ids.tolist(), sent.message.means, strict=True):
                x, y = state[at].tolist()
                lines.append(f"{sent.message.time},boat {one},{x!r},{y!r}")
    table.write_text("\n".join(lines))
    who = '[[requirement]]\nkind = "identity"\nverdict = "none"\nshare_min = 0.5\n[identities]\n"boat 2" = "mmsi:1"\n'
    profile.write_text(PROFILE + MORE + who)
    out, page = tmp_path / "scores.json", tmp_path / "report.html"
    files = ["--truth", str(table), "--json", str(out), "--html", str(page)]
    assert main(["evaluate", str(flown[0]), "--profile", str(profile), *files]) == 1
    assert "exact: not kept by target boat " in capsys.readouterr().out
    assert '<td class="left">boat 1</td>' in page.read_text()
    (told,) = json.loads(out.read_text())["requirements"]
    assert told["names"]["2"] == "boat 2"
    assert set(told["requirements"][-1]["targets"]) == {"2"}


def test_each_source_by_the_others_leaves_the_rest_by_the_missions_own_truth(
    flown: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first tables are of the truth, and nothing says that they are of a reference; the last one is of it."""
    own, out = str(flown[0]), tmp_path / "scores.json"
    assert main(["evaluate", own, "--json", str(out)]) == 0
    by_truth = json.loads(out.read_text())
    assert main(["evaluate", own, "--reference", "each", "--json", str(out)]) == 0
    said, told = capsys.readouterr().out, json.loads(out.read_text())
    assert "scored against a reference" not in said
    assert "Tracks against the truth:" in said
    assert (told["rows"], told["reference"]) == (by_truth["rows"], "")
    assert [one["source"] for one in told["each_source"]] == ["radar1", "radar2", "radar3"]
    assert all(one["pairs"] > 0 and one["rmse_position"] > 0 for one in told["each_source"])
    assert main(["evaluate", own, "--reference", "smoothed"]) == 0
    assert "Tracks against the reference:" in capsys.readouterr().out


def test_the_shipped_profiles_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--profile", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in shipped())
    assert main(["evaluate", "x.rrd", "--profile", "ship-rader"]) == 2
    assert "did you mean ship-radar?" in capsys.readouterr().err
