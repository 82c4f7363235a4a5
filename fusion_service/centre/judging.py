"""Whether an order of an operator can be obeyed, and what it does or why not.

`judge` is a pure function of an order and a `View`: the centre asks it in the step that obeys, a service before that,
to answer who ordered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.tracks import Tracks
from fusion_service.order import ABOUT, STATES, WHAT, LocalId, Order
from schemas import check_source

__all__ = ["MOST_STANDING", "Outcome", "Seen", "Standing", "View", "find_local", "judge", "linked_to", "lives"]

MOST_STANDING = 10_000
MOST_LISTED = 8
"""Names told in the reason of a refusal."""


class Outcome(NamedTuple):
    """Whether an order is obeyed, and what it does or why not."""

    done: bool
    text: str


class Seen(Protocol):
    """A source, as far as orders need to know it."""

    @property
    def epoch(self) -> int: ...
    @property
    def tracks(self) -> Tracks: ...


@dataclass(frozen=True, slots=True)
class Standing:
    """An order that stands: with its number, and all its local tracks by epoch. locals: those that a delete holds."""

    order: Order
    locals: tuple[LocalId, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What an order is judged by: time, ns; ids (G,) u64 sorted of the global tracks; sources by name; the standing
    orders; ignored: whom the config mutes. intensity: the centre links no local tracks;
    supervised: it judges its sources."""

    time: int
    ids: NDArray[np.uint64]
    sources: Mapping[str, Seen]
    standing: Mapping[int, Standing]
    ignored: frozenset[str] = frozenset()
    intensity: bool = False
    supervised: bool = True


class _No(Exception):
    """Why an order is not obeyed."""


def judge(order: Order, view: View) -> Outcome:
    """Whether `order` can be obeyed now, and what it does or why not. Never raises."""
    try:
        if order.refused:
            raise _No(order.refused)
        if order.what not in _CHECKS:
            raise _No(f"there is no order {order.what!r}: known are {', '.join(WHAT)}")
        if order.until is not None and order.until <= view.time:
            raise _No("it would stand until a time that has passed")
        if order.what in ABOUT and len(view.standing) >= MOST_STANDING:
            raise _No(f"{MOST_STANDING} orders stand already: withdraw some")
        return Outcome(True, _CHECKS[order.what](order, view))
    except _No as error:
        return Outcome(False, str(error))


def find_local(view: View, local: LocalId | None) -> tuple[LocalId, int]:
    """A local track with its epoch, and its row in its source's table. `_No` where there is none."""
    if local is None:
        raise _No("it needs a local track: [source, epoch or -1, id]")
    source = view.sources.get(local.source)
    if source is None:
        raise _No(_unknown(f"source {local.source!r}", sorted(view.sources)))
    if local.epoch not in (-1, source.epoch):
        raise _No(f"{local.source} runs in epoch {source.epoch}, not {local.epoch}")
    ids = source.tracks.id
    at = int(np.searchsorted(ids, np.uint64(local.id)))
    if at == len(ids) or int(ids[at]) != local.id:
        raise _No(_unknown(f"local track {local.id} of {local.source}", ids.tolist()))
    return LocalId(local.source, source.epoch, local.id), at


def linked_to(view: View, track: int) -> tuple[LocalId, ...]:
    """The local tracks of a global one, in canonical order."""
    found = []
    for name, source in sorted(view.sources.items()):
        ids = source.tracks.id[source.tracks.link == np.uint64(track)]
        found += [LocalId(name, source.epoch, one) for one in ids.tolist()]
    return tuple(found)


def _unknown(what: str, known: list[Any]) -> str:
    told = ", ".join(map(str, known[:MOST_LISTED])) or "none"
    return f"there is no {what}: known {'is' if len(known) == 1 else 'are'} {told}" + (
        f" and {len(known) - MOST_LISTED} more" if len(known) > MOST_LISTED else ""
    )


def _track(view: View, track: int | None) -> int:
    if track is None:
        raise _No("it needs a global track")
    if not (type(track) is int and 0 < track < 2**64 and np.isin(np.uint64(track), view.ids).item()):
        raise _No(_unknown(f"track {track}", view.ids.tolist()))
    return track


def _link(view: View, local: LocalId, at: int) -> int:
    return int(view.sources[local.source].tracks.link[at])


def _source(order: Order, view: View) -> str:
    if order.source not in view.sources:
        raise _No(_unknown(f"source {order.source!r}", sorted(view.sources)))
    return order.source


def _tracks_only(view: View) -> None:
    if view.intensity:
        raise _No("this centre fuses intensities: it links no local tracks")


def _about(view: View, what: str, source: str) -> int:
    """Number of the standing order `what` about a source, 0 for none."""
    return next((n for n, one in view.standing.items() if (one.order.what, one.order.source) == (what, source)), 0)


def _delete(order: Order, view: View) -> str:
    track = _track(view, order.track)
    held = linked_to(view, track)
    until = "until they end" if order.until is None else "until the time given"
    told = ", ".join(map(str, held[:MOST_LISTED])) + (" ..." if len(held) > MOST_LISTED else "")
    return f"ends track {track}" + (f" and holds {told} {until}" if held else "")


def _join(order: Order, view: View) -> str:
    _tracks_only(view)
    track, (local, at) = _track(view, order.track), find_local(view, order.local)
    others = [one for one in linked_to(view, track) if one.source == local.source and one != local]
    if others:
        raise _No(f"track {track} has {others[0]} already: unlink that first")
    was = _link(view, local, at)
    return f"{local} belongs to track {track}" + (f", not to track {was}" if was not in (0, track) else "")


