"""Names for the types of arrays: `Floats`, `Ints` (indices and counts), `Bools`.

Where a docstring says that longdouble is taken too, `Floats` stands for it: NumPy's types tell no width apart there.
"""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bools", "Floats", "Ints", "from_bytes", "picked", "to_bytes"]

Number = TypeVar("Number", bound=np.generic)
Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]


def picked(array: NDArray[Number], rows: Any) -> NDArray[Number]:
    """`array[..., rows]` with the batch contiguous: NumPy's own leaves it first in memory, and every element of what is
    done with it then is a line of the cache away from the next."""
    if not isinstance(rows, np.ndarray):
        return array[..., rows]
    return array.take(np.flatnonzero(rows) if rows.dtype == np.bool_ else rows, axis=-1)


def to_bytes(array: NDArray[Any]) -> bytes:
    """The numbers of an array, little-endian and in C order."""
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()


def from_bytes(packed: bytes, like: NDArray[Any]) -> Any:
    """The numbers that `to_bytes` packed, flat, of the type of `like`. Raises ValueError where they do not fit."""
    return np.frombuffer(packed, dtype=like.dtype.newbyteorder("<")).astype(like.dtype)
