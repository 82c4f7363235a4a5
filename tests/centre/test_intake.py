"""What is refused, by which reason, and that the rest goes on: the border of the centre."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import schemas
from fusion_service.centre import FusionCentre, Refused, SourceFound
from tests.centre.worlds import FRAME, SECOND, SPACE, START, centre, give, info, moved, step, tracks, truth

SOURCES = ("r1", "r2", "r3")


def broken(**changes: Any) -> schemas.LocalTracks:
    return dataclasses.replace(tracks("r1", 2, truth(3)), **changes)


def with_covariance(change: Callable[[Any], None]) -> schemas.LocalTracks:
    message = tracks("r1", 2, truth(3))
    change(message.covariances)
    return message


def poke(index: tuple[int, ...], value: float) -> Callable[[Any], None]:
    def change(covariances: Any) -> None:
        covariances[index] = value
        covariances[index[0], index[2], index[1]] = value

    return change


HOSTILE = {
    "nan mean": (broken(means=np.where(np.eye(3, 4) > 0, np.nan, 0.0)), "not-finite", 3),
    "nan covariance": (with_covariance(poke((1, 0, 1), np.nan)), "not-finite", 1),
    "negative variance": (with_covariance(poke((1, 0, 0), -1.0)), "not-positive-definite", 1),
    "indefinite": (with_covariance(poke((2, 0, 1), 1e6)), "not-positive-definite", 1),
    "far away": (broken(means=np.full((3, 4), 1e15)), "out-of-range", 3),
    "existence": (broken(existence=np.array([0.5, 2.0, np.nan])), "existence", 2),
    "future": (broken(time=START + 10**8 * SECOND), "future", 1),
    "future epoch": (broken(epoch=2**64 - 1), "future", 1),
    "late": (broken(time=START - 10 * SECOND), "late", 1),
    "loop": (broken(source="global/centre"), "loop", 1),
    "own name": (broken(source="centre"), "loop", 1),
    "other frame": (broken(frame=schemas.Local("dock")), "frame", 3),
    "bad period": (info("r1", seq=5, period=-1.0), "bad-info", 1),
    "nan period": (info("r1", seq=5, period=float("nan")), "bad-info", 1),
    "nan position": (info("r1", seq=5, position=(float("nan"), 0.0, 0.0)), "bad-info", 1),
    "truth": (
        schemas.Truth(
            source="r1",
            epoch=1,
            seq=0,
            sent=0,
            time=1,
            space=("x", "y"),
            frame=FRAME,
            ids=np.zeros(0, np.uint64),
            means=np.zeros((0, 2)),
        ),
        "type",
        1,
    ),
    "intensity": (
        schemas.LocalIntensity(
            source="r1",
            epoch=1,
            seq=0,
            sent=0,
            time=START,
            space=SPACE,
            frame=FRAME,
            weights=np.zeros(0),
            means=np.zeros((0, 4)),
            covariances=np.zeros((0, 4, 4)),
        ),
        "intensity",
        1,
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_messages_are_refused_by_reason_and_the_rest_goes_on(name: str) -> None:
    message, reason, count = HOSTILE[name]
    made = centre(("r1", "r2"))
    states = truth(3)
    give(made, tracks("r1", 1, states), tracks("r2", 1, states))
    before = step(made, 1).tracks
    give(made, message, tracks("r2", 2, moved(states, 1)))
    result = step(made, 2)
    assert result.status.refused == {reason: count}
    assert [entry.reason for entry in result.log.refused] == [reason]
    assert result.tracks.ids.tolist() == before.ids.tolist()
    assert (result.tracks.contributor_counts == 2).all()
    assert np.isfinite(result.tracks.means).all()
    assert schemas.check_numbers([result.tracks])[0].tolist() == [0, 0, 0]


def test_pending_messages_of_one_source_are_bounded() -> None:
    made = centre(("r2",), max_pending=5)
    give(made, *(tracks("r1", 5 + k / 10, truth(1), seq=k) for k in range(9)), tracks("r2", 1, truth(1)))
    result = step(made, 1)
    assert result.status.dropped == {"r1": 4}
    assert result.tracks.contributor_counts.tolist() == [1]


def test_more_names_than_a_network_has_do_not_grow_it_without_limit() -> None:
    made = FusionCentre({})
    give(made, *(SourceFound(f"s{k}") for k in range(1200)))
    result = step(made, 1)
    assert result.status.refused == {"too-many-sources": 200}


numbers = st.floats(-1e6, 1e6) | st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300, 0.0])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(SOURCES),
            st.integers(0, 6),
            st.integers(0, 12),
            st.integers(0, 4),
            st.lists(numbers, min_size=4, max_size=4),
            st.lists(numbers, min_size=10, max_size=10),
            st.booleans(),
            st.integers(1, 3),
        ),
        max_size=12,
    )
)
def test_no_message_makes_it_raise_or_publish_nonsense(batch: list[Any]) -> None:
    made = FusionCentre({"memory": "recursive", "rule": "hmd-ga"})
    for source, seq, second, count, mean, lower, complete, epoch in batch:
        covariance = schemas.unpack_lower(np.array(lower), 4)
        message = tracks(source, second, np.tile(mean, (count, 1)), seq=seq, complete=complete, epoch=epoch)
        give(made, dataclasses.replace(message, covariances=np.tile(covariance, (count, 1, 1))))
    for second in (1, 5, 9, 13):
        result = step(made, second)
        assert (schemas.check_numbers([result.tracks])[0] == 0).all()
        schemas.encode(result.log)
        schemas.encode(result.status)


def test_other_events_in_any_order_leave_the_same_bytes() -> None:
    events = [
        Refused("b", "not-msgpack"), Refused("a", "version"), Refused("a", "version"),
        Refused("c", "queue", 3, dropped=True), SourceFound("r2"), SourceFound("r1"),
        tracks("r1", 1, truth(2)), info("r1"),
    ]  # fmt: skip

    def run(order: Iterable[int]) -> list[bytes]:
        made = FusionCentre({})
        give(made, *(events[k] for k in order))
        result = step(made, 1)
        return [schemas.encode(part) for part in (result.tracks, result.log, result.status)]

    assert run(range(8)) == run(reversed(range(8)))


def test_the_time_of_reception_does_not_matter_between_repeats() -> None:
    blobs = []
    for received in ((5, 6), (6, 5)):
        made = centre(("r1",))
        for at in received:
            made.handle(tracks("r1", 1, truth(2)), START + at * SECOND)
        step(made, 1)
        blobs.append(made.checkpoint())
    assert blobs[0] == blobs[1]


def test_an_older_epoch_is_believed_once_the_newer_run_is_silent() -> None:
    made = centre(("r1",))
    give(made, info("r1", epoch=50), tracks("r1", 1, truth(2), epoch=50))
    step(made, 1)
    give(made, tracks("r1", 2, truth(2), epoch=40))
    assert step(made, 2).status.refused == {"old-epoch": 1}
    give(made, info("r1", epoch=40), tracks("r1", 8, truth(2), epoch=40, seq=1))
    assert step(made, 8).tracks.contributor_epoch.tolist() == [40, 40]


def test_the_frame_is_that_of_the_first_sound_track() -> None:
    made = FusionCentre({})
    give(made, info("a"), tracks("a", 1, np.zeros((0, 4)), frame=schemas.Local("x")))
    give(made, info("b"), tracks("b", 1, truth(2)))
    assert step(made, 1).tracks.frame == FRAME


def test_partial_scans_of_many_tracks_are_taken_together_and_as_one_by_one() -> None:
    states = truth(30)
    pictures: list[schemas.GlobalTracks] = []
    for at_once in (True, False):
        made = centre(("r1",))
        for k in range(30):
            give(made, tracks("r1", 1 + k / 100, states[k : k + 1], [k + 1], seq=k, complete=False))
            give(made, tracks("r1", 1.5 + k / 100, states[k : k + 1] + 1.0, [k + 1], seq=100 + k, complete=False))
            if not at_once:
                step(made, 1.5 + k / 100)
        pictures.append(step(made, 2).tracks)
    together, apart = pictures
    assert len(together.ids) == len(apart.ids) == 30
    np.testing.assert_array_equal(np.sort(together.means, axis=0), np.sort(apart.means, axis=0))


def test_a_table_full_of_tracks_takes_its_own_updates_and_refuses_more(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    count = 5000
    monkeypatch.setattr("fusion_service.centre.limits.MAX_TRACKS", count)
    means = np.concatenate([rng.uniform(-1e7, 1e7, (count, 2)), np.zeros((count, 2))], axis=1)
    made = centre(("r1",))
    give(made, tracks("r1", 1, means))
    assert len(step(made, 1).tracks.ids) == count
    give(made, tracks("r1", 2, means[:1], [count + 1], complete=False), tracks("r1", 3, means, seq=3))
    after = step(made, 3)
    assert after.status.refused == {"too-many-tracks": 1}
    assert after.tracks.contributor_counts.sum() == count


def test_a_filler_of_before_the_first_message_mends_no_gap() -> None:
    made = centre(("r1",), revise=0.0)
    give(made, *(tracks("r1", 1 + k / 100, truth(1), seq=seq) for k, seq in enumerate((10, 13))))
    step(made, 2)
    give(made, tracks("r1", 1.5, truth(1), seq=5), tracks("r1", 1.6, truth(1), seq=11))
    assert step(made, 3).status.sources["r1"]["gaps"] == 1


def test_a_track_whose_density_overflows_on_its_way_is_told() -> None:
    made = FusionCentre({"source_defaults": {"period": 1e5}})
    wild = np.array([1.0, 1.0, 9e3, 9e3])  # vaguer, and the velocity were none
    told = info("r1", period=1e5, motion=schemas.Motion("cv", 0.0))
    give(made, told, tracks("r1", 1, [[0, 0, 0, 0]], sigma=wild))
    result = step(made, 2e5)
    assert len(result.tracks.ids) == 0
    assert result.status.refused.get("ill-conditioned", 0) == 1


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    message = tracks("r1", 1, truth(3))
    made = centre(("r1", "r2"))
    give(made, dataclasses.replace(message, means=message.means[:2]), tracks("r2", 1, truth(3)))
    result = step(made, 1)
    assert result.status.refused == {"length": 1}
    assert len(result.tracks.ids) == 3
