"""The first client of a newcomer who reads WIRE.md and nothing else: it follows two targets at 2 Hz and writes down
where they really are. `MISTAKES` are what he gets wrong at first: a line of the right client, and what he wrote."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MISTAKES", "RIGHT", "Mistake", "with_mistakes"]

RIGHT = '''
"""newcomer.py ENDPOINT GPS.CSV"""
import sys, time
import msgpack, numpy as np
from fusion_service.bus import open_bus

endpoint, gps = sys.argv[1:]
rng = np.random.default_rng(1)
begin = time.time_ns()
frame = {"kind": "enu", "lat": 63.43, "lon": 10.39}
P = np.diag([25.0, 25.0, 1.0, 1.0])
P[0, 2] = P[2, 0] = P[1, 3] = P[3, 1] = 2.0
L = np.linalg.cholesky(P)
with open_bus([endpoint], wait=60.0) as bus, open(gps, "w") as truth:
    bus.announce("fusion/v1/local/newcomer/alive")
    out = {what: bus.publisher("fusion/v1/local/newcomer/" + what) for what in ("tracks", "info")}
    print("time,id,x,y", file=truth)
    for seq in range(10**6):
        now = time.time_ns()
        t = (now - begin) / 1e9
        true = np.array([[10.0 * t, 800.0, 10.0, 0.0], [-600.0, 400.0 - 5.0 * t, 0.0, -5.0]])
        seen = true + rng.normal(size=(2, 4)) @ L.T
        head = {"v": 1, "source": "newcomer", "epoch": begin, "seq": seq, "sent": now, "origin": "live", "frame": frame}
        if seq % 10 == 0:
            out["info"].put(msgpack.packb({
                **head, "type": "sensor_info", "position": [0.0, 0.0, 0.0],
                "period": 0.5,
                "motion": {"kind": "cv", "q": 0.1}, "initiation_delay": 1.0, "may_start": True,
                "coverage": {"kind": "disk", "radius": 5000.0},
            }))
        out["tracks"].put(msgpack.packb({
            **head, "type": "local_tracks", "complete": True, "space": ["x", "y", "vx", "vy"],
            "time": now,
            "ids": np.array([1, 2], "<u8").tobytes(),
            "means": seen.astype("<f8").tobytes(),
            "covs": np.tile(P[np.tril_indices(4)], 2).astype("<f8").tobytes(),
        }))
        for k in range(2):
            print(now, k + 1, *true[k, :2], sep=",", file=truth, flush=True)
        time.sleep(0.5)
'''


class Mistake(NamedTuple):
    right: str
    wrong: str
    reads: str
    """What he must read of it, wherever he looks."""


MISTAKES = (
    Mistake('"time": now,', '"time": now // 10**9,', r"`time` in seconds\? it must be ns"),
    Mistake('"period": 0.5,', '"period": 500,', r"`period` in ms"),
    Mistake("P[np.tril_indices(4)]", "P[np.triu_indices(4)]", r"upper triangle: send the lower one"),
)


def with_mistakes(some: tuple[Mistake, ...]) -> str:
    """The client with these mistakes."""
    text = RIGHT
    for one in some:
        assert one.right in text
        text = text.replace(one.right, one.wrong)
    return text
