"""A mission made by hand, whose every target is missed in a way of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from schemas import Decisions, Disk, Entry, GlobalTracks, Message, StepLog
from schemas.messages import GATE_FAILED
from tests.helpers.missions import at, info, picture, tracks, truth

__all__ = ["BIG", "PLACES", "SECONDS", "mission"]

SECONDS = 20
PLACES = {
    1: (0.0, 0.0),
    2: (5000.0, 0.0),
    3: (500.0, 0.0),
    4: (-500.0, 0.0),
    5: (0.0, 400.0),
    6: (0.0, 470.0),
    7: (0.0, -400.0),
    8: (300.0, 300.0),
    9: (-300.0, 300.0),
    10: (-300.0, -300.0),
    11: (300.0, -300.0),
}
"""Followed; outside all coverage; seen by none; confirmed late; two that merge; out of its gate; refused; lost and
found again under another number; its track too far off; in no fused track."""
BIG = 3 << 60
"""Added to the numbers of fused tracks: beyond 2^53."""


def shown(second: int) -> GlobalTracks:
    """Track 10 n for target n, of the local track n of a (of b: n + 50)."""
    rows: list[tuple[int, tuple[float, float], int, list[int]]] = []
    for target, place in PLACES.items():
        at_all = {
            1: True,
            4: True,
            5: True,
            6: not 8 <= second <= 12,
            7: second < 10,
            9: not 6 < second < 14,
            10: True,
        }.get(target, False)
        if at_all:
            here = (place[0], place[1] - 200.0) if target == 10 else place
            number = 95 if target == 9 and second >= 14 else 10 * target
            with_it = [target, 6] if target == 5 and 8 <= second <= 12 else [target]
            rows.append((BIG + number, here, 0 if target == 4 and second < 5 else 1, with_it))
    base = picture(second, [row[0] for row in rows], [row[1] for row in rows])
    inside = [local for row in rows for local in row[3]]
    return replace(
        base,
        status=np.array([row[2] for row in rows], dtype=np.uint8),
        sources=("a", "b"),
        contributor_counts=np.array([len(row[3]) for row in rows], dtype=np.uint16),
        contributor_source=np.zeros(len(inside), dtype=np.uint16),
        contributor_epoch=np.ones(len(inside), dtype=np.uint64),
        contributor_id=np.array(inside, dtype=np.uint64),
        contributor_influence=np.ones(len(inside)),
    )


def logged(second: int) -> StepLog:
    """The log of a step: a 7 outside its gate from 10 s on, and messages of b refused."""
    rows = 1 if second >= 10 else 0
    made = Decisions(
        kind=np.full(rows, GATE_FAILED, dtype=np.uint8),
        track=np.full(rows, BIG + 70, dtype=np.uint64),
        source=np.zeros(rows, dtype=np.uint16),
        epoch=np.ones(rows, dtype=np.uint64),
        id=np.full(rows, 7, dtype=np.uint64),
        other=np.zeros(rows, dtype=np.uint64),
        value=np.full(rows, 99.0),
    )
    return StepLog(
        source="centre",
        epoch=1,
        seq=second,
        sent=at(second),
        step=second,
        time=at(second),
        config_hash="",
        version="0",
        taken=(),
        refused=(Entry("b", 1, second, 0, "late"),),
        dropped=(),
        events=(),
        sources=("a",),
        decisions=made,
    )


def mission() -> list[Message]:
    """Both sources cover 1 km about the origin; a sees all but 2, 3 and 8, and 9 not from 7 to 13 s; b sees 8."""
    said: list[Message] = [info(name, coverage=Disk(1000.0)) for name in ("a", "b")]
    for second in range(SECONDS + 1):
        seen = [n for n in PLACES if n not in (2, 3, 8) and not (n == 9 and 6 < second < 14)]
        said += [
            truth(second, list(PLACES), list(PLACES.values())),
            tracks("a", second, seen, [PLACES[n] for n in seen]),
            tracks("b", second, [58], [PLACES[8]]),
            shown(second),
            logged(second),
        ]
    return said
