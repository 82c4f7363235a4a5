"""Every code block of README and docs does what it says: Python is executed, configs are loaded, of shell lines each is
read by the command's own parser, and what is cheap runs on a recorded mission.

The tutorial's blocks run together: tests/docs/test_tutorial.py.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import re
import runpy
import shlex
import sys
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fusion_service.cli
import schemas
import sensor_clients.cli
import studies.cli
from fusion_service.centre import FusionCentre
from fusion_service.config import load_config
from fusion_service.densities import Mixture
from fusion_service.recording import Recorder
from schemas import LocalTracks
from sensor_clients.scenarios.three_radars import three_radars
from studies import missions
from studies.experiments.sharma_three_radars import SETTINGS
from tests.docs.pages import ROOT, Block, blocks, pages
from tests.helpers.processes import Hub, Program

TUTORIAL = "docs/tutorial.md"
BLOCKS = [block for page in pages() if page != TUTORIAL for block in blocks(page)]
RUN = [block for block in BLOCKS if block.not_run is None]
NO_CODE = ("", "text", "mermaid")
COMMANDS = ("fusion-service", "sensor-client", "python", "make", "docker")
NOT_RUN = {
    "docker/README.md": [*["needs a container engine"] * 4, "is Compose's"],
    "deploy/README.md": ["needs a container engine"],
    "docs/security.md": ["it needs the certificates", "it is the file of a hub", "it sets a variable"],
}
"""All blocks that are not run, with the beginning of the reason that the page gives."""
UNMARKED = {"docs/rules.md": ("means", "covariances")}
"""What blocks need on pages that say it in their comments."""


TOGETHER = ("my_tracker", "a centre")
"""What the two blocks need that run in a test of their own."""


def of(language: str) -> pytest.MarkDecorator:
    found = [block for block in RUN if block.language == language and not set(TOGETHER) & set(block.needs)]
    assert found
    return pytest.mark.parametrize("block", found, ids=[block.name for block in found])


def test_every_block_has_a_language_that_is_tested() -> None:
    for block in RUN:
        assert block.language in (*NO_CODE, "python", "toml", "sh"), block.name
        if block.language in NO_CODE:
            assert not re.search(rf"^({'|'.join(COMMANDS)}) ", block.text, re.M), block.name


def test_blocks_that_are_not_run_say_why() -> None:
    left = [block for block in BLOCKS if block.not_run is not None]
    known = [(page, reason) for page, reasons in NOT_RUN.items() for reason in reasons]
    assert len(left) == len(known)
    for block, (page, reason) in zip(left, known, strict=True):
        assert block.page == page
        assert block.not_run is not None
        assert block.not_run.startswith(reason), block.name


# Python


def mixture(place: float) -> Mixture:
    means = np.array([[place, 0, 1, 0], [place + 9, 1, 0, 0]])
    return Mixture(np.array([0.4, 0.6]), means, np.stack([np.eye(4), 2 * np.eye(4)]))


GIVEN: dict[str, Any] = {
    "weights": np.array([0.4, 0.6]),
    "means": np.array([[0.0, 1, 2, 3], [0.5, 1.5, 2, 2]]),
    "covariances": np.stack([np.eye(4), np.diag([1.0, 2, 3, 4])]),
    "b": mixture(1.0),
    "c": mixture(2.0),
}


class Ended(Exception):
    """The reader's tracker has no more scans."""


def tracker(stop: threading.Event) -> Callable[[], tuple[Any, Any, Any]]:
    """`my_tracker`: a scan of two tracks every 0.1 s until `stop`."""

    def my_tracker() -> tuple[Any, Any, Any]:
        if stop.wait(0.1):
            raise Ended
        return [1, 2], [[100.0, 200, 1, 0], [-500.0, 90, 0, 1]], [np.eye(4) * 25] * 2

    return my_tracker


def execute(block: Block, given: dict[str, Any], **instead: str) -> None:
    text = block.text
    for old, new in instead.items():
        assert old in text
        text = text.replace(old, new)
    exec(compile("\n" * block.line + text, str(ROOT / block.page), "exec"), given)


