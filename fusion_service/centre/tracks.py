"""Local tracks column by column, batch axis last, in the centre's frame and their source's own state space.

`link` is the global id a track is linked to (0: none); it lives as long as the local id does within one epoch, so a
restarted client takes over nobody's links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, all_of, marked, same_ids
from fusion_service.centre.words import Codes
from fusion_service.densities import Mixtures
from fusion_service.records import altered, columns_of, made

__all__ = [
    "EXTENT_ROWS",
    "FUSED_ROWS",
    "LINKS",
    "Columns",
    "Pair",
    "Step",
    "Tracks",
    "as_mixtures",
    "by_id",
    "empty_tracks",
    "join_tracks",
    "no_parts",
    "padded",
    "relinked",
    "renewed",
    "set_links",
    "taken",
    "unlinked",
]

Columns = TypeVar("Columns", bound="HasParts")

EXTENT_ROWS, FUSED_ROWS = 11, 7
"""Numbers of an extent: as a local track says it, and fused (see `extents`)."""


class HasParts(Protocol):
    """Columns of densities that may be mixtures: `Tracks`, or the global tracks."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def mean(self) -> Floats: ...
    @property
    def covariance(self) -> Floats: ...
    @property
    def log_weight(self) -> Floats: ...
    @property
    def part_mean(self) -> Floats: ...
    @property
    def part_covariance(self) -> Floats: ...


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """T tracks of one source: mean (n, T), covariance (n, n, T), the rest (T,).

    Where some track is a mixture, parts (C > 0) hold its components, log_weight (C, T) with -inf for padding,
    part_mean (n, C, T), part_covariance (n, n, C, T), and mean and covariance are their moments; else C = 0.
    id u64; time i64 of the density; updated i64 of the last measurement; existence (NaN: not reported);
    interval i64 expected time to the next report, ns (see `intervals`); identity, kind i32 codes of what it is said to
    be (-1: not said), kind_p (NaN: not said); origin u8 index into `ORIGINS` of the message;
    link u64 global id or 0; since i64 step of the link; used i64 time of the version last fused (-1: none); judged
    i64 `updated` of the newest datum that was judged, seen i64 time of the step that did; weighed i64 newest datum of
    the others in the track when evidence was last added; data i64 how many were judged in this link; evidence f64 sum
    for the link; outside: the newest datum failed its gate; shadow u64 global id that it is a second track of, or 0;
    apart f64 sum for that; told i64 `updated` of the version whose identity and class the global track has heard;
    lineage i32 code of the sources whose data it contains (-1: its source alone); extent (E, T), what is said of the
    object's extent, E = 0 where nothing is of any (see `extents`).
    """

    id: NDArray[np.uint64]
    time: NDArray[np.int64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_weight: NDArray[np.float64]
    part_mean: NDArray[np.float64]
    part_covariance: NDArray[np.float64]
    existence: NDArray[np.float64]
    updated: NDArray[np.int64]
    interval: NDArray[np.int64]
    identity: Codes
    kind: Codes
    kind_p: NDArray[np.float64]
    origin: NDArray[np.uint8]
    lineage: NDArray[np.int32]
    extent: NDArray[np.float64]
    link: NDArray[np.uint64]
    since: NDArray[np.int64]
    used: NDArray[np.int64]
    judged: NDArray[np.int64]
    weighed: NDArray[np.int64]
    seen: NDArray[np.int64]
    data: NDArray[np.int64]
    evidence: NDArray[np.float64]
    outside: NDArray[np.bool_]
    shadow: NDArray[np.uint64]
    apart: NDArray[np.float64]
    told: NDArray[np.int64]

    def take(self, rows: Any) -> Tracks:
        """The given rows (indices or a mask); the same where the mask holds for all."""
        return cast(Tracks, taken(self, rows))

    def mixtures(self, rows: Any) -> Mixtures:
        """The densities of the given rows as mixtures."""
        return as_mixtures(self, rows)


_BLANK: dict[str, tuple[type[np.generic], float]] = {
    "link": (np.uint64, 0),
    **dict.fromkeys(("since", "used", "judged", "weighed", "seen"), (np.int64, -1)),
    "data": (np.int64, 0),
    "evidence": (np.float64, 0.0),
    "outside": (np.bool_, False),
    "shadow": (np.uint64, 0),
    "apart": (np.float64, 0.0),
    "told": (np.int64, -1),
}
LINKS = tuple(_BLANK)
"""Columns that a new version of a track takes over from the last."""
OF_THE_TRACK = ("judged", "seen", "told")
"""Those of them that a new link leaves as they are: what was done with the newest datum."""


Pair: TypeAlias = tuple[Tracks, Tracks]
"""Old versions of some tracks, and the new ones that came next."""


def empty_tracks(n: int) -> Tracks:
    """No tracks, of n components."""
    whole, real, code = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int32)
    log_weight, part_mean, part_covariance = no_parts(n, 0)
    return Tracks(
        id=np.zeros(0, dtype=np.uint64),
        time=whole,
        mean=np.zeros((n, 0)),
        covariance=np.zeros((n, n, 0)),
        log_weight=log_weight,
        part_mean=part_mean,
        part_covariance=part_covariance,
        existence=real,
        updated=whole,
        interval=whole,
        identity=code,
        kind=code,
        kind_p=real,
        origin=np.zeros(0, dtype=np.uint8),
        lineage=code,
        extent=np.zeros((0, 0)),
        **unlinked(0),
    )


