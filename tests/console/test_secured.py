"""The console with certificates: what a viewer may, what is seen, and whose name an order has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from fusion_service.bus.keyring import Keyring
from fusion_service.cli import main
from schemas import Motion
from sensor_clients.publisher import TrackPublisher
from tests.console.scenes import HARBOUR, ask
from tests.helpers.processes import Program, eventually, free_endpoint
from tests.helpers.scene import COMMAND


def test_an_operator_sees_where_sensors_stand_and_an_order_is_that_of_the_certificate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys, endpoint = tmp_path / "keys", free_endpoint()
    list(Keyring(keys).change([("centre", "main"), ("source", "r1"), ("operator", "alice"), ("viewer", "wall")]))
    config = keys / "centre-main" / "centre.toml"
    settings = f'[centre]\nname = "main"\n[service]\ncompiled = "off"\n[bus]\nconnect = ["{endpoint}"]\n'
    config.write_text(settings + (keys / "centre-main" / "security.toml").read_text())
    where = ["console", "--connect", endpoint, "--listen", "127.0.0.1:0"]
    assert main([*where, "--allow-orders", "--security", str(keys / "viewer-wall")]) == 2
    assert "it is that of viewer wall, and no good for a operator" in capsys.readouterr().err
    with (
        Program(COMMAND, "run", "--hub", "--config", str(config)),
        Program(COMMAND, *where, "--allow-orders", "--security", str(keys / "operator-alice")) as console,
        TrackPublisher("r1", connect=endpoint, wait=30.0, security=keys / "source-r1") as radar,
    ):
        radar.info(frame=HARBOUR, position=(0.0, 0.0, 5.0), period=1.0, motion=Motion("cv", q=1.0))
        address, _, token = console.line(30).removeprefix("console: ").partition("/#token=")
        port = int(address.rpartition(":")[2])

        with connect(f"{address.replace('http', 'ws')}/stream", open_timeout=20) as stream:
            stream.send(json.dumps({"token": token}))
            said = (json.loads(one) for one in stream if isinstance(one, str))
            shown = next(one for one in said if one["type"] == "places" and one["sources"])
        assert shown["sources"]["r1"]["place"] == pytest.approx([HARBOUR.lon, HARBOUR.lat])

        def order(**what: str) -> Any:
            body = json.dumps({"centre": "main", "order": what}).encode()
            given = {"Authorization": f"Bearer {token}", "Content_Type": "application/json", "Origin": address}
            return json.loads(ask(port, "/order", "POST", body, **given)[2])

        eventually(lambda: "orders" in order(what="list"), 30)
        assert order(what="mute", source="r1", who="mallory", why="as ordered")["done"] is True
        (stands,) = order(what="list")["orders"]
        assert (stands["who"], stands["proven"], stands["why"]) == ("alice", True, "as ordered")
        assert "order of alice from 127.0.0.1 to main" in console.told()
