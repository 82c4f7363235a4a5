"""A view as lines of text for a terminal of any width from 60 columns: what `top` shows, live or once.

A line is a list of (text, style); a style says what a text means: wrong, doubt, well, quiet, head, mark. Nothing is
said by colour alone: what is wrong has a `!` before it, and every state is a word.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from fusion_service.escape import escaped
from fusion_service.hints.health import STATES, Row
from fusion_service.hints.times import span
from fusion_service.lookout.view import Seen, View

__all__ = ["ORDERS", "Line", "Look", "frame", "listed", "plain"]

Line = list[tuple[str, str]]
NARROWEST = 60
FAULTS, LINES = 2, 3
"""Faults of a source that are listed, and lines of each; the source by itself shows all."""
ALARMS = 5
STYLES = {
    "gone": "wrong",
    "refused": "wrong",
    "silent": "wrong",
    "unheard": "doubt",
    "resting": "quiet",
    "muted": "quiet",
    "there": "well",
}


class _Column(NamedTuple):
    """title, width; text: of a row; least: width of the terminal from which on it is there; right: where it stands."""

    title: str
    width: int
    text: Callable[[Row], str]
    least: int = 0
    right: bool = True


def _rate(row: Row) -> str:
    if row.rate is None:
        return "-"
    return f"{row.rate:.3g}" + (f"/{1 / row.period:.3g}" if row.period else "")


def _some(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _seconds(value: float | None, sign: str) -> str:
    """As `+1.2 s`, `35 ms`: short whatever it is."""
    if value is None:
        return "-"
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("s", 1.0)):
        many = abs(value) / size
        if many >= (100 if unit != "s" else 0.1):
            return f"{value / size:{sign}{'.0f' if many >= 1000 else '.3g'}} {unit}"
    return f"{value * 1e3:{sign}.2g} ms"


COLUMNS = (
    _Column("STATE", 8, lambda row: row.state, right=False),
    _Column("RATE/SAID", 9, _rate),
    _Column("TRACKS", 6, lambda row: _some(row.tracks, "d")),
    _Column("SHARED", 6, lambda row: _some(row.share, ".0%")),
    _Column("REFUSED", 7, lambda row: str(row.refused)),
    _Column("CLOCK", 8, lambda row: _seconds(row.clock, "+"), 78),
    _Column("LATENCY", 8, lambda row: _seconds(row.latency, ""), 87),
    _Column("TRUST", 8, lambda row: row.trust or "-", 97, False),
    _Column("LAST REFUSAL", 12, lambda row: row.reason or "-", 112, False),
    _Column("LOST", 6, lambda row: str(row.gaps), 120),
)

ORDERS: dict[str, Callable[[Row], Any]] = {
    "trouble": lambda row: row.urgency,
    "name": lambda row: row.name,
    "rate": lambda row: ((row.rate or 0.0) * (row.period or 1.0), row.name),
    "tracks": lambda row: (-(row.tracks or 0), row.name),
    "shared": lambda row: (2.0 if row.share is None else row.share, row.name),
    "refused": lambda row: (-row.refused, row.name),
    "clock": lambda row: (-abs(row.clock or 0.0), row.name),
    "latency": lambda row: (-(row.latency or 0.0), row.name),
}
"""What sources may be sorted by; of a rate the one furthest below what is declared is first."""


class Look(NamedTuple):
    """How one looks at a view. order: of `ORDERS`; chosen: (centre, source) that is marked; alone: whether it is shown
    by itself, from the line `scroll` on; paused; said: a line for the foot; live: whether keys do something, and the
    height counts."""

    order: str = "trouble"
    chosen: tuple[str, str] | None = None
    alone: bool = False
    scroll: int = 0
    paused: bool = False
    said: str = ""
    live: bool = False


def listed(view: View, order: str) -> list[tuple[str, Row]]:
    """The sources of all centres with these, as they stand on the screen."""
    return [(one.name, row) for one in view.centres for row in sorted(one.health.rows, key=ORDERS[order])]


def frame(view: View, look: Look, width: int, height: int = 0) -> list[Line]:
    """The lines; height: how many there may be, 0 any number."""
    width = max(width, NARROWEST)
    foot = _foot(view, look, width)
    alone = next(((one, row) for one, row in listed(view, look.order) if (one, row.name) == look.chosen), None)
    if look.alone and alone is not None:
        head, body, marked = _title(view, look, width), _source(view, *alone, width), 0
    else:
        head = [*_title(view, look, width), *_general(view, width, 0 if look.live else 1000)]
        body, marked = _sources(view, look, width)
    lines = [*head, *body, *foot]
    if height:
        head = head[: max(1, height // 2)]
        room = max(height - len(head) - len(foot), 1)
        first = max(0, min(look.scroll or marked - room // 2, len(body) - room))
        lines = [*head, *body[first : first + room]]
        lines = [*lines, *[[]] * (height - len(lines) - len(foot)), *foot][:height]
    return [_cropped([(_clean(text), style) for text, style in line], width) for line in lines]


def _cropped(line: Line, width: int) -> Line:
    found: Line = []
    for text, style in line:
        found.append((text[:width], style))
        width -= len(found[-1][0])
    return found


def plain(line: Line) -> str:
    """A line without its styles."""
    return "".join(text for text, _ in line).rstrip()


def _clean(text: str) -> str:
    """What came from elsewhere neither steers the terminal nor begins a line."""
    return escaped(text).replace("\n", " ").replace("\t", " ")


def _title(view: View, look: Look, width: int) -> list[Line]:
    clock = datetime.fromtimestamp(view.now / 1e9, UTC).strftime("%H:%M:%SZ")
    count = len(view.wrong)
    well = "all is well" if not count else "1 thing is wrong" if count == 1 else f"{count} things are wrong"
    left = f"{'!' if count else ' '} {well}"
    right = f"realm {view.realm}  {'PAUSED' if look.paused else clock}"
    gap = " " * max(width - len(left) - len(right), 1)
    return [[(left, "wrong" if count else "well"), (gap, ""), (right, "mark" if look.paused else "quiet")]]


def _general(view: View, width: int, most: int) -> list[Line]:
    """What is wrong and about no source; the centres; the recorders."""
    lines: list[Line] = []
    most = most or ALARMS
    for said in view.general[:most]:
        lines += _wrapped("! ", said, width, "wrong", LINES)
    if len(view.general) > most:
        lines.append([(f"  and {len(view.general) - most} more: `fusion-service status` has them all", "quiet")])
    for one in view.centres:
        lines += _centre(one, width)
    for keeper in view.keepers:
        lines += _wrapped("! " if keeper.wrong else "  ", keeper.line, width, "wrong" if keeper.wrong else "", 2)
    if not view.keepers:
        lines.append([("  recorder: none is there, nothing is kept", "quiet")])
    if not view.everywhere and view.hub:
        lines.append([("  only this realm is heard: the certificate lets in no more", "quiet")])
    return lines


def _centre(one: Seen, width: int) -> list[Line]:
    """A centre by its newest status."""
    data = one.health.data
    steps, queue = data["step_time"], data["queue"]
    tracks = ", ".join(f"{count} {name}" for name, count in data["tracks"].items()) or "none yet"
    up = "gone" if one.gone else f"up {span(data['uptime'])}"
    head = f"centre {one.name}: {up}, step {data['step']}"
    pieces = [
        f"tracks: {tracks}",
        f"steps {steps.get('mean', 0.0) * 1e3:.1f} ms, at most {steps.get('max', 0.0) * 1e3:.0f} ms",
        f"{steps.get('skipped', 0.0):.0f} skipped",
        f"{steps.get('failed', 0.0):.0f} failed",
        f"queue {queue.get('waiting', 0)} of {queue.get('capacity', 0)}, at most {queue.get('high_water', 0)}",
        f"{data['rates'].get('messages', 0.0):.1f} messages/s",
        f"refused {sum(data['refused'].values())}, dropped {sum(data['dropped'].values())}",
    ]
    if "latency" in steps:
        pieces.append(f"picture {span(steps['latency'])} old")
    standby = data["standby"] or {}
    if standby.get("there"):
        pieces.append(f"standby: {standby['there']} there, {standby.get('ready', 0)} ready")
    troubled = one.gone or bool(steps.get("failed") or steps.get("busy") or "overload" in steps)
    lines: list[Line] = [[("! " if troubled else "  ", "wrong"), (head, "wrong" if one.gone else "head")]]
    lines += [[(line, "")] for line in _flow(pieces, width, "    ")]
    for note in data["notes"]:
        lines += _wrapped("    note: ", note, width, "doubt", 2)
    return lines


def _flow(pieces: Sequence[str], width: int, indent: str) -> list[str]:
    """Pieces side by side, in as many lines as they need."""
    lines = [indent]
    for piece in pieces:
        joined = lines[-1] + ("; " if lines[-1] != indent else "") + piece
        if len(joined) <= width or lines[-1] == indent:
            lines[-1] = joined
        else:
            lines.append(indent + piece)
    return lines


def _wrapped(mark: str, text: str, width: int, style: str, most: int) -> list[Line]:
    """A sentence in lines, the first behind `mark`; beyond `most` of them it is cut."""
    found = textwrap.wrap(_clean(text), width - len(mark), max_lines=most or None, placeholder=" ...") or [""]
    return [[(mark if k == 0 else " " * len(mark), style), (line, style)] for k, line in enumerate(found)]


def _shown(width: int, names: int) -> tuple[list[_Column], int]:
    """The columns for which there is room, and the width of the names."""
    columns = [one for one in COLUMNS if width >= one.least]
    room = width - 2 - sum(one.width + 1 for one in columns)
    return columns, max(8, min(room, max(names, 12)))


def _sources(view: View, look: Look, width: int) -> tuple[list[Line], int]:
    """The sources of each centre, and on which line the chosen one stands."""
    lines: list[Line] = []
    marked = 0
    rows = listed(view, look.order)
    columns, names = _shown(width, max((len(row.name) for _, row in rows), default=0))
    head = f"  {'SOURCE':<{names}} " + " ".join(_cell(one, one.title) for one in columns)
    for centre in view.centres:
        mine = [row for name, row in rows if name == centre.name]
        of = f" of {centre.name}" if len(view.centres) > 1 else ""
        lines += [[], [(head.rstrip(), "head")]]
        if not mine:
            lines.append([(f"  no source{of} yet: none holds a token, none has sent", "quiet")])
        for row in mine:
            chosen = look.live and look.chosen == (centre.name, row.name)
            marked = len(lines) if chosen else marked
            lines += _row(row, columns, names, width, chosen, look.live)
        if centre.health.beyond:
            lines.append([(f"  and {centre.health.beyond} sources more", "quiet")])
    return lines, marked


def _cell(column: _Column, text: str) -> str:
    text = text[: column.width]
    return f"{text:>{column.width}}" if column.right else f"{text:<{column.width}}"


def _row(row: Row, columns: Sequence[_Column], names: int, width: int, chosen: bool, live: bool) -> list[Line]:
    """A source, and below it what is wrong with it."""
    troubled = bool(row.faults) and not row.ignored
    mark = ("!" if troubled else "-" if row.state in ("resting", "muted") or row.ignored else " ") + (
        ">" if chosen else " "
    )
    name = row.name if len(row.name) <= names else row.name[: names - 1] + "~"
    line: Line = [(mark, "wrong" if troubled else "quiet"), (f"{name:<{names}} ", "mark" if chosen else "")]
    for column in columns:
        style = "quiet" if row.ignored else STYLES[row.state] if column.title == "STATE" else ""
        line.append((_cell(column, column.text(row)) + " ", style))
    if row.ignored and row.faults:
        return [line, [("    (ignored)", "quiet")]] if not live else [line]
    lines = [line]
    faults = row.faults[:FAULTS] if live else row.faults
    for fault in faults:
        lines += _wrapped("    ", fault, width, "wrong", LINES if live else 0)
    if len(row.faults) > len(faults):
        lines.append([(f"    and {len(row.faults) - len(faults)} more: Enter shows all", "quiet")])
    return lines


def _source(view: View, centre: str, row: Row, width: int) -> list[Line]:
    """One source by itself: all that is known of it."""
    said = next(one.health.data["sources"][row.name] for one in view.centres if one.name == centre)
    lines: list[Line] = [
        [],
        *_wrapped("  ", f"{row.name} of centre {centre}: {row.state}: {STATES[row.state]}", width, "head", 0),
    ]
    for fault in row.faults:
        lines += _wrapped("! ", fault, width, "wrong", 0)
    if not row.faults:
        lines.append([("  nothing is wrong with it", "well")])
    for one in row.more:
        lines += _wrapped("  ", one, width, "", 0)
    lines.append([])
    skipped = ("wrong", "doubts", "alarms", "is")
    for key, value in sorted(said.items()):
        if key not in skipped and value not in (None, "", [], {}, ()):
            lines += _wrapped(f"  {key:<18} ", _value(value), width, "", 4)
    return lines


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_value(one)}" for key, one in value.items())
    return ", ".join(map(_value, value)) if isinstance(value, (list, tuple)) else str(value)


def _foot(view: View, look: Look, width: int) -> list[Line]:
    if not look.live:
        return []
    keys = (
        "q quit  ↑↓ scroll  Esc back" if look.alone else f"q quit  s sort ({look.order})  p pause  ↑↓ Enter one source"
    )
    lines: list[Line] = [[(keys[:width], "quiet")]]
    return [*_wrapped("  ", look.said, width, "doubt", 1), *lines] if look.said else lines