def unlinked(count: int) -> dict[str, NDArray[Any]]:
    """The columns `LINKS` of tracks that nothing is known of."""
    whole, real, ids = np.full((6, count), -1), np.zeros((2, count)), np.zeros((2, count), dtype=np.uint64)
    return {
        "link": ids[0],
        "since": whole[0],
        "used": whole[1],
        "judged": whole[2],
        "weighed": whole[3],
        "seen": whole[4],
        "data": np.zeros(count, dtype=np.int64),
        "evidence": real[0],
        "outside": np.zeros(count, dtype=np.bool_),
        "shadow": ids[1],
        "apart": real[1],
        "told": whole[5],
    }


def set_links(tracks: Tracks, at: NDArray[np.intp], link: NDArray[np.uint64] | np.uint64, step: int) -> None:
    """Give the tracks `at` a link in `step`, 0 for none, with nothing known of it yet. Writes the columns `LINKS`."""
    if not len(at):
        return
    for name, (_, blank) in _BLANK.items():
        if name not in OF_THE_TRACK:
            getattr(tracks, name)[at] = blank
    tracks.link[at], tracks.since[at] = link, step


def relinked(tracks: Tracks, at: NDArray[np.intp], link: NDArray[np.uint64] | np.uint64, step: int) -> Tracks:
    """The same with other links, as `set_links` gives them."""
    new = altered(tracks, **{name: getattr(tracks, name).copy() for name in LINKS})
    set_links(new, at, link, step)
    return new


def no_parts(n: int, count: int) -> tuple[Floats, Floats, Floats]:
    """The columns of components of `count` tracks that are all Gaussian."""
    return np.zeros((0, count)), np.zeros((n, 0, count)), np.zeros((n, n, 0, count))


def join_tracks(parts: Sequence[Columns]) -> Columns:
    """One after the other; where some hold components, or an extent, all get them."""
    most = max(len(part.log_weight) for part in parts)
    if any(len(part.log_weight) != most for part in parts):
        parts = [padded(part, most) for part in parts]
    first = parts[0]
    if len({len(getattr(part, "extent", ())) for part in parts}) > 1:
        parts = [_with_extents(part) for part in parts]
    return made(type(first), [np.concatenate(column, axis=-1) for column in zip(*map(columns_of, parts), strict=True)])


def _with_extents(tracks: Columns) -> Columns:
    """The same with room for extents, nothing being said of them."""
    extent = getattr(tracks, "extent")  # noqa: B009
    if len(extent):
        return tracks
    rows = EXTENT_ROWS if isinstance(tracks, Tracks) else FUSED_ROWS
    return altered(tracks, extent=np.full((rows, extent.shape[-1]), np.nan))


def as_mixtures(tracks: HasParts, rows: Any) -> Mixtures:
    """The densities of the given rows as mixtures."""
    if not len(tracks.log_weight):
        mean, covariance = tracks.mean[:, None, rows], tracks.covariance[:, :, None, rows]
        return Mixtures(np.zeros_like(mean[0]), mean, covariance)
    return Mixtures(tracks.log_weight[:, rows], tracks.part_mean[..., rows], tracks.part_covariance[..., rows])


def padded(tracks: Columns, components: int) -> Columns:
    """The same with room for so many components."""
    had = len(tracks.log_weight)
    if had == components:
        return tracks
    log_weight = np.full((components, tracks.mean.shape[-1]), -np.inf)
    if had:
        index = np.minimum(np.arange(components), had - 1)
        log_weight[:had] = tracks.log_weight
        mean, covariance = tracks.part_mean[:, index], tracks.part_covariance[:, :, index]
    else:
        log_weight[0] = 0.0
        mean = np.repeat(tracks.mean[:, None], components, axis=1)
        covariance = np.repeat(tracks.covariance[:, :, None], components, axis=2)
    return altered(tracks, log_weight=log_weight, part_mean=mean, part_covariance=covariance)


def taken(columns: Any, rows: Any) -> Any:
    """Columns, (..., T) each, of the given rows (indices or a mask): the same ones where a mask holds for all."""
    if not isinstance(rows, np.ndarray):
        return made(type(columns), [column[..., rows] for column in columns_of(columns)])
    if rows.dtype != np.bool_:
        return made(type(columns), [column.take(rows, axis=-1) for column in columns_of(columns)])
    if all_of(rows):
        return columns
    at = marked(rows)
    return made(type(columns), [column.take(at, axis=-1, mode="clip") for column in columns_of(columns)])


