"""One tree of errors: every public error of ours is in it, in the drawing, and ends a command with its code."""

from __future__ import annotations

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

import fusion_service.errors
from fusion_service.config import ConfigError
from fusion_service.errors import DataError, FusionError, Stopped, UsageError
from fusion_service.process import exit_code

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "fusion_service", "sensor_clients", "studies")


def drawing() -> dict[str, tuple[str, str, int]]:
    """Name -> parent, what else it is, exit code, as the module's docstring draws them."""
    found: dict[str, tuple[str, str, int]] = {}
    above: list[str] = []
    for line in (fusion_service.errors.__doc__ or "").splitlines():
        if row := re.fullmatch(r"((?:  )*)(\w+)\s{2,}(?:(\w+)\s+)?([012])  \S.*", line):
            above[len(row[1]) // 2 :] = [row[2]]
            found[row[2]] = (above[-2] if len(above) > 1 else "", row[3] or "", int(row[4]))
    return found


@cache
def exceptions() -> list[type[BaseException]]:
    """Every exception that a module of ours defines, private ones left out."""
    found: list[type[BaseException]] = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text("utf-8")
            if re.search(r"^class \w+(Error|Stopped|Exception|Warning)\b", text, re.M):
                names = [node.name for node in ast.parse(text).body if isinstance(node, ast.ClassDef)]
                parts = path.relative_to(ROOT).with_suffix("").parts
                module = importlib.import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
                kinds = [getattr(module, name) for name in names if not name.startswith("_")]
                found += [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseException)]
    return found


def test_every_public_error_is_in_the_tree_as_it_is_drawn() -> None:
    drawn = drawing()
    there = {kind.__name__: kind for kind in exceptions()}
    assert set(there) == set(drawn)
    for name, kind in there.items():
        parent, also, code = drawn[name]
        assert issubclass(kind, FusionError)
        assert kind.exit_code == code, name
        bases = {base.__name__ for base in kind.__bases__}
        assert bases == ({parent, also} - {""} if parent else {"Exception"}), name
        assert kind.__doc__


def test_a_name_is_one_error() -> None:
    names = [kind.__name__ for kind in exceptions()]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (UsageError("say --out"), 2, "program: say --out\n"),
        (DataError("no rows"), 1, "program: no rows\n"),
        (
            ConfigError(["a.toml:1: rule: is 1", "a.toml:2: gate: is 2"]),
            2,
            "a.toml:1: rule: is 1\na.toml:2: gate: is 2\n",
        ),
        (Stopped("half way"), 0, ""),
        (FileNotFoundError("no file"), 1, "program: no file\n"),
        (ImportError("needs x"), 1, "program: needs x\n"),
    ],
)
def test_what_a_command_ends_with(error: Exception, code: int, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise error

    assert exit_code("program", fail) == code
    assert capsys.readouterr().err == told


def test_done_is_0_and_a_fault_of_ours_is_raised_on() -> None:
    assert exit_code("program", lambda: None) == 0
    with pytest.raises(ZeroDivisionError):
        exit_code("program", lambda: 1 // 0)
