"""Scans that come after the step that should have them, all of them: what `delay` would do."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fusion_service.hints.times import span

__all__ = ["late_doubt"]

ENOUGH = 20
"""Scans of which none was in time."""


def late_doubt(
    held: Sequence[int], came: Sequence[int], *, period: float, delay: float, lateness: float, again: bool
) -> str:
    """What is to be said where steps are made at multiples of `period`, each `delay` seconds after its time, and every
    one of these scans, of times `held` and received at `came`, ns, came later than that for its step. again: whether
    steps are made again for late data. Empty where one was in time, or they are so late that they are refused."""
    each = round(period * 1e9)
    if len(held) < ENOUGH or not each:
        return ""
    after = np.array([when - time - (-time) % each for time, when in zip(held, came, strict=True)]) / 1e9
    if not (delay < after.min() and np.median(after) < lateness):
        return ""
    late, most = span(float(np.median(after)) - delay), _rounded(float(after.max()))
    done = "steps are made again for each" if again else "they are used a step late"
    return (
        f"its scans, all of them, come {late} after the steps that should have them, so that {done}: set delay under "
        f"[centre] to {most} (it is {delay:g} s), or its clock, if that is behind"
    )


def _rounded(seconds: float) -> str:
    """Upwards, to two digits."""
    unit = 10.0 ** (math.floor(math.log10(max(seconds, 1e-3))) - 1)
    return f"{math.ceil(seconds / unit) * unit:.3g}"
