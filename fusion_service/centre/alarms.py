"""`Twice`: one identity in two places, told when it begins and when it is over.

It begins when two confirmed tracks with the same trusted identity are further apart than `FAR` in d2 of their places,
and is over when no pair of them has been beyond `NEAR` for `HOLD` seconds; in between it stands, and is told no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from schemas.messages import CONFIRMED

__all__ = ["FAR", "HOLD", "MOST", "NEAR", "Twice"]

FAR, NEAR = 50.0, 25.0
HOLD = 10.0
MOST = 1000
"""Alarms that stand at a time."""


class Twice:
    """The identities that are in two places: {identity: [last time it was seen so, ns, the two tracks]}."""

    def __init__(self) -> None:
        self.standing: dict[str, list[int]] = {}

    def follow(
        self,
        picture: Picture,
        identity: Sequence[str | None],
        trusted: NDArray[np.bool_],
        compartment: NDArray[np.int64],
        places: Sequence[int],
        time: int,
        journal: Journal,
    ) -> None:
        """After a step at `time`, ns: identity (G,) of the tracks, whether it is trusted, their compartments;
        places: indices of the place in the state."""
        shown = np.flatnonzero(trusted & (picture.status == CONFIRMED))
        groups: dict[tuple[str, int], list[int]] = {}
        for at in shown.tolist():
            groups.setdefault((identity[at] or "", int(compartment[at])), []).append(at)
        pairs = [(name, rows[0], other) for (name, _), rows in sorted(groups.items()) for other in rows[1:]]
        one, two = (np.array([pair[k] for pair in pairs], dtype=np.intp) for k in (1, 2))
        some = np.ix_(list(places), list(places))
        spread = picture.covariance[some][..., one] + picture.covariance[some][..., two]
        places_of = picture.mean[list(places)]
        far = linalg.quadratic(spread, places_of[:, one] - places_of[:, two]) if pairs else np.zeros(0)
        for (name, a, b), distance in zip(pairs, far.tolist(), strict=True):
            stands = name in self.standing
            if distance > (NEAR if stands else FAR) and (stands or len(self.standing) < MOST):
                tracks = [int(picture.id[a]), int(picture.id[b])]
                if not stands:
                    journal.event({"kind": "alarm", "what": "identity-twice", "identity": name, "tracks": tracks})
                self.standing[name] = [time, *tracks]
        for name, (last, *tracks) in sorted(self.standing.items()):
            if time - last > HOLD * 1e9:
                del self.standing[name]
                over = {"kind": "alarm_over", "what": "identity-twice", "identity": name, "tracks": tracks}
                journal.event(over)

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing was seen later."""
        for standing in self.standing.values():
            standing[0] = min(standing[0], time)

    def tracks(self) -> set[int]:
        """The global ids concerned."""
        return {track for _, *tracks in self.standing.values() for track in tracks}

    def kept(self) -> dict[str, list[int]]:
        """What a checkpoint holds of it, as plain values."""
        return dict(sorted(self.standing.items()))

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        self.standing = {str(name): [int(one) for one in last] for name, last in kept.items()}
