"""Small matrices by both roads, plain NumPy and compiled loops: `python -m benchmarks.compiled`.

Of each function of `fusion_service.linalg` that is compiled, and of the consensus of groups: the CPU time of a call at
n = 4 for batches of several sizes, the best of several rounds in turn, and whether the bits are the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.centre.consensus import consensus
from fusion_service.compiled import use

__all__ = ["main"]

SIZES = (1, 20, 1000, 10_000)
GROUPS = ((20, 3), (1000, 3), (1000, 20), (10_000, 2))
"""Groups, and the rows of each."""
ROUNDS = 7


def best(function: Callable[[], Any], repeats: int) -> float:
    """Seconds of a call."""
    found = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        for _ in range(repeats):
            function()
        found.append((time.process_time() - begin) / repeats)
    return min(found)


def compared(name: str, size: str, function: Callable[[], Any], repeats: int) -> None:
    """A line of the table."""
    seconds, bits = [], []
    for choice in ("off", "on"):
        use(choice)
        made = function()
        parts = made if isinstance(made, tuple) else (made,)
        bits.append([part.tobytes() for part in parts if isinstance(part, np.ndarray)])
        seconds.append(best(function, repeats))
    same = "same" if bits[0] == bits[1] else "DIFFERENT"
    plain, compiled = (1e6 * one for one in seconds)
    print(f"{name:<22}{size:>12}{plain:>12.1f}{compiled:>12.1f}{plain / compiled:>8.1f}  {same}")


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(1)
    print(f"{'':<22}{'B':>12}{'plain us':>12}{use('on'):>12}{'ratio':>8}  bits")
    for size in SIZES:
        G = rng.normal(size=(4, 6, size))
        P, x, Q = np.einsum("ikb,jkb->ijb", G, G), rng.normal(size=(4, size)), rng.normal(size=(4, 4, size))
        move = np.eye(4)
        move[0, 2] = move[1, 3] = 0.1
        cases: list[tuple[str, tuple[Any, ...]]] = [
            *((name, (P,)) for name in ("inverse", "sweep", "ldl", "det", "logdet", "is_positive_definite")),
            ("solve", (P, x)), ("quadratic", (P, x)), ("matvec", (Q, x)), ("product", (Q, P)), ("inner", (P, Q)),
            ("congruence", (move, P)), ("congruence", (Q, P)),
        ]  # fmt: skip
        for name, args in cases:
            compared(name, str(size), lambda n=name, a=args: getattr(linalg, n)(*a), max(1, 2000 // size))  # type: ignore[misc]
    for count, rows in GROUPS:
        labels = np.concatenate([rng.permutation(count) for _ in range(rows)]).astype(np.uint64)
        G = rng.normal(size=(4, 6, count * rows))
        P, x = np.einsum("ikb,jkb->ijb", G, G), rng.normal(size=(4, count * rows))

        def whole(labels: Any = labels, x: Any = x, P: Any = P) -> tuple[Any, ...]:
            made = consensus(labels, x, P)
            return made.mean, made.covariance, made.others_mean, made.others_covariance

        compared("consensus", f"{count} x {rows}", whole, max(1, 2000 // (count * rows)))


if __name__ == "__main__":
    main()
