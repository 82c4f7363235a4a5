"""The process noise that two local tracks of one target share: F and Q of the motions that their sources declare.

Two trackers of one target allow for the same wandering of it, each as it was told. Where they were told different
amounts the larger one counts; where they move states differently (another F, or one that depends on the state, as a
turn does) nothing follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from fusion_service.arrays import Floats, Ints
from fusion_service.motion import predict
from schemas import Motion

__all__ = ["SharedNoise", "shared_noise"]


class SharedNoise:
    """F and Q of pairs of sources. motions: what each source declares, None where that is not known or not all there
    is; `space`: of the states."""

    def __init__(self, motions: Sequence[Motion | None], space: tuple[str, ...]) -> None:
        self._space = space
        numbers: dict[Motion, int] = {}
        self.kind = np.full(len(motions), -1, dtype=np.intp)
        """(S,): number of the motion of each source, -1: none that anything follows from."""
        for i, motion in enumerate(motions):
            if motion is None:
                continue
            self.kind[i] = numbers.setdefault(motion, len(numbers))
        self._kinds = list(numbers)
        linear = np.array([self._is_linear(motion) for motion in self._kinds], dtype=np.bool_)
        if len(linear):
            self.kind = np.where((self.kind >= 0) & linear[self.kind], self.kind, -1)
        moves, noise = self._of_a_second()
        louder = noise[:, None] >= noise[None]
        number = np.arange(len(self._kinds))
        self._shared = np.where(moves[:, None] == moves[None], np.where(louder, number[:, None], number[None]), -1)

    def of(self, first: Ints, second: Ints) -> Ints:
        """The motion (K,) that sources `first` and `second` share, -1: none."""
        a, b = self.kind[first], self.kind[second]
        known = (a >= 0) & (b >= 0)
        return np.where(known, self._shared[a, b], -1) if len(self._kinds) else np.full(len(first), -1, dtype=np.intp)

    def between(self, shared: Ints, dt: Floats) -> tuple[Floats, Floats]:
        """F and Q (n, n, K) of these motions over `dt` (K,) seconds."""
        n = len(self._space)
        F, Q = np.zeros((2, n, n, len(dt)))
        for number in np.unique(shared).tolist():
            at = np.flatnonzero(shared == number)
            times, inverse = np.unique(dt[at], return_inverse=True)
            one = self._transition(self._kinds[number], times)
            F[:, :, at], Q[:, :, at] = one[0][:, :, inverse], one[1][:, :, inverse]
        return F, Q

    def _transition(self, motion: Motion, dt: Floats) -> tuple[Floats, Floats]:
        """F and Q (n, n, K), whatever motion it is: what it makes of unit states and of a state without error."""
        n, count = len(self._space), len(dt)
        states = np.concatenate([np.zeros((n, 1)), np.eye(n)], axis=1)
        means = np.repeat(states, count, axis=1)
        moved, Q = predict(motion, self._space, means, np.zeros((n, n, (n + 1) * count)), np.tile(dt, n + 1))
        moved = moved.reshape(n, n + 1, count)
        return moved[:, 1:] - moved[:, :1], Q[:, :, :count]

    def _is_linear(self, motion: Motion) -> bool:
        n, second = len(self._space), np.ones(1)
        F, _ = self._transition(motion, second)
        start = predict(motion, self._space, np.zeros((n, 1)), np.zeros((n, n, 1)), second)[0]
        state = np.arange(1.0, n + 1.0)[:, None]
        moved = predict(motion, self._space, state, np.zeros((n, n, 1)), second)[0]
        return bool(np.allclose(F[:, :, 0] @ state, moved - start))

    def _of_a_second(self) -> tuple[Ints, Floats]:
        """Of each motion which F (K,) it has, those that are equal by the same number, and trace Q (K,)."""
        known: dict[bytes, int] = {}
        moves, noise = [], []
        for motion in self._kinds:
            F, Q = self._transition(motion, np.ones(1))
            moves.append(known.setdefault((F + 0.0).tobytes(), len(known)))
            noise.append(float(np.trace(Q[:, :, 0])))
        return np.array(moves, dtype=np.intp), np.array(noise)


@lru_cache(maxsize=16)
def shared_noise(motions: tuple[Motion | None, ...], space: tuple[str, ...]) -> SharedNoise:
    """`SharedNoise`, made once for the same motions: sources seldom declare others."""
    return SharedNoise(motions, space)
