"""The image, the compose file and its config, as far as they can be checked without a container engine."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from fusion_service import cli, demo
from fusion_service.config import centre_config, load_config
from fusion_service.recording import default_path
from sensor_clients import cli as client_cli
from sensor_clients.scenarios.three_radars import three_radars
from tests.helpers.processes import Hub

ROOT = Path(__file__).parents[1]
DOCKER = ROOT / "docker"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PARSERS = {"fusion-service": cli._parser(), "sensor-client": client_cli._parser()}


def parse_yaml(text: str) -> Any:
    """The part of YAML that compose.yaml keeps to: block maps, block lists of scalars, lists as one line of
    JSON, an anchor on a map and `<<: *anchor`, whole-line comments. Anything else fails or stays text."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    anchors: dict[str, Any] = {}

    def indent() -> int:
        return len(lines[0]) - len(lines[0].lstrip()) if lines else -1

    def scalar(value: str) -> Any:
        return json.loads(value) if value[0] in '["' or value in ("true", "false") else value

    def block(depth: int) -> Any:
        if lines[0].lstrip().startswith("- "):
            items = []
            while indent() == depth:
                dash, _, item = lines.pop(0).strip().partition(" ")
                assert dash == "-"
                items.append(item)
            return items
        table: dict[str, Any] = {}
        while indent() == depth:
            found = re.fullmatch(r"\s*([\w<.-]+):(?: &([\w-]+))?(?: ([^&].*))?", line := lines.pop(0))
            assert found, f"not in the part of YAML that is read here: {line}"
            key, anchor, value = found.groups()
            if key == "<<":
                table = {**anchors[value.removeprefix("*")], **table}
                continue
            assert value or anchor or key not in table
            table[key] = scalar(value) if value else block(indent()) if indent() > depth else None
            if anchor:
                anchors[anchor] = table[key]
        assert indent() < depth, f"bad indentation: {lines[0]}"
        return table

    return block(0)


