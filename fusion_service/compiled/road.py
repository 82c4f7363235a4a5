"""Which road a process takes, and how kernels are compiled for it.

Compiled code is kept beside the kernels, or, where that place cannot be written, where numba keeps what is the user's
(`NUMBA_CACHE_DIR` names another place); where nothing can be written it is compiled anew by each process.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from hashlib import sha1
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from fusion_service.compiled import groups, kernels, merging, products, three, turns
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions

__all__ = ["CHOICES", "PLAIN", "THREAD", "VARIABLE", "begin", "is_kept", "road", "use"]

CHOICES = ("auto", "on", "off")
VARIABLE = "FUSION_COMPILED"
THREAD = "compiler"
PLAIN = "plain"
HOMES = (kernels, groups, three, turns, products, merging)

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
    else in a thread named `THREAD`, while work goes on by the plain road. `ValueError` where "on" cannot be had."""
    if _chosen(choice) in ("on", "off") or is_kept() or not _installed():
        told(use(choice, stop))
        return
    told(f"{PLAIN}, until the compiler is done")

    def run() -> None:
        try:
            told(use(choice, stop))
        except Exception as error:
            told(f"{PLAIN}: {type(error).__name__}: {error}")

    threading.Thread(target=run, name=THREAD).start()


def is_kept() -> bool:
    """Whether an earlier process has compiled all kernels as they are, as far as one can see where numba would look:
    one that was killed has compiled the first of them only."""
    return all(_kept(name) for name in SHAPES)


def _kept(name: str) -> bool:
    source = Path(_home(name).__file__ or "")
    place = _place(source)
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    found = place.glob(f"{source.stem}.{name}-*.{python}*.nbc") if place is not None else ()
    return any(one.stat().st_mtime >= source.stat().st_mtime for one in found)


def _place(source: Path) -> Path | None:
    """Where numba keeps what it makes of a source: the first place that can be written, even where there is nothing to
    be written any more, so that what stands beside a source that is read-only is no use."""
    folder = source.absolute().parent
    apart = f"{folder.name}_{sha1(str(folder).encode(), usedforsecurity=False).hexdigest()}"
    given, home = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    places = [Path(given, apart)] if given else []
    places += [folder / "__pycache__", Path(home).expanduser() / "numba" / apart]
    return next((one for one in places if _can_be_written(one)), None)


def _can_be_written(place: Path) -> bool:
    there = next((one for one in (place, *place.parents) if one.exists()), place)
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _home(name: str) -> ModuleType:
    """Where a kernel stands."""
    return next(one for one in HOMES if hasattr(one, name))


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
            raise ValueError(f"numba cannot be used ({error}): pip install numba") from None
        return PLAIN, None
    for name in SHAPES:
        if stop is not None and stop.is_set():
            return PLAIN, None
        home = _home(name)
        for helper in HELPERS.get(name, ()):
            if helper not in _MADE:
                _MADE[helper] = _kernel(numba, getattr(home, helper), ())
        if name not in _MADE:
            function = getattr(home, name)
            _MADE[name] = _kernel(numba, function, (_signature(numba, name),))
    return f"numba {numba.__version__}", SimpleNamespace(**_MADE)


def _kernel(numba: Any, function: Any, signature: tuple[Any, ...]) -> Any:
    """The function, compiled; what it calls are the kernels that are compiled already."""
    known = {**function.__globals__, **{name: made for name, made in _MADE.items() if name in function.__globals__}}
    again = FunctionType(function.__code__, known, function.__name__)
    again.__module__, again.__qualname__ = function.__module__, function.__qualname__
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(*signature, cache=True, **options)(again)
    except (RuntimeError, OSError):  # no place to keep it
        return numba.njit(*signature, **options)(again)


SHAPES = {
    "invert": ((3,), (3, 1, 1, 1)),
    "pivots": ((3,), (2,)),
    "ldl": ((3,), (3, 2)),
    "solve": ((3, 2), (2, 1)),
    "matvec": ((3, 2), (2,)),
    "product": ((3, 3), (3,)),
    "inner": ((3, 3), (1,)),
    "congruence": ((2, 3), (3,)),
    "congruence_each": ((3, 3), (3,)),
    "intersect": ((2, 3, 0), (2, 3, 1, 2, 3, 1)),
    "from_start_of_three": ((4, 3, 1, 2, 1), (2, 3, 2, 2, 1, 1, 1)),
    "jacobi": ((1, 1), (3,)),
    "product_of_all": ((3, 4), (2, 3, 1)),
    "merged_pivots": ((4, 3, 2, 0), (3,)),
    "settled": ((2, 0), (3, 2, 0)),
}
"""Numbers of axes of what each kernel reads, and then writes; 0: two, of places. `solve` takes a flag at the end."""
STRIDED = ("invert", "pivots", "ldl", "solve", "from_start_of_three", "merged_pivots")
"""Kernels that copy what they read into room of their own, so that it need not be contiguous."""
HELPERS = {
    "intersect": ("_turned", "_lowered", "_sum", "_copied", "_solved"),
    "from_start_of_three": ("_larger", "_inverted", "_looked_at", "_least_of_three", "_sought"),
    "product_of_all": ("_condition", "_summed"),
    "settled": ("_least",),
}
"""What kernels call, in the order in which it is compiled."""


def _signature(numba: Any, name: str) -> Any:
    types = numba.types
    kinds, results = [[(types.float64, axes) if axes else (types.int64, 2) for axes in side] for side in SHAPES[name]]
    read = [types.Array(kind, axes, "A" if name in STRIDED else "C", readonly=True) for kind, axes in kinds]
    written = [types.Array(kind, axes, "C") for kind, axes in results]
    return types.void(*read, *written, *([types.boolean] if name == "solve" else []))
