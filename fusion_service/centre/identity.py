"""`Identities`: what the global tracks are, of what origin, and what that means for association.

Identity and class are fused by Bayes over sources and time (`beliefs`), once for each new datum of a local track. A
source's identity is right with probability `identity_trust`, else anything; its class with `kind_accuracy`, else any
other of the classes known, evenly; a probability that comes with the class weakens it. Identities of different
schemes (mmsi:..., icao:...) do not contradict each other.

For the pairing of a local track with a track or another local one this gives a log-likelihood ratio of "same object"
to "two objects" (with `POPULATION` identities about), and forbids what trusted identities contradict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints, among, filled, marked
from fusion_service.centre.beliefs import OPEN, Beliefs, learned, no_beliefs
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.words import NONE, Codes
from fusion_service.records import altered

__all__ = ["MOST_CLASSES", "POPULATION", "TRUSTED", "Identities", "Terms"]

Ids = NDArray[np.uint64]
Mask = NDArray[np.bool_]

TRUSTED = 0.9
"""Probability from which an identity is trusted: it forbids another, and cannot be in two places."""
POPULATION = 1000
"""Identities that are about: how unlikely it is that two objects have the same."""
MOST_CLASSES = 32
SURE = 30.0
"""Log odds of what an operator says; `beliefs.DEPTH` bounds what is kept of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Of P pairs: ratio (P,), the log-likelihood ratio of one object to two by what they are said to be, 0 where
    nothing is (to be added to that of the states, or -2 times it to d2 + log det); forbidden (P,)."""

    ratio: Floats
    forbidden: Mask


class Identities:
    """The beliefs about every global track; identity, kind: as the last step left them."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self.identity = no_beliefs()
        self.kind = no_beliefs()

    def follow(self, rows: Rows, ids: Ids, heirs: Mapping[int, int]) -> None:
        """After a step: hear what the linked rows say that is new, and forget tracks that are no more. ids: of the
        picture, sorted; heirs: {id that ended: id that goes on for it}. Writes `told` of rows and tables."""
        tracks = rows.tracks
        says = (tracks.identity != NONE) | (tracks.kind != NONE)
        if not (says.any() or len(self.identity.track) or len(self.kind.track) or self.ordered()):
            return
        self.identity, self.kind = (_inherited(one, heirs) for one in (self.identity, self.kind))
        new = marked(says & (tracks.link != NO_TRACK) & ~tracks.outside & (tracks.updated > tracks.told))
        new = new[among(tracks.link[new], ids)]
        known = np.concatenate([self.identity.track, self.kind.track])
        new = new[~rows.echo[new] | ~among(tracks.link[new], known)]  # its own word is no news to a centre
        if len(new):
            self._hear(rows, new)
            tracks.told[new] = tracks.updated[new]
            self._write_back(rows)
        self._obey(ids)
        self.identity, self.kind = (one.take(among(one.track, ids)) for one in (self.identity, self.kind))

    def _hear(self, rows: Rows, new: Ints) -> None:
        tracks = rows.tracks
        one = new[tracks.identity[new] != NONE]
        code = tracks.identity[one]
        trust = self._stated("identity_trust", rows.source[one])
        question = self._intake.said.identity.schemes()[code]
        self.identity = learned(self.identity, tracks.link[one], question, code, np.log(trust / (1.0 - trust)))
        one = new[tracks.kind[new] != NONE]
        code, others = tracks.kind[one], self._classes() - 1
        right = self._stated("kind_accuracy", rows.source[one])
        said = np.where(np.isfinite(tracks.kind_p[one]), np.clip(tracks.kind_p[one], 0.0, 1.0), 1.0)
        right = np.clip(said * right + (1.0 - said) * (1.0 - right) / others, 1e-9, 1.0 - 1e-9)
        gain = np.log(right * others / (1.0 - right))
        self.kind = learned(self.kind, tracks.link[one], np.zeros(len(one), dtype=np.int32), code, gain)

    def _obey(self, ids: Ids) -> None:
        """What operators have said holds above all."""
        said = self.ordered()
        track = np.array([one for one in said if np.isin(np.uint64(one), ids)], dtype=np.uint64)
        if len(track):
            code = self._intake.said.identity.codes([said[one] for one in track.tolist()])
            question = self._intake.said.identity.schemes()[code]
            self.identity = learned(self.identity, track, question, code, np.full(len(track), SURE))

    def ordered(self) -> dict[int, str]:
        """{global id: identity that an operator gave it}."""
        standing = self._intake.orders.standing.values()
        return {one.order.track or 0: one.order.identity for one in standing if one.order.what == "identify"}

    def _write_back(self, rows: Rows) -> None:
        start = 0
        for name, count in rows.kept.items():
            source = self._intake.sources[name]
            source.tracks = altered(source.tracks, told=rows.tracks.told[start : start + count])
            start += count

    def schemes(self) -> Codes:
        """The scheme of each identity, by code."""
        return self._intake.said.identity.schemes()

    def _classes(self) -> int:
        return min(max(len(self._intake.said.kind.texts), 2), MOST_CLASSES)

    def _stated(self, setting: str, source: Ints) -> Floats:
        """A setting of each of the sources (indices into the sorted names)."""
        config = self._intake.config
        values = np.array([getattr(config.source(name), setting) for name in self._intake.names()], dtype=np.float64)
        return values[source] if len(values) else np.zeros(0)

    def named(self, ids: Ids) -> tuple[Codes, Floats]:
        """Identity (code, -1: none) and its probability (G,) of each of these tracks: of its schemes the surest."""
        code, p = _of_tracks(self.identity, ids, OPEN)
        for track, text in self.ordered().items():
            at = marked(ids == np.uint64(track))
            code[at], p[at] = self._intake.said.identity.code(text), 1.0
        return code, p

    def classed(self, ids: Ids) -> tuple[Codes, Floats]:
        """Class (code, -1: none) and its probability (G,) of each of these tracks."""
        return _of_tracks(self.kind, ids, self._classes())

    def terms(self, rows: Rows, row: Ints, track: Ids) -> Terms:
        """For candidate pairs (row, global id), each (P,)."""
        ratio, forbidden = np.zeros(len(row)), np.zeros(len(row), dtype=np.bool_)
        code = rows.tracks.identity[row]
        said = marked(code != NONE)
        if not len(said) or not len(self.identity.track):
            return Terms(ratio, forbidden)
        schemes, best = self._intake.said.identity.schemes(), self.identity.best(OPEN)
        at = self.identity.find(track[said], schemes[code[said]])
        said, at = said[at >= 0], at[at >= 0]
        trust = self._stated("identity_trust", rows.source[row[said]])
        p = np.where(self.identity.code[:, at] == code[said], self.identity.probabilities(OPEN)[:, at], 0.0).max(axis=0)
        ratio[said] = np.log(POPULATION * trust * p + (1.0 - trust) * (1.0 - p))
        other = (best[0][at] != code[said]) & (best[1][at] >= TRUSTED)
        forbidden[said] = other & (trust >= TRUSTED)
        return Terms(ratio, forbidden)

    @property
    def believes(self) -> bool:
        """Whether any track is believed to be something."""
        return len(self.identity.track) > 0

    def trusted_rows(self, rows: Rows, some: Ints) -> tuple[Ints, Codes]:
        """Of some rows those that say, from a source that is trusted, what they are, in order, and what (codes)."""
        said, _, code = self._trusted(rows, some)
        return said, code

    def trusted_tracks(self) -> tuple[Ids, Codes]:
        """The tracks that are believed to be something, `TRUSTED` or more, and what (codes); one may stand twice."""
        code, p = self.identity.best(OPEN)
        sure = p >= TRUSTED
        return self.identity.track[sure], code[sure]

    def contradicted(self, rows: Rows, linked: Ints, sure: Ints) -> Ints:
        """Of the linked rows those that are trusted to be another object than a row of the same track, which stays:
        one of `sure`, else one that says what the track is believed to be, else the one that was linked first."""
        said, question, code = self._trusted(rows, linked)
        if not len(said):
            return said
        link, since = rows.tracks.link[said], rows.tracks.since[said]
        at, best = self.identity.find(link, question), self.identity.best(OPEN)
        known = at >= 0
        unbelieved = np.ones(len(said), dtype=np.bool_)
        unbelieved[known] = (best[0][at[known]] != code[known]) | (best[1][at[known]] < TRUSTED)
        order = np.lexsort((said, since, unbelieved, ~among(said, sure), question, link))
        new = np.append(True, (np.diff(link[order]) != 0) | (np.diff(question[order]) != 0))
        stays = code[order][new][np.cumsum(new) - 1]
        odd: Ints = np.sort(said[order][code[order] != stays])
        return odd

    def denied(self, rows: Rows, row: Ints, track: Ids) -> Mask:
        """Of candidate pairs (row, global id), each (P,), those of which the row, and one linked to the track, are
        trusted to be two objects."""
        forbidden = np.zeros(len(row), dtype=np.bool_)
        mine, asked, code = self._trusted(rows, row)
        if not len(mine):
            return forbidden
        linked, question, said = self._trusted(rows, rows.linked())
        if not len(linked):
            return forbidden
        link, width = rows.tracks.link[linked], len(self._intake.said.identity.texts)
        tracks = np.unique(link)
        keys = np.searchsorted(tracks, link) * width + question
        order = np.argsort(keys, kind="stable")
        pairs = marked(among(row, mine) & among(track, tracks))
        place = np.searchsorted(mine, row[pairs])
        wanted = np.searchsorted(tracks, track[pairs]) * width + asked[place]
        at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
        forbidden[pairs] = (keys[order][at] == wanted) & (said[order][at] != code[place])
        return forbidden

    def _trusted(self, rows: Rows, some: Ints) -> tuple[Ints, Codes, Codes]:
        """Of some rows those that have an identity from a source that is trusted, in order, and each its question and
        its answer."""
        some = some[rows.tracks.identity[some] != NONE]
        some = np.unique(some) if len(some) else some
        if len(some):
            some = some[self._stated("identity_trust", rows.source[some]) >= TRUSTED]
        code = rows.tracks.identity[some]
        return some, self._intake.said.identity.schemes()[code], code

    def row_terms(self, rows: Rows, i: Ints, j: Ints) -> Terms:
        """For pairs of rows (i, j), each (P,)."""
        code = rows.tracks.identity
        both = (code[i] != NONE) & (code[j] != NONE)
        ratio, forbidden = np.zeros(len(i)), np.zeros(len(i), dtype=np.bool_)
        if not both.any():
            return Terms(ratio, forbidden)
        schemes = self._intake.said.identity.schemes()
        both &= schemes[code[i]] == schemes[code[j]]
        trust = self._stated("identity_trust", rows.source)
        one, two = trust[i], trust[j]
        equal = code[i] == code[j]
        match = POPULATION * one * two + (1.0 - one) * (1.0 - two)
        ratio = np.where(both, np.log(np.where(equal, match, 1.0 - one * two)), 0.0)
        return Terms(ratio, both & ~equal & (one >= TRUSTED) & (two >= TRUSTED))

    def compact(self) -> None:
        """Forget texts that nobody says any more."""
        tables = [source.tracks for source in self._intake.sources.values()]
        for name in ("identity", "kind"):
            beliefs: Beliefs = getattr(self, name)
            words = getattr(self._intake.said, name)
            new = words.compacted([*(getattr(one, name) for one in tables), beliefs.code, beliefs.question])
            if new is None:
                continue
            for source in self._intake.sources.values():
                source.tracks = altered(source.tracks, **{name: new[getattr(source.tracks, name)]})
            question = new[beliefs.question] if name == "identity" else beliefs.question
            setattr(self, name, altered(beliefs, code=new[beliefs.code], question=question))

    def kept(self) -> dict[str, Any]:
        """What a checkpoint holds of it, as plain values."""
        return {name: _packed(getattr(self, name)) for name in ("identity", "kind")}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        self.identity, self.kind = (_unpacked(kept[name]) for name in ("identity", "kind"))


