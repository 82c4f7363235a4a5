"""A mission whose local tracks are those of Kalman filters, flown by the real centre: r1 and r2 keep to themselves."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

import schemas
from tests.centre.worlds import SPACE, START, info, tracks
from tests.helpers.flown import REALM, Flight

__all__ = ["fly"]

Q = 1.0
F = np.eye(4) + np.eye(4, k=2)
NOISE = Q * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
R = 15.0**2 * np.eye(2)


def fly(seconds: int = 24, *, fed: int = 24, alone: int = 24, targets: int = 3, seed: int = 3, **config: Any) -> Flight:
    """Sources r1, r2 and r3, cv with q = 1, a scan a second. From second `fed` on r3 says that it is fed with fused
    tracks; after second `alone` only r3 sends. The status of each step is in the log too."""
    print(f"seed {seed}")
    flight = Flight({"memory": "tracklet", "coast": 60.0, **config})
    rng = np.random.default_rng(seed)
    truth = np.hstack([9e3 * np.arange(targets)[:, None] * [1.0, 0.5], rng.normal(0, 10, (targets, 2))])
    names = ("r1", "r2", "r3")
    means = {
        name: np.hstack([truth[:, :2] + rng.normal(0, 15, (targets, 2)), np.zeros((targets, 2))]) for name in names
    }
    P = np.diag([*np.diag(R), 150.0, 150.0])
    for name in names:
        flight.put(info(name), 0.0)
    for second in range(1, seconds + 1):
        if second == fed:
            flight.put(info("r3", seq=1, feedback=True), second)
        if second > 1:
            truth = truth @ F.T + rng.multivariate_normal(np.zeros(4), NOISE, targets)
            P = F @ P @ F.T + NOISE
            K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
            for name in names:
                predicted = means[name] @ F.T
                z = truth[:, :2] + rng.normal(0, 15, (targets, 2))
                means[name] = predicted + (z - predicted[:, :2]) @ K.T
            P = P - K @ P[:2]
            P = (P + P.T) / 2
        world = schemas.Truth(
            source="world", epoch=1, seq=second, sent=START, time=START + second * 10**9, space=SPACE,
            frame=info("r1").frame, ids=np.arange(1, targets + 1, dtype=np.uint64), means=truth,
        )  # fmt: skip
        flight.put(world, second)
        for name in names if second <= alone else ("r3",):
            flight.put(tracks(name, second, means[name], covariances=np.tile(P, (targets, 1, 1))), second + 0.05)
        status = dataclasses.replace(flight.step(second).status, sent=START)
        key = schemas.global_key(flight.config.name, "status", REALM)
        flight.log.append((key, schemas.encode(status), START + second * 10**9 + 3 * 10**8))
    return flight
