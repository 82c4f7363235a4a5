"""Orders carried out on the picture and on the sources' tables, and told to the journal with what they did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fusion_service.centre.ids import Ids
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.judging import View, find_local, judge, linked_to
from fusion_service.centre.lifecycle import Picture, newborn
from fusion_service.centre.partial import Unknown, brought
from fusion_service.centre.rows import NO_TRACK
from fusion_service.centre.tracks import relinked
from fusion_service.order import LocalId, Order, order_event

__all__ = ["Obeyed", "heirs", "obey", "view_of"]


class Obeyed(NamedTuple):
    """The picture after the orders, and the global tracks that are no more: {id: that which goes on for it, or 0}."""

    picture: Picture
    gone: dict[int, int]


def view_of(intake: Intake, picture: Picture, time: int) -> View:
    """What orders are judged by at `time`, ns: live, not a copy."""
    ignored = frozenset(name for name, one in intake.config.sources.items() if one.ignore)
    return View(
        time,
        picture.id,
        {**intake.sources, **intake.resting} if intake.resting else intake.sources,
        intake.orders.standing,
        ignored,
        intake.config.kind == "intensity",
        intake.config.supervision != "off",
    )


def obey(
    given: list[Order], intake: Intake, picture: Picture, ids: Ids, journal: Journal, time: int, step: int
) -> Obeyed:
    """Let end what no longer stands at `time`, ns, of `step`, then obey the orders given, in the order of their
    coming."""
    if not given and not intake.orders.standing:
        intake.mute()
        return Obeyed(picture, {})
    hands = _Hands(intake, picture, ids, journal, time, step)
    lasting = replace(hands.view(), ids=ids.known(picture.id))
    for one, why in intake.orders.expire(lasting):
        journal.event({"kind": "order_ended", "number": one.order.number, "what": one.order.what, "why": why})
    for order in given:
        order = intake.orders.numbered(order)
        outcome = judge(order, hands.view())
        if outcome.done:
            getattr(hands, f"_{order.what.replace('-', '_')}")(order)
        journal.event(order_event(order) | {"done": outcome.done, "outcome": outcome.text})
    intake.mute()
    return Obeyed(hands.picture, hands.gone)


class _Hands:
    """Carries out what `judge` has found good: a method an order."""

    def __init__(self, intake: Intake, picture: Picture, ids: Ids, journal: Journal, time: int, step: int) -> None:
        self.intake, self.picture, self.journal, self.time = intake, picture, journal, time
        self._ids, self._step = ids, step
        self.gone: dict[int, int] = {}

    def view(self) -> View:
        return view_of(self.intake, self.picture, self.time)

    def _local(self, local: LocalId | None) -> LocalId:
        return find_local(self.view(), local)[0]

    def _set_link(self, local: LocalId, link: int) -> None:
        """A new link, as if just made."""
        source = self.intake.sources[local.source]
        at = np.searchsorted(source.tracks.id, np.array([local.id], dtype=np.uint64))
        source.tracks = relinked(source.tracks, at, np.uint64(link), self._step)

    def _relink(self, old: int, new: int) -> None:
        for local in linked_to(self.view(), old):
            self._set_link(local, new)

    def _end(self, track: int, heir: int) -> None:
        self.gone[track] = heir
        self.picture = self.picture.take(self.picture.id != np.uint64(track))

    def _stand(self, order: Order, held: tuple[LocalId, ...] = ()) -> None:
        order = order.stripped()
        local = order.local and self._local(order.local)
        against = order.against and self._local(order.against)
        self.intake.orders.stand(replace(order, local=local, against=against), held)

    def _delete(self, order: Order) -> None:
        track = order.track or 0
        held = linked_to(self.view(), track)
        self.journal.end(track, "ordered", None)
        self._relink(track, int(NO_TRACK))
        self._end(track, 0)
        if held:
            self._stand(order, held)

    def _link(self, order: Order) -> None:
        local = self._local(order.local)
        standing = self.intake.orders.standing
        overruled = [
            n
            for n, one in standing.items()
            if one.order.local == local and (one.order.what == "link" or one.order.track == order.track)
        ]
        self.intake.orders.end(overruled)
        self._set_link(local, order.track or 0)
        self._stand(order)

    def _unlink(self, order: Order) -> None:
        view = self.view()
        local, at = find_local(view, order.local)
        track = int(view.sources[local.source].tracks.link[at])
        self._release_forced(local)
        self._set_link(local, int(NO_TRACK))
        self._stand(replace(order, track=track))

    def _release_forced(self, local: LocalId) -> None:
        """What was ordered to be linked no longer is."""
        standing = self.intake.orders.standing
        self.intake.orders.end(
            n for n, one in standing.items() if one.order.what == "link" and one.order.local == local
        )

    def _never_link(self, order: Order) -> None:
        view = self.view()
        local, at = find_local(view, order.local)
        link = int(view.sources[local.source].tracks.link[at])
        if order.against is not None:
            other, beside = find_local(view, order.against)
            if link and link == int(view.sources[other.source].tracks.link[beside]):
                self._release_forced(other)
                self._set_link(other, int(NO_TRACK))
            self._stand(replace(order, track=None))
            return
        if link == order.track:
            self._release_forced(local)
            self._set_link(local, int(NO_TRACK))
        self._stand(order)

    def _merge(self, order: Order) -> None:
        track, other = order.track or 0, order.other or 0
        self._relink(other, track)
        self.journal.merge(track, other, float("nan"))
        self._end(other, track)
        self.intake.orders.follow({other: track})

    def _split(self, order: Order) -> None:
        """The local track starts a global one that stands, until the next step fuses it, where it stands itself."""
        view, space = self.view(), self.intake.config.space
        local, at = find_local(view, order.local)
        source = self.intake.sources[local.source]
        old = int(source.tracks.link[at])
        one = slice(at, at + 1)
        mean, covariance = brought(
            source.tracks.mean[:, one], source.tracks.covariance[..., one], source.space, Unknown.of(space)
        )
        new = self._ids.allot(1, lambda: [[(local.source, local.epoch, local.id)]])
        born = replace(
            newborn(new, len(space), self.time),
            mean=mean,
            covariance=covariance,
            time=source.tracks.time[at : at + 1],
            updated=source.tracks.updated[at : at + 1],
            seen=source.tracks.time[at : at + 1],
        )
        self.picture = self.picture.join(born)
        if (order_by := self.picture.order()) is not None:  # a step made again gives ids that are known
            self.picture = self.picture.take(order_by)
        self._release_forced(local)
        self._set_link(local, int(new[0]))
        self.journal.birth(new)
        self.journal.split(int(new[0]), old)
        self._stand(replace(order, track=old))

    def _rename(self, order: Order) -> None:
        self._stand(order)

    def _identify(self, order: Order) -> None:
        self._stand(order)

    def _mute(self, order: Order) -> None:
        self.intake.admitted(order.source)
        self._stand(order)

    def _unmute(self, order: Order) -> None:
        self._end_about("mute", order.source)

    def _end_about(self, what: str, source: str) -> None:
        standing = self.intake.orders.standing
        self.intake.orders.end(n for n, one in standing.items() if (one.order.what, one.order.source) == (what, source))

    def _quarantine(self, order: Order) -> None:
        """Tracks that the source shares go on without it; those it has alone stay its own."""
        tables = [source.tracks.link for name, source in self.intake.sources.items() if name != order.source]
        shared = np.unique(np.concatenate([*tables, np.zeros(0, dtype=np.uint64)]))
        source = self.intake.sources[order.source]
        both = np.flatnonzero(np.isin(source.tracks.link, shared[shared != NO_TRACK]))
        source.tracks = relinked(source.tracks, both, NO_TRACK, self._step)
        self._stand(order)

    def _release(self, order: Order) -> None:
        self._end_about("quarantine", order.source)

    def _drop(self, order: Order) -> None:
        source = self.intake.sources[order.source]
        source.tracks = source.tracks.take(slice(0, 0))

    def _supervise(self, order: Order) -> None:
        self._end_about("supervise", order.source)
        if order.state != "auto":
            self._stand(order)

    def _withdraw(self, order: Order) -> None:
        self.intake.orders.end([order.withdrawn])


def heirs(ended: tuple[tuple[int, str, int | None], ...]) -> Mapping[int, int]:
    """{id that ended: id that goes on for it}, of what a journal tells."""
    return {old: heir for old, _, heir in ended if heir is not None}
