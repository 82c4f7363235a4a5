"""Names for the types of arrays: `Floats`, `Ints` (indices and counts), `Bools`.

Where a docstring says that longdouble is taken too, `Floats` stands for it: NumPy's types tell no width apart there.
"""

from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Bools",
    "Floats",
    "Ints",
    "all_of",
    "among",
    "any_of",
    "constant",
    "filled",
    "find_sorted",
    "finite",
    "from_bytes",
    "marked",
    "picked",
    "same_ids",
    "subset",
    "to_bytes",
]

Number = TypeVar("Number", bound=np.generic)
Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

SHORT = 4
"""Values that are compared one by one."""
FEW = 64
"""Below, a search is quicker than a table."""
SMALL = 4096
"""Comparisons of each with each, up to which they are quicker than sorting."""
SPARSE = 8
"""Numbers of the span of ids for each of them, up to which a table is worth its room."""


def all_of(mask: Any) -> bool:
    """Whether a mask holds for all: `mask.all()` at a quarter of its price where rows are few; some forty times a
    step."""
    return b"\0" not in mask.tobytes()


def any_of(mask: Any) -> bool:
    """Whether a mask holds for any, likewise."""
    return b"\1" in mask.tobytes()


def same_ids(one: NDArray[np.integer[Any]], other: NDArray[np.integer[Any]]) -> bool:
    """Whether two columns of one kind of whole numbers are the same."""
    return one.shape == other.shape and one.tobytes() == other.tobytes()


def finite(values: Floats) -> Floats:
    """`np.nan_to_num(values)`: themselves, no copy, where they are finite."""
    return values if all_of(np.isfinite(values)) else np.nan_to_num(values)


def filled(count: int | tuple[int, ...], value: Any, kind: Any) -> NDArray[Any]:
    """`np.full(count, value, kind)` (K,) without what that does beside it."""
    column = np.empty(count, kind)
    column.fill(value)
    return column


def find_sorted(ids: NDArray[np.uint64], some: NDArray[np.uint64]) -> Ints:
    """`np.searchsorted(ids, some)` for ids in order: where these lie close together by a table, ten times as fast."""
    if len(some) < FEW or not len(ids):
        return ids.searchsorted(some)
    first, last = int(ids[0]), int(ids[-1])
    if not 0 <= last - first < SPARSE * (len(ids) + len(some)) or last == 2**64 - 1:
        return ids.searchsorted(some)
    before = np.zeros(last - first + 2, dtype=np.intp)
    before[(ids - np.uint64(first)).astype(np.intp) + 1] = 1
    return before.cumsum()[(np.clip(some, np.uint64(first), np.uint64(last + 1)) - np.uint64(first)).astype(np.intp)]


def among(values: NDArray[np.integer[Any]], some: NDArray[np.integer[Any]]) -> Bools:
    """`np.isin(values, some)` (K,) of two flat arrays of one kind: where one of them is empty, or the second short, as
    they are nearly always, at a fraction of its price."""
    if not len(some) or not len(values):
        return np.zeros(len(values), dtype=np.bool_)
    if len(some) > SHORT:
        if len(values) * len(some) > SMALL:
            return np.isin(values, some)
        return np.asarray((values[:, None] == some).any(axis=1))
    found: Bools = values == some[0]
    for one in some[1:]:
        found |= values == one
    return found


def constant(count: int, value: float, kind: Any) -> NDArray[Any]:
    """`np.full(count, value, kind)` that nobody writes to: the same array again where it is short."""
    return _constant(count, value, kind) if count <= SMALL else np.full(count, value, dtype=kind)


@lru_cache(maxsize=256)
def _constant(count: int, value: float, kind: Any) -> NDArray[Any]:
    column = np.full(count, value, dtype=kind)
    column.flags.writeable = False
    return column


def marked(mask: Any) -> Ints:
    """`np.flatnonzero(mask)` of a flat array (K,), without what that does beside it, which is most of it where rows are
    few."""
    at: Ints = mask.nonzero()[0]
    return at


def picked(array: NDArray[Number], rows: Any) -> NDArray[Number]:
    """`array[..., rows]` with the batch contiguous: NumPy's own leaves it first in memory, and every element of what is
    done with it then is a line of the cache away from the next."""
    if not isinstance(rows, np.ndarray):
        return array[..., rows]
    return array.take(rows.nonzero()[0] if rows.dtype == np.bool_ else rows, axis=-1)


def subset(array: NDArray[Number], rows: Ints) -> NDArray[Number]:
    """`picked` of rows that are in order, each once: the array itself, no copy, where these are all of them."""
    return array if len(rows) == array.shape[-1] else array.take(rows, axis=-1)


def to_bytes(array: NDArray[Any]) -> bytes:
    """The numbers of an array, little-endian and in C order."""
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()


def from_bytes(packed: bytes, like: NDArray[Any]) -> Any:
    """The numbers that `to_bytes` packed, flat, of the type of `like`. Raises ValueError where they do not fit."""
    return np.frombuffer(packed, dtype=like.dtype.newbyteorder("<")).astype(like.dtype)
