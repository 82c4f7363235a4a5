"""What becomes of a status: names that are known, labels that are bounded, and nothing that a scrape would refuse."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from fusion_service.monitoring import METRICS, Sample, Serving, process_samples, status_samples
from fusion_service.monitoring.figures import MOST_NAMED
from schemas import Status

SOURCE: dict[str, Any] = {
    "alive": True, "stale": False, "muted": False, "last": 10**18, "offset": 0.1, "messages": 7, "repeats": 1,
    "gaps": 2, "reordered": 3, "tracks": 4, "refused": {"late": 5}, "rate": 1.5, "declared_period": 1.0, "clock": -0.5,
    "state": "inflated", "doubts": ["one"],
    "last_refusal": {"reason": "late", "time": 10**18, "count": 5, "said": "x", "field": "time", "value": "1"},
}  # fmt: skip


def status(sources: dict[str, dict[str, Any]] | None = None, **more: Any) -> Status:
    given: dict[str, Any] = {
        "source": "centre", "epoch": 1, "seq": 0, "sent": 10**18, "time": 10**18, "step": 9, "uptime": 3.0,
        "rates": {"messages": 2.0, "bytes": 200.0, "steps": 1.0},
        "queue": {"waiting": 1, "capacity": 10, "high_water": 2, "pending": 0, "missed": 0, "overtaken": 0},
        "refused": {"late": 5, "version": 1}, "dropped": {"r1": 2}, "tracks": {"confirmed": 3, "tentative": 1},
        "step_time": {"last": 0.1, "max": 0.2, "mean": 0.1, "failed": 0.0, "unsaved": 0.0, "skipped": 0.0,
                      "behind": 0.0, "latency": 0.5, "busy": 2.0, "overload": 3.0, "failed_turns": 1.0},
        "memory": 10**8, "notes": ("a note",), "road": "numpy", "term": 5, "standby": {"there": 1, "ready": 1},
        "sources": {"r1": SOURCE} if sources is None else sources,
    }  # fmt: skip
    return Status(**{**given, **more})


def served(one: Status) -> list[Any]:
    """The families as Prometheus reads them, of all that is told."""
    text, kind = Serving(lambda: [*process_samples("service", ""), *status_samples(one)]).text("")
    assert kind.startswith("text/plain")
    return [family for family in text_string_to_metric_families(text.decode()) if family.name.startswith("fusion_")]


def test_names_follow_the_conventions() -> None:
    units = ("_seconds", "_bytes", "_messages", "_total", "_info", "_per_second")
    plain = {
        *("ready", "step_number", "tracks", "notes", "term", "standby", "sources", "sources_alive", "sources_unnamed"),
        *(
            "source_alive",
            "source_stale",
            "source_muted",
            "source_state",
            "source_tracks",
            "source_doubts",
            "hub_links",
        ),
    }
    for name, metric in METRICS.items():
        assert re.fullmatch(r"fusion_[a-z_]+", name)
        assert (metric.kind == "counter") == name.endswith("_total"), name
        assert name.endswith(units) or name.removeprefix("fusion_") in plain, name
        assert metric.help
        assert not metric.help.endswith(".")


def test_every_figure_of_a_status_is_served() -> None:
    families = {family.name: family for family in served(status())}
    ours = {name.removesuffix("_total") for name, metric in METRICS.items() if "centre" in metric.labels}
    assert set(families) == {*ours, "fusion_build_info", "fusion_ready"}
    values = {
        (one.name, *(one.labels[name] for name in METRICS[one.name].labels)): one.value
        for family in families.values()
        for one in family.samples
    }
    assert values["fusion_tracks", "centre", "confirmed"] == 3.0
    assert values["fusion_refused_total", "centre", "late"] == 5.0
    assert values["fusion_source_clock_ahead_seconds", "centre", "r1"] == -0.5
    assert values["fusion_source_state", "centre", "r1", "inflated"] == 1.0
    assert values["fusion_source_refusal_timestamp_seconds", "centre", "r1", "late"] == 1e9
    assert values["fusion_status_timestamp_seconds", "centre"] == 1e9
    assert values["fusion_sources_alive", "centre"] == 1.0


@pytest.mark.parametrize(
    "name", ['a"b', "a\\", "a\nb", "}\n# TYPE x counter", "é\u202e", "\ud800", "x" * 500, "", "{}", "NaN 1 2"]
)
def test_hostile_names_are_labels_and_nothing_else(name: str) -> None:
    said = served(status({name: SOURCE, name + "x": SOURCE, "x" * 64: SOURCE}, refused={name: 3}, dropped={name: 1}))
    assert {family.name for family in said} <= {one.removesuffix("_total") for one in METRICS}
    for family in said:
        keys = [tuple(sorted(one.labels.items())) for one in family.samples]
        assert len(set(keys)) == len(keys), family.name  # two of the same make Prometheus refuse all


@pytest.mark.parametrize("value", ["7", None, math.nan, math.inf, 10**400, [], {}, b"", True])
def test_what_is_no_number_is_left_out(value: Any) -> None:
    bad = {**dict.fromkeys(SOURCE, value), "last_refusal": value}
    one = status({"r1": bad, "*": {"more": value}}, standby={"there": value}, queue={"waiting": value})
    for family in served(one):
        assert all(math.isfinite(sample.value) for sample in family.samples)
    assert {"fusion_sources", "fusion_tracks"} <= {family.name for family in served(one)}


def test_names_are_bounded_and_the_rest_is_counted() -> None:
    many = {f"r{number}": SOURCE for number in range(MOST_NAMED + 50)}
    said = list(status_samples(status({**many, "*": {"more": 7}}, refused={f"w{n}": 1 for n in range(500)})))
    assert sum(one.name == "fusion_source_tracks" for one in said) == MOST_NAMED
    assert sum(one.name == "fusion_refused_total" for one in said) == 100
    assert Sample("fusion_sources_unnamed", ("centre",), 57.0) in said
    assert Sample("fusion_sources", ("centre",), MOST_NAMED + 57.0) in said


def test_a_service_that_has_done_nothing_yet_is_told() -> None:
    empty = replace(
        status({}), rates={}, queue={}, refused={}, dropped={}, tracks={}, step_time={}, memory=None, notes=None,
        road=None, term=None, standby=None,
    )  # fmt: skip
    values = {one.name: one.value for one in status_samples(empty)}
    assert values["fusion_sources"] == values["fusion_overload_seconds"] == values["fusion_busy_seconds"] == 0.0
