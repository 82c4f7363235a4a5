"""What is told of how a source's messages come, and of the targets that it has in common with others."""

from __future__ import annotations

import numpy as np
import pytest

import schemas
from fusion_service.centre import StepResult
from tests.centre.worlds import SECOND, START, centre, info, step, tracks

PLACES = np.array([[1000.0 * k, 0.0, 0.0, 0.0] for k in range(6)])


def test_period_latency_jitter_and_loss_are_told() -> None:
    rng = np.random.default_rng(7)
    made = centre(("r1",))
    lost, transits, count = 0, [], 0
    result: StepResult | None = None
    for k in range(60):
        seq = k
        if rng.random() < 0.1 and k not in (0, 59):
            lost += 1
            continue
        transit = 0.3 + 0.1 * rng.random()
        transits.append(transit)
        count += 1
        t = 2.0 * k + 2.0
        made.handle(tracks("r1", t, PLACES[:1], [1], seq=seq), START + round((t + transit) * SECOND))
        result = step(made, t)
    assert result is not None
    assert lost > 2
    said = result.status.sources["r1"]
    assert said["latency"] == pytest.approx(0.35, abs=0.02)
    assert said["jitter"] == pytest.approx(np.abs(np.diff(transits)).mean(), abs=0.02)
    assert said["period"] == pytest.approx(2.0 * 60 / count, rel=0.15)
    assert said["loss"] == pytest.approx(lost / (count + lost + 1), abs=0.02)
    assert "missed_share" not in said
    assert "confirmed_share" not in said


def test_who_confirms_whom_is_told_where_coverage_is_declared() -> None:
    made = centre(())
    frame = tracks("r1", 1.0, PLACES, range(6)).frame
    for name, radius in (("r1", 1e5), ("r2", 1e5), ("r3", 2500.0)):
        made.handle(info(name, coverage=schemas.Disk(radius), frame=frame, position=(0.0, 0.0, 0.0)), START)
    result: StepResult | None = None
    for t in range(1, 40):
        for name, which in (("r1", range(6)), ("r2", range(3)), ("r3", range(3))):
            some = list(which)
            made.handle(tracks(name, t, PLACES[some], [k + 1 for k in some]), START + t * SECOND)
        result = step(made, t)
    assert result is not None
    told = result.status.sources
    assert told["r1"]["confirmed_share"] == pytest.approx(0.5, abs=0.05)
    assert told["r1"]["missed_share"] < 0.05
    assert told["r2"]["confirmed_share"] > 0.95
    assert told["r2"]["missed_share"] == pytest.approx(0.5, abs=0.05)
    assert told["r3"]["missed_share"] < 0.05
