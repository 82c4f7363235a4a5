"""What a service sees by liveliness tokens alone: who went while it was down, who is in a realm nearly its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.service import tokens
from fusion_service.service.tokens import Tokens
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
        scene.bus.announce("fusoin/v1/local/m02/alive")
        eventually(lambda: scene.last_status().epoch > before and scene.said_of("goes", "alive") is False, 30)
        assert scene.said_of("stays", "alive") is True
        note = "fusoin/v1/local/m02/alive: it publishes in the realm 'fusoin': did you mean 'fusion'?"
        eventually(lambda: note in (scene.last_status().notes or ()))


def test_whose_token_is_not_seen_for_a_while_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Tokens(lambda: None)
    said: dict[str, dict[str, bool | None]] = {
        "here": {"alive": True},
        "away": {"alive": True},
        "mute": {"alive": None},
        "left": {"alive": False},
    }
    one.note("fusion/v1/local/here/alive", True)
    one.compare(said)
    assert one.changes() == {"here": True}
    monkeypatch.setattr(tokens, "GRACE", -1.0)
    one.compare(said)
    assert one.changes() == {"away": False}
    one.compare(said)
    one.note("fusion/v1/local/away/alive", True)
    assert one.changes() == {"away": True}
