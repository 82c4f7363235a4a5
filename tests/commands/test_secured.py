"""The commands with certificates, as processes: the smallest installation, one file for all, and what each says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from fusion_service.bus.keyring import Keyring
from tests.helpers.processes import Program, eventually, free_endpoint

SERVICE = "import sys; from fusion_service.cli import main; sys.exit(main(sys.argv[1:]))"


def command(module: str, *words: str | Path) -> tuple[int, str]:
    line = [sys.executable, "-m", module, *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=30, check=False)
    return done.returncode, done.stdout + done.stderr


def test_the_smallest_installation_with_certificates_in_its_config(tmp_path: Path) -> None:
    """`run --hub` by one file that holds settings and [security] both; radar and operator come in, a stranger not."""
    keys = tmp_path / "keys"
    list(Keyring(keys).change([("centre", "main"), ("source", "radar1"), ("operator", "alice")]))
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
