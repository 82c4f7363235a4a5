"""A rule is one file: what a file more in the folder changes, and the pages that are made of what rules declare."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fusion_service.rules import MIXTURE_RULES, RULES
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.face.registry import collect
from fusion_service.rules.face.table import PAGES, written

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "fusion_service" / "rules"
NEW = """
from dataclasses import replace
from fusion_service.rules.base.options import Option, in_range
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.ci import ci

def wide(sources, weights, influence, *, factor):
    fused = ci(sources, weights, influence, criterion="det")
    return replace(fused, covariance=factor * fused.covariance)

RULE = Rule(
    name="wide", title="CI made wider", promise="conservative for every correlation", source="ten lines", fuse=wide,
    takes={"factor": Option(1.5, in_range(lambda factor: factor >= 1.0, "at least 1"))},
)
"""


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages and pages with one rule more in its folder."""
    root = tmp_path_factory.mktemp("house")
    unwanted = shutil.ignore_patterns("__pycache__", "*.json", "*.png")
    for package in ("fusion_service", "schemas", "studies"):
        shutil.copytree(ROOT / package, root / package, ignore=unwanted)
    (root / "docs").mkdir()
    for page in PAGES:
        shutil.copy(ROOT / page, root / page)
    (root / "fusion_service" / "rules" / "wide.py").write_text(NEW, encoding="utf-8")
    return root


def ran(house: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(house)}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=house,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_rule_in_a_file_of_its_own_is_listed_by_the_command(house: Path) -> None:
    listed = ran(house, "-m", "fusion_service", "rules")
    assert listed.returncode == 0, listed.stderr
    assert re.search(
        r"^wide +N-way +conservative for every correlation\n +options: factor=1\.5; source: ten lines$",
        listed.stdout,
        re.MULTILINE,
    )
    assert all(re.search(rf"^{name} ", listed.stdout, re.MULTILINE) for name in RULES)


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        ("{factor = 2.0}", 0, "good (wide"),
        ("{factor = 0.5}", 2, "factor 0.5: at least 1"),
        ("{power = 2}", 2, "has no option 'power'"),
    ],
)
def test_it_is_known_to_the_config_check_with_its_options(house: Path, options: str, code: int, says: str) -> None:
    config = house / "centre.toml"
    config.write_text(f'[centre]\nrule = "wide"\nrule_options = {options}\n', encoding="utf-8")
    check = ran(house, "-m", "fusion_service", "check", str(config))
    assert (check.returncode, says in check.stdout + check.stderr) == (code, True), check.stdout + check.stderr


def test_it_is_in_the_tables_and_the_studies(house: Path) -> None:
    made = ran(house, "-m", "fusion_service.rules")
    assert made.returncode == 0, made.stderr
    assert "| `wide` | CI made wider | conservative for every correlation |\n" in (house / "README.md").read_text(
        encoding="utf-8"
    )
    long = "| `wide` | CI made wider | conservative for every correlation | any number | `factor=1.5` | ten lines |\n"
    assert long in (house / "docs" / "rules.md").read_text(encoding="utf-8")
    listed = ran(house, "-c", "from studies.rules import fuser; print(fuser('wide').rule); fuser('second')")
    assert listed.stdout == "wide\n"
    assert re.search(r"unknown rule 'second': one of naive, .*, wide, or FILE.py:FUNCTION", listed.stderr)
    asked = ran(house, "-c", "from studies.rules import fuser; fuser('wide:factor=0.5')")
    assert "rule 'wide:factor=0.5': factor 0.5: at least 1" in asked.stderr


@pytest.mark.parametrize("page", PAGES)
def test_the_pages_say_what_the_rules_declare(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert written(page, text) == text, "python -m fusion_service.rules makes it anew"


def test_a_page_without_its_markers_is_refused() -> None:
    with pytest.raises(ValueError, match="needs the markers"):
        written("README.md", "# no table\n")


def test_every_file_is_one_rule() -> None:
    for folder, rules in ((FOLDER, RULES), (FOLDER / "mixtures", MIXTURE_RULES)):
        files = {path.stem.replace("_", "-") for path in folder.glob("*.py") if not path.name.startswith("_")}
        assert files == set(rules)
        assert all(rule.name == name and rule.promise and rule.source and rule.title for name, rule in rules.items())
    for names in (("ci", "bci"), ("aa", "cu"), ("naive", "ci")):
        assert [name for name in RULES if name in names] == list(names)


def test_what_is_no_rule_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that declares nothing, something of another kind, or a name that is taken."""
    package = tmp_path / "somerules"
    package.mkdir()
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    taken = 'from fusion_service.rules.naive import RULE\n__all__ = ["RULE"]\n'
    for number, (text, error) in enumerate(
        (("", AttributeError), (taken, ValueError), ("from fusion_service.rules.mixtures.aa import RULE", TypeError))
    ):
        for old in package.glob("rule_*.py"):
            old.unlink()
        (package / f"rule_{number}a.py").write_text(text, encoding="utf-8")
        (package / f"rule_{number}b.py").write_text(taken, encoding="utf-8")
        with pytest.raises(error):
            collect(Rule, package, "somerules")


def test_no_rule_imports_the_registry_that_imports_it() -> None:
    """The registry's imports cannot be read from its source; these are their other half."""
    above = ("fusion_service.rules.face", "fusion_service.rules.mixtures")
    for path in [*FOLDER.glob("*.py"), *(FOLDER / "base").glob("*.py"), *(FOLDER / "weights").glob("*.py")]:
        if not path.name.startswith("_"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            names = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
            assert [name for name in names if name.startswith(above)] == [], path
    for path in (FOLDER / "mixtures").glob("*.py"):
        if not path.name.startswith("_"):
            assert "mixtures.face" not in path.read_text(encoding="utf-8"), path
