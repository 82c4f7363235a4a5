"""Options that are typed wrong, and pipes whose reader goes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence

import pytest

from fusion_service.cli import main as service
from fusion_service.commands.arguments import size
from sensor_clients.cli import main as clients


@pytest.mark.parametrize(
    ("call", "words", "told"),
    [
        (service, ["status", "--foo"], "fusion-service status: error: unrecognized arguments: --foo"),
        (service, ["status", "--relm", "x"], "unrecognized arguments: --relm x (did you mean --realm?)"),
        (service, ["--realm", "x", "top"], "--realm goes behind the command, as in: fusion-service top --realm ..."),
        (service, ["tpo"], "did you mean 'top'?"),
        (service, ["orders"], "did you mean 'order'?"),
        (service, ["record", "--keep-size", "500"], "'500' has no unit: give one, as in 500MB, or 500B for bytes"),
        (clients, ["check", "m01", "--fro", "3"], "sensor-client check: error: unrecognized arguments: --fro 3 (did"),
    ],
)
def test_an_option_that_is_wrong_is_told_of_by_its_command(
    call: Callable[[Sequence[str]], int], words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        call(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert told in said
    usage = f"usage: {'fusion-service' if call is service else 'sensor-client'} {words[0]}"
    assert said.startswith(usage) or words[0].startswith("--") or "choose from" in said


def test_sizes_have_units() -> None:
    assert [size(text) for text in ("500MB", "1.5 kB", "2GiB", "7B")] == [500_000_000, 1500, 2 * 2**30, 7]
    for text in ("500", "1.5", "MB", "5 XB", "-1MB", ""):
        with pytest.raises(ValueError):
            size(text)


WORK = """
import sys
from fusion_service.process import exit_code, reader_left
from fusion_service.errors import HealthError
def work():
    print("first", flush=True)
    sys.stdin.readline()  # whoever read is gone
    for k in range(20000):
        print("a line that nobody reads", k)
    sys.stdout.flush()
    open(sys.argv[1], "w").write(f"page {reader_left()}")
    raise HealthError("one thing is wrong")
sys.exit(exit_code("program", work))
"""


def test_who_reads_no_more_costs_no_page_and_no_verdict(tmp_path: object) -> None:
    page = f"{tmp_path}/page"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", WORK, page], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as run:
        assert run.stdin is not None
        assert run.stdout is not None
        assert run.stderr is not None
        assert run.stdout.readline() == "first\n"
        run.stdout.close()
        run.stdin.write("\n")
        run.stdin.close()
        assert run.stderr.read() == "program: one thing is wrong\n"
        assert run.wait(20) == 1
    with open(page) as file:
        assert file.read() == "page True"


def test_help_goes_into_a_pipe_that_is_closed() -> None:
    code = "import sys; sys.stdin.readline(); from fusion_service.cli import main; main(['--help'])"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as run:
        assert run.stdout is not None
        run.stdout.close()
        run.stdout = None
        assert run.communicate("\n", timeout=20)[1] == ""
        assert run.returncode == 0
