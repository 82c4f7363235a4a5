"""Why what a source sends is not used, in a sentence for its status, with what mends it."""

from __future__ import annotations

from collections.abc import Mapping

from fusion_service.config import CentreConfig
from fusion_service.rules import RULES
from fusion_service.ways import reason_words
from schemas import Message

__all__ = [
    "UNPLACED",
    "ahead",
    "frame_refused",
    "frame_waiting",
    "no_tracklets",
    "partial",
    "refusal",
    "stale",
    "unfit",
    "unplaced",
    "waiting",
]

MENDS = {
    "motion": "let it declare its motion, or set motion for it under [centre.sources]",
    "space": "set space under [centre] to hold its components, and let it send velocities or declare ou or still",
    "innovations": "let its covariances and the motion it declares be those of its tracker and its targets",
    "increments": "a tracker of several models, or one whose covariances are edited, gives none",
}
"""What to do, or what is behind it."""
UNPLACED = "late messages that were used as they came, and not put in their places: "
"""How the note begins that `unplaced` gives."""
KEPT_OUT = {
    "start": "from before this process began, whose steps it cannot make again",
    "room": "of steps that were let go, since more is not kept: set a smaller lateness",
    "turn": "whose turn did not come in time: set revise under [centre] higher, or delay, so that less is late",
    "behind": "while the centre was behind",
}
"""What keeps late messages from being put in their places."""


def refusal(reason: str, message: Message, last: int, received: int, config: CentreConfig) -> str:
    """Why a message was refused, where its source can mend it; empty for other reasons. last: newest step, ns."""
    time = getattr(message, "time", message.epoch)
    if reason == "late":
        return (
            f"its newest refused message is {(last - time) / 1e9:.1f} s older than the step: if its clock is right, "
            f"set lateness above that (it is {config.lateness:g} s)"
        )
    if reason == "future":
        return (
            f"its newest refused message, or the start it gives for its run, is "
            f"{(max(time, message.epoch) - received) / 1e9:.1f} s ahead of this computer's clock: set one of the clocks"
        )
    return ""


def stale(age: float, limit: float) -> str:
    """Its tracks were `age` seconds old at the step, and are stale after `limit`."""
    return (
        f"its tracks were {age:.1f} s old at the step, and are stale after {limit:.1f} s: if it is only slow, "
        f"raise lateness, or set stale for it"
    )


def ahead(seconds: float) -> str:
    """Its newest message is for a later step."""
    return f"its newest message is for {seconds:.1f} s after the step: its clock is ahead, or delay could be less"


def waiting() -> str:
    """It has not said what it is."""
    return "its tracks wait a step for its sensor_info"


def frame_waiting(spoken: str) -> str:
    """The sources do not agree yet on a frame, or none of theirs can be that of the picture."""
    return f"its tracks, in {spoken}, wait for the frame of the picture: set frame under [centre] to say which it is"


def frame_refused(why: str) -> str:
    """Its tracks cannot be brought into the picture's frame."""
    return f"{why}: let it send ENU or ECEF with what they need, or set frame under [centre] to its own"


def unfit(spoken: str, space: tuple[str, ...]) -> str:
    """What it speaks in cannot be the frame of the picture."""
    return f"{spoken} cannot be the frame of a picture in {' '.join(space)}"


def partial(space: tuple[str, ...], config: CentreConfig) -> str:
    """Its tracks lack components of the picture, and the rule is not in information form; else empty."""
    missing = [name for name in config.space if name not in space]
    if not missing or config.kind == "intensity" or config.rule not in RULES or RULES[config.rule].information:
        return ""
    return (
        f"its tracks have no {' '.join(missing)}: {config.rule} fuses what all sources of a track have, "
        f"and these follow from the sources that tell them"
    )


def no_tracklets(why: str) -> str:
    """Its tracks go by the rule, not as tracklets, for the reason `why`."""
    return f"no tracklets of it: {reason_words(why)}" + (f": {MENDS[why]}" if why in MENDS else "")


def unplaced(why: Mapping[str, int]) -> str:
    """So many late messages, by what kept them from being put in their places, stay where they came."""
    parts = "; ".join(f"{count} {KEPT_OUT[one]}" for one, count in sorted(why.items()))
    return f"{UNPLACED}{parts}"
