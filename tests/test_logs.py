"""Lines of the log: for people, for machines, for the journal."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusion_service.logs import set_up_logging


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:], root.level = handlers, level


def logged(capfd: pytest.CaptureFixture[str], form: str) -> list[str]:
    set_up_logging(form=form)
    log = logging.getLogger("fusion_service.test")
    log.warning("source %s: refused\n%s", "r\x1b[31m1", "é", extra={"source": "r\x1b1", "reason": "late"})
    try:
        raise ValueError("of ours")
    except ValueError:
        log.exception("a fault")
    log.debug("not said")
    return capfd.readouterr().err.splitlines()


def test_json_has_stable_fields_and_is_ascii(capfd: pytest.CaptureFixture[str]) -> None:
    lines = logged(capfd, "json")
    assert len(lines) == 2
    assert all(line.isascii() and line.isprintable() for line in lines)
    first, second = map(json.loads, lines)
    assert list(first) == ["time", "level", "logger", "message", "source", "reason"]
    assert (first["level"], first["logger"]) == ("warning", "fusion_service.test")
    assert first["message"] == "source r\x1b[31m1: refused\né"
    assert (first["source"], first["reason"]) == ("r\x1b1", "late")
    assert list(second) == ["time", "level", "logger", "message", "trace"]
    assert second["trace"].endswith("ValueError: of ours")


def test_text_is_escaped_and_indented(capfd: pytest.CaptureFixture[str]) -> None:
    lines = logged(capfd, "text")
    assert "\x1b" not in "".join(lines)
    assert lines[0].endswith("refused")
    assert lines[1] == "    é"


@pytest.mark.parametrize(("form", "is_json"), [("auto", True), ("json", True), ("text", False)])
def test_the_journal_is_told_priorities(
    form: str, is_json: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where stderr is the stream that systemd names, and nowhere else."""
    with (tmp_path / "log").open("w") as journal:
        said = os.fstat(journal.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{said.st_dev}:{said.st_ino}")
        monkeypatch.setattr("sys.stderr", journal)
        set_up_logging(form=form)
        logging.getLogger("fusion_service.test").error("first\nsecond")
        logging.getLogger("fusion_service.test").info("third")
    lines = (tmp_path / "log").read_text().splitlines()
    assert [line[:3] for line in lines] == (["<3>", "<6>"] if is_json else ["<3>", "<3>", "<6>"])
    if is_json:
        assert json.loads(lines[0][3:])["message"] == "first\nsecond"
