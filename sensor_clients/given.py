"""What an integrator gives, in any form that NumPy can read, made what a message holds, or refused with its name."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas import FAULTS, LocalIntensity, LocalTracks, MessageError, check_numbers, check_space

__all__ = [
    "all_sound",
    "check_densities",
    "checked_space",
    "densities",
    "floats",
    "instant",
    "lineage_bits",
    "maybe",
    "objects",
    "whole",
]

ASYMMETRY = 1e-6
"""The most that P_ij and P_ji may differ, as a part of sqrt(P_ii P_jj)."""


def maybe(convert: Callable[..., Any], name: str, value: Any, *options: Any) -> Any:
    return None if value is None else convert(name, value, *options)


def objects(
    extent: ArrayLike | None,
    sigma: ArrayLike | None,
    shape: str | None,
    reference: str | None,
    covariances: ArrayLike | None,
) -> dict[str, Any]:
    """The columns of what the objects are like."""
    return {
        "extent": maybe(floats, "extent", extent, (None, 3)),
        "extent_sigma": maybe(floats, "extent_sigma", sigma, (None, 3)),
        "shape": shape,
        "reference": reference,
        "reference_covariances": maybe(floats, "reference_covariances", covariances, (None, 2, 2)),
    }


def all_sound(sound: Callable[[NDArray[np.float64]], NDArray[np.bool_]], column: NDArray[np.float64] | None) -> bool:
    return column is None or bool(sound(column).all())


def lineage_bits(lineages: Sequence[Sequence[str]], whole: Sequence[str]) -> NDArray[np.uint8]:
    """Which names of the whole lineage are in each track (T, ceil(L/8))."""
    place = {name: at for at, name in enumerate(whole)}
    bits = np.zeros((len(lineages), len(whole)), dtype=np.bool_)
    for row, names in enumerate(lineages):
        unknown = [name for name in names if name not in place]
        if unknown or not names:
            known = ", ".join(whole) or "none"
            raise MessageError("bad-field", f"lineages: {list(names)} of track {row} are not in the lineage ({known})")
        bits[row, [place[name] for name in names]] = True
    return np.packbits(bits, axis=1, bitorder="little")


def floats(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """float64 of `shape`, None standing for any length; an empty one may come without its other axes."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise MessageError("bad-field", f"{name}: {error}") from None
    if array.size == 0 and shape[0] is None:
        return np.zeros([length or 0 for length in shape])
    if len(shape) != array.ndim or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise MessageError("length", f"{name} has shape {array.shape} where ({wanted}) belongs")
    return array


def whole(name: str, value: ArrayLike, dtype: type[np.integer[Any]]) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise MessageError("bad-field", f"{name}: {error}") from None
    limits = np.iinfo(dtype)
    if array.ndim != 1:
        raise MessageError("length", f"{name} has shape {array.shape} where (any) belongs")
    if array.size and (array.dtype.kind not in "iu" or array.min() < limits.min or array.max() > limits.max):
        raise MessageError("bad-field", f"{name}: not whole numbers from {limits.min} to {limits.max}")
    return array.astype(dtype)


def instant(time: SupportsIndex) -> int:
    try:
        return operator.index(time)
    except TypeError:
        raise MessageError("bad-field", f"time: {time!r} is not whole nanoseconds, as time.time_ns() is") from None


def checked_space(space: Sequence[str]) -> tuple[str, ...]:
    try:
        return check_space(tuple(space))
    except (ValueError, TypeError) as error:
        raise MessageError("bad-field", f"space: {error}") from None


def densities(means: ArrayLike, covariances: ArrayLike, n: int) -> dict[str, Any]:
    return {
        "means": floats("means", means, (None, n)),
        "covariances": floats("covariances", covariances, (None, n, n)),
    }


def check_densities(message: LocalTracks | LocalIntensity) -> None:
    """Refuse what the centre would, and covariances that only seem sound because one triangle is sent."""
    codes = check_numbers([message])[0]
    bad = np.flatnonzero(codes)
    if len(bad):
        row = int(bad[0])
        what = f"track {message.ids[row]}" if isinstance(message, LocalTracks) else f"component {row}"
        raise MessageError(FAULTS[codes[row]], f"{what} of {message.source}")
    scale = np.sqrt(np.diagonal(message.covariances, axis1=1, axis2=2))
    gap = np.abs(message.covariances - message.covariances.swapaxes(1, 2))
    if not (gap <= ASYMMETRY * scale[:, :, None] * scale[:, None, :]).all():
        raise MessageError("bad-field", f"a covariance of {message.source} is not symmetric")
