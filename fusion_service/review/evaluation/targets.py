"""Each target by itself: how long it was followed, by which tracks, and why not when it was not.

Times are between scored ones at which the target exists. From one to the next it is followed if it is at both; else
that time belongs to a gap, with the cause of the later one (of the earlier one where it is followed again):

    life = followed + gaps        gaps = sum over the causes
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats
from fusion_service.review.evaluation.misses import CAUSES, Sighting

__all__ = ["Gap", "Spell", "TargetRecord", "spells", "target_records"]


class Spell(NamedTuple):
    """From when to when, ns."""

    begin: int
    end: int
    what: int


class Gap(NamedTuple):
    """A time without a fused track, ns: from the last scored time with one (begun: or from that at which the target
    began) to the next with one (ended: or to its last). causes: seconds by code, the largest first; into: ids of the
    targets whose tracks took it in; sources: that had a track on it meanwhile."""

    begin: int
    end: int
    begun: bool
    ended: bool
    causes: tuple[tuple[int, float], ...]
    into: tuple[int, ...]
    sources: tuple[str, ...]

    @property
    def seconds(self) -> float:
        return (self.end - self.begin) / 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetRecord:
    """One target. begin, end: ns, of its first and last scored time, and times: how many; life, followed: s; causes:
    seconds by code, the largest first; seen: ns and sources of the first scored time at which any had a track on it;
    confirm: s, NaN where it was never followed; rmse: m, NaN likewise; tracks: ids of the fused tracks that it had, in
    their order; switches: how often another one than before."""

    target: int
    name: str
    begin: int
    end: int
    times: int
    life: float
    followed: float
    gaps: tuple[Gap, ...]
    causes: tuple[tuple[int, float], ...]
    seen: tuple[int, tuple[str, ...]] | None
    confirm: float
    rmse: float
    tracks: tuple[int, ...]
    switches: int

    @property
    def missed(self) -> float:
        """Seconds without a track; of a target that was there at one scored time, whether it was missed then."""
        return self.life - self.followed if self.times > 1 else float(not self.tracks)

    def as_json(self) -> dict[str, Any]:
        """Plain values; ids as text, for they may have 64 bits."""
        return {
            "target": str(self.target),
            "name": self.name,
            "begin_ns": self.begin,
            "end_ns": self.end,
            "life": self.life,
            "followed": self.followed,
            "gaps": [
                {
                    "begin_ns": gap.begin,
                    "end_ns": gap.end,
                    "lost": not gap.begun,
                    "found_again": not gap.ended,
                    "causes": {CAUSES[code]: seconds for code, seconds in gap.causes},
                    "merged_into_tracks_of": [str(one) for one in gap.into],
                    "seen_by": list(gap.sources),
                }
                for gap in self.gaps
            ],
            "missed_because": {CAUSES[code]: seconds for code, seconds in self.causes},
            "first_seen_ns": self.seen[0] if self.seen else None,
            "first_seen_by": list(self.seen[1]) if self.seen else [],
            "time_to_confirm": self.confirm if np.isfinite(self.confirm) else None,
            "rmse": self.rmse if np.isfinite(self.rmse) else None,
            "tracks": [str(one) for one in self.tracks],
            "switches": self.switches,
        }


def spells(numbers: NDArray[np.int32], times: NDArray[np.int64]) -> list[Spell]:
    """Runs of one number (K,), but -1, at `times` (K,)."""
    begins = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist()] if len(numbers) else []
    ends = [*begins[1:], len(numbers)]
    return [
        Spell(int(times[begin]), int(times[end - 1]), int(numbers[begin]))
        for begin, end in zip(begins, ends, strict=True)
        if numbers[begin] >= 0
    ]


def target_records(
    times: NDArray[np.int64],
    targets: Sequence[int],
    exists: Bools,
    errors: Floats,
    confirm: Floats,
    missed: tuple[NDArray[np.uint8], NDArray[np.int32]],
    fused: Sighting | None,
    sources: Mapping[str, Sighting],
    names: Mapping[int, str],
) -> tuple[TargetRecord, ...]:
    """Of all `targets` (T,) that exist (K, T) at any of `times` (K,) ns. errors (K, T): m, of the fused tracks;
    confirm (T,): s; missed: codes and others, as of `Misses`; fused: None without a centre."""
    if not len(times):
        return ()
    codes, others = missed
    found = []
    for t in np.flatnonzero(exists.any(axis=0)).tolist():
        there = np.flatnonzero(exists[:, t])
        held = fused.held[there, t] if fused is not None else np.full(len(there), -1, dtype=np.int32)
        seen = {name: one.held[there, t] >= 0 for name, one in sources.items()}
        gaps, life, followed, causes = _gaps(times, there, held, codes[there, t], others[there, t], seen, targets)
        first = np.flatnonzero(np.any(list(seen.values()), axis=0)) if seen else np.zeros(0, dtype=np.intp)
        tracks = held[held >= 0]
        error = errors[there, t][np.isfinite(errors[there, t])]
        ids = [] if fused is None else [fused.numbers.keys[one][1] for one in tracks.tolist()]
        found.append(
            TargetRecord(
                target=targets[t],
                name=names.get(targets[t], ""),
                begin=int(times[there[0]]),
                end=int(times[there[-1]]),
                times=len(there),
                life=life,
                followed=followed,
                gaps=gaps,
                causes=causes,
                seen=(
                    (int(times[there[first[0]]]), tuple(name for name, one in sorted(seen.items()) if one[first[0]]))
                    if len(first)
                    else None
                ),
                confirm=float(confirm[t]),
                rmse=float(np.sqrt(np.mean(error**2))) if len(error) else float("nan"),
                tracks=tuple(dict.fromkeys(ids)),
                switches=int((np.diff(tracks) != 0).sum()),
            )
        )
    return tuple(sorted(found, key=lambda one: (-one.missed, -one.switches, -np.nan_to_num(one.rmse), one.target)))


def _gaps(
    times: NDArray[np.int64],
    there: NDArray[np.intp],
    held: NDArray[np.int32],
    codes: NDArray[np.uint8],
    others: NDArray[np.int32],
    seen: Mapping[str, Bools],
    targets: Sequence[int],
) -> tuple[tuple[Gap, ...], float, float, tuple[tuple[int, float], ...]]:
    """The gaps of one target, its life, how long it was followed, s, and its causes. All (M,) but `times`: of the
    scored times `there`."""
    at = times[there]
    together = np.diff(there) == 1
    steps = np.where(together, np.diff(at) / 1e9, 0.0)
    has = held >= 0
    followed = steps[has[1:] & has[:-1]].sum()
    code = np.where(has[1:], codes[:-1], codes[1:])
    lost = ~(has[1:] & has[:-1])
    begins = np.flatnonzero(~has & np.append(True, has[:-1] | ~together))
    ends = np.flatnonzero(~has & np.append(has[1:] | ~together, True))
    found = []
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        before, after = begin > 0 and together[begin - 1], end + 1 < len(there) and together[end]
        low, high = begin - int(before), end + int(after)
        within = others[begin : end + 1]
        found.append(
            Gap(
                int(at[low]),
                int(at[high]),
                not before,
                not after,
                _by_cause(code[low:high], steps[low:high]) or ((int(codes[begin]), 0.0),),
                tuple(targets[one] for one in np.unique(within[within >= 0]).tolist()),
                tuple(name for name, one in sorted(seen.items()) if one[begin : end + 1].any()),
            )
        )
    return tuple(found), float(steps.sum()), float(followed), _by_cause(code[lost], steps[lost])


def _by_cause(codes: NDArray[Any], seconds: Floats) -> tuple[tuple[int, float], ...]:
    """Seconds by code, the largest first."""
    total = np.bincount(codes.astype(np.intp), weights=seconds, minlength=len(CAUSES))
    return tuple((int(code), float(total[code])) for code in np.argsort(-total, kind="stable") if total[code] > 0)
