"""Which local tracks a global track was fused from, as lines from each to it.

/picture/global/{centre}/links/{source}      one line per contribution, in the colour of the source

The near end is the local track as it is drawn: as its source last told, not as the centre predicted it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.recording.columns import entity
from fusion_service.recording.drawing.tables import Table
from schemas import GlobalTracks

__all__ = ["links", "links_path"]


def links_path(centre: str, source: str) -> str:
    """The entity of the lines from the tracks of `source` to those of `centre`."""
    return entity("picture", "global", centre, "links", source)


def links(message: GlobalTracks, fused: Table, local: Mapping[str, Table]) -> Iterator[tuple[str, Floats, Floats]]:
    """Of each source of `message`: its name, ends (S, 2, 2) in m, local track first, and their heights (S, 2).

    fused: the global tracks that are drawn; local: those of each source.
    """
    owner = np.repeat(message.ids, message.contributor_counts)
    for index, name in enumerate(message.sources):
        table = local.get(name)
        mine = np.flatnonzero(message.contributor_source == index)
        if table is None or not len(table.ids) or not len(mine) or not len(fused.ids):
            yield name, np.zeros((0, 2, 2)), np.zeros((0, 2))
            continue
        mine = mine[message.contributor_epoch[mine] == np.uint64(table.epoch)]
        near, has_near = _find(table.ids, message.contributor_id[mine])
        far, has_far = _find(fused.ids, owner[mine])
        both = has_near & has_far
        near, far = near[both], far[both]
        ends = np.stack([table.place.xy[near], fused.place.xy[far]], axis=1)
        yield name, ends, np.stack([table.place.z[near], fused.place.z[far]], axis=1)


def _find(known: NDArray[np.uint64], wanted: NDArray[np.uint64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The row of each of `wanted` in `known`, not empty, and whether it is there."""
    order = np.argsort(known, kind="stable")
    place = np.minimum(np.searchsorted(known[order], wanted), len(known) - 1)
    rows = order[place]
    return rows, known[rows] == wanted
