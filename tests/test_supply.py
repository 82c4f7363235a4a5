"""What is installed is pinned by hash, and the image's list of parts says what is in it, under which licence."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOCKS = ("constraints.txt", "docker/requirements.txt", "docker/build.txt")
PIN = re.compile(r"([A-Za-z0-9][\w.-]*)==([\w.+!-]+)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n")
PERMISSIVE = ("MIT", "BSD", "Apache", "PSF", "Python-2.0", "0BSD", "EPL")
"""Licences of which a part may be: of those with a choice, one is enough."""


def pins(name: str) -> dict[str, tuple[str, frozenset[str]]]:
    """Name, in its canonical form, to version and hashes."""
    text = (ROOT / name).read_text("utf-8")
    assert PIN.sub("", text) == "", f"{name} holds something else than names, versions and hashes"
    return {
        canonical(found[1]): (found[2], frozenset(re.findall(r"sha256:(\w+)", found[3])))
        for found in PIN.finditer(text)
    }


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("name", LOCKS)
def test_every_pin_has_hashes_and_the_image_has_the_same_versions(name: str) -> None:
    everything = pins("constraints.txt")
    assert len(pins(name)) > 5
    for package, (version, hashes) in pins(name).items():
        assert hashes, package
        assert everything[package][0] == version, package


def test_all_that_the_project_asks_for_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = {*project["dependencies"], *(one for name, some in extras.items() if name != "oracle" for one in some)}
    names = {canonical(re.split(r"[\[<>=!~ ]", one)[0]) for one in wanted}
    assert names <= set(pins("constraints.txt"))
    image = {
        *project["dependencies"],
        *(one for name in ("record", "report", "keys", "metrics", "console", "top") for one in extras[name]),
    }
    assert {canonical(re.split(r"[\[<>=!~ ]", one)[0]) for one in image} <= set(pins("docker/requirements.txt"))


def test_the_list_of_parts_is_that_of_the_image_with_licences() -> None:
    listed = json.loads((ROOT / "docker" / "sbom.json").read_text("utf-8"))
    assert listed["bomFormat"] == "CycloneDX"
    parts = {canonical(part["name"]): part for part in listed["components"]}
    assert {name: part["version"] for name, part in parts.items()} == {
        name: version for name, (version, _) in pins("docker/requirements.txt").items()
    }
    for name, part in parts.items():
        said = json.dumps(part["licenses"])
        assert any(word in said for word in PERMISSIVE), (name, said)
