"""Names for the types of arrays: `Floats`, `Ints` (indices and counts), `Bools`.

Where a docstring says that longdouble is taken too, `Floats` stands for it: NumPy's types tell no width apart there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bools", "Floats", "Ints", "from_bytes", "to_bytes"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]


def to_bytes(array: NDArray[Any]) -> bytes:
    """The numbers of an array, little-endian and in C order."""
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()


def from_bytes(packed: bytes, like: NDArray[Any]) -> Any:
    """The numbers that `to_bytes` packed, flat, of the type of `like`. Raises ValueError where they do not fit."""
    return np.frombuffer(packed, dtype=like.dtype.newbyteorder("<")).astype(like.dtype)
