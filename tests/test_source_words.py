"""What is said of a source in words: the right number in its unit, and nothing of what is not of the right kind."""

from __future__ import annotations

import math

import pytest

from fusion_service.source_words import biases, consistency, source_event, source_health, state_of


def test_parts_of_a_bias_are_shown_in_their_units() -> None:
    parts = {
        "heading": {"value": math.pi / 180, "sigma": math.pi / 1800, "observable": True, "why": ""},
        "clock": {"value": -0.25, "sigma": 0.01, "observable": True, "why": ""},
        "range": {"value": 5.0, "sigma": 90.0, "observable": False, "why": "too few targets"},
    }
    clock, heading, reach = biases({"bias": parts})
    assert (heading.value, heading.sigma) == pytest.approx((1.0, 0.1))
    assert heading.unit == "°"
    assert str(clock) == "clock -0.25 ± 0.01 s"
    assert str(reach) == "range: not observable (too few targets)"


@pytest.mark.parametrize(
    "bias",
    [None, 3, [], {"clock": 1}, {"clock": {"value": math.inf, "sigma": 1}}, {"clock": {"value": True, "sigma": 1}}],
)
def test_what_is_no_bias_is_left_out(bias: object) -> None:
    assert biases({"bias": bias}) == []


def test_consistency_needs_its_bounds() -> None:
    assert consistency({"consistency": 1.0, "consistency_low": 0.5}) is None
    assert consistency({"consistency": 1, "consistency_low": 0.5, "consistency_high": 2.0}) == (1.0, 0.5, 2.0)
    assert state_of({"state": 3}) == ""


def test_health_says_what_is_amiss_and_nothing_of_a_sound_source() -> None:
    assert source_health({"state": "trusted", "state_why": "as it should be"}) == []
    assert source_health({}) == []
    clock = {"clock": {"value": 0.5, "sigma": 0.02, "observable": True}}
    said = {"state": "out", "state_why": "spoofed", "bias": clock, "bias_applied": True, "alarms": ["stuck", 3]}
    assert source_health(said) == ["out: spoofed", "clock +0.5 ± 0.02 s, taken off", "stuck"]
    assert source_health({"bias": clock, "bias_note": "half of it is mine"}) == ["half of it is mine"]


@pytest.mark.parametrize(
    ("event", "words"),
    [
        ({"kind": "supervision", "state": "out", "was": "watch", "why": "w"}, (True, "out, was watch: w")),
        ({"kind": "supervision", "state": "trusted", "was": "out", "why": ""}, (False, "trusted, was out")),
        ({"kind": "registration", "applied": True, "why": "clock"}, (True, "clock")),
        ({"kind": "registration", "applied": False, "why": ""}, (False, "its bias is not taken off")),
        ({"kind": "alarm", "what": "jump", "source": "a", "metres": 3}, (True, "alarm: jump (metres 3)")),
        ({"kind": "alarm_over", "what": "jump", "source": "a", "why": "w"}, (False, "no more: jump: w")),
        ({"kind": "alarm", "what": "identity-twice", "identity": "x"}, None),
        ({"kind": "order"}, None),
    ],
)
def test_an_event_in_words(event: dict[str, object], words: tuple[bool, str] | None) -> None:
    assert source_event(event) == words
