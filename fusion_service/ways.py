"""What global tracks are fused by, track by track, and why tracks of a source are no tracklets: in words for people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import GlobalTracks

__all__ = ["AUTO_PROMISE", "REASONS", "fused_by", "innovations", "no_tracklets", "reason_words", "tracklet_health"]

REASONS = {
    "motion": "nobody declares how its tracks move",
    "feedback": "its tracker is fed with fused tracks",
    "covariance_floor": "a covariance_floor is set for it",
    "registration": "all its tracks have an error in common, which is stated, or remains of one taken off",
    "space": "its tracks do not have the components of the picture",
    "innovations": "its innovations are not those that its covariances and its motion say",
    "dependent": "what it adds agrees with the picture as if it came from it: is its tracker fed with fused tracks?",
    "increments": "most of what its versions add is no measurement",
}
"""Why a source gives no tracklets, by the word that status and step log have."""

AUTO_PROMISE = (
    "per track the tightest that is covered by what is known of it: tracklets, derived cross-covariances, bounds "
    "derived or declared, ci"
)

LONGEST = 100
"""Characters of a reason that is not one of ours."""


def fused_by(picture: GlobalTracks) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """The names of the ways, and which of them (T,) each track was fused by."""
    if picture.rules is None or picture.track_rule is None:
        return (picture.rule,), np.zeros(len(picture.ids), dtype=np.intp)
    return picture.rules, picture.track_rule.astype(np.intp)


def reason_words(reason: str) -> str:
    """A reason in words."""
    return REASONS.get(reason, reason[:LONGEST])


def no_tracklets(event: Mapping[str, Any]) -> str:
    """What the event `tracklets` of a step log says of its source."""
    why, ratio = _text(event.get("why")), _number(event.get("ratio"))
    if not why:
        return "its tracks are taken as tracklets"
    seen = f" (normalised innovations {ratio:.2f}, 1 is right)" if why == "innovations" and ratio is not None else ""
    return f"no tracklets: {reason_words(why)}{seen}"


def innovations(said: Mapping[str, Any]) -> str:
    """What a source's own normalised innovations are, within which bounds, and what that says; "" where not known."""
    ratio, low, high = (_number(said.get(f"innovation{end}")) for end in ("", "_low", "_high"))
    if ratio is None or low is None or high is None:
        return ""
    text = f"innovations {ratio:.2f}, right within {low:.2f} to {high:.2f}"
    if ratio > high:
        return f"{text}: too large, its measurements are worse, or targets move more, than it says"
    return text + (": too small, its tracker is not what it declares, or its errors go together" if ratio < low else "")


def tracklet_health(said: Mapping[str, Any]) -> str:
    """What a source's entry in the status says of its tracklets, in a line; "" where it says nothing."""
    share, why = _number(said.get("tracklets")), _text(said.get("no_tracklets"))
    parts = [] if share is None else [f"{100 * share:.0f} % of its new versions taken as tracklets"]
    if why:
        parts = [f"no tracklets: {reason_words(why)}"]
    ratio, high = _number(said.get("innovation")), _number(said.get("innovation_high"))
    if share and not why and ratio is not None and high is not None and ratio > high:
        parts.append(f"each counts {100 / ratio:.0f} %")
    return "; ".join(filter(None, [*parts, innovations(said)]))


def _number(value: Any) -> float | None:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else None


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""