def _leave(order: Order, view: View) -> str:
    _tracks_only(view)
    local, at = find_local(view, order.local)
    link = _link(view, local, at)
    if not link or order.track not in (None, link):
        raise _No(f"{local} belongs to " + (f"track {link}" if link else "no track"))
    return f"{local} leaves track {link}"


def _never(order: Order, view: View) -> str:
    _tracks_only(view)
    local, at = find_local(view, order.local)
    if order.against is None:
        return f"{local} never belongs to track {_track(view, order.track)}"
    other, beside = find_local(view, order.against)
    if local == other:
        raise _No("it needs two different local tracks")
    together = _link(view, local, at) and _link(view, local, at) == _link(view, other, beside)
    return f"{local} and {other} never belong together" + (f": {other} leaves its track" if together else "")


def _merge(order: Order, view: View) -> str:
    _tracks_only(view)
    track, other = _track(view, order.track), _track(view, order.other)
    if track == other:
        raise _No("it needs two different tracks")
    ours, theirs = ({one.source for one in linked_to(view, each)} for each in (track, other))
    if ours & theirs:
        raise _No(f"both have a local track of {min(ours & theirs)}")
    return f"track {other} goes on as track {track}"


def _split(order: Order, view: View) -> str:
    _tracks_only(view)
    local, at = find_local(view, order.local)
    link = _link(view, local, at)
    if not link or order.track not in (None, link):
        raise _No(f"{local} belongs to " + (f"track {link}" if link else "no track"))
    if len(linked_to(view, link)) == 1:
        raise _No(f"{local} is all that track {link} has")
    return f"{local} leaves track {link} and starts one of its own"


def _rename(order: Order, view: View) -> str:
    track = _track(view, order.track)
    if not order.name and not order.shown:
        raise _No("it needs a number or a callsign")
    for one in view.standing.values():
        if one.order.what == "rename" and one.order.track != track:
            same = (order.shown and one.order.shown == order.shown) or (order.name and one.order.name == order.name)
            if same:
                raise _No(f"track {one.order.track} is called so already")
    return f"track {track} is shown as {order.name or order.shown}"


def _identify(order: Order, view: View) -> str:
    track = _track(view, order.track)
    if not order.identity or len(order.identity) > 64:
        raise _No("it needs an identity of at most 64 characters, as in mmsi:257054000")
    return f"track {track} is {order.identity}"


def _mute(order: Order, view: View) -> str:
    try:
        check_source(order.source)
    except (ValueError, TypeError) as error:
        raise _No(str(error)) from None
    if number := _about(view, "mute", order.source):
        raise _No(f"{order.source} is muted already by order {number}")
    unheard = "" if order.source in view.sources else ", of which nothing was heard yet"
    return f"refuses what {order.source} sends{unheard}"


def _unmute(order: Order, view: View) -> str:
    if order.source in view.ignored:
        raise _No(f"the config ignores {order.source}")
    if not _about(view, "mute", order.source):
        _source(order, view)
        raise _No(f"{order.source} is not muted")
    return f"takes what {order.source} sends again"


def _quarantine(order: Order, view: View) -> str:
    _tracks_only(view)
    source = _source(order, view)
    if number := _about(view, "quarantine", source):
        raise _No(f"{source} is in quarantine already by order {number}")
    return f"tracks {source} apart"


def _release(order: Order, view: View) -> str:
    if not _about(view, "quarantine", order.source):
        _source(order, view)
        raise _No(f"{order.source} is not in quarantine")
    return f"fuses {order.source} again"


def _drop(order: Order, view: View) -> str:
    source = _source(order, view)
    return f"forgets {len(view.sources[source].tracks.id)} tracks of {source}"


def _supervise(order: Order, view: View) -> str:
    _tracks_only(view)
    source = _source(order, view)
    if not view.supervised:
        raise _No("this centre does not supervise its sources: set supervision under [centre]")
    if order.state not in (*STATES, "auto"):
        raise _No(f"there is no state {order.state!r}: known are {', '.join(STATES)}, auto")
    if order.state == "auto":
        if not _about(view, "supervise", source):
            raise _No(f"{source} is judged by the centre already")
        return f"judges {source} by its tracks again"
    return f"takes {source} as {order.state}"


def _withdraw(order: Order, view: View) -> str:
    one = view.standing.get(order.withdrawn)
    if one is None:
        raise _No(_unknown(f"standing order {order.withdrawn}", sorted(view.standing)))
    return f"order {order.withdrawn} ({one.order.what}) stands no more"


_CHECKS = {
    "delete": _delete,
    "link": _join,
    "unlink": _leave,
    "never-link": _never,
    "merge": _merge,
    "split": _split,
    "rename": _rename,
    "identify": _identify,
    "mute": _mute,
    "unmute": _unmute,
    "quarantine": _quarantine,
    "release": _release,
    "drop": _drop,
    "supervise": _supervise,
    "withdraw": _withdraw,
}


def lives(view: View, local: LocalId) -> bool:
    """Whether a local track is still in its source's table, in the same run."""
    source = view.sources.get(local.source)
    if source is None or source.epoch != local.epoch:
        return False
    at = int(np.searchsorted(source.tracks.id, np.uint64(local.id)))
    return at < len(source.tracks.id) and int(source.tracks.id[at]) == local.id
