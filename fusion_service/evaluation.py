"""From a mission's messages to a score: how well each source and the fused tracks followed the truth.

* All is scored by position, (x, y), and z if the scoring space has it, in the frame of the centre's tracks, at the
  steps of the centre or at every multiple of `every` seconds (UTC), from the first truth to the last.
* Truth is interpolated linearly. An object exists from its first message to its last, but not inside a gap longer
  than `gap` seconds and than three of its median intervals.
* A source shows the newest version of each track of its newest epoch, unless a later complete scan left the track
  out or it is older than three declared periods; predicted to the time with its declared motion. All it publishes
  counts, whatever the existence probability.
* The centre shows the confirmed and the coasting tracks of its newest picture, not the tentative ones, no older
  than two steps. Where it is not of the very time it is predicted, by constant velocity with the largest q that
  its sources declare.
* RMSE, NEES and identity switches are over the pairs that GOSPA (p = 2, alpha = 2) assigns: errors below c. The
  bounds of the ANEES suppose independent errors; those along one track are not, so the true bounds are wider.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.geodesy import FrameError
from fusion_service.metrics import gospa, identity_switches, nees, nees_bounds
from fusion_service.snapshots import (
    Snapshot,
    centre_snapshots,
    interval,
    source_snapshots,
    truth_path,
    truth_positions,
)
from schemas import Frame, GlobalTracks, LocalTracks, Message, Motion, SensorInfo, Truth

__all__ = ["METRICS", "Evaluation", "Scores", "evaluate", "format_table"]

Floats = NDArray[np.float64]

METRICS = (
    "gospa",
    "gospa_localisation",
    "gospa_missed",
    "gospa_false",
    "rmse_position",
    "anees",
    "identity_switches",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """One source, or the fused tracks, over K scored times and T targets.

    gospa: mean distance, m; gospa_localisation, _missed, _false: mean squares, m2. rmse_position, m, and anees, the
    mean NEES of position over its dimension (1 is ideal), are NaN without a pair. bounds: 95 % for the anees of
    so many pairs. errors (K, T), m, and nees (K, T), over the dimension: NaN where no track was assigned.
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

    def as_json(self) -> dict[str, float | int | None]:
        """The seven numbers of `METRICS`, None for what does not exist."""
        return {name: _plain(getattr(self, name)) for name in METRICS}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """The scores of each source and of the centre.

    times (K,) ns; targets: T truth ids; exists (K, T); seen (K, T): how many sources had a track assigned to the
    target; left_out: source -> why it could not be scored.

    shared: "seen_by_2", ..., "seen_by_2_or_more" -> over the pairs (target, time) on which so many sources had an
    assigned track: pairs, fused_missed (those without a fused track, which are in none of the other numbers), RMSE
    and ANEES, fused and best single source on the same pairs. The best single source is the one with the smallest
    RMSE, found with the truth for each target and set of sources that saw it: an advantage no operator has.
    """

    c: float
    dimension: int
    times: NDArray[np.int64]
    targets: tuple[int, ...]
    exists: NDArray[np.bool_]
    centre: str | None
    sources: dict[str, Scores]
    fused: Scores
    seen: NDArray[np.int64]
    shared: dict[str, dict[str, Any]]
    left_out: dict[str, str]

    def as_json(self, scenario: str, rule: str, recording: str) -> dict[str, Any]:
        """The summary as plain values, ready for `json.dumps`."""
        return {
            "scenario": scenario,
            "rule": rule,
            "recording": recording,
            "sources": {name: scores.as_json() for name, scores in self.sources.items()},
            "fused": self.fused.as_json(),
            "shared": {name: {key: _plain(value) for key, value in row.items()} for name, row in self.shared.items()},
            "nees_bounds": {
                "sources": {name: _plain(scores.bounds) for name, scores in self.sources.items()},
                "fused": _plain(self.fused.bounds),
            },
            "scored": {
                "c": self.c,
                "p": 2,
                "alpha": 2,
                "dimension": self.dimension,
                "times": len(self.times),
                "targets": len(self.targets),
                "left_out": self.left_out,
            },
        }


