"""One source's or one centre's score, gathered block by block of times.

RMSE, NEES and identity switches are over the pairs that GOSPA assigns; OSPA has the same assignment (its sum of cut-off
distances is least for it too); SIAP and OSPA(2): `continuity`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from fusion_service.arrays import Floats
from fusion_service.metrics import DENSE, assign_near, near_pairs, nees, nees_bounds
from fusion_service.review.evaluation.continuity import Following, Instant, Siap, ospa2, siap_of
from fusion_service.review.evaluation.hulls import HullScore, HullTally, TrueHulls
from fusion_service.review.snapshots import Block, Times

__all__ = ["METRICS", "WINDOW", "Scores", "Series", "Tally", "averages", "bounds", "plain"]


METRICS = (
    "gospa",
    "gospa_localisation",
    "gospa_missed",
    "gospa_false",
    "rmse_position",
    "anees",
    "identity_switches",
)
P = 2.0
WINDOW = 10
"""Scored times in a window of OSPA(2)."""
WINDOWS = 300
"""About how many windows are scored of a long mission, evenly spread."""
HALF = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """K values each, over the scored times: GOSPA, m, and its parts, m2; OSPA, m; RMSE, m, ANEES over its dimension and
    its 95 % bounds, NaN without a pair; pairs assigned; tracks shown; the number of objects that its existence
    probabilities expect (NaN where it says none); SIAP's completeness, ambiguity, spuriousness.
    ospa2: at the times with the indices `windows`."""

    gospa: Floats
    localisation: Floats
    missed: Floats
    false: Floats
    ospa: Floats
    rmse: Floats
    anees: Floats
    low: Floats
    high: Floats
    pairs: NDArray[np.int64]
    shown: NDArray[np.int64]
    expected: Floats
    completeness: Floats
    ambiguity: Floats
    spuriousness: Floats
    windows: NDArray[np.int64]
    ospa2: Floats

    def as_json(self) -> dict[str, list[Any]]:
        """Rounded to six digits, None for what does not exist."""
        return {name: [plain(_six(one)) for one in getattr(self, name).tolist()] for name in Series.__slots__}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """One source, or the fused tracks, over K scored times and T targets.

    gospa: mean distance, m; gospa_localisation, _missed, _false: mean squares, m2. rmse_position, m, and anees, the
    mean NEES of position over its dimension (1 is ideal), are NaN without a pair. bounds: 95 % for the anees of
    so many pairs. errors (K, T), m, and nees (K, T), over the dimension: NaN where no track was assigned.
    rmse_velocity, m/s: NaN without velocities. ospa, ospa2: means, m. followed: targets that had a track assigned at
    half of their times or more. tracks: how many were ever shown. hull: None where truth tells no extents.
    """

    gospa: float
    gospa_localisation: float
    gospa_missed: float
    gospa_false: float
    rmse_position: float
    anees: float
    identity_switches: int
    bounds: tuple[float, float]
    errors: Floats
    nees: Floats
    rmse_velocity: float
    ospa: float
    ospa2: float
    followed: int
    tracks: int
    siap: Siap
    series: Series
    hull: HullScore | None = None

    def as_json(self) -> dict[str, float | int | None]:
        """The seven numbers of `METRICS`, None for what does not exist."""
        return {name: plain(getattr(self, name)) for name in METRICS}

    def more_json(self) -> dict[str, Any]:
        """All other numbers, and the series."""
        names = ("rmse_velocity", "ospa", "ospa2", "followed", "tracks", "bounds")
        return {
            **{name: plain(getattr(self, name)) for name in names},
            "siap": {name: plain(getattr(self.siap, name)) for name in Siap.__slots__},
            "series": self.series.as_json(),
            **({"hull": self.hull.as_json()} if self.hull is not None else {}),
        }


class Tally:
    """Gathers the scores of one source or centre.

    times (K,); truth (K, T, m): position, and then velocity, NaN where it is not known or a target does not exist.
    """

    def __init__(self, times: Times, truth: Floats, d: int, c: float, hulls: TrueHulls | None = None) -> None:
        count, targets = truth.shape[:2]
        self._times, self._truth, self._d, self._c = times, truth, d, c
        self._parts = np.zeros((count, 3))
        self._ospa = np.zeros(count)
        self._shown = np.zeros(count, dtype=np.int64)
        self._siap = np.zeros((count, 2), dtype=np.int64)
        self._expected = np.full(count, np.nan)
        self._errors, self._nees = np.full((2, count, targets), np.nan)
        self.held = np.full((count, targets), -1, dtype=np.int32)
        """(K, T): the number of the track that is assigned to each target, -1 without one."""
        self._last = np.full(targets, -1)
        self._switches = 0
        self._sums = np.zeros(4)
        """Of SIAP's errors of position and of velocity, and how many there are."""
        self._velocity = np.zeros(2)
        """Sum of the squared errors of velocity of the pairs, and their number."""
        self._tracks = np.zeros(0, dtype=np.bool_)
        """By the number of a track: whether it was ever shown."""
        self._following = Following(targets)
        self._hulls = None if hulls is None else HullTally(hulls)
        self._window: deque[Instant] = deque(maxlen=WINDOW)
        self._stride = max(1, count // WINDOWS)
        self._windows: list[tuple[int, float]] = []

    def add(self, k: int, there: NDArray[np.intp], tree: cKDTree | None, block: Block, row: int) -> None:
        """What `block` shows at its time `row`, the k-th: `there` are the targets that exist, `tree` their places."""
        mine = slice(int(block.ends[row]), int(block.ends[row + 1]))
        states, number, d, c = block.states[mine], block.number[mine], self._d, self._c
        if number.max(initial=-1) >= len(self._tracks):
            self._tracks = np.pad(self._tracks, (0, int(number.max()) + 1))
        self._tracks[number] = True
        truth = self._truth[k, there]
        crowd = tree if tree is not None and len(there) * len(states) > DENSE else truth[:, :d]
        i, j, apart = near_pairs(crowd, states[:, :d], c)
        kept = assign_near(i, j, c**P - apart**P, (len(there), len(states)))
        rows, columns = i[kept], j[kept]
        self._score(k, there[rows], mine.start + columns, number[columns], apart[kept], len(there), len(states), block)
        by = np.lexsort((apart, j))
        nearest = by[np.flatnonzero(np.diff(j[by], prepend=-1))]
        rows, columns = i[nearest], j[nearest]
        velocity = _lengths(states[columns, d:] - truth[rows, d:])
        known = np.isfinite(velocity)
        self._sums += (apart[nearest].sum(), len(nearest), velocity[known].sum(), known.sum())
        self._siap[k] = len(np.unique(rows)), len(nearest)
        self._following.add(k, there[rows], number[columns])
        from_end = len(self._times) - 1 - k
        if from_end % self._stride < WINDOW:
            self._window.append(Instant(there, number, there[i], number[j], apart))
            if from_end % self._stride == 0:
                self._windows.append((k, ospa2(self._window, c, P)))
        if from_end % self._stride == 0 and self._stride >= WINDOW:
            self._window.clear()

    def expect(self, k: int, number: float) -> None:
        """How many objects the existence probabilities in the picture of the k-th time expect, tentative tracks'
        too."""
        self._expected[k] = number

    def _score(
        self,
        k: int,
        targets: NDArray[np.intp],
        rows: NDArray[np.intp],
        tracks: NDArray[np.intp],
        apart: Floats,
        objects: int,
        shown: int,
        block: Block,
    ) -> None:
        c, d, most = self._c, self._d, max(objects, shown)
        squared = float((apart**P).sum())
        self._parts[k] = squared, c**P / 2 * (objects - len(targets)), c**P / 2 * (shown - len(targets))
        self._ospa[k] = ((squared + c**P * (most - len(targets))) / most) ** (1 / P) if most else 0.0
        self._shown[k] = shown
        self._errors[k, targets], self.held[k, targets] = apart, tracks
        offset = block.states[rows] - self._truth[k, targets]
        self._nees[k, targets] = nees(offset[:, :d], block.covariances[rows]) / d
        if self._hulls is not None:
            true, shown_ = self._truth[k, targets][:, :2], block.states[rows][:, :2]
            self._hulls.add(k, targets, true, shown_, block.covariances[rows][:, :2, :2])
        velocity = (offset[:, d:] ** 2).sum(axis=1)
        known = np.isfinite(velocity) & (offset.shape[1] > d)
        self._velocity += velocity[known].sum(), known.sum()
        last = self._last[targets]
        self._switches += int(((last >= 0) & (last != tracks)).sum())
        self._last[targets] = tracks

    def assigned(self, k: int) -> NDArray[np.bool_]:
        """The targets (T,) that have a track at the k-th time."""
        there: NDArray[np.bool_] = np.isfinite(self._errors[k])
        return there

    def scores(self) -> Scores:
        """When all times are added."""
        errors, squared = self._errors, self._nees
        pairs, exists = np.isfinite(errors), np.isfinite(self._truth[:, :, 0])
        series = self._series(pairs, exists)
        localisation, missed, false = self._parts.T
        rmse, anees = averages(errors[pairs], squared[pairs])
        with np.errstate(invalid="ignore", divide="ignore"):
            velocity = np.sqrt(self._velocity[0] / self._velocity[1])
        return Scores(
            gospa=float(series.gospa.mean()),
            gospa_localisation=float(localisation.mean()),
            gospa_missed=float(missed.mean()),
            gospa_false=float(false.mean()),
            rmse_position=rmse,
            anees=anees,
            identity_switches=self._switches,
            bounds=bounds(self._d, int(pairs.sum())),
            errors=errors,
            nees=squared,
            rmse_velocity=float(velocity),
            ospa=float(self._ospa.mean()),
            ospa2=float(series.ospa2.mean()),
            followed=int((pairs.sum(axis=0) >= np.maximum(HALF * exists.sum(axis=0), 1)).sum()),
            tracks=int(self._tracks.sum()),
            siap=self._siap_of(exists),
            series=series,
            hull=None if self._hulls is None else self._hulls.score(),
        )

    def _series(self, pairs: NDArray[np.bool_], exists: NDArray[np.bool_]) -> Series:
        """pairs (K, T): where a track is assigned; exists (K, T): where a target is."""
        counts, d = pairs.sum(axis=1), self._d
        objects, tracked, assigned = exists.sum(axis=1), self._siap[:, 0], self._siap[:, 1]
        localisation, missed, false = self._parts.T
        with np.errstate(invalid="ignore", divide="ignore"):
            over_time = np.sqrt(np.nansum(self._errors**2, axis=1) / counts)
            consistent = np.nansum(self._nees, axis=1) / counts
            low, high = (2 * gammaincinv(d * counts / 2, q) / (d * counts) for q in (0.025, 0.975))
            share = [tracked / objects, assigned / tracked, 1 - assigned / self._shown]
        return Series(
            gospa=self._parts.sum(axis=1) ** (1 / P),
            localisation=localisation,
            missed=missed,
            false=false,
            ospa=self._ospa,
            rmse=over_time,
            anees=consistent,
            low=low,
            high=high,
            pairs=counts,
            shown=self._shown,
            expected=self._expected,
            completeness=share[0],
            ambiguity=share[1],
            spuriousness=share[2],
            windows=np.array([k for k, _ in self._windows], dtype=np.int64),
            ospa2=np.array([value for _, value in self._windows]),
        )

    def _siap_of(self, exists: NDArray[np.bool_]) -> Siap:
        with np.errstate(invalid="ignore", divide="ignore"):
            accuracy = self._sums[[0, 2]] / self._sums[[1, 3]]
        life = np.zeros(0)
        if len(exists):
            some = exists[:, exists.any(axis=0)]
            life = (self._times[len(some) - 1 - some[::-1].argmax(axis=0)] - self._times[some.argmax(axis=0)]) / 1e9
        counts = (exists.sum(), self._siap[:, 0].sum(), self._shown.sum(), self._siap[:, 1].sum())
        objects, tracked, shown, assigned = map(float, counts)
        return siap_of(
            self._following.segments(len(self._times) - 1),
            self._times,
            life,
            (objects, tracked, shown, assigned),
            (float(accuracy[0]), float(accuracy[1])),
        )


def averages(errors: Floats, squared: Floats) -> tuple[float, float]:
    """RMSE and ANEES of pairs (R,), (R,); NaN without a pair."""
    return (float(np.sqrt(np.mean(errors**2))), float(np.mean(squared))) if len(errors) else (np.nan, np.nan)


def bounds(d: int, pairs: int) -> tuple[float, float]:
    """95 % for the ANEES of so many pairs."""
    return nees_bounds(d, pairs) if pairs else (np.nan, np.nan)


def plain(value: Any) -> Any:
    """As JSON has it: None for what is not finite."""
    if isinstance(value, tuple):
        return [plain(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _lengths(rows: Floats) -> Floats:
    """(R, m) -> (R,), NaN where m is 0."""
    return np.sqrt((rows * rows).sum(axis=1)) if rows.shape[1] else np.full(len(rows), np.nan)


def _six(value: Any) -> Any:
    return float(f"{value:.6g}") if isinstance(value, float) else value
