"""What a step's fusion is told of the correlation of local tracks: bounds between declared groups of sources, or what
`derived` knows of each pair.

A source's group is what its SensorInfo says (`correlation_group`), else what the config says of it, with `override` the
other way round; a source without one is a group of its own, named as itself.

Derived: `bci` takes the bound of each pair. `bar-shalom-campo` takes the cross-covariances where all pairs of a target
are known but for less than `ENOUGH` of their correlation; elsewhere, and where they make no covariance, it is `bci`
under the bounds there are, and `ci` where there are none. `auto` is the same, under what is derived or declared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, marked, picked
from fusion_service.centre.derived import MOST_MEMBERS, Followed
from fusion_service.centre.intake import Intake
from fusion_service.centre.kept_weights import KeptWeights
from fusion_service.centre.lifecycle import WAYS
from fusion_service.centre.rows import Rows
from fusion_service.centre.sources import Source
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.config.correlation import group_bounds, is_derived
from fusion_service.rules import Fused, fuse_last
from schemas import Motion

__all__ = ["AUTO", "BY_UNION", "Correlation", "Ways", "declared_correlation", "declared_motions", "sound_rows"]

AUTO = "auto"
Ways = NDArray[np.uint8]
BY_CROSS, BY_DERIVED, BY_DECLARED, BY_CI, BY_UNION = (
    WAYS.index(way) for way in ("bar-shalom-campo derived", "bci derived", "bci declared", "ci", "cu")
)
EACH = ("max_correlation", "cross_covariance")
"""Options that have an element for each fusion."""
WEIGHED = ("ci", "bci")
"""Rules whose best weights a step may take over from the last one."""
ENOUGH = 0.05
"""What may be left of the unknown start of a pair whose cross-covariance is taken as known."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """How the rows of a step are fused by the rule of the config, with what is known of their correlation.

    groups (S,): of each source, by sorted name, the number of its group; bounds (G, G): between two of the groups.
    None where nothing is declared by groups. followed: pairs whose cross-covariance is derived. kept: the weights of
    the last step, None where the best are wanted.
    """

    config: CentreConfig
    groups: Ints | None = None
    bounds: Floats | None = None
    followed: Followed | None = None
    kept: KeptWeights | None = None

    def fuse(
        self, rows: Rows, members: Ints, means: Floats, covariances: Floats, weights: Floats | None, some: Ints
    ) -> tuple[Fused, Ways]:
        """Fuse rows `members` (B, N), of means (N, m, B) and covariances (N, m, m, B) of the components `some` (m,) of
        the space; what cannot be fused is NaN. And what each was fused by (B,): index into `lifecycle.WAYS`."""
        rule, options = self.config.rule, dict(self.config.rule_options)
        doubted = _doubted(rows, members)
        if doubted.any():
            sure, ways = self._sure(rows, members, means, covariances, weights, some, ~doubted)
            either = _part("cu", means, covariances, doubted)
            columns = zip(_columns(either), _columns(sure), strict=True)
            fused = Fused(*(np.where(doubted, a, b) for a, b in columns))
            return fused, np.where(doubted, BY_UNION, ways).astype(np.uint8)
        if "scales" in options and len(some) < len(self.config.space):
            options["scales"] = np.asarray(options["scales"], dtype=np.float64)[some]
        if rule == AUTO or is_derived(rule, options):
            return self._as_known(rows, members, means, covariances, some, options)
        if self.groups is not None:
            options["max_correlation"] = self._between(rows, members)
        start = self._start(rows, members) if rule in WEIGHED and weights is None else None
        fused = fuse_last(rule, means, covariances, weights, influence=True, start=start, **options)
        if rule in WEIGHED:
            self._note(rows, members, fused.weights)
        return fused, np.zeros(len(members), dtype=np.uint8)

    def _start(self, rows: Rows, members: Ints) -> Floats | None:
        """The weights (N, B) of the last step."""
        return None if self.kept is None else self.kept.of(rows.tracks.link[members[:, 0]], rows.source[members.T])

    def _note(self, rows: Rows, members: Ints, weights: Floats) -> None:
        if self.kept is not None:
            self.kept.note(rows.tracks.link[members[:, 0]], rows.source[members.T], weights)

    def _sure(
        self,
        rows: Rows,
        members: Ints,
        means: Floats,
        covariances: Floats,
        weights: Floats | None,
        some: Ints,
        mask: Bools,
    ) -> tuple[Fused, Ways]:
        """`fuse` of the elements of `mask` (B,), in a batch in which the others are NaN."""
        whole, ways = _part("cu", means, covariances, np.zeros_like(mask)), np.zeros(len(mask), dtype=np.uint8)
        if mask.any():
            w = None if weights is None else weights[..., mask]
            part, ways[mask] = self.fuse(rows, members[mask], means[..., mask], covariances[..., mask], w, some)
            for column, wide in zip(_columns(part), _columns(whole), strict=True):
                wide[..., mask] = column
        return whole, ways

    def _between(self, rows: Rows, members: Ints) -> Floats:
        """Bounds (N, N, B) that are declared."""
        size, N = members.shape
        if self.groups is None or self.bounds is None:
            return np.ones((N, N, size))
        group = self.groups[rows.source[members.T]]
        R = self.bounds[group[:, None], group[None]]
        R[range(N), range(N)] = 1.0
        return R

    def _as_known(
        self, rows: Rows, members: Ints, means: Floats, covariances: Floats, some: Ints, options: dict[str, Any]
    ) -> tuple[Fused, Ways]:
        """By the cross-covariances where all of a target are known; else under the bounds, those derived and those
        declared; else by `ci`. Of more than `MOST_MEMBERS` rows not all pairs are followed, and nothing is derived."""
        size, N = members.shape
        few = {name: value for name, value in options.items() if name not in ("max_correlation", "cross")}
        followed = self.followed if 1 < N <= MOST_MEMBERS else None
        start = self._start(rows, members)
        if followed is None and self.groups is None:
            fused = fuse_last("ci", means, covariances, influence=True, start=start, **few)
            self._note(rows, members, fused.weights)
            return fused, np.full(size, BY_CI, dtype=np.uint8)
        R, C, unknown = np.ones((N, N, size)), None, np.ones(size)
        if followed is not None:
            R, whole, unknown = followed.of(members)
            C = whole if len(some) == whole.shape[2] else whole[:, :, some][:, :, :, some]
        derived = (R < 1.0).any(axis=(0, 1))
        if self.groups is not None:
            R = np.minimum(R, self._between(rows, members))
        bounded = (R < 1.0).any(axis=(0, 1))
        known = (unknown < ENOUGH) & (self.config.rule != "bci")
        exact = _part("bar-shalom-campo", means, covariances, known, cross_covariance=C)
        known &= np.isfinite(exact.covariance[0, 0]) & (exact.covariance[0, 0] > 0.0)
        bounded &= ~known
        under = _part("bci", means, covariances, bounded, start, max_correlation=R, **few)
        neither = ~known & ~bounded
        safe = _part("ci", means, covariances, neither, start, **few)
        fused = _joined((known, exact), (bounded, under), (neither, safe))
        self._note(rows, members, np.where(known, np.nan, fused.weights) if known.any() else fused.weights)
        way = np.where(known, BY_CROSS, np.where(bounded, np.where(derived, BY_DERIVED, BY_DECLARED), BY_CI))
        return fused, way.astype(np.uint8)


def _doubted(rows: Rows, members: Ints) -> Bools:
    """Which groups (B, N) of several rows hold one of a source that is fused by covariance union."""
    union = getattr(rows, "union", None)
    if union is None or members.shape[1] < 2:
        return np.zeros(len(members), dtype=np.bool_)
    return np.asarray(union[members].any(axis=1))


def _part(
    rule: str, means: Floats, covariances: Floats, some: Bools, start: Floats | None = None, **options: Any
) -> Fused:
    """The fusions of some elements, in a batch in which the others are NaN."""
    N, n, size = means.shape
    at = marked(some)
    if len(at) == size:
        return fuse_last(rule, means, covariances, influence=True, start=start, **options)
    whole = Fused(*(np.full((*shape, size), np.nan) for shape in ((n,), (n, n), (N,), (N,))))
    if len(at):
        options |= {name: picked(options[name], at) for name in EACH if name in options}
        begin = None if start is None else picked(start, at)
        x, P = picked(means, at), picked(covariances, at)
        part = fuse_last(rule, x, P, influence=True, start=begin, **options)
        for column, wide in zip(_columns(part), _columns(whole), strict=True):
            wide[..., at] = column
    return whole


def _joined(*parts: tuple[Bools, Fused]) -> Fused:
    """One batch of `_part`s, each element of the one whose mask it is in."""
    there = [(some, part) for some, part in parts if some.any()] or list(parts[:1])
    whole = there[0][1]
    for some, part in there[1:]:
        columns = zip(_columns(whole), _columns(part), strict=True)
        whole = Fused(*(np.where(some, new, old) for old, new in columns))
    return whole


def _columns(fused: Fused) -> tuple[Floats, Floats, Floats, Floats]:
    assert fused.influence is not None
    return fused.mean, fused.covariance, fused.weights, fused.influence


def declared_correlation(
    intake: Intake, config: CentreConfig, followed: Followed | None = None, kept: KeptWeights | None = None
) -> Correlation:
    """What the sources declare of it now, and what is known of pairs of rows."""
    bounds = group_bounds(config.rule_options) if config.rule in ("bci", AUTO) else None
    if bounds is None:
        return Correlation(config, followed=followed, kept=kept)
    named = [intake.declared(source).correlation_group or name for name, source in sorted(intake.sources.items())]
    groups = sorted(set(named))
    number = {name: i for i, name in enumerate(groups)}
    size = len(groups), len(groups)
    between = np.array([[bounds.of(first, second) for second in groups] for first in groups]).reshape(size)
    return Correlation(config, np.array([number[name] for name in named], dtype=np.intp), between, followed, kept)


def declared_motions(intake: Intake) -> list[Motion | None]:
    """How tracks of each source, by sorted name, move: None where nobody says so, or where the centre's space is not
    all that it estimates, so that what it reports there is not a filter of its own."""
    return [_motion(intake, source) for _, source in sorted(intake.sources.items())]


def _motion(intake: Intake, source: Source) -> Motion | None:
    own = intake.config.source(source.name)
    known = source.info is not None or own.override or own.motion != SourceConfig().motion
    whole = set(source.space) == set(intake.config.space)
    return intake.declared(source).motion if known and whole else None


def sound_rows(rows: Rows) -> Bools:
    """The rows (M,) that are one Gaussian."""
    if not len(rows.tracks.log_weight):
        return np.ones(len(rows.source), dtype=np.bool_)
    return np.asarray(np.isfinite(rows.tracks.log_weight).sum(axis=0) <= 1)
