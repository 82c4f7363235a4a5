"""What fusion gains: fused tracks beside the best single source on the pairs of target and time that several saw."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.review.evaluation.scoring import Scores, averages, bounds

__all__ = ["fusion_gain"]


def fusion_gain(sources: list[Scores], fused: Scores, seen: NDArray[np.int64], d: int) -> dict[str, dict[str, Any]]:
    """`Evaluation.shared`: by how many sources had an assigned track, the numbers of those pairs.

    seen (K, T): how many sources had a track on each target at each time; d: dimension of the position.
    """
    classes = {f"seen_by_{n}": seen == n for n in range(2, len(sources) + 1)} | {"seen_by_2_or_more": seen >= 2}
    both = (seen >= 2) & np.isfinite(fused.errors)
    best, best_nees = _best_single(sources, both)
    shared: dict[str, dict[str, Any]] = {}
    for name, mask in classes.items():
        pairs = mask & both
        fused_rmse, fused_anees = averages(fused.errors[pairs], fused.nees[pairs])
        best_rmse, best_anees = averages(best[mask[both]], best_nees[mask[both]])
        shared[name] = {
            "pairs": int(pairs.sum()),
            "fused_missed": int((mask & ~both).sum()),
            "fused_rmse": fused_rmse,
            "best_rmse": best_rmse,
            "fused_anees": fused_anees,
            "best_anees": best_anees,
            "nees_bounds": bounds(d, int(pairs.sum())),
        }
    return shared


def _best_single(sources: list[Scores], both: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Error and NEES of the best single source on the pairs `both` (K, T), R of them: of those that saw the target
    then, the one with the least mean square on all the pairs of this target that the same sources saw."""
    _, group = np.nonzero(both)
    for index, one in enumerate(sources):
        group = 2 * group + np.isfinite(one.errors[both])
        if index % 32 == 31:
            group = np.unique(group, return_inverse=True)[1]
    _, group = np.unique(group, return_inverse=True)
    least, best, best_nees = np.full(len(group), np.inf), *np.full((2, len(group)), np.nan)
    for one in sources:
        errors = one.errors[both]
        total = np.bincount(group, weights=np.nan_to_num(errors) ** 2)[group] if len(group) else errors
        better = np.isfinite(errors) & (total < least)
        least[better], best[better], best_nees[better] = total[better], errors[better], one.nees[both][better]
    return best, best_nees
