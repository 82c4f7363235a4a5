"""Names for the types of arrays: `Floats`, `Ints` (indices and counts), `Bools`.

Where a docstring says that longdouble is taken too, `Floats` stands for it: NumPy's types tell no width apart there.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bools", "Floats", "Ints"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
