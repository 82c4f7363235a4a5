"""What is doubtful in the messages of a source, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion_service.hints import Listened
from fusion_service.hints.tracks import coverage_doubt, frame_doubt
from schemas import Disk, Enu, LocalTracks, Motion, Sector, SensorInfo

FRAME = Enu(59.0, 10.0)
SECOND = 10**9
NOW = 1_790_000_000 * SECOND


def message(
    k: int,
    mean: tuple[float, ...],
    epoch: int = NOW,
    late: float = 0.0,
    ids: tuple[int, ...] = (1,),
    sigma: float = 5.0,
) -> LocalTracks:
    """The k-th, a second after the one before."""
    n, count = len(mean), len(ids)
    return LocalTracks(
        source="a", epoch=epoch, seq=k, sent=NOW + k * SECOND - round(late * SECOND),
        time=NOW + k * SECOND, complete=True,
        space=("x", "y", "vx", "vy", "turn_rate")[:n], frame=FRAME, ids=np.array(ids, np.uint64),
        means=np.tile(np.array(mean), (count, 1)), covariances=np.tile(sigma**2 * np.eye(n), (count, 1, 1)),
    )  # fmt: skip


def info(period: float = 1.0) -> SensorInfo:
    return SensorInfo(
        source="a", epoch=NOW, seq=0, sent=NOW, frame=FRAME, position=(0.0, 0.0, 0.0), period=period,
        motion=Motion("cv", 1.0),
    )  # fmt: skip


def doubts(messages: list[LocalTracks], period: float = 1.0) -> str:
    heard = Listened()
    heard.heard(replace(info(period), sent=messages[0].sent), NOW)
    for k, one in enumerate(messages):
        heard.heard(one, NOW + k * SECOND)
    return " | ".join(heard.doubts(NOW + len(messages) * SECOND, FRAME))


def test_a_source_that_is_right_draws_no_word() -> None:
    assert doubts([message(k, (1000.0 + 20.0 * k, 500.0, 20.0, 0.0)) for k in range(12)]) == ""


def test_noise_is_no_order_of_components() -> None:
    rng = np.random.default_rng(16)
    assert doubts([message(k, (*rng.normal(0, 5, 2), *rng.normal(0, 5, 2))) for k in range(12)]) == ""


@pytest.mark.parametrize(
    ("made", "reads"),
    [
        (lambda k: message(k, (1000.0 + 20.0 * k, 20.0, 500.0, 0.0)), "in the order x, vx, y, vy"),
        (lambda k: message(k, (1000.0 + 20.0 * k, 500.0, 5000.0, 0.0)), "do not move by the velocities"),
        (lambda k: message(k, (0.0, 0.0, 0.0, 0.0, 12.0)), "is it in degrees a second"),
        (lambda k: message(k, (59.0, 10.0), sigma=1e-5), "x and y look like degrees"),
        (lambda k: message(k, (0.0, 0.0), ids=(3 * k + 1, 3 * k + 2, 3 * k + 3)), "ids are new in every message"),
        (lambda k: message(k, (0.0, 0.0), late=5.0), "clock is 5 s behind"),
        (lambda k: message(0, (0.0, 0.0)), "seq is always 0"),
        (lambda k: message(k, (0.0, 0.0), epoch=NOW + k), "epoch changes with every message"),
        (lambda k: message(k, (0.0, 0.0), epoch=NOW + k % 2), "two publishers have its name"),
    ],
)
def test_a_doubt_says_what_and_asks_for_the_usual_mistake(made: object, reads: str) -> None:
    assert callable(made)
    assert reads in doubts([made(k) for k in range(8)])


@pytest.mark.parametrize(("period", "reads"), [(1000.0, "in ms"), (20.0, "declare how often"), (1.2, "")])
def test_a_period_is_compared_with_what_comes(period: float, reads: str) -> None:
    said = doubts([message(k, (0.0, 0.0)) for k in range(8)], period)
    assert reads in said
    assert bool(said) == bool(reads)


@pytest.mark.parametrize(
    ("frame", "reads"),
    [
        (Enu(10.0, 59.0), "swapped"),
        (Enu(np.radians(59.0), np.radians(10.0)), "in rad"),
        (Enu(59.0, -10.0), "sign of lon"),
        (Enu(-59.0, 10.0), "sign of lat"),
        (Enu(0.0, 120.0), "is its origin right"),
        (Enu(59.5, 11.0), ""),
    ],
)
def test_a_frame_that_is_far_from_the_picture(frame: Enu, reads: str) -> None:
    said = frame_doubt(frame, FRAME)
    assert reads in said
    assert bool(said) == bool(reads)


def test_a_coverage_that_does_not_hold_the_tracks() -> None:
    east = np.array([[1000.0, 2000.0], [0.0, 10.0]])
    assert coverage_doubt(Disk(5000.0), east, (0.0, 0.0, 0.0)) == ""
    assert "radius in m" in coverage_doubt(Disk(5.0), east, (0.0, 0.0, 0.0))
    assert "counted from east" in coverage_doubt(Sector(5000.0, 0.0, 1.0), east, (0.0, 0.0, 0.0))
    assert "stood at 0, 0" in coverage_doubt(Disk(5000.0), east, (6e6, 58e5, 0.0))
