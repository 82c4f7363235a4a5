"""Sources whose scans are too late for their steps are told of, with the delay that would do."""

from __future__ import annotations

import numpy as np
import pytest

from fusion_service.hints.lateness import late_doubt

SECOND = 10**9
START = 1_700_000_000 * SECOND


def told(latency: float, *, period: float = 0.1, delay: float = 0.05, each: float = 0.1, count: int = 30) -> str:
    rng = np.random.default_rng(14)
    held = [START + round(each * k * SECOND) for k in range(count)]
    came = [one + round((latency + rng.uniform(0, 0.01)) * SECOND) for one in held]
    return late_doubt(held, came, period=period, delay=delay, lateness=5.0, again=True)


def test_all_of_them_late_gives_the_delay_that_is_needed() -> None:
    said = told(0.3)
    assert "steps are made again for each" in said
    needed = float(said.split("set delay under [centre] to ")[1].split()[0])
    assert 0.3 <= needed <= 0.33
    assert told(0.3, delay=needed) == ""


@pytest.mark.parametrize(
    "said",
    [
        told(0.02),
        told(0.3, count=19),
        told(6.0),
        told(-0.2),
        told(0.3, period=10.0, each=1.0),
        late_doubt([], [], period=0.1, delay=0.0, lateness=5.0, again=False),
    ],
)
def test_nothing_is_told_of_what_is_in_time_or_few_or_refused_or_ahead(said: str) -> None:
    assert said == ""


def test_a_scan_between_two_steps_has_until_the_later_of_them() -> None:
    """Scans of .05 s before each step, .09 s late: within a delay of .05 s."""
    held = [START + round((0.05 + 0.1 * k) * SECOND) for k in range(30)]
    came = [one + round(0.09 * SECOND) for one in held]
    assert late_doubt(held, came, period=0.1, delay=0.05, lateness=5.0, again=True) == ""
    assert late_doubt(held, came, period=0.1, delay=0.03, lateness=5.0, again=False) != ""
