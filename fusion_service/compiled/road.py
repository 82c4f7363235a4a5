"""Which road a process takes, and how kernels are compiled for it.

Compiled code is kept beside the kernels, or, where that place cannot be written, where numba keeps what is the user's
(`NUMBA_CACHE_DIR` names another place); where nothing can be written it is compiled anew by each process.
"""

from __future__ import annotations

import inspect
import os
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from fusion_service.compiled import kernels
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions
from fusion_service.errors import FusionError

__all__ = ["CHOICES", "VARIABLE", "RoadError", "road", "use", "warm_up"]

CHOICES = ("auto", "on", "off")
VARIABLE = "FUSION_COMPILED"
PLAIN = "plain"

_LOCK = threading.Lock()
_NAME = [PLAIN]


class RoadError(FusionError, ValueError):
    """The compiled road is asked for and cannot be taken: why, in one line."""


def road() -> str:
    """The road that is taken: "plain", or the compiler and its version."""
    return _NAME[0]


def use(choice: str = "auto") -> str:
    """Take the compiled road if `choice` is "on", or "auto" and numba is there; the plain one if "off". Returns
    `road()`. Compiles what no earlier process has: up to a minute, once. `RoadError` where "on" cannot be had."""
    if choice not in CHOICES:
        raise RoadError(f"compiled {choice!r}: one of {', '.join(CHOICES)}")
    if choice == "auto":
        choice = os.environ.get(VARIABLE) or choice
    with _LOCK:
        if choice == "off":
            FAST.clear()
            _NAME[0] = PLAIN
        elif _NAME[0] == PLAIN:
            name, compiled = _compiled(choice == "on")
            if compiled is not None:
                FAST.update(functions(compiled))
                _NAME[0] = name
        return road()


def warm_up(choice: str, told: Callable[[str], None]) -> threading.Thread:
    """`use(choice)` in a thread of its own, while work goes on by the plain road; says by `told` which road it is."""

    def run() -> None:
        try:
            told(use(choice))
        except RoadError as error:
            told(f"{PLAIN}: {error}")

    thread = threading.Thread(target=run, name="compile", daemon=True)
    thread.start()
    return thread


def _compiled(wanted: bool) -> tuple[str, SimpleNamespace | None]:
    try:
        import numba
    except ImportError as error:
        if wanted:
            raise RoadError(f"numba cannot be used ({error}): pip install 'track-fusion-centre[fast]'") from None
        return PLAIN, None
    made = {name: _kernel(numba, getattr(kernels, name)) for name in kernels.__all__ if name != "LANES"}
    return f"numba {numba.__version__}", SimpleNamespace(**made)


def _kernel(numba: Any, function: Callable[..., None]) -> Any:
    """The function, compiled for views of any strides as arguments and contiguous arrays as results."""
    signature = numba.types.void(
        *(_type(numba, name, function.__name__) for name in inspect.signature(function).parameters)
    )
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(signature, cache=True, **options)(function)
    except (RuntimeError, OSError):  # no place to keep it
        return numba.njit(signature, **options)(function)


MATRICES, VECTORS = ("P", "A", "B", "F"), ("x",)
RESULTS = {
    "invert": {"out": 3, "det": 1, "margin": 1, "least": 1},
    "pivots": {"d": 2},
    "ldl": {"L": 3, "d": 2},
    "solve": {"y": 2, "square": 1},
    "matvec": {"out": 2},
    "product": {"out": 3},
    "inner": {"out": 1},
    "congruence": {"out": 3},
    "congruence_each": {"out": 3},
}
"""Number of axes of what each kernel writes."""


def _type(numba: Any, argument: str, kernel: str) -> Any:
    types = numba.types
    if argument in RESULTS[kernel]:
        return types.Array(types.float64, RESULTS[kernel][argument], "C")
    if argument in MATRICES:
        axes = 2 if (kernel, argument) == ("congruence", "F") else 3
        return types.Array(types.float64, axes, "A", readonly=True)
    return types.Array(types.float64, 2, "A", readonly=True) if argument in VECTORS else types.boolean
