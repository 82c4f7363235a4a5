"""A view, live in a terminal: drawn by rich onto the terminal's second screen, and changed by keys."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from fusion_service.escape import escaped
from fusion_service.lookout.keyboard import Keys, keyboard
from fusion_service.lookout.layout import ORDERS, Line, Look, frame, listed
from fusion_service.lookout.view import View

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["pressed", "show"]

PERIOD = 1.0
"""Seconds between two views."""
QUICK = 0.1
"""Seconds in which a key is answered."""
STYLES = {"wrong": "bold red", "doubt": "yellow", "well": "green", "quiet": "dim", "head": "bold", "mark": "reverse"}
PAGE, FARTHEST = 10, 200
"""Lines of a page, and as many as are scrolled at most."""


class _Last(logging.Handler):
    """Keeps the last line that is logged, which would else be written across the screen."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.line = ""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep it."""
        self.line = escaped(record.getMessage())


def show(make: Callable[[], View], look: Look, stop: threading.Event) -> None:
    """Show what `make` gives until `stop` is set, q is pressed, or the terminal goes. Raises ImportError where rich is
    not installed."""
    from rich.console import Console
    from rich.live import Live

    console = Console(file=sys.__stdout__, highlight=False, markup=False, emoji=False)
    root, last = logging.getLogger(), _Last()
    before, root.handlers = root.handlers, [last]
    try:
        with (
            keyboard() as keys,
            Live(
                console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
            ) as live,
        ):
            _loop(make, look, stop, keys, console, last, lambda drawn: live.update(drawn, refresh=True))
    finally:
        root.handlers = before


def _loop(
    make: Callable[[], View],
    look: Look,
    stop: threading.Event,
    keys: Keys,
    console: object,
    last: _Last,
    draw: Callable[[RenderableType], None],
) -> None:
    from rich.console import Console

    assert isinstance(console, Console)
    view, made, shown = make(), time.monotonic(), (0, 0)
    look = look._replace(live=True)
    changed = True
    while not stop.is_set() and not keys.closed:
        if not look.paused and time.monotonic() - made >= PERIOD:
            view, made, changed = make(), time.monotonic(), True
        size = console.size
        if changed or shown != (size.width, size.height):
            look = look._replace(said=last.line)
            draw(_drawn(frame(view, look, size.width, size.height)))
            shown, changed = (size.width, size.height), False
        for key in keys.read(QUICK):
            if key == "q":
                return
            after = pressed(key, look, view)
            changed, look = changed or after != look, after


def pressed(key: str, look: Look, view: View) -> Look:
    """How one looks after a key."""
    rows = [(centre, row.name) for centre, row in listed(view, look.order)]
    at = rows.index(look.chosen) if look.chosen in rows else -1
    if key == "p":
        return look._replace(paused=not look.paused)
    if key == "s":
        names = list(ORDERS)
        return look._replace(order=names[(names.index(look.order) + 1) % len(names)])
    if key == "back":
        return look._replace(alone=False, scroll=0) if look.alone else look._replace(chosen=None)
    moved = {"up": -1, "down": 1, "page up": -PAGE, "page down": PAGE}
    if key in moved and look.alone:
        return look._replace(scroll=max(0, min(look.scroll + moved[key], FARTHEST)))
    if key in moved and rows:
        first = 0 if moved[key] > 0 else len(rows) - 1
        return look._replace(chosen=rows[first if at < 0 else max(0, min(at + moved[key], len(rows) - 1))])
    if key == "enter" and rows:
        return look._replace(alone=True, scroll=0, chosen=rows[max(at, 0)])
    return look


def _drawn(lines: list[Line]) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    drawn = []
    for line in lines:
        text = Text(no_wrap=True, overflow="crop", end="\n")
        for part, style in line:
            text.append(part, STYLES.get(style, ""))
        drawn.append(text)
    return Group(*drawn)
