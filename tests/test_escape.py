"""Text from elsewhere cannot steer a terminal: in logs, in errors and in what is printed."""

from __future__ import annotations

import io
import subprocess
import sys
from typing import TextIO, cast

import pytest

from fusion_service.errors import ReviewError
from fusion_service.escape import Escaped, escaped
from fusion_service.process import exit_code

EVIL = "\x1b]0;owned\x07\x1b[2J\x9b1A\u202egnp\r"
SHOWN = r"\x1b]0;owned\x07\x1b[2J\x9b1A\u202egnp\x0d"


def test_every_character_that_steers_is_written_out_and_no_other() -> None:
    assert escaped(EVIL) == SHOWN
    assert escaped("Kiel\tß 東\n") == "Kiel\tß 東\n"
    assert all(escaped(chr(code)).isprintable() for code in range(0x2100) if code not in (0x09, 0x0A) and steers(code))


def steers(code: int) -> bool:
    return code < 0x20 or 0x7F <= code < 0xA0


def test_what_is_printed_and_what_is_said_of_a_failure_is_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    def fails() -> None:
        print(EVIL)
        raise ReviewError(f"bad {EVIL}")

    before = sys.stdout
    assert exit_code("program", fails) == 1
    assert sys.stdout is before
    told = capsys.readouterr()
    assert told.out == f"{SHOWN}\n"
    assert told.err == f"program: bad {SHOWN}\n"


def test_a_stream_is_otherwise_as_it_was() -> None:
    under = io.StringIO()
    stream = Escaped(under)
    assert stream.write("a\x00b") == 3
    stream.writelines(["c\n", "\x1b"])
    stream.flush()
    assert under.getvalue() == "a\\x00bc\n\\x1b"
    assert cast(TextIO, stream).isatty() is False


def test_a_log_line_cannot_forge_another() -> None:
    code = (
        "import logging; from fusion_service.logs import set_up_logging; set_up_logging();"
        "logging.getLogger('x').warning('%s', 'one\\n12:00:00 INFO forged \\x1b[2J')"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env={}).stderr
    assert "\x1b" not in told
    lines = told.splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("    12:00:00 INFO forged \\x1b[2J")