def by_id(tracks: Tracks) -> Tracks:
    """The same, sorted by id; those of one id in the order of time, or as given where times are equal."""
    ids = tracks.id
    if all_of(ids[1:] > ids[:-1]):
        return tracks
    return tracks.take(np.lexsort((tracks.time, ids)))


class Step(NamedTuple):
    """What a report makes of a table: the new versions (T,), sorted by id and one of each, with the links of the old
    ones; stays (O,): which rows of the old table they do not replace; pair: the new versions that hold a newer
    measurement than the ones before, beside these, None where there is none (or they were not asked for)."""

    new: Tracks
    stays: Bools
    pair: Pair | None


def renewed(old: Tracks, new: Tracks, versions: bool = False) -> Step:
    """The step from a table, sorted by id, to what a report says, `new` (as `by_id`; it may hold an id several times):
    of each id the newest counts, the later given where times are equal. Links are kept unless the origin has changed.
    versions: give the pairs too."""
    if len(new.id) and same_ids(old.id, new.id) and all_of(old.time <= new.time):
        return _renewed_all(old, new, versions)
    last = np.append(new.id[1:] != new.id[:-1], np.ones(min(len(new.id), 1), dtype=np.bool_))
    pair = successive(old, new) if versions and not last.all() else None
    single, new = last.all(), new.take(last)
    at, there = _places(old.id, new.id)
    beaten = there & (old.time[at] > new.time) if len(old.id) else there
    if beaten.any():
        new, at, there = new.take(~beaten), at[~beaten], there[~beaten]
    stays = np.ones(len(old.id), dtype=np.bool_)
    stays[at[there]] = False
    if not there.any():
        return Step(_alike(old, new), stays, pair)
    whole = len(at) == len(old.id) and bool(there.all())
    was = old if whole else old.take(at)
    same = there & (was.origin == new.origin)
    if versions and single:
        later = same & (new.updated > was.updated)
        pair = (was.take(later), new.take(later)) if later.any() else None
    if same.all():
        kept = {name: getattr(was, name) for name in LINKS}
    else:
        kept = {name: np.where(same, getattr(was, name), getattr(new, name)) for name in LINKS}
    return Step(_alike(old, altered(new, **kept)), stays, pair)


def _renewed_all(old: Tracks, new: Tracks, versions: bool) -> Step:
    """`renewed` of a table by a report that names each of its tracks once, and no older: what nearly every one does."""
    same, pair = old.origin == new.origin, None
    if versions:
        later = same & (new.updated > old.updated)
        pair = (old.take(later), new.take(later)) if later.any() else None
    kept = {name: getattr(old, name) for name in LINKS}
    if not all_of(same):
        kept = {name: np.where(same, column, getattr(new, name)) for name, column in kept.items()}
    return Step(_alike(old, altered(new, **kept)), np.zeros(len(old.id), dtype=np.bool_), pair)


def _places(ids: NDArray[np.uint64], some: NDArray[np.uint64]) -> tuple[Ints, Bools]:
    """Where each of `some` (K,) stands in `ids`, sorted, and whether it does."""
    if len(ids) == len(some) and (ids == some).all():
        return np.arange(len(some)), np.ones(len(some), dtype=np.bool_)
    if not len(ids):
        return np.zeros(len(some), dtype=np.intp), np.zeros(len(some), dtype=np.bool_)
    at = np.minimum(np.searchsorted(ids, some), len(ids) - 1)
    return at, ids[at] == some


def _alike(old: Tracks, new: Tracks) -> Tracks:
    """The new ones with room for components and extents where the old ones have it."""
    if len(old.log_weight) <= len(new.log_weight) and len(old.extent) <= len(new.extent):
        return new
    return join_tracks([old.take(slice(0, 0)), new])


def successive(old: Tracks, new: Tracks) -> Pair | None:
    """Each version of `new` with the one before it, in `old` (sorted by id) or in `new`; without those that hold no
    newer measurement than it, or of which a later one was there already. None if there is no such version."""
    if not len(old.id) or not len(new.id):
        return None
    both = join_tracks([old.take(np.isin(old.id, new.id)), new])
    order = np.lexsort((np.arange(len(both.id)), both.time, both.id))
    both, fresh = both.take(order), order >= len(both.id) - len(new.id)
    first, last = both.take(slice(None, -1)), both.take(slice(1, None))
    begun = np.maximum.accumulate(np.where(fresh, -1, np.arange(len(fresh))))[:-1]
    same = (first.id == last.id) & (begun >= 0) & (both.id[begun] == first.id) & fresh[1:]
    same &= (last.updated > first.updated) & (first.origin == last.origin)
    return (first.take(same), last.take(same)) if same.any() else None