@of("python")
def test_python_runs(block: Block) -> None:
    needs = block.needs or UNMARKED.get(block.page, ())
    used = {node.id for node in ast.walk(ast.parse(block.text)) if isinstance(node, ast.Name)}
    assert used >= set(needs), "it says that it needs what it does not use"
    execute(block, {name: GIVEN[name] for name in needs})


def test_client_and_reader_of_the_readme(hub: Hub) -> None:
    """Both as they stand, with a hub, a service and a tracker: the reader prints what the client's tracker saw."""
    client, reader = (next(block for block in RUN if name in block.needs) for name in TOGETHER)
    endpoint = {"tcp/127.0.0.1:7447": hub.endpoint}
    stop, enough = threading.Event(), threading.Event()
    printed: list[tuple[Any, ...]] = []

    def show(*what: Any) -> None:
        if len(what[1]) == 2 and not enough.is_set():
            printed.append(what)
            enough.set()

    def publish() -> None:
        with pytest.raises(Ended):
            execute(client, {"my_tracker": tracker(stop)}, **endpoint)

    code = "import sys\nfrom fusion_service.cli import main\nraise SystemExit(main(sys.argv[1:]))"
    thread = threading.Thread(target=publish)
    with Program(code, "run", "--connect", hub.endpoint):
        thread.start()
        try:
            wait = {"time.sleep(60)": "enough.wait(60)"}
            execute(reader, {"print": show, "enough": enough}, **endpoint, **wait)
        finally:
            stop.set()
            thread.join()
    assert enough.is_set()
    ((_, _, means),) = printed
    assert sorted(np.round(means[:, 0], -2)) == [-500, 100]


# TOML


@of("toml")
def test_configs_are_good(block: Block, tmp_path: Path) -> None:
    (tmp_path / "centre.toml").write_text(block.text, "utf-8")
    load_config(tmp_path / "centre.toml")


# Shell


class Parsed(BaseException):
    """The parser took the arguments: as far as a line goes that is not run."""


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    original = argparse.ArgumentParser.parse_args

    def parse_args(*arguments: Any, **named: Any) -> None:
        original(*arguments, **named)
        raise Parsed

    with monkeypatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
        yield


MAINS: dict[str, Callable[[list[str]], int]] = {
    "fusion-service": fusion_service.cli.main,
    "sensor-client": sensor_clients.cli.main,
    "studies": studies.cli.main,
}
CHEAP = {
    "fusion-service": ("rules", "check", "evaluate", "replay", "explain", "export", "repair"),
    "sensor-client": ("list",),
    "studies": ("list",),
}
"""What runs, if the files that it reads are there."""


def lines(block: Block) -> Iterator[list[str]]:
    """The commands of a block in words, without comments, settings of the environment, `&` and prompts."""
    for line in block.text.replace("\\\n", " ").splitlines():
        words = shlex.split(re.sub(r"\$\(\(.*\)\)", "0", line), comments=True)
        while words and re.match(r"[A-Z_]+=", words[0]):
            words.pop(0)
        if words:
            yield [word for word in words if word != "&"]


def command_of(words: list[str]) -> tuple[str, list[str]]:
    """(fusion-service, sensor-client, studies, a module or another program; its arguments)."""
    if words[0] == "docker":
        image = words.index("track-fusion-centre") if "track-fusion-centre" in words else -1
        return ("docker", []) if image < 0 or words[1] == "build" else command_of(words[image + 1 :])
    if words[:2] == ["python", "-m"]:
        return words[2], words[3:]
    return words[0], words[1:]


