"""What every process of ours does the same way: logs, signals in two stages, errors in one line."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["GRACE", "set_up_logging", "stop_on_signals"]

GRACE = 4.0
"""Seconds after the first signal in which a process must have ended by itself."""


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        import json

        entry = {"time": round(record.created, 3), "level": record.levelname.lower(), "logger": record.name}
        entry["message"] = record.getMessage()
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry)


def set_up_logging(verbose: bool = False) -> None:
    """Log to stderr: text, or JSON lines under a service manager (systemd sets JOURNAL_STREAM)."""
    handler = logging.StreamHandler()
    if os.environ.get("JOURNAL_STREAM"):
        handler.setFormatter(_JsonFormatter())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler], force=True)


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT or SIGTERM sets. A second signal, or `GRACE` seconds, end the process at once.

    Both is left to the kernel, so that it also happens while a long call holds the interpreter; only the first
    signal needs Python to run once.
    """
    stop, left = threading.Event(), threading.Event()

    def last_resort() -> None:
        if not left.wait(GRACE):
            sys.stderr.write(f"not stopped within {GRACE:g} s: ending now\n")
            os._exit(1)

    def on_signal(number: int, frame: FrameType | None) -> None:
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(one, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, GRACE + 0.5)
        stop.set()
        threading.Thread(target=last_resort, daemon=True).start()

    handled = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in (*handled, signal.SIGALRM)}
    for number in handled:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        left.set()
        if stop.is_set():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
