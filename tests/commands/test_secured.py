"""The commands with certificates, as processes: the smallest installation, one file for all, and what each says."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from fusion_service.bus.keyring import Keyring
from fusion_service.cli import main as service
from sensor_clients.cli import main as clients
from tests.helpers.processes import Program, eventually, free_endpoint

SERVICE = "import sys; from fusion_service.cli import main; sys.exit(main(sys.argv[1:]))"


def command(module: str, *words: str | Path) -> tuple[int, str]:
    line = [sys.executable, "-m", module, *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout + done.stderr


def test_the_smallest_installation_with_certificates_in_its_config(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`run --hub` by one file that holds settings and [security] both; radar and operator come in, a stranger not; a
    viewer sees by every command what its role lets it."""
    keys = tmp_path / "keys"
    list(Keyring(keys).change([("centre", "main"), ("source", "radar1"), ("operator", "alice"), ("viewer", "wall")]))
    endpoint = free_endpoint()
    place = keys / "centre-main"
    config = place / "centre.toml"
    service = (
        f'[centre]\nname = "main"\nclock = "message"\n[service]\ncompiled = "off"\n[bus]\nconnect = ["{endpoint}"]\n'
    )
    config.write_text(service + (place / "security.toml").read_text())
    radar = ["simulate", "three-radars", "--sensor", "radar1", "--duration", "2", "--speed", "20"]
    with Program(SERVICE, "run", "--hub", "--config", str(config)):
        where = ["--connect", endpoint, "--security", str(keys / "source-radar1")]
        code, said = command("sensor_clients", *radar, *where)
        assert code == 0, said
        orders = ["order", "list", "--centre", "main", "--connect", endpoint]
        answers: list[tuple[int, str]] = []

        def answered() -> bool:
            answers.append(command("fusion_service", *orders, "--security", keys / "operator-alice"))
            return answers[-1] == (0, "no order stands\n")

        eventually(answered, 20.0)
        code, said = command("fusion_service", *orders)
        assert code == 1
        assert "asks for certificates (TLS): give --security FILE" in said
        code, said = command("fusion_service", *orders, "--security", keys / "source-radar1")
        assert code == 2
        assert "it is that of source radar1, and no good for a operator" in said
        monkeypatch.setattr("fusion_service.commands.top.FIRST", 0.5)
        looks_on(["--connect", endpoint, "--security", str(keys / "viewer-wall")], capsys)


def looks_on(where: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """As a viewer, at a centre whose only source has gone."""

    def told(call: Callable[[Sequence[str]], int], *words: str) -> tuple[int, str]:
        code = call([*words, *where])
        said = capsys.readouterr()
        return code, said.out + said.err

    code, said = told(service, "status", "--for", "0.5")
    assert code == 1
    assert "radar1: it is gone" in said
    assert "only this realm was heard: the certificate lets in no more" in said
    assert told(service, "status", "--for", "0.5", "--ignore", "rad*")[0] == 0
    code, said = told(service, "top", "--once")
    assert code == 0
    assert "! radar1" in said
    assert told(service, "listen", "--count", "1", "--type", "status")[0] == 0
    code, said = told(service, "listen", "fusion/v1/local/radar1/tracks")
    assert code == 1
    assert "viewer wall may not subscribe there" in said
    code, said = told(clients, "check", "radar1", "--for", "0.5")
    assert "this certificate may not hear sources: what centres say of it is all that is told" in said
    assert "centre main: has taken " in said
