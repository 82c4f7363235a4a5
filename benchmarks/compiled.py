"""Small matrices by both roads, plain NumPy and compiled loops: `python -m benchmarks.compiled`.

Of each function of `fusion_service.linalg` that is compiled, and of the consensus of groups: the CPU time of a call at
n = 4 for batches of several sizes, the best of several rounds in turn, and whether the bits are the same. Then the rule
`ci` of unequal covariances with the best weights sought, and with those of an earlier step kept, by both roads: of the
same covariances, and of such as have changed by .3 %.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.centre.consensus import consensus
from fusion_service.compiled import use
from fusion_service.rules import fuse_last

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
    head = f"{'sought us':>12}{'kept us':>12}{'changed us':>12}"
    print(f"\n{'rule ci, weights':<22}{'B x N':>12}{head}  NumPy, then numba")
    for choice in ("off", "on"):
        use(choice)
        for count, rows in GROUPS[:3]:
            G = rng.normal(size=(rows, 4, 6, count))
            x, P = rng.normal(size=(rows, 4, count)), np.einsum("sikb,sjkb->sijb", G, G)
            start = fuse_last("ci", x, P).weights
            sought = best(lambda x=x, P=P: fuse_last("ci", x, P, influence=True), 3)  # type: ignore[misc]
            kept = best(lambda x=x, P=P, w=start: fuse_last("ci", x, P, influence=True, start=w), 3)  # type: ignore[misc]
            E = np.eye(4)[None, :, :, None] + 0.003 * rng.normal(size=(rows, 4, 4, count))
            Q = np.einsum("sikb,sklb,sjlb->sijb", E, P, E)
            changed = best(lambda x=x, P=Q, w=start: fuse_last("ci", x, P, influence=True, start=w), 3)  # type: ignore[misc]
            print(f"{'':<22}{f'{count} x {rows}':>12}{1e6 * sought:>12.0f}{1e6 * kept:>12.0f}{1e6 * changed:>12.0f}")


if __name__ == "__main__":
    main()
