"""What is there to be seen at one moment: centres with their health, recorders, and all that is wrong."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fusion_service.hints.elsewhere import no_centre
from fusion_service.hints.health import Health, health_of
from fusion_service.hints.times import span
from fusion_service.lookout.ear import Ear

__all__ = ["Keeper", "Seen", "View", "size_words", "view_of"]

SILENT = 15.0
"""Seconds in which a recorder must write."""
LOW = 10**9
"""Bytes left on a recorder's disk from which on it is an alarm."""
GONE = 3.5
"""Seconds without a status after which a centre whose token is gone is told to be gone."""


class Seen(NamedTuple):
    """A centre. age: seconds since its newest status came; gone: whether its token is gone as well."""

    name: str
    health: Health
    age: float
    gone: bool


class Keeper(NamedTuple):
    """A recorder: what it keeps, in a line, and what is wrong with it."""

    name: str
    line: str
    wrong: tuple[str, ...]
    said: dict[str, Any]


class View(NamedTuple):
    """now: ns; hub: whether it is there; everywhere: whether all realms are heard; wrong: all that is, the gravest
    first; general: those of them that are not about a source that is listed."""

    now: int
    realm: str
    hub: bool
    everywhere: bool
    centres: list[Seen]
    keepers: list[Keeper]
    beside: list[str]
    twice: list[str]
    wrong: list[str]
    general: list[str]


def view_of(ear: Ear, now: int, *, centre: str = "", ignored: Sequence[str] = (), hub: bool = True) -> View:
    """What `ear` has heard, at `now`, ns. centre: the only one that is looked at; ignored: patterns of sources whose
    faults do not count; hub: whether it is there."""
    seen = []
    for name, status in sorted(ear.statuses.copy().items()):
        age = time.monotonic() - ear.came.get(name, time.monotonic())
        health = health_of(status, ear.pictures.get(name), now, ignored)
        seen.append(Seen(name, health, age, ear.centre_is_there(name) is False and age > GONE))
    keepers = [_keeper(name, said) for name, several in ear.recorders.items() for said in several or [{}]]
    beside, twice = ear.beside(), ear.twice()
    general = []
    if not hub:
        general.append("the hub is away: what is shown is as it was")
    elif not seen:
        who = f"no centre of the realm {ear.realm} answers: is `fusion-service run` there?"
        general.append(no_centre(centre, ear.centres_there()) if centre else who)
    for one in seen if hub else []:
        if one.gone:
            general.append(f"centre {one.name} is gone for {span(one.age)}: its liveliness token is no more")
        else:
            general += _of_no_source(one.health)
    general += [*twice, *beside, *(f"recorder {one.name}: {fault}" for one in keepers for fault in one.wrong)]
    sources = [
        f"{row.name}: {fault}" for one in seen for row in one.health.rows if not row.ignored for fault in row.faults
    ]
    return View(now, ear.realm, hub, ear.everywhere, seen, keepers, beside, twice, [*general, *sources], general)


def _of_no_source(health: Health) -> list[str]:
    of_sources = {f"{row.name}: {fault}" for row in health.rows for fault in row.faults}
    return [one for one in health.wrong if one not in of_sources]


def _keeper(name: str, said: Mapping[str, Any]) -> Keeper:
    """A recorder by what it says; nothing: it does not answer."""
    if not said:
        return Keeper(name, f"recorder {name}: there, and does not answer", ("it does not answer",), {})
    wrong = []
    silent, free = _number(said, "silent"), _number(said, "free")
    if silent is not None and silent > SILENT:
        wrong.append(f"it has written nothing for {span(silent)}: is its disk held up?")
    if free is not None and free < LOW:
        wrong.append(f"its disk has {size_words(free)} left: make room, or let it end parts (--keep-size)")
    parts = _number(said, "parts") or 1
    told = [
        f"{said.get('file')} on {said.get('host')}",
        f"{size_words(_number(said, 'bytes') or 0)}{f' in {parts:.0f} parts' if parts > 1 else ''}",
        f"{_number(said, 'messages') or 0:.0f} messages",
        f"{_number(said, 'lost') or 0:.0f} lost",
    ]
    bad = _number(said, "undecodable") or 0
    told += [f"{bad:.0f} that cannot be read"] if bad else []
    return Keeper(name, f"recorder {name}: {', '.join(told)}", tuple(wrong), dict(said))


def _number(said: Mapping[str, Any], key: str) -> float | None:
    value = said.get(key)
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def size_words(count: float) -> str:
    """Bytes as people say them."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
