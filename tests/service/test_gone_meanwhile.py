"""A source that goes while the service is down is gone for the service that comes back."""

from __future__ import annotations

from pathlib import Path

from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import opened


def test_a_source_that_went_while_the_service_was_down_is_not_alive_after_its_restart(hub: Hub, tmp_path: Path) -> None:
    with opened(hub, tmp_path) as scene:
        service = scene.service()
        scene.sensor("stays", 0)
        goes = scene.sensor("goes", 0)
        eventually(lambda: scene.said_of("goes", "messages") and scene.said_of("stays", "alive"), 30)
        eventually(lambda: b"goes" in (tmp_path / "state" / "checkpoint").read_bytes())
        before = scene.last_status().epoch
        service.kill()
        goes.kill()
        scene.service()
        eventually(lambda: scene.last_status().epoch > before and scene.said_of("goes", "alive") is False, 30)
        assert scene.said_of("stays", "alive") is True
