"""A function that is computed on whichever road is taken."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

__all__ = ["FAST", "Floats", "Places", "either"]

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

Given = ParamSpec("Given")
Result = TypeVar("Result")

FAST: dict[str, Callable[..., Any]] = {}
"""The functions that are compiled, by name; empty on the plain road. Each returns None for what is not for it."""


def either(plain: Callable[Given, Result]) -> Callable[Given, Result]:
    """`plain`, or what `FAST` holds under its name where that takes the arguments."""
    name = plain.__name__

    @wraps(plain)
    def chosen(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        fast = FAST.get(name)
        if fast is not None:
            result = fast(*args, **kwargs)
            if result is not None:
                return cast(Result, result)
        return plain(*args, **kwargs)

    return chosen
