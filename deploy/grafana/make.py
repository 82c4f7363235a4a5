"""Makes dashboard.json, beside this file: `python deploy/grafana/make.py`. A panel a line; Grafana 9 or newer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["dashboard", "main"]

OUT = Path(__file__).with_name("dashboard.json")
SOURCE = {"type": "prometheus", "uid": "${datasource}"}
WIDTH = 24
SHORT = {"@": '{centre=~"$centre"}', "@,": '{centre=~"$centre",', "[R]": "[$__rate_interval]"}
"""What stands for what in `PANELS`."""
PANELS = """
# Now
Ready | stat | bool_yes_no | 3
  fusion_ready -> {{instance}}
Status, age | stat | s | 3
  time() - fusion_status_timestamp_seconds@ -> {{centre}}
Confirmed tracks | stat | none | 3
  fusion_tracks@,status="confirmed"} -> {{centre}}
Sources there | stat | none | 3
  fusion_sources_alive@ -> {{centre}}
Sources away | stat | none | 3
  fusion_sources@ - fusion_sources_alive@ -> {{centre}}
Overload | stat | s | 3
  fusion_overload_seconds@ -> {{centre}}
Stand by, ready | stat | none | 3
  fusion_standby@,state="ready"} -> {{centre}}
Notes | stat | none | 3
  fusion_notes@ -> {{centre}}
# Picture
Global tracks | timeseries | none | 8
  fusion_tracks@ -> {{centre}} {{status}}
Age of the picture when it goes out | timeseries | s | 8
  fusion_picture_latency_seconds@ -> {{centre}}
Time of a step | timeseries | s | 8
  fusion_step_last_seconds@ -> {{centre}} last
  fusion_step_mean_seconds@ -> {{centre}} mean
# Load
Messages in | timeseries | cps | 6
  fusion_received_messages_per_second@ -> {{centre}}
Bytes in | timeseries | Bps | 6
  fusion_received_bytes_per_second@ -> {{centre}}
Waiting | timeseries | none | 6
  fusion_queue_messages@ -> {{centre}} queue
  fusion_pending_messages@ -> {{centre}} for their step
Lost to load | timeseries | cps | 6
  rate(fusion_steps_skipped_total@[R]) -> {{centre}} steps skipped
  rate(fusion_overtaken_scans_total@[R]) -> {{centre}} scans overtaken
  sum by (centre) (rate(fusion_dropped_total@[R])) -> {{centre}} messages dropped
  rate(fusion_missed_messages_total@[R]) -> {{centre}} missed on the bus
# Sources
There (1), silent or gone (0) | state-timeline | none | 12
  fusion_source_alive@ * (1 - fusion_source_stale@) -> {{source}}
Refused | timeseries | cps | 12
  rate(fusion_source_refused_total@[R]) -> {{source}} {{reason}}
Rate | timeseries | cps | 6
  fusion_source_rate_per_second@ -> {{source}}
Clock ahead of the centre's | timeseries | s | 6
  fusion_source_clock_ahead_seconds@ -> {{source}}
Local tracks | timeseries | none | 6
  fusion_source_tracks@ -> {{source}}
Lost on the way | timeseries | cps | 6
  rate(fusion_source_lost_total@[R]) -> {{source}}
Not trusted | table | none | 24
  fusion_source_state@,state!="trusted"} == 1 ->
# Recorder and processes
Recorded | timeseries | Bps | 6
  rate(fusion_recorder_bytes_total[R]) -> {{instance}}
Disk free | timeseries | bytes | 6
  fusion_recorder_disk_free_bytes -> {{instance}}
Processor | timeseries | percentunit | 4
  rate(process_cpu_seconds_total[R]) * on (instance) group_left (process) fusion_build_info -> {{process}} {{instance}}
Memory | timeseries | bytes | 4
  process_resident_memory_bytes * on (instance) group_left (process) fusion_build_info -> {{process}} {{instance}}
  fusion_memory_max_bytes@ -> {{centre}} at most