def check_module(name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """`python -m` of ours: a module, or a package whose parser may be in any of its files."""
    assert name.startswith(("benchmarks.", "tests.", "fusion_service.rules")), name
    found = importlib.util.find_spec(name)
    assert found is not None, name
    package = found.submodule_search_locations is not None
    files = [Path(found.origin)] if found.origin is not None and not package else []
    for folder in found.submodule_search_locations or ():
        files += sorted(Path(folder).glob("*.py"))
    assert files, name
    if not any("argparse" in file.read_text("utf-8") for file in files):
        assert arguments == [], name
        return
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    started = f"{name}.__main__" if package else name
    monkeypatch.delitem(sys.modules, started, raising=False)  # runpy warns of what another test imported
    with pytest.raises(Parsed):
        runpy.run_module(name, run_name="__main__")


SHELL = [(block, words) for block in BLOCKS if block.language == "sh" for words in lines(block)]
INLINE = [
    (block, shlex.split(command))
    for page in pages()
    for block in [Block(page, 0, "sh", "")]
    for command in re.findall(
        r"`((?:fusion-service|sensor-client|python -m) [^`]+)`",
        re.sub(r"^```.*?^```$", "", (ROOT / page).read_text("utf-8"), flags=re.M | re.S),
    )
    if not re.search(r"[A-Z]{4,}|\.\.\.", command) and len(command.split()) > 1
]
"""Commands in the text, but those with a word in capitals in the place of an argument."""


@pytest.mark.usefixtures("parse_only")
@pytest.mark.parametrize(
    ("block", "words"), [*SHELL, *INLINE], ids=[f"{b.name} {' '.join(w)}" for b, w in [*SHELL, *INLINE]]
)
def test_shell_lines_are_read(block: Block, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    program, arguments = command_of(words)
    if program in MAINS:
        if block.line == 0 and (" ".join(words[:2]) in TOPICS):
            return
        with pytest.raises(Parsed):
            MAINS[program](arguments)
    elif program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
        assert {word for word in arguments if "=" not in word} <= set(targets)
    elif program == ".ci/run":
        assert os.access(ROOT / program, os.X_OK)
    elif program != "docker":
        check_module(program, arguments, monkeypatch)


TOPICS = {
    f"fusion-service {name}"
    for name in ("evaluate", "replay", "explain", "export", "repair", "verify", "record", "run", "order", "keys")
} | {"sensor-client simulate", "sensor-client playback"}
"""In the text, a command may be named without what it must be given."""


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `mission.rrd`: 150 s of three radars and their truth through a centre, as `demo` records them."""
    folder = tmp_path_factory.mktemp("mission")
    scenario = three_radars()
    centre = FusionCentre({"clock": "message", "lateness": 15.0, **SETTINGS}, generation=3)
    told = [*missions.told(scenario, 1), *missions.truths(scenario)]
    at, end = scenario.start, scenario.start + 150 * 10**9
    told = sorted((one for one in told if one.sent <= end), key=lambda one: one.sent)
    with Recorder(folder / "mission.rrd", draw=False) as recorder:

        def step(time: int) -> None:
            result = centre.step(time)
            for what, one in (("tracks", result.tracks), ("log", result.log)):
                recorder.handle(schemas.global_key("centre", what), schemas.encode(one), time + 1)
            recorder.tick()

        for one in told:
            if one.sent > at:
                step(at)
                at += 10 * 10**9
            if isinstance(one, schemas.Truth):
                key = schemas.truth_key(one.source)
            else:
                key = schemas.local_key(one.source, "tracks" if isinstance(one, LocalTracks) else "info")
                centre.handle(one, one.sent)
            recorder.handle(key, schemas.encode(one), one.sent)
        step(at)
    (folder / "centre.toml").write_text('[centre]\nrule = "ci"\n', "utf-8")
    (own,) = [block.text for block in blocks("docs/rules.md") if block.text.startswith("# my_rule.py")]
    (folder / "my_rule.py").write_text(own, "utf-8")
    return folder


def cheap(words: list[str], folder: Path) -> bool:
    program, arguments = command_of(words)
    read = [word for before, word in pairwise(arguments) if before != "--out"]
    files = [word for word in read if word.endswith((".rrd", ".toml", ".csv", "/"))]
    return bool(set(arguments[:1]) & set(CHEAP.get(program, ()))) and all((folder / file).exists() for file in files)


PAGES = sorted({block.page for block, _ in SHELL})


@pytest.mark.parametrize("page", PAGES)
def test_cheap_shell_lines_run(
    page: str, mission: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the order of the page, in a folder with a mission and a config."""
    for file in mission.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    ran = 0
    for block, words in SHELL:
        if block.page == page and cheap(words, tmp_path):
            program, arguments = command_of(words)
            assert MAINS[program](arguments) == 0, (block.name, words, capsys.readouterr().err)
            ran += 1
    if page == "docs/review.md":
        assert ran >= 12
