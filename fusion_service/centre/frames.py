"""In which frame the picture is: as configured, or as the live sources agree.

The candidates are the frames that sources speak in, but ECEF only where the picture has z. A source supports every
frame into which its tracks can be brought, so that sources about different origins on the earth agree. Where all that
were heard agree, that is at once; else the most supported frame is taken when `frame_wait` seconds have passed. Then
it is kept, unless more than half of the live sources cannot be brought into it, and agree on another, for as long.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fusion_service.centre.heights import lifted_space
from fusion_service.config import CentreConfig
from fusion_service.geodesy import FrameError, transform
from schemas import Ecef, Enu, Frame, Local

__all__ = ["FrameVoting", "Vote", "agreed", "convertible", "may_be_picture", "name_frame", "outvoted"]


class Vote(NamedTuple):
    """The frame and space a source spoke in, and at which step, ns."""

    frame: Frame
    space: tuple[str, ...]
    time: int


def convertible(vote: Vote, frame: Frame) -> bool:
    """Whether what a source says can be brought into `frame`."""
    space = lifted_space(vote.space, vote.frame, frame, ("z",) if isinstance(frame, Ecef) else (), 0.0)
    n = len(space)
    try:
        transform(np.zeros((0, n)), np.zeros((0, n, n)), space, vote.frame, frame)
    except FrameError:
        return False
    return True


def may_be_picture(frame: Frame, space: tuple[str, ...]) -> bool:
    """Whether a picture in `space` can be in `frame`."""
    return not isinstance(frame, Ecef) or "z" in space


def agreed(votes: Mapping[str, Vote], space: tuple[str, ...]) -> tuple[Frame | None, int]:
    """The frame of a picture in `space` that most sources support, and how many do: of two with equal support the
    one more sources speak in, then that of the first name."""
    spoken = Counter(votes[name].frame for name in sorted(votes))
    candidates: dict[type[Frame], Frame] = {}
    for frame, _ in spoken.most_common():
        if may_be_picture(frame, space):
            candidates.setdefault(type(frame), frame)
    best, most = None, 0
    for frame in sorted(candidates.values(), key=list(spoken).index):
        support = sum(convertible(vote, frame) for vote in votes.values())
        if support > most or (support == most and best is not None and spoken[frame] > spoken[best]):
            best, most = frame, support
    return best, most


def outvoted(votes: Mapping[str, Vote], space: tuple[str, ...], frame: Frame) -> Frame | None:
    """The frame that more than half of the sources agree on, none of which can be brought into `frame`."""
    against = {name: vote for name, vote in votes.items() if not convertible(vote, frame)}
    if 2 * len(against) <= len(votes):
        return None
    best, support = agreed(against, space)
    return best if 2 * support > len(votes) else None


def name_frame(frame: Frame) -> str:
    """A frame in words."""
    if isinstance(frame, Enu):
        return f"ENU about {frame.lat:g} {frame.lon:g}"
    return f"the local frame {frame.name!r}" if isinstance(frame, Local) else "ECEF"


class FrameVoting:
    """When the frame is decided. asked: since when, ns, sources have not agreed on it, or with it; -1: they do."""

    def __init__(self) -> None:
        self.asked = -1

    def settle(self, votes: Mapping[str, Vote], frame: Frame | None, config: CentreConfig, time: int) -> Frame | None:
        """The frame that the picture takes at `time`, ns, or None where it stays as it is (`frame`)."""
        if frame is None:
            best, support = agreed(votes, config.space)
            opposed = support < len(votes)
        else:
            best, opposed = outvoted(votes, config.space, frame), True
        if best is None:
            self.asked = -1
            return None
        self.asked = time if self.asked < 0 else self.asked
        if opposed and time - self.asked < config.frame_wait * 1e9:
            return None
        self.asked = -1
        return best
