"""Which road a process takes, and how kernels are compiled for it.

Compiled code is kept beside the kernels, or, where that place cannot be written, where numba keeps what is the user's
(`NUMBA_CACHE_DIR` names another place); where nothing can be written it is compiled anew by each process.
"""

from __future__ import annotations

import inspect
import os
import threading
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fusion_service.compiled import kernels
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions

__all__ = ["CHOICES", "PLAIN", "VARIABLE", "begin", "is_kept", "road", "use"]

CHOICES = ("auto", "on", "off")
VARIABLE = "FUSION_COMPILED"
PLAIN = "plain"

_LOCK = threading.Lock()
_NAME = [PLAIN]
_MADE: dict[str, Any] = {}
"""Kernels that this process has compiled."""


def road() -> str:
    """The road that is taken: "plain", or the compiler and its version."""
    return _NAME[0]


def use(choice: str = "auto", stop: threading.Event | None = None) -> str:
    """Take the compiled road if `choice` is "on", or "auto" and numba is there; the plain one if "off". Returns
    `road()`. Compiles what no earlier process has: up to a minute, once; given up between two functions once `stop` is
    set. `ValueError` where "on" cannot be had."""
    choice = _chosen(choice)
    with _LOCK:
        if choice == "off":
            FAST.clear()
            _NAME[0] = PLAIN
        elif _NAME[0] == PLAIN:
            name, compiled = _compiled(choice == "on", stop)
            if compiled is not None:
                FAST.update(functions(compiled))
                _NAME[0] = name
        return road()


def begin(choice: str, stop: threading.Event, told: Callable[[str], None]) -> None:
    """`use(choice)`, and say by `told` which road is taken: at once where all is compiled already, or "on" is wanted;
    else in a thread, while work goes on by the plain road. `ValueError` where "on" cannot be had."""
    if _chosen(choice) in ("on", "off") or is_kept() or not _installed():
        told(use(choice, stop))
        return
    told(f"{PLAIN}, until the compiler is done")

    def run() -> None:
        try:
            told(use(choice, stop))
        except Exception as error:
            told(f"{PLAIN}: {type(error).__name__}: {error}")

    threading.Thread(target=run, name="compiler").start()


def is_kept() -> bool:
    """Whether an earlier process has compiled, as far as one can see beside the kernels."""
    return any((Path(kernels.__file__).parent / "__pycache__").glob("kernels.*.nbi"))


def _installed() -> bool:
    return find_spec("numba") is not None


def _chosen(choice: str) -> str:
    if choice == "auto":
        choice = os.environ.get(VARIABLE) or choice
    if choice not in CHOICES:
        raise ValueError(f"compiled {choice!r}: one of {', '.join(CHOICES)}")
    return choice


def _compiled(wanted: bool, stop: threading.Event | None) -> tuple[str, SimpleNamespace | None]:
    try:
        import numba
    except ImportError as error:
        if wanted:
            raise ValueError(f"numba cannot be used ({error}): pip install 'track-fusion-centre[fast]'") from None
        return PLAIN, None
    for name in RESULTS:
        if stop is not None and stop.is_set():
            return PLAIN, None
        if name not in _MADE:
            _MADE[name] = _kernel(numba, getattr(kernels, name))
    return f"numba {numba.__version__}", SimpleNamespace(**_MADE)


def _kernel(numba: Any, function: Callable[..., None]) -> Any:
    """The function, compiled for views of any strides as arguments and contiguous arrays as results."""
    names = inspect.signature(function).parameters
    signature = numba.types.void(*(_type(numba, name, function.__name__) for name in names))
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
