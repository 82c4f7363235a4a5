"""A step log and the messages are enough to make the mission again, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, Order, SourceFound, SourceLost
from fusion_service.config import CentreConfig, centre_config
from tests.centre.worlds import SECOND, START, info, moved, seen, tracks, truth
from tests.helpers import fuse_again


@pytest.mark.parametrize("memory", ["restart", "recursive", "tracklet"])
@pytest.mark.parametrize("rule", ["naive", "ci", "hmd-ga"])
def test_a_messy_mission_is_made_again(rule: str, memory: str) -> None:
    """Late, lost, repeated and bad messages, restarts of sources and of the centre, orders."""
    config: CentreConfig = centre_config({"rule": rule, "memory": memory, "lateness": 2.0, "coast": 2.0})
    rng = np.random.default_rng(11)
    states = truth(12)
    centre = FusionCentre(config, generation=1, epoch=100)
    sent: list[Any] = []
    recorded: list[Any] = []
    epochs = {"r1": 1, "r2": 1, "r3": 1}
    first: dict[str, int] = {}
    for second in range(1, 16):
        for name in epochs:
            if second == 6 and name == "r2":
                epochs[name] = 2
            if rng.random() < 0.1:
                continue
            chosen = rng.permutation(12)[: rng.integers(8, 13)]
            at = second - 0.25 * int(rng.integers(0, 3))
            message = tracks(
                name, at, seen(moved(states, at), rng)[chosen], chosen + 1, seq=second, epoch=epochs[name],
                complete=bool(rng.random() < 0.7),
            )  # fmt: skip
            if rng.random() < 0.1:
                message.means[0, 0] = np.nan
            if first.get(name) != epochs[name] and second > 1:
                sent.append(info(name, epoch=epochs[name]))
                first[name] = epochs[name]
            sent.append(message)
        recorded += sent
        for message in sent:
            if rng.random() < 0.15:
                continue  # comes with the next step
            centre.handle(message, START + second * SECOND)
            if rng.random() < 0.1:
                centre.handle(message, START + second * SECOND)
        sent = [m for m in sent if rng.random() < 0.2]
        if second == 3:
            centre.handle(SourceFound("r1"), START)
        if second == 9:
            centre.handle(SourceLost("r1"), START)
            centre.handle(Order("mute", "r3"), START)
        if second == 12:
            centre.handle(Order("unmute", "r3"), START)
            centre = FusionCentre(config, centre.checkpoint(), generation=2, epoch=200)
        result = centre.step(START + second * SECOND)
        recorded += [result.tracks, result.log]
    bus = [schemas.decode(schemas.encode(message)) for message in recorded]
    pairs = fuse_again.again(config, bus)
    assert len(pairs) == 15
    assert fuse_again.differing(pairs) == []
    assert len(pairs[-1][0].ids) >= 10