def _inherited(beliefs: Beliefs, heirs: Mapping[int, int]) -> Beliefs:
    """With what was known of tracks that go on as others."""
    old = np.array(sorted(heirs), dtype=np.uint64)
    at = marked(among(beliefs.track, old))
    if not len(at):
        return beliefs
    new = np.array([heirs[track] for track in old.tolist()], dtype=np.uint64)
    place, row = np.nonzero(beliefs.code[:, at] != NONE)
    some = at[row]
    gain = beliefs.weight[place, some] - beliefs.weight[-1, some]
    heir = new[np.searchsorted(old, beliefs.track[some])]
    return learned(beliefs, heir, beliefs.question[some], beliefs.code[place, some], gain)


def _of_tracks(beliefs: Beliefs, ids: Ids, answers: int) -> tuple[Codes, Floats]:
    code, p = filled(len(ids), NONE, np.int32), np.zeros(len(ids))
    if len(beliefs.track) and len(ids):
        best, sure = beliefs.best(answers)
        order = np.lexsort((beliefs.question, -sure, beliefs.track))
        order = order[np.append(True, beliefs.track[order][1:] != beliefs.track[order][:-1])]
        at = np.minimum(np.searchsorted(beliefs.track[order], ids), len(order) - 1)
        there = beliefs.track[order][at] == ids
        code[there], p[there] = best[order[at[there]]], sure[order[at[there]]]
    return code, p


_FORM = {"track": "<u8", "question": "<i4", "code": "<i4", "weight": "<f8"}


def _packed(beliefs: Beliefs) -> dict[str, bytes]:
    return {name: np.ascontiguousarray(getattr(beliefs, name), form).tobytes() for name, form in _FORM.items()}


def _unpacked(packed: Mapping[str, bytes]) -> Beliefs:
    count, like = len(packed["track"]) // 8, no_beliefs()
    columns = []
    for name, form in _FORM.items():
        empty = getattr(like, name)
        flat = np.frombuffer(packed[name], dtype=form).astype(empty.dtype)
        columns.append(flat.reshape(*empty.shape[:-1], count))
    return Beliefs(*columns)
