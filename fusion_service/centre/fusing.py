"""All global tracks of one step fused at once: every source's track of a target, by the configured rule.

Gaussian tracks go by `rule`. Where a track is a mixture, a target that one source sees keeps it; what several see
is fused by `mixture_rule` ("moments": by `rule` on means and covariances, and the result is Gaussian), reduced to
`max_components`. Without options of its own, the arithmetic average ("aa") weighs
every source by the existence it reports. With recursive memory the predicted last result joins as one more source under
`memory_correlation`, by its moments, and each version of a local track is used once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, all_of, any_of, finite, marked
from fusion_service.centre import kinship
from fusion_service.centre.association import by_size, uniform_ci
from fusion_service.centre.blocks import fuse_known
from fusion_service.centre.bounding import union_bound
from fusion_service.centre.correlation import AUTO, BY_UNION, Correlation, Ways
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.tracks import no_parts, padded
from fusion_service.config import CentreConfig
from fusion_service.densities import Mixtures, reduce_mixtures
from fusion_service.records import altered
from fusion_service.rules import MIXTURE_RULES, RULES, Fused, fuse_last
from fusion_service.rules.mixtures import fuse_mixtures_last
from schemas import Entry

__all__ = ["fuse_all", "with_parts"]


MOST_PRODUCTS = 4096
"""Components that a product of sources may have before it is reduced; theirs are reduced first to fit, and beyond
twelve sources moments are fused."""


def fuse_all(
    rows: Rows, picture: Picture, time: int, known: Correlation, journal: Journal, left: Bools | None = None
) -> tuple[Picture, Floats]:
    """The picture after fusion, and the influence (M,) of each row: trace(K)/n of its gain, 0 where it brought
    nothing new, NaN where it has no link.

    picture: predicted to `time`, ns; known: of the rows' correlation. Of a mixture fused as such the influence is that
    of its moments; with recursive memory it is the product of the shares in the two stages. left (M,): rows that
    are not to be fused here.
    """
    tracks, config = rows.tracks, known.config
    linked = rows.inside_mask()
    influence = np.where(tracks.link != NO_TRACK, 0.0, np.nan)
    linked = linked if left is None else linked & ~left
    used = linked & (tracks.time > tracks.used) if config.memory == "recursive" else linked
    chosen = marked(used)
    lineage, way = picture.lineage.copy(), picture.way.copy()
    state_time = np.where(picture.time >= 0, time, -1)
    mixed: list[tuple[Ints, Mixtures]] = []
    done: list[Ints] = [np.zeros(0, dtype=np.intp)]
    states: list[tuple[Floats, Floats]] = []
    unknown = Unknown.of(config.space)
    for ids, groups in by_size(tracks.link[chosen]):
        at, members = picture.find(ids), chosen[groups]
        one, spread, gains, by = _gaussian(rows, members, known, unknown, journal)
        parts, several = _as_mixtures(rows, members, config, unknown)
        if parts is not None:
            one[:, several], spread[:, :, several] = parts.moments()
            mixed.append((at[several], parts))
        if config.memory == "recursive":
            old, echo = picture.time[at] >= 0, rows.echo[members].any(axis=1)
            for some, bound in ((old & ~echo, config.memory_correlation), (old & echo, 1.0)):
                _remember(one, spread, gains, picture, at, marked(some), bound, unknown)
        state_time[at], way[at] = time, by
        states.append((one, spread))
        lineage[at] = kinship.inherited(rows, members, lineage[at], memory=config.memory == "recursive")
        influence[members] = gains.T
        done.append(at)
    tracks.used[chosen] = tracks.time[chosen]
    at = np.concatenate(done)
    mean, covariance = _placed(picture, at, states)
    picture = altered(picture, mean=mean, covariance=covariance, time=state_time, lineage=lineage, way=way)
    return with_parts(picture, at, mixed), influence


def _placed(picture: Picture, at: Ints, states: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Means and covariances of the picture, those of the tracks `at` (K,) being `states`, one after the other."""
    if len(states) == 1 and len(at) == len(picture.id):
        return states[0]
    if not states:
        return picture.mean, picture.covariance
    ones, spreads = (np.concatenate(part, axis=-1) for part in zip(*states, strict=True))
    if len(at) == len(picture.id):
        order = np.argsort(at)
        return ones.take(order, axis=-1), spreads.take(order, axis=-1)
    mean, covariance = picture.mean.copy(), picture.covariance.copy()
    mean[:, at], covariance[:, :, at] = ones, spreads
    return mean, covariance


