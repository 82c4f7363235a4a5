"""What is declared of the correlation of sources, as the centre fuses by it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusion_service.centre import FusionCentre
from fusion_service.config import centre_config, config_hash
from fusion_service.config.settings import nested, plain_settings, recordable
from fusion_service.rules import fuse
from tests.centre.worlds import give, info, step, tracks

TABLE: dict[str, Any] = {"between": 0.2, "pairs": [{"groups": ["nav", "shore"], "bound": 0.5}]}
SIGMAS = {
    "a": np.array([30.0, 20.0, 2.0, 3.0]),
    "b": np.array([20.0, 40.0, 3.0, 1.0]),
    "c": np.array([35.0, 35.0, 1.0, 2.0]),
}
PLACE = np.array([[100.0, 200.0, 3.0, 4.0]])


def fused(groups: dict[str, str | None], sources: dict[str, Any] | None = None, **options: Any) -> Any:
    """The covariance of a target that a, b and c see, and of one that a and c see."""
    table = {"max_correlation": {**TABLE, **options}}
    made = FusionCentre({"rule": "bci", "rule_options": table, "sources": sources or {}})
    far = PLACE + np.array([50_000.0, 0.0, 0.0, 0.0])
    for name, sigma in SIGMAS.items():
        give(made, info(name, correlation_group=groups.get(name)))
        seen = PLACE if name == "b" else np.concatenate([PLACE, far])
        give(made, tracks(name, 0.0, seen, sigma=sigma))
    result = step(made, 0.0).tracks
    order = np.argsort(result.means[:, 0])
    assert result.means[order, 0] == pytest.approx([PLACE[0, 0], far[0, 0]])
    return result.covariances[order]


def wanted(names: str, R: list[list[float]]) -> Any:
    P = np.stack([np.diag(SIGMAS[name] ** 2) for name in names])
    return fuse("bci", np.zeros((1, *P.shape[:2])), P[None], max_correlation=np.array([R])).covariance[0]


def test_bounds_between_the_groups_that_sources_declare() -> None:
    whole = fused({"a": "nav", "b": "nav", "c": "shore"})
    three = wanted("abc", [[1, 1, 0.5], [1, 1, 0.5], [0.5, 0.5, 1]])
    np.testing.assert_allclose(whole[0], three, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(whole[1], wanted("ac", [[1, 0.5], [0.5, 1]]), rtol=1e-9, atol=1e-9)
    apart = fused({})
    np.testing.assert_allclose(apart[1], wanted("ac", [[1, 0.2], [0.2, 1]]), rtol=1e-9, atol=1e-9)
    assert np.trace(apart[0]) < np.trace(whole[0])


def test_the_config_gives_a_group_to_a_source_that_names_none_and_with_override_to_any() -> None:
    told = {"a": {"correlation_group": "nav"}, "c": {"correlation_group": "shore"}}
    whole = fused({"a": "nav", "c": "shore"})
    np.testing.assert_array_equal(fused({}, told), whole)
    np.testing.assert_array_equal(fused({"a": "nav", "c": "shore"}, {"c": {"correlation_group": "nav"}}), whole)
    other = fused({"a": "nav", "c": "shore"}, {"c": {"correlation_group": "nav", "override": True}})
    np.testing.assert_allclose(other[1], wanted("ac", [[1, 1], [1, 1]]), rtol=1e-9, atol=1e-9)


def test_a_source_without_a_group_is_one_named_as_itself() -> None:
    pairs = [{"groups": ["c", "a"], "bound": 0.7}]
    np.testing.assert_allclose(fused({}, pairs=pairs)[1], wanted("ac", [[1, 0.7], [0.7, 1]]), rtol=1e-9, atol=1e-9)


def test_bounds_are_in_the_step_log_and_come_back() -> None:
    config = centre_config({"rule": "bci", "rule_options": {"max_correlation": TABLE}})
    recorded = recordable(config)
    assert recorded is not None
    assert config_hash(centre_config(nested(recorded))) == config_hash(config)
    assert plain_settings(config)["rule_options.max_correlation.pairs"] == [["nav", "shore", 0.5]]
