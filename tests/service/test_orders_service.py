"""Orders to a service that runs: by the command as an operator gives them, and by the bus."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

import schemas
from fusion_service.bus import BusError
from fusion_service.cli import main
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        made.running = made.service()
        made.sensor("r1", 0, 1)
        made.sensor("r2", 0)
        eventually(made.seen.sees(0, 1), 20)
        eventually(lambda: made.seen.feeders(made.seen.confirmed()[0]) == {"r1", "r2"}, 20)
        yield made


def test_an_operator_orders_lists_and_withdraws(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    def order(*words: str) -> tuple[int, str, str]:
        code = main(["order", *words, "--connect", scene.endpoint])
        return (code, *capsys.readouterr())

    track = scene.seen.confirmed()[0]
    short = str(track % 2**32)
    assert order("list") == (0, "no order stands\n", "")
    code, out, _ = order(
        "rename", "--track", short, "--name", "PILOT", "--number", "12", "--who", "anna", "--why", "so"
    )
    assert (code, out) == (0, f"order 1: track {track} is shown as PILOT\n")
    eventually(lambda: "PILOT" in (scene.seen.pictures[-1].callsign or ()))
    code, out, _ = order("quarantine", "--source", "r2", "--until", "1h")
    assert (code, out) == (0, "order 2: tracks r2 apart\n")
    eventually(lambda: scene.seen.feeders(track) == {"r1"})
    code, _, err = order("delete", "--track", "PILOTS")
    assert code == 1
    assert "order 3 is refused: there is no track PILOTS: known are " in err
    assert "12 (PILOT)" in err
    assert err.endswith(': did you mean "PILOT"?\n')
    code, out, _ = order("list")
    assert code == 0
    assert [line.split()[:2] for line in out.splitlines()] == [["1", "rename"], ["2", "quarantine"]]
    assert "PILOT, 12" in out
    assert "anna" in out
    assert order("withdraw", "2")[:2] == (0, "order 4: order 2 (quarantine) stands no more\n")
    code, _, err = order("list", "--centre", "center")
    assert (code, err) == (
        1,
        "fusion-service order: no centre named center answers, but centre: give --centre centre\n",
    )
    for answer in (b"\xc1", b"\x05", msgpack.packb({"orders": [{}]}), msgpack.packb({"orders": [{"number": []}]})):

        def forge(_: bytes | None, said: bytes = answer) -> bytes:
            return said

        forged = scene.bus.answer(schemas.global_key("forged", "orders"), forge)
        assert order("list", "--centre", "forged")[::2] == (
            1, "fusion-service order: the answer in the name of centre forged cannot be read: who is it?\n"
        )  # fmt: skip
        forged.close()
    eventually(lambda: scene.seen.feeders(track) == {"r1", "r2"}, 20)
    assert order("delete", "--track", "PILOT", "--why", "test")[0] == 0
    eventually(lambda: track not in scene.seen.pictures[-1].ids)
    told = {e["number"]: e for log in scene.seen.logs for e in log.events if e["kind"] == "order"}
    assert [(told[k]["what"], told[k]["done"]) for k in sorted(told)] == [
        *(("rename", True), ("quarantine", True), ("delete", False), ("withdraw", True), ("delete", True)),
    ]
    code, out, _ = order("mute", "--source", "R1")
    assert code == 0
    assert ', of which nothing was heard yet (known are r1, r2): did you mean "r1"?' in out
    assert order("withdraw", out.split(":")[0].removeprefix("order "))[0] == 0
    code, _, err = order("link", "--local", "rr2", "1", "--to", "2")
    assert (code, err.endswith('r1, r2: did you mean "r2"?\n')) == (1, True)
    assert told[1]["who"] == "anna"
    assert told[5]["who"]
    count = len(scene.seen.pictures)
    eventually(lambda: len(scene.seen.pictures) > count + 10)
    assert 0 not in scene.seen.confirmed(), "its local tracks are held"


def test_usage_is_told_without_a_centre(capsys: pytest.CaptureFixture[str], hub: Hub) -> None:
    assert main(["order", "link", "--track", "7"]) == 2
    assert "it needs --local SOURCE ID" in capsys.readouterr().err
    for words in (["explode"], ["mute", "--until", "soon"]):
        with pytest.raises(SystemExit) as ended:
            main(["order", *words])
        assert ended.value.code == 2
    capsys.readouterr()
    assert main(["order", "list", "--centre", "nobody", "--connect", hub.endpoint]) == 1
    assert "no centre named nobody answers" in capsys.readouterr().err


def test_orders_outlive_a_kill(scene: Scene) -> None:
    key = schemas.global_key("centre", "orders")

    def ask(**request: Any) -> dict[str, Any]:
        [(_, answer)] = scene.bus.ask(key, msgpack.packb(request), 20.0)
        read: dict[str, Any] = msgpack.unpackb(answer)
        return read

    assert ask(what="mute", source="r2", why="noise")["done"]
    eventually(lambda: [one["what"] for one in ask(what="list")["orders"]] == ["mute"])
    assert not ask(what="mute", source="r2")["done"], "it is muted already"
    eventually(lambda: any(e.get("number") == 2 for log in scene.seen.logs for e in log.events))
    malformed: tuple[Any, ...] = (
        [],
        {"what": "delete"},
        {"what": "link", "track": 1, "local": "r1"},
        {"what": "mute", "source": "r1", "for": -1},
    )
    for bad in malformed:
        with pytest.raises(BusError, match="order"):
            scene.bus.ask(key, msgpack.packb(bad), 20.0)
    assert scene.running is not None
    scene.running.kill()
    before = len(scene.seen.pictures)
    scene.service()
    eventually(lambda: len(scene.seen.pictures) > before + 2, 20)
    [one] = ask(what="list")["orders"]
    assert (one["what"], one["source"], one["why"], one["number"]) == ("mute", "r2", "noise", 1)
    assert ask(what="drop", source="r1")["number"] > 2
    eventually(lambda: scene.said_of("r2", "muted") is True)
