"""One messy mission for all tests of replay."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.flown import Flight, messy


@pytest.fixture(scope="session")
def flight() -> Flight:
    return messy({"rule_options": {"criterion": "trace"}})


@pytest.fixture(scope="session")
def mission(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flight.record(tmp_path_factory.mktemp("replay") / "mission.rrd")