def _gaussian(
    rows: Rows, members: Ints, known: Correlation, unknown: Unknown, journal: Journal
) -> tuple[Floats, Floats, Floats, Ways]:
    """Means, covariances and gains of groups (B, k), and what each was fused by (see `Correlation.fuse`)."""
    config = known.config
    # in memory (n, k, B): as the rules have it
    means = rows.tracks.mean.take(members.T, axis=-1).transpose(1, 0, 2)
    covariances = rows.tracks.covariance.take(members.T, axis=-1).transpose(2, 0, 1, 3)
    related = np.zeros(len(members), dtype=np.bool_)
    if config.rule not in kinship.ANY_CORRELATION:
        related = kinship.is_related(rows, members)
    by = np.zeros(len(members), dtype=np.uint8)
    ruled = Ruled(rows, members, known, unknown, journal)
    if len(related) and all_of(related):
        one, spread, gains = ruled.kin(means, covariances)
    else:
        weights = _shares(rows, members) if config.rule == "aa" and not config.rule_options else None
        one, spread, gains = ruled.fuse(means, covariances, weights, np.arange(len(members)), by)
        if any_of(related):
            some = Ruled(rows, members[related], known, unknown, journal)
            one[:, related], spread[:, :, related], gains[:, related] = some.kin(
                means[..., related], covariances[..., related]
            )
            by[related] = 0
    return one, spread, gains, by


@dataclass(frozen=True, slots=True)
class Ruled:
    """Fusion of groups `members` (B, k) of rows by the rule of the config, whatever components each knows."""

    rows: Rows
    members: Ints
    known: Correlation
    unknown: Unknown
    journal: Journal

    def fuse(
        self, means: Floats, covariances: Floats, weights: Floats | None, which: Ints, by: Ways, columns: Any = ...
    ) -> tuple[Floats, Floats, Floats]:
        """The groups `which` (some of B,), of means (k, n, .) and covariances (k, n, n, .); columns: which of their
        rows these are, or stand for. Writes `by` (.,), what each was fused by."""
        name = self.known.config.rule

        def rule(x: Floats, P: Floats, w: Floats | None, some: Ints, at: Ints) -> tuple[Floats, Floats, Floats]:
            members = self.members[which[at]][:, columns]
            fused, by[at] = self.known.fuse(self.rows, members, x, P, w, some)
            one, spread, gains = fused.mean, fused.covariance, finite(_influence(fused))
            bad = ~(linalg.is_positive_definite(spread) & np.logical_and.reduce(np.isfinite(one)))
            if any_of(bad):
                self._mend(one, spread, bad, bad & ((by[at] == BY_UNION) | (name == "cu")), x, P)
                gains[:, bad] = 1.0 / len(x)
            return one, spread, gains

        information = name == AUTO or RULES[name].information
        return fuse_known(means, covariances, weights, self.unknown, information, rule)

    def _mend(self, one: Floats, spread: Floats, bad: Bools, union: Bools, x: Floats, P: Floats) -> None:
        """Put what is conservative for the rule in the place of what it could not fuse, and say so: equal-weight
        intersection, or where all is to be covered, of `union`, what is above all."""
        rest = bad & ~union
        one[:, rest], spread[:, :, rest] = uniform_ci(x[:, :, rest], P[:, :, :, rest])
        if union.any():
            one[:, union], spread[:, :, union] = union_bound(x[:, :, union], P[:, :, :, union])
            self.journal.event({"kind": "union-bound", "tracks": int(union.sum())})
        self.journal.refuse(Entry("", 0, 0, 0, "fusion", int(bad.sum())))

    def kin(self, means: Floats, covariances: Floats) -> tuple[Floats, Floats, Floats]:
        """Groups whose rows have data in common (see `kinship`): what is derived of rows holds for no result of
        them."""
        ruled = altered(self, known=altered(self.known, followed=None, kept=None))

        def by_rule(x: Floats, P: Floats, which: list[int], some: Ints) -> kinship.Estimates:
            return kinship.Estimates(*ruled.fuse(x, P, None, some, np.zeros(len(some), dtype=np.uint8), which))

        return kinship.fuse_related(means, covariances, kinship.common(self.rows, self.members), by_rule)


