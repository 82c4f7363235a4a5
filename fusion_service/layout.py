"""The batch as the last axis: arrays turned from the faces' layout and back, and a batch cut to fit the cache."""

from collections.abc import Iterator
from math import prod

import numpy as np

from fusion_service.arrays import Floats

__all__ = ["TURN", "blocks", "to_first", "to_last"]

CACHE_BYTES = 1 << 19
"""What one block's (n, n, B) array may occupy: half a megabyte, some 4,000 matrices at n = 4."""

TURN = 128
"""Elements transposed at a time: five times faster than a long array at once."""


def to_last(a: Floats, core: int) -> Floats:
    """Flatten the leading batch axes of `a` and move them last: (..., *core axes) -> (*core axes, B).

    `core` is the number of trailing axes that make one element (1: vectors, 2: matrices). Contiguous copy.
    """
    a = np.asarray(a, dtype=np.float64)
    batch, shape = a.shape[: a.ndim - core], a.shape[a.ndim - core :]
    size, entries = prod(batch), prod(shape)
    out = np.empty((*shape, size))
    tall, wide = a.reshape(size, entries), out.reshape(entries, size)
    for i in range(0, size, TURN):
        wide[:, i : i + TURN] = tall[i : i + TURN].T
    return out


def to_first(a: Floats, batch: tuple[int, ...], core: int, out: Floats | None = None) -> Floats:
    """The inverse of `to_last`: (*core axes, B) -> (*batch, *core axes), a contiguous copy, or into `out`."""
    shape = a.shape[:core]
    size, entries = prod(batch), prod(shape)
    if out is None:
        out = np.empty((*batch, *shape))
    tall, wide = out.reshape(size, entries), a.reshape(entries, size)
    for i in range(0, size, TURN):
        tall[i : i + TURN] = wide[:, i : i + TURN].T
    return out


def blocks(n: int, size: int, copies: int = 1) -> Iterator[slice]:
    """Slices that cut a batch of `size` elements, each of `copies` n x n matrices, into pieces for the cache."""
    most = min(4096, max(256, CACHE_BYTES // (8 * n * n * max(copies, 1))))
    step = -(-size // -(-size // most)) if size else 1
    return (slice(i, min(i + step, size)) for i in range(0, size, step))