COMPOSE = parse_yaml((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
CLIENTS = {name: one for name, one in SERVICES.items() if one["command"].startswith("sensor-client ")}


def command(name: str, environment: dict[str, str]) -> list[str]:
    """A service's command as Compose makes it: ${NAME:-default}, ${NAME:+replacement}, then words."""
    text = re.sub(r"\$\{(\w+):-([^{}]*)\}", lambda m: environment.get(m[1]) or m[2], SERVICES[name]["command"])
    text = re.sub(r"\$\{(\w+):\+([^{}]*)\}", lambda m: m[2] if environment.get(m[1]) else "", text)
    assert "$" not in text
    return shlex.split(text)


def arguments(name: str, **environment: str) -> Any:
    program, *rest = command(name, environment)
    return PARSERS[program].parse_args(rest)


@pytest.mark.parametrize("environment", [{}, {"SPEED": "10", "SEED": "3", "START_AT": "1767225600"}])
@pytest.mark.parametrize("name", SERVICES)
def test_every_command_is_one_of_ours(name: str, environment: dict[str, str]) -> None:
    options = arguments(name, **environment)
    if name in CLIENTS:
        assert options.sensor == name
        expected = (10.0, 3, 1767225600.0) if environment else (1.0, 1, None)
        assert (options.speed, options.seed, options.start_at) == expected


def test_the_whole_scenario_is_there() -> None:
    assert set(CLIENTS) == {*three_radars().sensors, "truth"}
    assert set(SERVICES) - set(CLIENTS) == {"hub", "service", "record", "metrics"}
    assert all(arguments(name).scenario == "three-radars" for name in CLIENTS)


def test_all_join_the_hub_on_a_network_without_a_way_out() -> None:
    (listen,) = arguments("hub").listen
    endpoint = f"tcp/hub:{listen.rpartition(':')[2]}"
    assert listen.startswith("tcp/0.0.0.0:")
    assert all(arguments(name).connect == [endpoint] for name in CLIENTS)
    assert arguments("record").connect == arguments("metrics").connect == [endpoint]
    assert load_config(DOCKER / "centre.toml").bus.connect == (endpoint,)
    for name, one in SERVICES.items():
        assert one.get("ports", []) == (["127.0.0.1:9467:9467"] if name == "metrics" else [])
        assert one["networks"] == (["bus", "watch"] if name == "metrics" else ["bus"])
    assert COMPOSE["networks"]["bus"]["internal"] is True


def test_health_is_asked_where_it_is_served() -> None:
    """Within the container, by HTTP: each session that asked over the bus would leave some KiB in the hub."""
    for name in set(SERVICES) - set(CLIENTS):
        options = arguments(name)
        host, port = options.listen if name == "metrics" else options.metrics
        *words, code = SERVICES[name]["healthcheck"]["test"]
        assert words == ["CMD", "python", "-c"]
        assert host == "0.0.0.0"
        path = "readyz" if name in ("hub", "service") else "healthz"
        assert f"http://127.0.0.1:{port}/{path}" in code
        compile(code, name, "exec")


def test_no_process_is_root_or_may_become_it() -> None:
    uid = re.findall(r"^USER (\S+)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    for one in SERVICES.values():
        assert [one["user"]] == uid
        assert (one["read_only"], one["cap_drop"], one["security_opt"]) == (True, ["ALL"], ["no-new-privileges:true"])


def test_a_client_that_is_done_stays_away_and_the_rest_comes_back() -> None:
    for name, one in SERVICES.items():
        assert one["restart"] == ("on-failure" if name in CLIENTS else "unless-stopped")


def test_what_must_survive_a_container_is_on_a_volume() -> None:
    (home,) = re.findall(r"^WORKDIR (/data)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    config = Path(arguments("service").config)
    state = load_config(DOCKER / "centre.toml").service.state
    mounted = {name: dict(v.split(":")[:2][::-1] for v in SERVICES[name]["volumes"]) for name in ("service", "record")}
    assert mounted == {
        "service": {str(config): "./centre.toml", state: "state"},
        "record": {f"{home}/{default_path().parent}": "recordings"},
    }
    assert arguments("record").out is None  # with a fixed name, the second start would find the file there
    assert set(COMPOSE["volumes"]) == {"state", "recordings"}


def test_the_example_config_is_the_demos(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(DOCKER / "centre.toml")
    assert cli.main(["check", path]) == 0
    assert f"{path}: good" in capsys.readouterr().out
    wanted = centre_config({"clock": "message", "rule": "ci", "lateness": 15.0, **tomllib.loads(demo.THREE_RADARS)})
    assert load_config(path).centre == wanted


def copied() -> set[str]:
    """What the Dockerfile copies from the context."""
    instructions = re.findall(r"^COPY (?!--from)(.+)$", (DOCKER / "Dockerfile").read_text(), re.MULTILINE)
    return {source for instruction in instructions for source in instruction.split()[:-1]}


def test_the_image_gets_what_the_wheel_needs_and_no_more() -> None:
    project = PROJECT["project"]
    packages = set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    licences = {one for one in project["license-files"] if one.split("/")[0] not in packages}
    needed = {"pyproject.toml", project["readme"], *licences, *packages}
    assert copied() == needed | {
        f"docker/{name}" for name in ("build.txt", "health.py", "requirements.txt", "sbom.json")
    }
    assert all((ROOT / source).exists() for source in copied())
    lines = (ROOT / ".dockerignore").read_text().splitlines()[1:]
    assert lines == ["*", *(line for line in lines if line.startswith("!")), "**/__pycache__"]
    assert {line[1:] for line in lines[1:-1]} == copied()


def test_health_follows_the_service(hub: Hub, tmp_path: Path) -> None:
    config = tmp_path / "centre.toml"
    config.write_text(f'[bus]\nconnect = ["{hub.endpoint}"]\n[service]\nstatus_period = 0.2\n')

    def health() -> tuple[int, str]:
        check = [sys.executable, "-W", "error", str(DOCKER / "health.py"), hub.endpoint]
        done = subprocess.run(check, capture_output=True, text=True, timeout=30)
        return done.returncode, done.stdout

    assert health() == (1, "no status of centre within 3 s\n")
    run = [sys.executable, "-m", "fusion_service", "run", "--config", str(config)]
    service = subprocess.Popen(run, stderr=subprocess.DEVNULL)
    try:
        code, said = health()
        while code and "no status" in said and service.poll() is None:
            code, said = health()
        assert (code, said) == (0, "")
    finally:
        service.terminate()
        assert service.wait(10) == 0


def test_the_health_check_can_be_executed() -> None:
    assert os.access(DOCKER / "health.py", os.X_OK)
