"""A program in a terminal of its own: what it shows, and keys for it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
from typing import Self

COMMAND = "import sys\nfrom fusion_service.cli import main\nraise SystemExit(main(sys.argv[1:]))"
HOME = "\x1b[H"
STYLE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """`fusion-service` with these words, in a terminal of so many columns and lines; killed at the end of `with`."""

    def __init__(self, *words: str, width: int = 100, height: int = 30, **environment: str) -> None:
        self._own, theirs = pty.openpty()
        self._text = ""
        self.resize(width, height)
        inherited = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", COMMAND, *words],
            stdin=theirs,
            stdout=theirs,
            stderr=subprocess.PIPE,
            env={**inherited, "TERM": "xterm-256color", **environment},
        )
        os.close(theirs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        if self.process.stderr is not None:
            self.process.stderr.close()
        os.close(self._own)

    def resize(self, width: int, height: int) -> None:
        """Make it as large."""
        fcntl.ioctl(self._own, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))

    def press(self, keys: str) -> None:
        """Type them."""
        os.write(self._own, keys.encode())

    def text(self) -> str:
        """All that was written to it until now."""
        while select.select([self._own], [], [], 0)[0]:
            try:
                data = os.read(self._own, 65536)
            except OSError:  # nobody has it open any more
                break
            if not data:
                break
            self._text += data.decode(errors="replace")
        return self._text

    def screen(self) -> list[str]:
        """The lines of the newest whole picture."""
        for picture in reversed(self.text().split(HOME)[2:]):
            lines = STYLE.sub("", picture).splitlines()
            if lines and len(lines[-1]) == len(lines[0]) and len(lines) > 1:
                return [line.rstrip() for line in lines]
        return []

    def shows(self, *words: str) -> bool:
        """Whether all of these are on the screen, wherever its lines end."""
        now = " ".join(" ".join(self.screen()).split())
        return all(word in now for word in words)
