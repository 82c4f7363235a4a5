"""Words, keys and times that are nearly right."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fusion_service.hints import key_finding, near, refusal_finding
from fusion_service.hints.times import clock_words, span, unit_of_time
from fusion_service.hints.words import COMPONENT_WORDS, component_hint
from schemas import COMPONENTS, LocalTracks, Motion, SensorInfo
from schemas.spaces import Local

NOW = time.time_ns()


@pytest.mark.parametrize(
    ("key", "reads"),
    [
        ("fusoin/v1/local/a/tracks", "did you mean 'fusion'"),
        ("harbour/v1/local/a/tracks", "the centre listens in 'fusion'"),
        ("fusion/v1/local/a/track", 'did you mean "tracks"'),
        ("fusion/v1/local/a/position", "tracks, intensity, info or alive"),
        ("fusion/local/a/tracks", "where v1 belongs"),
        ("fusion/v2/local/a/tracks", "'v2' where v1 belongs"),
        ("fusion/v1/locl/a/tracks", "'locl' is no part of a key"),
        ("a", "names no source"),
    ],
)
def test_a_key_that_is_nearly_right(key: str, reads: str) -> None:
    found = key_finding(key)
    assert found is not None
    assert reads in found.said


def test_a_key_that_is_right_draws_no_word() -> None:
    assert key_finding("fusion/v1/local/a/tracks") is None
    assert key_finding("a/b/v1/local/a/tracks", "a/b") is None


def test_every_other_name_of_a_component_leads_to_it() -> None:
    assert set(COMPONENT_WORDS) == set(COMPONENTS)
    for component, others in COMPONENT_WORDS.items():
        assert all(f'"{component}"' in component_hint(other) for other in others), component
        assert near(component, COMPONENTS) == component


def test_nothing_near_is_nothing() -> None:
    assert near("zzzzzz", COMPONENTS) == ""
    assert near(5, COMPONENTS) == ""
    assert near("x" * 10**6, COMPONENTS) == ""
    assert component_hint("altogether") == ""


@pytest.mark.parametrize(("factor", "unit"), [(10**9, "seconds"), (10**6, "ms"), (10**3, "us"), (1, "")])
def test_the_unit_of_a_time(factor: int, unit: str) -> None:
    assert unit_of_time(NOW // factor, NOW) == unit
    assert unit_of_time(float("nan"), NOW) == ""


def test_durations_and_clocks_in_words() -> None:
    assert [span(one) for one in (0.02, 3, 300, 7200, 1e6, 1.8e9)] == [
        "20 ms",
        "3 s",
        "5 min",
        "2 h",
        "11.6 days",
        "57 years",
    ]
    assert "GPS" in clock_words(18.1)
    assert "TAI" in clock_words(37.0)
    assert "local time" in clock_words(-5.5 * 3600)
    assert "NTP" in clock_words(3.0)


def test_a_refusal_without_its_message_still_says_what_to_do() -> None:
    for reason in ("late", "old-epoch", "origin", "queue", "frame", "something-new"):
        assert len(refusal_finding(reason, None, NOW).said) > 20


def test_a_mission_of_another_time_is_asked_for_its_clock() -> None:
    info = SensorInfo(
        source="a", epoch=1, seq=0, sent=NOW, frame=Local("h"), position=(0.0, 0.0, 0.0), period=1.0,
        motion=Motion("cv", 1.0),
    )  # fmt: skip
    for seconds, words in ((8, "raise lateness"), (330 * 86400, 'clock = "message"')):
        late = LocalTracks(
            source="a", epoch=1, seq=0, sent=NOW, time=NOW - seconds * 10**9, complete=True, space=("x", "y"),
            frame=info.frame, ids=np.zeros(0, np.uint64), means=np.zeros((0, 2)), covariances=np.zeros((0, 2, 2)),
        )  # fmt: skip
        assert words in refusal_finding("late", late, NOW).said


def test_an_epoch_from_the_future_is_named() -> None:
    info = SensorInfo(
        source="a",
        epoch=NOW + 10**12,
        seq=0,
        sent=NOW,
        frame=Local("h"),
        position=(0.0, 0.0, 0.0),
        period=1.0,
        motion=Motion("cv", 1.0),
    )
    found = refusal_finding("future", info, NOW)
    assert found.field == "epoch"
    assert "ahead" in found.said
