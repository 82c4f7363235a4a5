"""SIGHUP: reload what can be reloaded; or the terminal has gone, which ends a process in good order.

A process that lasts heeds it from its first moment on; what it does then, a command says by `on_hangup`. Where the
terminal in which the process was started has been closed, nobody asks for a reload: it stops as by SIGTERM. One that
was started with the signal ignored (nohup) outlives its terminal.

A signal that comes while Python has just handled another, and goes back to wait, is noticed only when the wait ends:
who waits for `stop` waits a second at a time.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["heed", "on_hangup"]

log = logging.getLogger(__name__)

_asked: queue.SimpleQueue[bool] = queue.SimpleQueue()
"""A SIGHUP each, or False for the end: a handler of signals may put into it, whatever it has interrupted."""


@contextmanager
def heed(stop: Callable[[], None]) -> Iterator[None]:
    """No SIGHUP ends the process by itself. stop: called where the terminal is gone. For the main thread."""
    before = signal.getsignal(signal.SIGHUP)
    here = before is not signal.SIG_IGN and _has_terminal()

    def on_signal(number: int, frame: object) -> None:
        if here and not _has_terminal():
            stop()
        else:
            _asked.put(True)

    signal.signal(signal.SIGHUP, on_signal)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@contextmanager
def on_hangup(call: Callable[[], None]) -> Iterator[None]:
    """`call` for every SIGHUP, on a thread of its own; what it raises is logged."""

    def watch() -> None:
        while _asked.get():
            try:
                call()
            except Exception:
                log.exception("the reload failed: what was there goes on")

    thread = threading.Thread(target=watch, name="hangup", daemon=True)
    thread.start()
    try:
        yield
    finally:
        _asked.put(False)
        thread.join()


def _has_terminal() -> bool:
    """Whether the process has a controlling terminal now."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True