Connections of the hub | timeseries | none | 4
  fusion_hub_links -> {{instance}}
"""
"""# a row; title | kind | unit | width of 24; and below it each series, -> its legend."""


class Panel(NamedTuple):
    title: str
    kind: str
    unit: str
    width: int
    series: list[tuple[str, str]]


def rows() -> Iterator[tuple[str, list[Panel]]]:
    """`PANELS`, row by row."""
    for part in PANELS.split("\n# ")[1:]:
        title, *lines = part.strip().split("\n")
        panels: list[Panel] = []
        for line in lines:
            if not line.startswith("  "):
                name, kind, unit, width = line.split(" | ")
                panels.append(Panel(name, kind, unit, int(width), []))
                continue
            expression, _, legend = line.strip().partition(" ->")
            for short in ("@,", "@", "[R]"):
                expression = expression.replace(short, SHORT[short])
            panels[-1].series.append((expression, legend.strip()))
        yield title, panels


def panel(number: int, place: dict[str, int], one: Panel) -> dict[str, Any]:
    """A panel of Grafana."""
    kind = one.kind
    targets = [
        {
            "datasource": SOURCE, "editorMode": "code", "expr": expression, "legendFormat": legend or "__auto",
            "refId": chr(ord("A") + k), "instant": kind in ("stat", "table"), "range": kind not in ("stat", "table"),
            **({"format": "table"} if kind == "table" else {}),
        }
        for k, (expression, legend) in enumerate(one.series)
    ]  # fmt: skip
    defaults: dict[str, Any] = {"unit": one.unit, "color": {"mode": "palette-classic"}}
    if kind == "timeseries":
        defaults["custom"] = {"lineWidth": 1, "fillOpacity": 5, "showPoints": "never", "spanNulls": False}
    return {
        "id": number, "type": kind, "title": one.title, "gridPos": place, "datasource": SOURCE, "targets": targets,
        "fieldConfig": {"defaults": defaults, "overrides": []},
        "options": {"legend": {"displayMode": "list", "placement": "bottom"}} if kind == "timeseries" else {},
    }  # fmt: skip


def dashboard() -> dict[str, Any]:
    """The whole of it."""
    panels: list[dict[str, Any]] = []
    top = 0
    for title, row in rows():
        place = {"x": 0, "y": top, "w": WIDTH, "h": 1}
        panels.append(
            {"id": len(panels) + 1, "type": "row", "title": title, "collapsed": False, "gridPos": place, "panels": []}
        )
        top, left = top + 1, 0
        height = 4 if row[0].kind == "stat" else 8
        for one in row:
            if left + one.width > WIDTH:
                top, left = top + height, 0
            panels.append(panel(len(panels) + 1, {"x": left, "y": top, "w": one.width, "h": height}, one))
            left += one.width
        top += height
    variables = [
        {"name": "datasource", "type": "datasource", "query": "prometheus", "label": "Prometheus"},
        {
            "name": "centre", "type": "query", "label": "Centre", "datasource": SOURCE, "refresh": 2, "multi": True,
            "includeAll": True, "allValue": ".*", "current": {"text": "All", "value": "$__all"},
            "query": {"query": "label_values(fusion_status_timestamp_seconds, centre)", "refId": "centre"},
        },
    ]  # fmt: skip
    return {
        "uid": "track-fusion", "title": "Track fusion", "tags": ["track-fusion"], "schemaVersion": 38, "version": 1,
        "editable": True, "refresh": "10s", "time": {"from": "now-1h", "to": "now"}, "timezone": "utc",
        "templating": {"list": variables}, "panels": panels, "annotations": {"list": []}, "links": [],
    }  # fmt: skip


def main() -> None:
    """Write it."""
    OUT.write_text(json.dumps(dashboard(), indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
