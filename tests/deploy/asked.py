"""Asks a real Prometheus every question of the dashboard, beside a running mission, and draws the answers:
`python -m tests.deploy.asked [--seconds 90] [--out docs/pictures/dashboard.png]`.

Prometheus' own program is needed (Debian: prometheus; or PROMETHEUS names it). Ends with 1 where a question is refused,
or has no answer though there should be one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.helpers.processes import Program, eventually, free_endpoint
from tests.helpers.scene import COMMAND, SENSOR

ROOT = Path(__file__).parents[2]
QUIET = ("Not trusted", "Lost to load")
"""Panels that are empty when all is well."""
LATE = """
import sys, time
import numpy as np
from schemas import Enu
from sensor_clients.publisher import TrackPublisher
with TrackPublisher("radar3", connect=sys.argv[1]) as publisher:
    while True:
        publisher.tracks(time=time.time_ns() - 60 * 10**9, space=("x", "y", "vx", "vy"), frame=Enu(59.0, -55.0),
                         ids=[1], means=np.zeros((1, 4)), covariances=np.eye(4)[None])
        time.sleep(1.0)
"""
"""A source whose tracks are a minute old when they come."""
CENTRE = """
[centre]
period = 0.5
delay = 0.2
coast = 3.0
[bus]
connect = ["{endpoint}"]
[service]
state = "{folder}/state"
"""
SCRAPE = """
global: {{scrape_interval: 1s, evaluation_interval: 1s}}
rule_files: ["{rules}"]
scrape_configs: [{{job_name: fusion, static_configs: [{{targets: {targets}}}]}}]
"""


def answers(address: str, expression: str, begin: float, end: float) -> list[dict[str, Any]]:
    """Of a question, over a time. Raises what urllib does where it is refused."""
    plain = expression.replace("$centre", ".*").replace("$__rate_interval", "10s")
    query = urllib.parse.urlencode({"query": plain, "start": begin, "end": end, "step": 1})
    with urllib.request.urlopen(f"http://{address}/api/v1/query_range?{query}", timeout=30) as answer:
        found: list[dict[str, Any]] = json.load(answer)["data"]["result"]
        return found


def fly(seconds: float, prometheus: str) -> list[tuple[dict[str, Any], list[list[dict[str, Any]]]]]:
    """A mission in which a source goes after two thirds; each panel with the answers to its questions."""
    panels = json.loads((ROOT / "deploy/grafana/dashboard.json").read_text("utf-8"))["panels"]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        endpoint, web, *ports = (free_endpoint().removeprefix("tcp/") for _ in range(5))
        endpoint = f"tcp/{endpoint}"
        (folder / "centre.toml").write_text(CENTRE.format(endpoint=endpoint, folder=folder))
        rules = ROOT / "deploy/prometheus/rules.yaml"
        (folder / "prometheus.yaml").write_text(SCRAPE.format(rules=rules, targets=json.dumps(ports)))
        for words in (
            ["hub", "--listen", endpoint, "--metrics", ports[0]],
            ["run", "--config", f"{folder}/centre.toml"],
            ["record", "--out", f"{folder}/mission/", "--connect", endpoint, "--metrics", ports[1]],
            ["metrics", "--connect", endpoint, "--listen", ports[2]],
        ):
            stack.enter_context(Program(COMMAND, *words))
        stack.enter_context(Program(SENSOR, endpoint, "radar1", "given", "0", "1", "2"))
        stack.enter_context(Program(LATE, endpoint))
        other = stack.enter_context(Program(SENSOR, endpoint, "radar2", "reversed", "1", "2", "3"))
        line = [prometheus, f"--config.file={folder}/prometheus.yaml", f"--storage.tsdb.path={folder}/data"]
        with (folder / "prometheus.log").open("wb") as log:
            server = subprocess.Popen([*line, f"--web.listen-address={web}"], stderr=log, stdout=log)
        stack.callback(server.wait)
        stack.callback(server.terminate)

        def stepping() -> bool:
            try:
                return bool(answers(web, 'fusion_tracks{status="confirmed"} >= 4', time.time() - 5, time.time()))
            except OSError:
                assert server.poll() is None, (folder / "prometheus.log").read_text()
                return False

        eventually(stepping, 120.0)
        begin = time.time()
        time.sleep(seconds * 2 / 3)
        other.kill()
        time.sleep(seconds / 3)
        return [
            (panel, [answers(web, one["expr"], begin, time.time()) for one in panel["targets"]])
            for panel in panels
            if panel["type"] != "row"
        ]


def draw(asked: list[tuple[dict[str, Any], list[list[dict[str, Any]]]]], out: Path) -> None:
    """Each panel at its place, as lines over the time; of numbers the newest."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    height = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel, _ in asked)
    figure = plt.figure(figsize=(20, height * 0.36))
    for panel, results in asked:
        place = panel["gridPos"]
        axes = figure.add_axes(
            (place["x"] / 24 + 0.02, 1 - (place["y"] + place["h"] - 0.9) / height, place["w"] / 24 - 0.03,
             (place["h"] - 2.1) / height)
        )  # fmt: skip
        axes.set_title(f"{panel['title']} ({panel['fieldConfig']['defaults']['unit']})", fontsize=9, loc="left")
        axes.tick_params(labelsize=7)
        series = [
            (one["legendFormat"], row) for one, rows in zip(panel["targets"], results, strict=True) for row in rows
        ]
        if panel["type"] == "stat":
            axes.axis("off")
            values = [f"{float(row['values'][-1][1]):.4g}" for _, row in series]
            axes.text(0.0, 0.4, "  ".join(values) or "-", fontsize=16)
            continue
        for legend, row in series:
            name = legend
            for key, value in row["metric"].items():
                name = name.replace(f"{{{{{key}}}}}", value)
            begin = row["values"][0][0]
            times = [at - begin for at, _ in row["values"]]
            axes.plot(times, [float(value) for _, value in row["values"]], label=name[:40], lw=1)
        if series and place["w"] < 24:
            axes.legend(fontsize=6, frameon=False)
    figure.savefig(out, dpi=70)


def main() -> int:
    """0 where every question has an answer."""
    parser = argparse.ArgumentParser(prog="python -m tests.deploy.asked", description=__doc__)
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--out", type=Path, help="a drawing of the answers")
    arguments = parser.parse_args()
    prometheus = os.environ.get("PROMETHEUS") or shutil.which("prometheus")
    if prometheus is None:
        print("prometheus is not installed (Debian: prometheus; or PROMETHEUS names it)", file=sys.stderr)
        return 1
    asked = fly(arguments.seconds, prometheus)
    empty = [p["title"] for p, results in asked if not all(results) and p["title"] not in QUIET]
    questions = sum(len(panel["targets"]) for panel, _ in asked)
    print(f"{questions} questions in {len(asked)} panels; without an answer: {', '.join(empty) or 'none'}")
    if arguments.out is not None:
        draw(asked, arguments.out)
    return bool(empty)


if __name__ == "__main__":
    raise SystemExit(main())
