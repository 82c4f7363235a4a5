"""A newcomer's first hour, run with real processes: a client of his own that is wrong in three ways is found out by
`check` and `top`, mended, seen in the console, recorded, and judged by requirements and the truth that he wrote down.

    python -m tests.newcomer --out /tmp/first-hour
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from tests.helpers.browser import CHROMIUM, Browser
from tests.helpers.processes import Hub, Program, eventually, free_endpoint
from tests.newcomer.client import MISTAKES, with_mistakes

CONFIG = """
[centre]
frame = {{kind = "enu", lat = 63.43, lon = 10.39}}
period = 0.5
[bus]
connect = ["{endpoint}"]
[service]
state = "{folder}/state"
"""
PROFILE = """
[profile]
name = "a newcomer's"
source = "what he promised"

[[requirement]]
name = "shown every second"
kind = "update"
interval_s = 1.0
share_min = 0.8

[[requirement]]
name = "position, 95 %"
kind = "position_error"
within_m = 20.0
share_min = 0.9

[[requirement]]
name = "false tracks"
kind = "false_tracks"
farther_than_m = 100.0
share_max = 0.1
"""
FUSION, SENSOR = (
    f"import sys\nfrom {where}.cli import main\nraise SystemExit(main(sys.argv[1:]))"
    for where in ("fusion_service", "sensor_clients")
)


class Hour:
    """What he does, one thing after the other, each told with its second."""

    def __init__(self, folder: Path, stack: ExitStack, tell: Callable[[str], None]) -> None:
        self.folder, self._stack, self._tell = folder, stack, tell
        self._began = time.monotonic()
        hub = Hub().start()
        stack.callback(hub.kill)
        self.endpoint = hub.endpoint
        (folder / "centre.toml").write_text(CONFIG.format(endpoint=hub.endpoint, folder=folder), "utf-8")
        (folder / "mine.toml").write_text(PROFILE, "utf-8")

    def say(self, text: str) -> None:
        self._tell(f"{time.monotonic() - self._began:5.1f} s  {text}")

    def start(self, *words: str) -> Program:
        return self._stack.enter_context(Program(FUSION, *words))

    def ask(self, code: str, *words: str) -> tuple[int, str]:
        """Exit code and all that a command prints."""
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120)
        return done.returncode, done.stdout + done.stderr

    def client(self, mistakes: int) -> Program:
        """His client, with the last so many mistakes left in it."""
        path = self.folder / "newcomer.py"
        path.write_text(with_mistakes(MISTAKES[len(MISTAKES) - mistakes :]), "utf-8")
        code = f"import runpy\nrunpy.run_path({str(path)!r}, run_name='__main__')"
        return self._stack.enter_context(Program(code, self.endpoint, str(self.folder / "gps.csv")))

    def told_by(self, what: str, code: str, words: tuple[str, ...], pattern: str) -> None:
        """Wait until a command says it, and tell the line."""
        lines: list[str] = []

        def said() -> bool:
            _, text = self.ask(code, *words)
            plain = " ".join(text.split())
            found = re.search(f"[^:;|]{{0,40}}(?:{pattern})", plain)
            lines[:] = [found[0].strip()] if found else [text]
            return found is not None

        try:
            eventually(said, 40)
        except AssertionError:
            raise AssertionError(f"{what} does not say {pattern!r}:\n{lines[0]}") from None
        self.say(f"{what}: ... {lines[0]}")


def first_hour(folder: Path, seconds: float = 20.0, tell: Callable[[str], None] = print) -> dict[str, object]:
    """All of it, into `folder`; what the last report says, as JSON. seconds: recorded of the client that is right."""
    with ExitStack() as stack:
        hour = Hour(folder, stack, tell)
        service = hour.start("run", "--config", str(folder / "centre.toml"))
        look = ("--once", "--connect", hour.endpoint)
        check = ("check", "newcomer", "--connect", hour.endpoint)
        for left in range(len(MISTAKES), 0, -1):
            one = MISTAKES[len(MISTAKES) - left]
            hour.say(f"he writes {one.wrong!r} and starts his client")
            client = hour.client(left)
            hour.told_by("check", SENSOR, check, one.reads)
            hour.told_by("top", FUSION, ("top", *look), one.reads)
            client.kill()
            hour.say(f"he mends it: {one.right!r}")
        recording = folder / "mission.rrd"
        recorder = hour.start("record", "--out", str(recording), "--connect", hour.endpoint)
        eventually(recording.exists, 60)
        client = hour.client(0)
        code, text = 1, ""

        def fine() -> bool:
            nonlocal code, text
            code, text = hour.ask(FUSION, "status", "--connect", hour.endpoint)
            return code == 0 and "2 tracks" in text

        try:
            eventually(fine, 60)
        except AssertionError:
            raise AssertionError(f"all should be well:\n{text}") from None
        hour.say("status: " + " ".join(text.split())[:100])
        if CHROMIUM:
            see(hour, stack)
        else:
            hour.say("console: not looked at, for no Chromium is installed")
        until = time.monotonic() + seconds
        eventually(lambda: time.monotonic() > until, seconds + 10)
        client.signal(signal.SIGKILL)
        recorder.signal(signal.SIGINT)
        assert recorder.end(20)[0] == 0
        service.signal(signal.SIGINT)
        assert service.end(20)[0] == 0
        words = ("--truth", str(folder / "gps.csv"), "--profile", str(folder / "mine.toml"))
        code, text = hour.ask(FUSION, "evaluate", str(recording), *words, "--json", str(folder / "scores.json"))
        verdicts = [line for line in text.splitlines() if line.startswith("a newcomer's:")]
        hour.say("evaluate: " + (verdicts[0].strip() if verdicts else text))
        assert code == 0, text
        found: dict[str, object] = json.loads((folder / "scores.json").read_text("utf-8"))
        return found


def see(hour: Hour, stack: ExitStack) -> None:
    """His tracks in the console, with a picture of it."""
    port = free_endpoint().rpartition(":")[2]
    console = hour.start("console", "--connect", hour.endpoint, "--listen", f"127.0.0.1:{port}")
    address = console.line(60).removeprefix("console: ")
    browser = stack.enter_context(Browser())
    page = browser.page(address, 1200, 800)
    page.until("document.querySelector('#map').dataset.tracks >= 2", 60)
    page.js("document.querySelector('#fit').click()")
    page.js("document.querySelector('#tab-sources').click()")
    page.until("/newcomer/.test(document.querySelector('main').innerText)", 30)
    page.shot(hour.folder / "console.png")
    hour.say(f"console: 2 tracks of newcomer on the map ({hour.folder / 'console.png'})")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.newcomer", description=__doc__)
    parser.add_argument("--out", metavar="FOLDER", help="where all is written (default: a folder of its own)")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="recorded in the end (default 20)")
    args = parser.parse_args()
    folder = Path(args.out or tempfile.mkdtemp(prefix="first-hour-"))
    folder.mkdir(parents=True, exist_ok=True)
    first_hour(folder, args.seconds)
    print(f"all of it is in {folder}")


if __name__ == "__main__":
    main()
