"""Dashboard and alerts ask for figures that there are, and Prometheus' own tool finds nothing wrong with them."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from fusion_service.commands.observed import PORTS
from fusion_service.monitoring import METRICS

DEPLOY = Path(__file__).parents[2] / "deploy"
RULES = DEPLOY / "prometheus" / "rules.yaml"
PROMTOOL = os.environ.get("PROMTOOL") or shutil.which("promtool")
OF_OTHERS = {"up", "ALERTS", "process_cpu_seconds_total", "process_resident_memory_bytes"}


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((DEPLOY / "grafana" / "dashboard.json").read_text("utf-8"))["panels"]
    return found


def rules() -> list[dict[str, Any]]:
    (group,) = yaml.safe_load(RULES.read_text("utf-8"))["groups"]
    found: list[dict[str, Any]] = group["rules"]
    return found


def expressions() -> Iterator[str]:
    yield from (target["expr"] for one in panels() for target in one.get("targets", ()))
    yield from (rule["expr"] for rule in rules())


def asked(expression: str) -> dict[str, set[str]]:
    """The figures that an expression asks for, and the labels that it picks of each."""
    found: dict[str, set[str]] = {}
    for name, _, matchers in re.findall(r"\b(fusion_\w+|process_\w+|up\b|ALERTS\b)(\{([^}]*)\})?", expression):
        found.setdefault(name, set()).update(re.findall(r"(\w+)\s*(?:=~|!~|!=|=)", matchers))
    return found


def test_every_figure_that_is_asked_for_is_served() -> None:
    seen = set()
    for expression in expressions():
        figures = asked(expression)
        assert figures, expression
        for name, labels in figures.items():
            assert name in METRICS or name in OF_OTHERS, expression
            if name in METRICS:
                assert labels <= set(METRICS[name].labels), expression
        seen |= set(figures)
    assert len(seen & set(METRICS)) > 30


def test_counters_are_asked_for_their_growth_and_gauges_are_not() -> None:
    for expression in expressions():
        growing = set(re.findall(r"(?:rate|increase)\(\s*(\w+)", expression))
        for name in asked(expression):
            assert (name in growing) == name.endswith("_total"), expression


def test_the_dashboard_is_what_its_maker_makes() -> None:
    made = runpy.run_path(str(DEPLOY / "grafana" / "make.py"))["dashboard"]()
    assert json.loads((DEPLOY / "grafana" / "dashboard.json").read_text("utf-8")) == made
    numbers = [one["id"] for one in panels()]
    assert len(set(numbers)) == len(numbers)
    places = [{(x, y) for x in range(p["x"], p["x"] + p["w"]) for y in range(p["y"], p["y"] + p["h"])}
              for p in (one["gridPos"] for one in panels())]  # fmt: skip
    assert sum(map(len, places)) == len(set().union(*places))  # none lies on another
    assert max(x for place in places for x, _ in place) < 24


def test_every_alert_says_what_and_what_to_do() -> None:
    page = (DEPLOY.parent / "docs" / "monitoring.md").read_text("utf-8")
    for rule in rules():
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert set(rule["annotations"]) == {"summary", "action"}
        assert f"`{rule['alert']}`" in page
        for path in re.findall(r"docs/[\w./-]+\.md", rule["annotations"]["action"]):
            assert (DEPLOY.parent / path).exists()


def test_every_figure_is_documented() -> None:
    page = (DEPLOY.parent / "docs" / "monitoring.md").read_text("utf-8")
    told = set(re.findall(r"^\| `(fusion_\w+)`", page, re.M))
    assert told == set(METRICS)
    for name, metric in METRICS.items():
        labels = ", ".join(metric.labels)
        assert f"| `{name}` | {labels} | {metric.help} |" in page


def test_prometheus_asks_where_processes_serve() -> None:
    config = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yaml").read_text("utf-8"))
    (job,) = config["scrape_configs"]
    (group,) = job["static_configs"]
    assert set(group["targets"]) == {f"127.0.0.1:{PORTS[name]}" for name in ("hub", "recorder", "metrics")}


@pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed (Debian: prometheus; or PROMTOOL names it)")
def test_promtool_finds_nothing_wrong_and_every_alert_fires_when_it_should() -> None:
    folder = DEPLOY / "prometheus"
    for words in (["check", "config", "prometheus.yaml"], ["test", "rules", "rules_test.yaml"]):
        done = subprocess.run([str(PROMTOOL), *words], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    tested = (folder / "rules_test.yaml").read_text("utf-8")
    assert {rule["alert"] for rule in rules()} <= set(re.findall(r"Fusion\w+", tested))
