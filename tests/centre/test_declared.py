"""What the config states for a source that does not say it, or says it wrongly."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.declared import declared_by, sensor_of
from fusion_service.config import ConfigError, centre_config, config_hash
from fusion_service.config.settings import nested, plain_settings, recordable
from tests.centre.worlds import give, info, step, tracks, truth

DISK, SMALL = schemas.Disk(20_000.0), schemas.Disk(5_000.0, 10.0)
TABLE: dict[str, Any] = {
    "coverage": {"kind": "disk", "radius": 20_000},
    "detection_probability": 0.9,
    "initiation_delay": 4.0,
    "stale": 30.0,
}


def said(**table: Any) -> Any:
    return centre_config({"sources": {"r1": {**TABLE, **table}}}).source("r1")


def test_the_config_states_what_the_source_does_not() -> None:
    whole = declared_by(said(), info("r1", period=2.0))
    assert (whole.coverage, whole.detection_probability, whole.initiation_delay) == (DISK, 0.9, 4.0)
    assert (whole.period, whole.stale) == (2.0, 30.0)
    own = info("r1", coverage=SMALL, detection_probability=0.5, initiation_delay=1.0)
    whole = declared_by(said(), own)
    assert (whole.coverage, whole.detection_probability, whole.initiation_delay) == (SMALL, 0.5, 1.0)
    whole = declared_by(said(override=True, period=7.0), own)
    assert (whole.coverage, whole.detection_probability, whole.initiation_delay, whole.period) == (DISK, 0.9, 4.0, 7.0)
    bare = centre_config({"sources": {"r1": {"override": True}}}).source("r1")
    whole = declared_by(bare, own)
    assert (whole.coverage, whole.detection_probability, whole.initiation_delay) == (SMALL, 0.5, 1.0)
    sensor = sensor_of(declared_by(said(), info("r1")), info("r1"))
    assert sensor is not None
    assert (sensor.coverage, sensor.detection_probability, sensor.initiation_delay) == (DISK, 0.9, 4.0)
    assert sensor_of(said(), None) is None


@pytest.mark.parametrize(
    "coverage",
    [
        {"kind": "disk", "radius": 100.0, "inner": 5},
        {"kind": "sector", "radius": 100.0, "azimuth": 1.0, "width": 0.5},
        {"kind": "polygon", "points": [[0, 0], [10, 0], [10, 20.5]]},
    ],
)
def test_every_coverage_goes_through_config_and_log_and_back(coverage: dict[str, Any]) -> None:
    config = centre_config({"sources": {"r1": {"coverage": coverage}}, "source_defaults": {"coverage": coverage}})
    assert config.source("r1").coverage is not None
    assert recordable(config) is not None
    again = centre_config(nested(plain_settings(config)))
    assert again == config
    assert config_hash(again) == config_hash(config)


@pytest.mark.parametrize(
    "table",
    [
        {"coverage": {"kind": "square"}},
        {"coverage": {"kind": "disk", "radius": -1.0}},
        {"coverage": {"kind": "polygon", "points": [[0, 0], [1, 1]]}},
        {"coverage": 3},
        {"detection_probability": 1.5},
        {"initiation_delay": -1},
        {"stale": 0},
        {"inflation": 0},
        {"covariance_floor": -3},
    ],
)
def test_what_no_source_can_be_is_an_error_of_the_config(table: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"sources.r1.{next(iter(table))}"):
        centre_config({"sources": {"r1": table}})


def with_sources(sources: dict[str, Any]) -> FusionCentre:
    made = FusionCentre({"lateness": 3.0, "publish": "mean", "sources": sources})
    give(made, info("r1"), info("r2"))
    return made


def test_floor_and_inflation_widen_what_a_source_says() -> None:
    made = with_sources({"r1": {"covariance_floor": 40.0, "inflation": 4.0}})
    give(made, tracks("r1", 1, truth(1)), tracks("r2", 1, truth(1) + 50_000.0))
    result = step(made, 1).tracks
    wide, plain = np.diag([30.0**2, 30.0**2, 4.0, 4.0]) * 4 + np.diag([1600.0, 1600.0, 0, 0]), [900.0, 900.0, 4.0, 4.0]
    near = int(np.abs(result.means[:, 0] - truth(1)[0, 0]).argmin())
    np.testing.assert_allclose(result.covariances[near], wide, rtol=1e-12)
    np.testing.assert_allclose(result.covariances[1 - near], np.diag(plain), rtol=1e-12)


def test_a_mixture_is_widened_in_each_component() -> None:
    made = with_sources({"r1": {"covariance_floor": 40.0, "inflation": 2.0}})
    message = tracks("r1", 1, np.array([[0.0, 0, 0, 0], [300.0, 0, 0, 0]]), [7, 8])
    counts, weights = np.array([2], np.uint16), np.array([0.25, 0.75])
    give(made, dataclasses.replace(message, ids=message.ids[:1], counts=counts, weights=weights))
    result = step(made, 1).tracks
    # mean 225 m; variance along x: within, 2 * 900 + 1600, and between, .25 * 225^2 + .75 * 75^2
    np.testing.assert_allclose(result.means[0, 0], 225.0)
    np.testing.assert_allclose(result.covariances[0, 0, 0], 2 * 900 + 1600 + 0.25 * 225**2 + 0.75 * 75**2)
    np.testing.assert_allclose(result.covariances[0, 2, 2], 2 * 4.0)
