"""`status`, `top` and `listen` beside a real service: what they show, and what they end with."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgpack
import pytest

import schemas
from fusion_service import __version__
from fusion_service.cli import main
from tests.helpers.processes import Hub, eventually, free_endpoint
from tests.helpers.scene import COMMAND, Scene, opened
from tests.helpers.terminal import Terminal


@pytest.fixture(scope="module")
def its_hub() -> Iterator[Hub]:
    hub = Hub().start()
    yield hub
    hub.kill()


@pytest.fixture(scope="module")
def scene(its_hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A service with two sensors that see the same, and a recorder."""
    with ExitStack() as stack:
        made = stack.enter_context(opened(its_hub, tmp_path_factory.mktemp("status")))
        made.service()
        out = str(made.folder / "mission.rrd")
        made.start(COMMAND, "record", "--connect", made.endpoint, "--out", out, "--name", "rec", "--no-draw")
        made.sensor("r1", 0, 1)
        made.sensor("r2", 0, 1)
        eventually(lambda: made.seen.sees(0, 1)() and made.said_of("r2", "rate"), 30)
        tokens: dict[str, bool] = {}
        made.bus.watch(schemas.record_key("*", "alive"), tokens.__setitem__)
        eventually(lambda: tokens.get("fusion/v1/record/rec/alive"), 30)
        yield made


def test_a_centre_that_is_well_is_told_and_ends_with_0(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["status", "--connect", scene.endpoint, "--json"])
    said = json.loads(capsys.readouterr().out)
    assert (code, said["wrong"]) == (0, [])
    (centre,) = said["centres"]
    assert centre["tracks"]["confirmed"] == 2
    for name in ("r1", "r2"):
        source = centre["sources"][name]
        assert source["linked_share"] == 1.0
        assert source["declared_period"] == 0.2
        assert 1.0 < source["rate"] < 10.0
        assert source["wrong"] == []
    assert main(["status", "--connect", scene.endpoint]) == 0
    text = capsys.readouterr().out
    assert "centre centre: up" in text
    assert "100% shared with others" in text
    assert f"recorder rec: {scene.folder / 'mission.rrd'} on " in text