def evaluate(
    messages: Iterable[Message],
    *,
    c: float,
    every: float | None,
    frame: Frame | None = None,
    space: tuple[str, ...] | None = None,
    centre: str | None = None,
    gap: float = 5.0,
    motion: Motion | None = None,
) -> Evaluation:
    """Score a mission by the rules at the head of this module; the order of the messages does not matter.

    c: GOSPA's cut-off, m. every: seconds between scored times, None for the times of the centre's pictures.
    frame, space: to score in, by default those of the centre's first picture. centre: which one, if several.
    motion: of sources that never published a SensorInfo (default: cv, q = 1 m2/s3); their period is their median
    interval. A source whose frame has no relation to the scoring one, or that lacks z where it is scored, is left out,
    by name. Raises ValueError where nothing can be scored.
    """
    if not c > 0 or not (every is None or every > 0):
        raise ValueError(f"c and every must be positive: {c}, {every}")
    local: dict[str, list[LocalTracks]] = {}
    fused: dict[str, list[GlobalTracks]] = {}
    infos: dict[str, SensorInfo] = {}
    truths: list[Truth] = []
    for message in messages:
        if isinstance(message, LocalTracks):
            local.setdefault(message.source, []).append(message)
        elif isinstance(message, GlobalTracks):
            fused.setdefault(message.source, []).append(message)
        elif isinstance(message, Truth):
            truths.append(message)
        elif isinstance(message, SensorInfo):
            known = infos.get(message.source, message)
            infos[message.source] = max(known, message, key=lambda info: (info.epoch, info.seq))

    if centre is None and len(fused) > 1:
        raise ValueError(f"tracks of several centres ({', '.join(sorted(fused))}): say which one to score")
    if centre is not None and centre not in fused:
        raise ValueError(f"no tracks of a centre {centre!r} (there are: {', '.join(sorted(fused)) or 'none'})")
    centre = centre or next(iter(fused), None)
    pictures = fused[centre] if centre else []
    if pictures:
        first = min(pictures, key=lambda picture: (picture.time, picture.epoch))
        frame, space = frame or first.frame, space or first.space
    if frame is None or space is None or (every is None and not pictures):
        raise ValueError("no global tracks: without a centre, frame, space and every must be given")

    axes = tuple(name for name in "xyz" if name in space)
    paths = truth_path(truths, frame, axes)
    if not paths:
        raise ValueError("no truth to score against")
    times = _scored_times(paths, pictures, every)
    positions = np.stack([truth_positions(*path, times, gap) for path in paths.values()], axis=1)
    sources: dict[str, Scores] = {}
    left_out: dict[str, str] = {}
    for name, scans in sorted(local.items()):
        info = infos.get(name)
        period, moves = (info.period, info.motion) if info else (interval(scans), motion or Motion("cv", 1.0))
        try:
            sources[name] = _score(positions, source_snapshots(scans, times, period, moves, frame, axes), c)
        except FrameError as error:
            left_out[name] = str(error)
    drift = Motion("cv", max((infos[name].motion.q for name in infos if name in sources), default=1.0))
    scores = _score(positions, centre_snapshots(pictures, times, drift, frame, axes), c)

    exists = np.isfinite(positions[..., 0])
    seen = np.zeros(exists.shape, dtype=np.int64)
    for one in sources.values():
        seen += np.isfinite(one.errors)
    return Evaluation(
        c=c,
        dimension=len(axes),
        times=times,
        targets=tuple(paths),
        exists=exists,
        centre=centre,
        sources=sources,
        fused=scores,
        seen=seen,
        shared=_shared(list(sources.values()), scores, seen, len(axes)),
        left_out=left_out,
    )


