"""What a step's fusion is told of the correlation of local tracks: bounds between declared groups of sources, or what
`derived` knows of each pair.

A source's group is what its SensorInfo says (`correlation_group`), else what the config says of it, with `override` the
other way round; a source without one is a group of its own, named as itself.

Derived: `bci` takes the bound of each pair. `bar-shalom-campo` takes the cross-covariances where all pairs of a target
are known but for less than `ENOUGH` of their correlation; elsewhere, and where they make no covariance, it is `bci`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.derived import Followed
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import Rows
from fusion_service.centre.sources import Source
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.config.correlation import group_bounds, is_derived
from fusion_service.rules import Fused, fuse_last
from schemas import Motion

__all__ = ["Correlation", "declared_correlation", "declared_motions", "sound_rows"]

ENOUGH = 0.05
"""What may be left of the unknown start of a pair whose cross-covariance is taken as known."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """How the rows of a step are fused by the rule of the config, with what is known of their correlation.

    groups (S,): of each source, by sorted name, the number of its group; bounds (G, G): between two of the groups.
    None where nothing is declared by groups. followed: pairs whose cross-covariance is derived.
    """

    config: CentreConfig
    groups: Ints | None = None
    bounds: Floats | None = None
    followed: Followed | None = None

    def fuse(self, rows: Rows, members: Ints, means: Floats, covariances: Floats, weights: Floats | None) -> Fused:
        """Fuse rows `members` (B, N), of means (N, n, B) and covariances (N, n, n, B); what cannot be fused is NaN."""
        options = dict(self.config.rule_options)
        if is_derived(self.config.rule, options):
            return self._derived(members, means, covariances)
        if self.groups is not None and self.bounds is not None:
            group = self.groups[rows.source[members.T]]
            R = self.bounds[group[:, None], group[None]]
            R[range(len(R)), range(len(R))] = 1.0
            options["max_correlation"] = R
        return fuse_last(self.config.rule, means, covariances, weights, influence=True, **options)

    def _derived(self, members: Ints, means: Floats, covariances: Floats) -> Fused:
        size, N = members.shape
        n = means.shape[1]
        if self.followed is None:
            R, C, unknown = np.ones((N, N, size)), np.zeros((N, N, n, n, size)), np.ones(size)
        else:
            R, C, unknown = self.followed.of(members)
        if self.config.rule == "bci":
            options = {**self.config.rule_options, "max_correlation": R}
            return fuse_last("bci", means, covariances, influence=True, **options)
        known = unknown < ENOUGH
        exact = _part("bar-shalom-campo", means, covariances, known, cross_covariance=C)
        known[known] = np.isfinite(exact.covariance[0, 0, known]) & (exact.covariance[0, 0, known] > 0.0)
        bounded = _part("bci", means, covariances, ~known, max_correlation=R)
        return Fused(*(_either(known, *pair) for pair in zip(_columns(exact), _columns(bounded), strict=True)))


def _part(rule: str, means: Floats, covariances: Floats, some: Bools, **options: Floats) -> Fused:
    """The fusions of some elements, in a batch in which the others are NaN."""
    chosen = {name: value[..., some] for name, value in options.items()}
    part = fuse_last(rule, means[..., some], covariances[..., some], influence=True, **chosen)
    whole = []
    for column in _columns(part):
        wide = np.full((*column.shape[:-1], len(some)), np.nan)
        wide[..., some] = column
        whole.append(wide)
    return Fused(*whole)


def _columns(fused: Fused) -> tuple[Floats, Floats, Floats, Floats]:
    assert fused.influence is not None
    return fused.mean, fused.covariance, fused.weights, fused.influence


def _either(first: Bools, one: Floats, other: Floats) -> Floats:
    return np.where(first, one, other)


def declared_correlation(intake: Intake, config: CentreConfig, followed: Followed | None = None) -> Correlation:
    """What the sources declare of it now, and what is known of pairs of rows."""
    bounds = group_bounds(config.rule_options) if config.rule == "bci" else None
    if bounds is None:
        return Correlation(config, followed=followed)
    named = [intake.declared(source).correlation_group or name for name, source in sorted(intake.sources.items())]
    groups = sorted(set(named))
    number = {name: i for i, name in enumerate(groups)}
    size = len(groups), len(groups)
    between = np.array([[bounds.of(first, second) for second in groups] for first in groups]).reshape(size)
    return Correlation(config, np.array([number[name] for name in named], dtype=np.intp), between)


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