def test_the_recorder_says_what_it_keeps(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--connect", scene.endpoint, "--json"]) == 0
    (recorder,) = json.loads(capsys.readouterr().out)["recorders"]
    assert (recorder["name"], recorder["wrong"], recorder["parts"], recorder["lost"]) == ("rec", [], 1, 0)
    assert recorder["file"] == str(scene.folder / "mission.rrd")
    assert recorder["messages"] > 0
    assert recorder["bytes"] > 0
    assert recorder["silent"] < 15.0


def test_what_is_wrong_is_told_and_ends_with_1(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    late = scene.bus.publisher("fusion/v1/local/m01/tracks")
    beside = scene.bus.publisher("fusoin/v1/local/m02/tracks")
    message = {
        "v": 1, "type": "local_tracks", "source": "m01", "epoch": 1, "seq": 0, "sent": time.time_ns(),
        "origin": "live", "time": time.time_ns() // 10**9, "complete": True, "space": ["x", "y"],
        "frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}, "ids": b"", "means": b"", "covs": b"",
    }  # fmt: skip
    late.put(msgpack.packb(message))
    eventually(lambda: scene.said_of("m01", "last_refusal"))
    beside_code = []
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.1):
            beside.put(b"?")

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        beside_code.append(main(["status", "--connect", scene.endpoint]))
    finally:
        stop.set()
        thread.join()
    told = capsys.readouterr()
    assert beside_code == [1]
    assert "is `time` in seconds? it must be ns" in told.out
    assert "fusoin/v1/local/m02/tracks: it publishes in the realm 'fusoin': did you mean 'fusion'?" in told.out
    assert told.err.startswith("fusion-service status: ")
    assert told.err.count("\n") == 1


def test_nobody_who_answers_ends_with_1(
    scene: Scene, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_service.commands.status.PATIENCE", 0.5)
    assert main(["status", "--connect", scene.endpoint, "--realm", "nowhere", "--for", "0.1", "--json"]) == 1
    told = capsys.readouterr()
    assert "no centre of the realm nowhere answers" in json.loads(told.out)["wrong"][0]


def test_listen_prints_messages_decoded_and_raw(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--connect", scene.endpoint, "--for", "10"]
    assert main(["listen", *where, "--source", "r1", "--type", "local_tracks", "--tracks", "1", "--count", "1"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert "fusion/v1/local/r1/tracks  local_tracks r1 seq" in first
    assert "2 of x y vx vy in enu 59.0000 -55.0000" in first
    assert "±" in second
    assert main(["listen", "fusion/v1/local/r2/tracks", "--raw", "--count", "1", *where]) == 0
    raw = json.loads(capsys.readouterr().out)
    assert raw["payload"]["source"] == "r2"
    assert bytes.fromhex(raw["payload"]["ids"])
    assert main(["listen", "--type", "status", "--count", "1", *where]) == 0
    assert "status centre seq" in capsys.readouterr().out


def test_listen_says_what_is_wrong_and_that_nothing_came(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = scene.bus.publisher("sensors/m03")
    wrong.put(b'{"x": 1}')
    where = ["--connect", scene.endpoint]
    assert main(["listen", "sensors/*", "--wrong", "--count", "1", "--for", "10", *where]) == 0
    told = capsys.readouterr().out
    assert "bytes that cannot be read" in told
    assert "payload is JSON" in told
    assert "publish on fusion/v1/local/NAME/tracks" in told
    assert main(["listen", "nothing/here", "--for", "0.3", *where]) == 1
    assert "nothing was heard on nothing/here" in capsys.readouterr().err


def test_top_shows_who_is_wrong_lives_through_the_hub_and_ends_by_q(scene: Scene, its_hub: Hub) -> None:
    late = scene.bus.publisher("fusion/v1/local/m03/tracks", cache=1)
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.3):
            late.put(b'{"source": "m03"}')

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with Terminal("top", "--connect", scene.endpoint, width=70, height=40, NO_COLOR="1") as top:
            eventually(lambda: top.shows("! m03", "payload is JSON: send MessagePack", "recorder rec: "), 30)
            rows = [line for line in top.screen() if line[2:4] in ("m0", "r1", "r2")]
            wrong = [line[:5] for line in rows if line.startswith("!")]  # m01 too, where it has just been tried
            assert set(wrong) - {"! m01"} == {"! m03"}
            assert [line[:5] for line in rows] == [*wrong, "  r1 ", "  r2 "]
            assert [line.split()[1] for line in rows[-2:]] == ["there", "there"]
            assert max(map(len, top.screen())) <= 70
            top.resize(70, 9)
            top.press("\x1b[B\r")
            eventually(lambda: top.shows("m0", " of centre centre: refused", "Esc back"))
            top.press("\x1b[6~")
            eventually(lambda: not top.shows(" of centre centre: refused") and top.shows("Esc back"))
            top.press("\x1bs")
            eventually(lambda: top.shows("s sort (name)", "SOURCE"))
            top.resize(120, 30)
            eventually(lambda: top.shows("LAST REFUSAL", "LATENCY"))
            its_hub.kill()
            eventually(lambda: top.shows("! the hub is away: what is shown is as it was", "r1"))
            its_hub.start()
            eventually(lambda: top.screen() and not top.shows("the hub is away"), 30)
            top.press("p")
            eventually(lambda: top.shows("PAUSED"))
            assert "\x1b[2J" not in top.text().partition("\x1b[H")[2].partition("\x1b[H")[2]
            top.press("q")
            assert top.process.wait(20) == 0
            assert not re.search(r"\x1b\[(?:\d+;)*[34]\dm", top.text()), "colours, with NO_COLOR"
            assert top.text().endswith("\x1b[?25h\x1b[?1049l")
            assert top.process.stderr is not None
            assert top.process.stderr.read() == b""
    finally:
        stop.set()
        thread.join()


def test_a_hub_that_is_not_there_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_service.bus.options.PATIENCE", 0.2)
    assert main(["status", "--connect", free_endpoint()]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_two_processes_that_publish_as_one_centre_are_told_of() -> None:
    from fusion_service.lookout.ear import Ear

    ear = Ear("fusion")
    for seq in range(2):
        for epoch in (1, 2):
            status = schemas.Status(
                source="centre", epoch=epoch, seq=seq, sent=1, time=1, step=1, uptime=1.0, rates={}, queue={},
                refused={}, dropped={}, sources={}, tracks={}, step_time={},
            )  # fmt: skip
            assert ear.twice() == [] or seq == 1
            ear.take("fusion/v1/global/centre/status", schemas.encode(status))
    assert "2 processes publish as centre centre: end one of them" in ear.twice()[0]


def test_a_command_that_is_nearly_right_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["stauts"])
    assert ended.value.code == 2
    assert "did you mean 'status'?" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"fusion-service {__version__}\n"
