"""What pages say of files, links and imports is so."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import fusion_service
from tests.docs.pages import ROOT, pages

PACKAGES = ("schemas", "fusion_service", "sensor_clients", "studies", "benchmarks")
LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.M | re.S)


def text_of(page: str) -> str:
    return (ROOT / page).read_text("utf-8")


def anchors(page: Path) -> set[str]:
    """Those that a reader of Markdown makes of the headings, and those written out."""
    text = FENCE.sub("", page.read_text("utf-8"))
    made = {
        re.sub(r"[^\w\- ]", "", re.sub(r"`", "", head).strip().lower()).replace(" ", "-")
        for head in re.findall(r"^#+ (.+)$", text, re.M)
    }
    return made | set(re.findall(r'(?:id|name)="([^"]+)"', text))


@pytest.mark.parametrize("page", pages())
def test_links_lead_somewhere(page: str) -> None:
    place = (ROOT / page).parent
    for target in LINK.findall(FENCE.sub("", text_of(page))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = (place / path).resolve() if path else ROOT / page
        assert there.exists(), target
        assert there.is_relative_to(ROOT), target
        if anchor:
            assert anchor in anchors(there), target


@pytest.mark.parametrize("page", [page for page in pages() if page != "docs/studies.md"])
def test_files_that_are_named_are_there(page: str) -> None:
    for name in re.findall(
        r"`((?:docs|tests|fusion_service|sensor_clients|schemas|studies|benchmarks)/[\w./-]+)`", text_of(page)
    ):
        assert (ROOT / name).exists(), name


def test_every_decision_is_in_the_index_and_short() -> None:
    folder = ROOT / "docs" / "decisions"
    found = {path.name for path in folder.glob("*.md")} - {"README.md"}
    assert set(re.findall(r"\]\(([\w-]+\.md)\)", text_of("docs/decisions/README.md"))) == found
    for name in found:
        text = (folder / name).read_text("utf-8")
        assert re.findall(r"^## (.+)$", text, re.M) == ["Context", "Decision", "Consequences"], name
        assert len(text.splitlines()) <= 50, name


def test_the_changelog_begins_with_this_version() -> None:
    assert re.findall(r"^## (.+)$", text_of("CHANGELOG.md"), re.M)[0] == fusion_service.__version__


# The drawing of the rooms


def rooms() -> dict[str, set[str]]:
    """The arrows of docs/architecture.md."""
    drawing = re.search(r"^```mermaid\nflowchart TD\n(.*?)^```$", text_of("docs/architecture.md"), re.M | re.S)
    assert drawing is not None
    arrows = re.findall(r"^ +(\w+) --> (\w+)$", drawing[1], re.M)
    assert len(arrows) == drawing[1].count("-->")
    return {one: {low for high, low in arrows if high == one} for one in {name for arrow in arrows for name in arrow}}


ROOMS = rooms()


FACES = {"clock": "centre"}
"""Files that are another path of a room."""


def below(room: str) -> set[str]:
    """All that `room` reaches by arrows."""
    found: set[str] = set()
    rest = [room]
    while rest:
        new = ROOMS[rest.pop()] - found
        found |= new
        rest += new
    return found


def room_of(module: str) -> str | None:
    """The room that a module is in; None of what is not ours, and of the packages' own `__init__`."""
    package, _, inner = module.partition(".")
    if package not in PACKAGES:
        return None
    if package != "fusion_service":
        return package
    first = inner.partition(".")[0]
    if first in ("cli", "__main__"):
        return "commands"
    if not first or first.startswith("__"):
        return None
    return FACES.get(first, first if first in ROOMS else "ground")


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module, path
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def arrows() -> dict[tuple[str, str], str]:
    """(room, room that it imports): a file that does."""
    found: dict[tuple[str, str], str] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).with_suffix("").as_posix()
            here = room_of(name.replace("/", ".").removesuffix(".__init__"))
            for module in imports(path):
                there = room_of(module)
                if here is not None and there not in (None, here):
                    assert there is not None
                    found[here, there] = name
    return found


def test_the_drawing_of_the_rooms_is_the_house() -> None:
    found = arrows()
    wrong = {f"{here} imports {there}: {file}" for (here, there), file in found.items() if there not in below(here)}
    assert wrong == set()
    drawn = {(high, low) for high in ROOMS for low in ROOMS[high]}
    assert drawn - set(found) == set(), "drawn, but not so"


def test_arrows_lead_down_and_none_is_superfluous() -> None:
    for room, lower in ROOMS.items():
        assert room not in below(room), "a circle"
        for one in lower:
            assert not any(one in below(other) for other in lower - {one}), (room, one)


def test_every_folder_is_in_the_drawing_and_the_table() -> None:
    folders = {path.parent.name for path in (ROOT / "fusion_service").glob("*/__init__.py")}
    assert folders <= set(ROOMS)
    told = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (.+?) \|", text_of("docs/architecture.md"), re.M))))
    assert set(ROOMS) - {"ground"} <= told


# Without installation


def test_the_core_is_imported_from_a_clone_that_is_not_installed(tmp_path: Path) -> None:
    """With NumPy, SciPy and MessagePack on the path, and nothing else: no metadata of ours, no Zenoh, no Rerun."""
    libraries = tmp_path / "libraries"
    libraries.mkdir()
    for name in ("numpy", "scipy", "msgpack"):
        home = Path(__import__(name).__file__ or "").parent
        for entry in home.parent.iterdir():
            if re.fullmatch(rf"{name}(\.libs)?", entry.name):
                (libraries / entry.name).symlink_to(entry)
    code = (
        "import fusion_service.centre, schemas, sys, importlib.metadata as m\n"
        "assert fusion_service.__version__\n"
        "result = fusion_service.centre.FusionCentre({}).step(1)\n"
        "assert schemas.decode(schemas.encode(result.log)).version == fusion_service.__version__\n"
        "assert 'track-fusion-centre' not in {one.metadata['Name'] for one in m.distributions()}\n"
        "assert not {'zenoh', 'rerun', 'matplotlib'} & set(sys.modules)\n"
    )
    isolated = f"import sys; sys.path[:0] = {[str(ROOT), str(libraries)]!r}\n{code}"
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", isolated], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
