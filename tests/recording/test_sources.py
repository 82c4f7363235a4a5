"""What a recording shows of how far sources are trusted and how they are shifted, read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.supervised import CLOCK, STEPS, WHY, mission
from tests.recording.contents import entities, rows, texts


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mission(tmp_path_factory.mktemp("sources") / "mission.rrd", draw=True)


def scalars(path: Path, entity: str) -> list[float]:
    return [row["Scalars:scalars"][0] for row in rows(path, entity)]


def test_consistency_is_a_series_with_the_widest_bounds(path: Path) -> None:
    np.testing.assert_allclose(scalars(path, "/consistency/centre/r2"), 1.0 + 0.5 * np.arange(STEPS))
    assert set(scalars(path, "/consistency/centre/bounds/low")) == {0.5}
    assert set(scalars(path, "/consistency/centre/bounds/high")) == {1.6}
    assert "/consistency/centre/r3" not in entities(path)


def test_a_clock_has_a_line_between_two_sigma(path: Path) -> None:
    sigma = 0.4 / (np.arange(STEPS) + 1)
    assert scalars(path, "/clock/centre/r2") == [CLOCK] * STEPS
    np.testing.assert_allclose(scalars(path, "/clock/centre/r2/low"), CLOCK - 2 * sigma)
    np.testing.assert_allclose(scalars(path, "/clock/centre/r2/high"), CLOCK + 2 * sigma)


def test_the_place_is_a_cross_east_right_and_north_up(path: Path) -> None:
    last = rows(path, "/registration/centre/r2")[-1]["LineStrips2D:strips"]
    sigma = 0.4 / STEPS
    np.testing.assert_allclose(last[0], [[30 - 200 * sigma, 40], [30 + 200 * sigma, 40]], rtol=1e-6)
    np.testing.assert_allclose(last[1], [[30, 40 - 100 * sigma], [30, 40 + 100 * sigma]], rtol=1e-6)
    assert rows(path, "/registration/centre/r2/place")[-1]["Points2D:labels"] == ["r2: x +30 ± 5 m, y -40 ± 2.5 m"]


def test_log_and_health_page_say_it_in_words(path: Path) -> None:
    said = [line.partition("  ")[2] for line in texts(path, "sources")]
    assert f"source r2: inflated, was trusted: {WHY}" in said
    assert "source r2: clock +0.5 s" in said
    assert "source r2: alarm: stuck: track 4 stands still to the bit" in said
    page = rows(path, "/health/centre")[-1]["TextDocument:text"][0]
    assert "| r2 | lost | inflated | 4.50 (0.50 to 1.60) |" in page
    assert f"- **r2** inflated: {WHY}" in page
