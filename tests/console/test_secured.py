"""The console with certificates: what a viewer may, and whose name an order has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fusion_service.bus.keyring import Keyring
from fusion_service.cli import main
from tests.console.scenes import ask
from tests.helpers.processes import Program, eventually, free_endpoint
from tests.helpers.scene import COMMAND


def test_an_order_is_that_of_the_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys, endpoint = tmp_path / "keys", free_endpoint()
    list(Keyring(keys).change([("centre", "main"), ("operator", "alice"), ("viewer", "wall")]))
    config = keys / "centre-main" / "centre.toml"
    settings = f'[centre]\nname = "main"\n[service]\ncompiled = "off"\n[bus]\nconnect = ["{endpoint}"]\n'
    config.write_text(settings + (keys / "centre-main" / "security.toml").read_text())
    where = ["console", "--connect", endpoint, "--listen", "127.0.0.1:0"]
    assert main([*where, "--allow-orders", "--security", str(keys / "viewer-wall")]) == 2
    assert "it is that of viewer wall, and no good for a operator" in capsys.readouterr().err
    with (
        Program(COMMAND, "run", "--hub", "--config", str(config)),
        Program(COMMAND, *where, "--allow-orders", "--security", str(keys / "operator-alice")) as console,
    ):
        address, _, token = console.line(30).removeprefix("console: ").partition("/#token=")
        port = int(address.rpartition(":")[2])

        def order(**what: str) -> Any:
            body = json.dumps({"centre": "main", "order": what}).encode()
            given = {"Authorization": f"Bearer {token}", "Content_Type": "application/json", "Origin": address}
            return json.loads(ask(port, "/order", "POST", body, **given)[2])

        eventually(lambda: "orders" in order(what="list"), 30)
        assert order(what="mute", source="r1", who="mallory", why="as ordered")["done"] is True
        (stands,) = order(what="list")["orders"]
        assert (stands["who"], stands["proven"], stands["why"]) == ("alice", True, "as ordered")
        assert "order of alice from 127.0.0.1 to main" in console.told()