def _scored_times(
    paths: dict[int, tuple[NDArray[np.int64], Floats]], pictures: Sequence[GlobalTracks], every: float | None
) -> NDArray[np.int64]:
    first, last = min(int(known[0]) for known, _ in paths.values()), max(int(known[-1]) for known, _ in paths.values())
    if every is None:
        times = np.unique(np.array([picture.time for picture in pictures], dtype=np.int64))
        times = times[(times >= first) & (times <= last)]
    else:
        step = round(every * 1e9)
        times = np.arange(-(-first // step), last // step + 1, dtype=np.int64) * step
    if not len(times):
        raise ValueError("no time to score: no picture of the centre, or no multiple of every, while there is truth")
    return times


def _score(positions: Floats, snapshots: list[Snapshot], c: float) -> Scores:
    """positions (K, T, d), NaN where a target does not exist."""
    count, targets, d = positions.shape
    parts = np.zeros((count, 4))
    assignments: list[dict[int, tuple[int, int]]] = []
    errors, squared = np.full((2, count, targets), np.nan)
    offsets, spreads = [np.empty((0, d))], [np.empty((0, d, d))]
    for k, (truth, shown) in enumerate(zip(positions, snapshots, strict=True)):
        there = np.flatnonzero(np.isfinite(truth[:, 0]))
        result = gospa(truth[there], shown.positions, c)
        parts[k] = result[:4]
        rows, columns = there[result.assignment >= 0], result.assignment[result.assignment >= 0]
        assignments.append({j: shown.keys[i] for j, i in zip(rows.tolist(), columns.tolist(), strict=True)})
        errors[k, rows] = 0.0
        offsets.append(shown.positions[columns] - truth[rows])
        spreads.append(shown.covariances[columns])
    pairs, offset = np.isfinite(errors), np.concatenate(offsets)
    errors[pairs] = np.sqrt((offset * offset).sum(axis=1))
    squared[pairs] = nees(offset, np.concatenate(spreads)) / d
    distance, localisation, missed, false = (float(value) for value in parts.mean(axis=0))
    rmse, anees = _averages(errors[pairs], squared[pairs])
    return Scores(
        gospa=distance,
        gospa_localisation=localisation,
        gospa_missed=missed,
        gospa_false=false,
        rmse_position=rmse,
        anees=anees,
        identity_switches=identity_switches(assignments),
        bounds=_bounds(d, int(pairs.sum())),
        errors=errors,
        nees=squared,
    )


def _averages(errors: Floats, squared: Floats) -> tuple[float, float]:
    """RMSE and ANEES of pairs (R,), (R,); NaN without a pair."""
    return (float(np.sqrt(np.mean(errors**2))), float(np.mean(squared))) if len(errors) else (np.nan, np.nan)


def _bounds(d: int, pairs: int) -> tuple[float, float]:
    return nees_bounds(d, pairs) if pairs else (np.nan, np.nan)


def _shared(sources: list[Scores], fused: Scores, seen: NDArray[np.int64], d: int) -> dict[str, dict[str, Any]]:
    both = (seen >= 2) & np.isfinite(fused.errors)
    best, best_nees = np.full((2, *seen.shape), np.nan)
    if sources:
        errors, squared = np.stack([one.errors for one in sources]), np.stack([one.nees for one in sources])
        saw = np.isfinite(errors)
        for j in np.flatnonzero(both.any(axis=0)):
            for group in np.unique(saw[:, both[:, j], j], axis=1).T:
                rows = np.flatnonzero(both[:, j] & (saw[:, :, j] == group[:, None]).all(axis=0))
                mean_square = np.where(group, np.mean(errors[:, rows, j] ** 2, axis=1), np.inf)
                chosen = int(np.argmin(mean_square))
                best[rows, j], best_nees[rows, j] = errors[chosen, rows, j], squared[chosen, rows, j]
    classes = {f"seen_by_{n}": seen == n for n in range(2, len(sources) + 1)} | {"seen_by_2_or_more": seen >= 2}
    shared: dict[str, dict[str, Any]] = {}
    for name, mask in classes.items():
        pairs = mask & both
        fused_rmse, fused_anees = _averages(fused.errors[pairs], fused.nees[pairs])
        best_rmse, best_anees = _averages(best[pairs], best_nees[pairs])
        shared[name] = {
            "pairs": int(pairs.sum()),
            "fused_missed": int((mask & ~both).sum()),
            "fused_rmse": fused_rmse,
            "best_rmse": best_rmse,
            "fused_anees": fused_anees,
            "best_anees": best_anees,
            "nees_bounds": _bounds(d, int(pairs.sum())),
        }
    return shared


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def format_table(evaluation: Evaluation) -> str:
    """A plain text table: each source and the fused tracks, then the targets that several sources see."""
    fused = f"fused ({evaluation.centre})" if evaluation.centre else "fused (no centre)"
    table = [["", "RMSE", "GOSPA", "localis.", "missed", "false", "ANEES", "95 % bounds", "id switches"]]
    for name, one in [*evaluation.sources.items(), (fused, evaluation.fused)]:
        parts = (one.rmse_position, one.gospa, one.gospa_localisation, one.gospa_missed, one.gospa_false)
        numbers = [*map(_digits, parts), _fixed(one.anees), _fixed(*one.bounds), str(one.identity_switches)]
        table.append([name, *numbers])
    lines = [
        f"Scored at {len(evaluation.times)} times against {len(evaluation.targets)} targets; GOSPA p = 2, alpha = 2, "
        f"c = {evaluation.c:g} m",
        "RMSE and GOSPA in m, its parts in m2; ANEES over its dimension, 1 is ideal",
        *_aligned(table),
        *(f"not scored: {name}: {reason}" for name, reason in evaluation.left_out.items()),
    ]
    table = [["", "pairs", "RMSE fused", "best single", "ANEES fused", "best single", "95 % bounds", "no fused track"]]
    for name, row in evaluation.shared.items():
        rmse = [_digits(row["fused_rmse"]), _digits(row["best_rmse"])]
        anees = [_fixed(row["fused_anees"]), _fixed(row["best_anees"]), _fixed(*row["nees_bounds"])]
        table.append([name.replace("_", " "), str(row["pairs"]), *rmse, *anees, str(row["fused_missed"])])
    title = "Targets that several sources track: fused beside the best single source, on the same pairs (target, time)"
    return "\n".join([*lines, "", title, *_aligned(table)] if evaluation.seen.max() > 1 else lines)


def _digits(value: float) -> str:
    """Four significant digits, no exponent."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.{max(0, 3 - int(np.floor(np.log10(abs(value)))))}f}" if value else "0"


def _fixed(*values: float) -> str:
    return " - ".join(f"{value:.2f}" for value in values) if np.isfinite(values).all() else "-"


def _aligned(table: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = ([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in table)
    return ["  ".join(row) for row in rows]
