"""What holds of every command: one file each, help with an example, and nothing loaded that it does not need."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fusion_service import commands
from fusion_service.cli import main
from fusion_service.commands import COMMANDS, arguments
from fusion_service.process import argument, data_folder, positive, whole
from fusion_service.review.replay.variants import variants_of
from fusion_service.rules import RULES

FILES = {path.stem for path in Path(commands.__path__[0]).glob("*.py")} - {
    "__init__",
    "arguments",
    "observed",
    "requirements",
    "scored_mission",
    "sealed",
}


def test_every_file_is_a_command() -> None:
    assert set(COMMANDS) == FILES


@pytest.mark.parametrize(("name", "module"), COMMANDS.items(), ids=COMMANDS)
def test_a_command_has_help_and_an_example(name: str, module: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert set(module.__all__) == {"EXAMPLE", "HELP", "add", "run"}
    assert module.EXAMPLE.startswith(f"fusion-service {name}")
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    assert f"Example:\n  {module.EXAMPLE}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "light"),
    [
        (["--help"], {"numpy", "zenoh", "rerun", "scipy", "msgpack"}),
        (["rules"], {"zenoh", "rerun", "fusion_service.demo", "fusion_service.config", "fusion_service.service"}),
        (["check"], {"zenoh", "rerun", "fusion_service.demo", "fusion_service.service"}),
    ],
)
def test_a_command_loads_only_what_it_needs(command: list[str], light: set[str]) -> None:
    code = (
        "import sys\nfrom fusion_service.cli import main\ntry:\n  main(sys.argv[1:])\nexcept SystemExit:\n  pass\n"
        "print('loaded', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=True)
    assert set(done.stdout.rpartition("loaded ")[2].split()) & light == set()


@pytest.mark.parametrize(
    ("read", "good", "bad"),
    [
        (positive, {"0.5": 0.5, "1e3": 1000.0}, ["0", "-1", "nan", "inf", "x", ""]),
        (whole, {"0": 0, "17": 17}, ["-1", "1.0", "x", "", "9" * 19, "²"]),
        (arguments.port, {"1": 1, "65535": 65535}, ["0", "65536", "-1", "x", ""]),
    ],
)
def test_values_of_options(read: object, good: dict[str, object], bad: list[str]) -> None:
    assert callable(read)
    for text, value in good.items():
        assert argument(read)(text) == value
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError, match="is not a"):
            argument(read)(text)


def test_data_are_in_the_folder_or_in_one_of_their_name_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FUSION_DATA", raising=False)
    assert data_folder("autoferry") is None
    assert data_folder("autoferry", "") is None
    assert data_folder("autoferry", tmp_path) == tmp_path
    (tmp_path / "autoferry").mkdir()
    assert data_folder("autoferry", str(tmp_path)) == tmp_path / "autoferry"
    assert data_folder("autoferry", tmp_path / "autoferry") == tmp_path / "autoferry"
    monkeypatch.setenv("FUSION_DATA", str(tmp_path))
    assert data_folder("autoferry") == tmp_path / "autoferry"
    assert data_folder("other") == tmp_path
    assert data_folder("other", "given") == Path("given")


def test_auto_is_among_the_rules(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rules"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[::2]] == [*RULES, "auto"]
    assert "max_correlation" in lines[-1]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["--set", "rule_options.delta=0.5"], "auto has no option 'delta' (known: criterion, max_correlation, scales)"),
        (
            ["--set", "rule_options.max_correlation=0.5"],
            "auto takes max_correlation as a table of bounds between groups",
        ),
        (["--set", "rule_options.max_correlation={within = 2}"], "max_correlation.within is 2, must be a number from"),
        (["--criterion", "size"], "auto cannot fuse 1 source here: criterion 'size': one of det, trace"),
        (["--set", "rule_options.scales=[1, 2]"], "auto cannot fuse 1 source here: "),
    ],
)
def test_what_auto_does_not_take_is_told_in_one_line(
    asked: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--rule", "auto", *asked]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert "bci" not in told


def test_the_demo_and_a_replay_take_tracklets_and_auto() -> None:
    parser = argparse.ArgumentParser()
    COMMANDS["demo"].add(parser)
    for memory in ("auto", "restart", "recursive", "tracklet"):
        assert parser.parse_args(["--memory", memory, "--rule", "auto"]).memory == memory
    for one in variants_of(["auto", "ci"], ["memory=tracklet"], ()):
        assert one.config({}).by_tracklets
        assert one.config({}).rule == one.name