def _as_mixtures(
    rows: Rows, members: Ints, config: CentreConfig, unknown: Unknown
) -> tuple[Mixtures | None, NDArray[np.bool_]]:
    """The fused mixtures of the groups where a member is one, and which groups these are; not of those whose members do
    not know the same, by a mixture rule that is not in information form."""
    components = np.isfinite(rows.tracks.log_weight).sum(axis=0) if len(rows.tracks.log_weight) else None
    several = np.zeros(len(members), dtype=np.bool_)
    alone = members.shape[1] == 1
    if components is None or config.memory == "recursive" or (config.mixture_rule == "moments" and not alone):
        return None, several
    several = (components[members] > 1).any(axis=1)
    if config.mixture_rule not in kinship.ANY_CORRELATION:
        several &= ~kinship.is_related(rows, members)
    if not alone and not (MIXTURE_RULES.get(config.mixture_rule) or RULES[config.mixture_rule]).information:
        known = unknown.known(rows.tracks.covariance[:, :, members])
        several &= (known == known[:, :, :1]).all(axis=(0, 2))
    if not several.any():
        return None, several
    sources = [rows.tracks.mixtures(members[several, j]) for j in range(members.shape[1])]
    if alone:
        return sources[0], several
    fits = max(1, int(MOST_PRODUCTS ** (1 / len(sources)) + 1e-9))
    if config.mixture_rule != "aa" and max(len(one.log_weights) for one in sources) > fits:
        if fits == 1:
            return None, np.zeros(len(members), dtype=np.bool_)
        sources = [reduce_mixtures(one, max_components=fits) for one in sources]
    options = {**config.mixture_options, "max_components": config.max_components}
    by_existence = config.mixture_rule == "aa" and not config.mixture_options
    weights = _shares(rows, members[several]) if by_existence else None
    parts, _ = fuse_mixtures_last(config.mixture_rule, sources, weights, **options)
    with np.errstate(invalid="ignore"):  # of sources that rule each other out there is no mass left
        mean, covariance = parts.moments()
    sound = linalg.is_positive_definite(covariance) & np.isfinite(mean).all(axis=0)
    several[marked(several)[~sound]] = False
    return parts.take(sound), several


def _shares(rows: Rows, members: Ints) -> Floats:
    """Weights (k, B) of an arithmetic average: each source counts as it believes in the target."""
    r = np.nan_to_num(rows.tracks.existence[members].T, nan=1.0)
    total = r[0]
    for one in r[1:]:
        total = total + one
    return np.where(total > 0, r / np.where(total > 0, total, 1.0), 1.0 / len(r))


def _remember(
    one: Floats, spread: Floats, gains: Floats, picture: Picture, at: Ints, old: Ints, bound: float,
    unknown: Unknown,
) -> None:  # fmt: skip
    """Fuse the result of the local tracks `old` with the predicted last one, under a bound on their correlation."""
    if not len(old):
        return

    def rule(x: Floats, P: Floats, _w: Floats | None, _c: Ints, _e: Ints) -> tuple[Floats, Floats, Floats]:
        again = fuse_last("bci", x, P, influence=True, max_correlation=bound)
        return again.mean, again.covariance, _influence(again)

    means = np.stack([one[:, old], picture.mean[:, at[old]]])
    covariances = np.stack([spread[:, :, old], picture.covariance[:, :, at[old]]])
    mean, covariance, shares = fuse_known(means, covariances, None, unknown, True, rule)
    good = linalg.is_positive_definite(covariance) & np.isfinite(mean).all(axis=0)
    kept = old[good]
    one[:, kept], spread[:, :, kept] = mean[:, good], covariance[:, :, good]
    gains[:, kept] *= shares[0][good]


def with_parts(picture: Picture, done: Ints, mixed: list[tuple[Ints, Mixtures]]) -> Picture:
    """The picture with the components of the tracks just fused; without any where all are Gaussian."""
    most = max([len(picture.log_weight), *(len(parts.log_weights) for _, parts in mixed)])
    if not most:
        return picture
    picture = padded(picture, most)
    log_weight, means, covariances = (
        column.copy() for column in (picture.log_weight, picture.part_mean, picture.part_covariance)
    )
    log_weight[:, done] = -np.inf
    log_weight[0, done] = 0.0
    means[:, :, done] = picture.mean[:, None, done]
    covariances[:, :, :, done] = picture.covariance[:, :, None, done]
    for at, parts in mixed:
        size = len(parts.log_weights)
        log_weight[:size, at] = parts.log_weights
        means[:, :size, at], covariances[:, :, :size, at] = parts.means, parts.covariances
    needed = int(marked(np.isfinite(log_weight).any(axis=1))[-1]) + 1 if log_weight.shape[1] else 0
    if needed <= 1:
        columns = no_parts(len(picture.mean), len(picture.id))
    else:
        columns = log_weight[:needed], means[:, :needed], covariances[:, :, :needed]
    return altered(picture, log_weight=columns[0], part_mean=columns[1], part_covariance=columns[2])


def _influence(fused: Fused) -> Floats:
    assert fused.influence is not None
    return fused.influence
