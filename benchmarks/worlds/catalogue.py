"""All worlds by name, each with its variants."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple
from zlib import crc32

import numpy as np

from benchmarks.worlds import dense, faulty, moving, radars, sparse
from benchmarks.worlds.world import World

__all__ = ["KINDS", "Kind", "make"]


class Kind(NamedTuple):
    """A generator and what it is made for; quick: the variants of a quick run."""

    make: Callable[[str, np.random.Generator, bool], World]
    variants: tuple[str, ...]
    quick: tuple[str, ...]


KINDS = {
    "formation": Kind(dense.formation, ("gap 20", "gap 10", "gap 5", "gap 10 rough"), ("gap 10",)),
    "crossing": Kind(dense.crossing, ("3 deg", "10 deg", "30 deg"), ("30 deg",)),
    "lanes": Kind(dense.lanes, ("15 m", "8 m"), ("15 m",)),
    "splits": Kind(dense.splits, ("20 s",), ("20 s",)),
    "joins": Kind(dense.joins, ("resolved", "unresolved"), ("unresolved",)),
    "manoeuvres": Kind(moving.manoeuvres, tuple(moving.KINDS), ("aircraft 5 g",)),
    "id re-use": Kind(faulty.ids_again, ("one source", "a swaps", "b swaps"), ("one source", "a swaps")),
    "outliers": Kind(faulty.outliers, ("slow source, 300 m", "10 km"), ("10 km",)),
    "clutter": Kind(sparse.clutter, ("0", "20", "100", "200"), ("20",)),
    "detection": Kind(sparse.detection, ("Pd .5", "Pd .7", "Pd .9", "Pd 1"), ("Pd .7",)),
    "rates": Kind(sparse.rates, ("10, 1, .1 Hz", "10, .1 Hz", ".1, .1 Hz", ".1 Hz", ".1 Hz unsaid"), ("10, 1, .1 Hz",)),
    "latencies": Kind(
        faulty.latencies,
        ("10 Hz, .9 s late", "10 Hz, .9 s late; 1 Hz", "1 Hz, 4 s late; 1 Hz"),
        ("10 Hz, .9 s late; 1 Hz",),
    ),
    "bias": Kind(faulty.bias, tuple(f"{metres} m" for metres in range(0, 61, 10)), ("20 m",)),
    "overlap": Kind(sparse.overlap, ("a, both, b",), ("a, both, b",)),
    "three radars": Kind(radars.three_radars, ("ckf",), ()),
}


def make(name: str, variant: str, seed: int, *, quick: bool = False) -> World:
    """The world of that name and variant: the same for the same seed, whatever else is made."""
    return KINDS[name].make(variant, np.random.default_rng([seed, crc32(f"{name}/{variant}".encode())]), quick)
