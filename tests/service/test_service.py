"""The service as operators run it: hub, service and clients as processes, killed and started again."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import schemas
from fusion_service.bus import open_bus
from schemas.messages import GlobalTracks
from tests.helpers.processes import Hub, Program, eventually, free_endpoint, slowness
from tests.helpers.scene import COMMAND, CONFIG, SENSOR, Observer, Scene, opened


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_a_killed_sensor_is_told_at_once_and_others_keep_its_targets(scene: Scene) -> None:
    scene.service()
    sensors = [scene.sensor("r1", 0, 1, 2), scene.sensor("r2", 1, 2, 3), scene.sensor("r3", 2, 3, 4)]
    eventually(lambda: scene.seen.sees(0, 1, 2, 3, 4)() and len(scene.seen.feeders(scene.seen.confirmed()[2])) == 3)
    before = scene.seen.confirmed()
    sensors[1].kill()
    killed = time.monotonic()
    eventually(lambda: scene.said_of("r2", "alive") is False)
    at = next(at for at, one in scene.seen.statuses if one.sources.get("r2", {}).get("alive") is False)
    print("a killed sensor is told after", at - killed, "s")
    assert at - killed < 1.0 * slowness(), "by its silence alone after ten"
    count = len(scene.seen.pictures)
    eventually(lambda: scene.said_of("r2", "stale"))
    eventually(lambda: scene.seen.feeders(before[2]) == {"r1", "r3"})
    eventually(lambda: len(scene.seen.pictures) > count + 5)
    assert scene.seen.confirmed() == before


def test_the_picture_comes_back_after_kill_9_with_the_same_ids(scene: Scene) -> None:
    sensors = [scene.sensor("r1", 0, 1, 2), scene.sensor("r2", 1, 2, 3)]
    service = scene.service()
    eventually(scene.seen.sees(0, 1, 2, 3))
    before = scene.seen.confirmed()
    service.kill()
    killed = len(scene.seen.pictures)
    service = scene.service()
    eventually(lambda: len(scene.seen.pictures) > killed and scene.seen.sees(0, 1, 2, 3)())
    assert scene.seen.confirmed() == before
    assert all(set(picture.ids.tolist()) <= set(before.values()) for picture in scene.seen.pictures[killed:])
    scene.sensor("r3", 7)
    eventually(scene.seen.sees(0, 1, 2, 3, 7))
    born = scene.seen.born()
    assert len(born) == len(set(born))
    assert scene.seen.confirmed()[7] not in before.values()
    service.signal(signal.SIGTERM)
    assert service.end(timeout=5.0)[0] == 0
    scene.service()
    eventually(lambda: scene.seen.pictures[-1].epoch != scene.seen.pictures[killed].epoch)
    eventually(scene.seen.sees(0, 1, 2, 3, 7))
    assert {k: scene.seen.confirmed()[k] for k in before} == before
    for sensor in sensors:
        assert sensor.running()


def test_a_restarted_sensor_takes_over_nobodys_links(scene: Scene) -> None:
    scene.service()
    scene.sensor("r1", 0, 1, 2)
    second = scene.sensor("r2", 0, 1, 2)
    eventually(lambda: scene.seen.sees(0, 1, 2)() and scene.seen.feeders(scene.seen.confirmed()[0]) == {"r1", "r2"})
    before = scene.seen.confirmed()
    second.kill()
    scene.sensor("r2", 0, 1, 2, order="reversed")

    def newest() -> int:
        return max(int(epoch) for epoch in scene.seen.pictures[-1].contributor_epoch)

    first = newest()
    eventually(lambda: newest() > first)
    eventually(lambda: all(scene.seen.feeders(track) == {"r1", "r2"} for track in before.values()))
    assert scene.seen.confirmed() == before
    picture = scene.seen.pictures[-1]
    at = {int(track): k for k, track in enumerate(np.repeat(picture.ids, picture.contributor_counts))}
    assert len(at) == 3


def test_what_cannot_be_read_is_refused_by_reason_and_the_rest_goes_on(scene: Scene) -> None:
    scene.service()
    scene.sensor("r1", 0, 1)
    eventually(scene.seen.sees(0, 1))
    now = time.time_ns()
    good = schemas.LocalTracks(
        source="bad", epoch=now, seq=0, sent=now, time=now, complete=True, space=("x", "y", "vx", "vy"),
        frame=schemas.Enu(59.0, -55.0), ids=np.arange(2, dtype=np.uint64), means=np.full((2, 4), 5e5),
        covariances=np.tile(np.eye(4), (2, 1, 1)),
    )  # fmt: skip
    data = schemas.encode(good)
    import msgpack

    raw = msgpack.unpackb(data)

    def changed(**values: object) -> bytes:
        return bytes(msgpack.packb({**raw, **values}))

    nan = np.full(8, np.nan).tobytes()
    cases: list[tuple[str, bytes]] = [
        ("not-msgpack", data[: len(data) // 2]),
        ("not-msgpack", b""),
        ("version", changed(v=2)),
        ("type", changed(type="local_trucks")),
        ("length", changed(means=raw["means"][:-8])),
        ("bad-field", changed(means=raw["means"][:-1])),
        ("length", changed(counts=np.array([65535, 65535], "<u2").tobytes(), weights=b"")),
        ("not-finite", changed(means=nan, seq=1)),
        ("not-positive-definite", changed(covs=(-np.array([1, 0, 1, 0, 0, 1, 0, 0, 0, 1.0] * 2)).tobytes(), seq=2)),
        ("future", changed(time=now + 3600 * 10**9, seq=3)),
        ("source", changed(source="r1")),
        ("missing", changed(ids=None)),
    ]
    expected: dict[str, int] = {}
    publisher = scene.bus.publisher(schemas.local_key("bad", "tracks"))
    for reason, payload in cases:
        publisher.put(payload)
        expected[reason] = expected.get(reason, 0) + (2 if reason in ("not-finite", "not-positive-definite") else 1)
    eventually(lambda: scene.last_status().refused == expected)
    publisher.put(changed(seq=10))
    publisher.put(changed(seq=10))
    eventually(lambda: scene.said_of("bad", "repeats") == 1)
    assert scene.seen.sees(0, 1)()
    assert {entry.reason for log in scene.seen.logs for entry in log.refused} == {*expected, "repeat"}


def test_operators_can_ask_and_order(scene: Scene) -> None:
    import msgpack

    from fusion_service.bus import BusError

    scene.service()
    scene.sensor("r1", 0, 1)
    scene.sensor("r2", 0)
    eventually(scene.seen.sees(0, 1))
    [(_, data)] = scene.bus.ask(schemas.global_key("centre", "picture"), timeout=20.0)
    picture = schemas.decode(data)
    assert isinstance(picture, GlobalTracks)
    assert set(picture.ids.tolist()) >= set(scene.seen.confirmed().values())
    orders = schemas.global_key("centre", "orders")
    scene.bus.ask(orders, msgpack.packb({"what": "mute", "source": "r2"}), 20.0)
    eventually(lambda: scene.seen.feeders(scene.seen.confirmed()[0]) == {"r1"})
    with pytest.raises(BusError, match="an order is a map"):
        scene.bus.ask(orders, msgpack.packb({"what": "explode"}), 20.0)


def test_by_message_time_it_steps_when_all_live_sources_have_passed(hub: Hub, tmp_path: Path) -> None:
    from sensor_clients.publisher import TrackPublisher

    second = 10**9
    start = 1_700_000_000 * second
    frame, space = schemas.Enu(59.0, -55.0), ("x", "y", "vx", "vy")

    def send(publisher: TrackPublisher, at: float) -> None:
        publisher.tracks(
            time=start + round(at * second), space=space, frame=frame, ids=[1], means=[[0, 0, 0, 0]],
            covariances=[np.diag([25.0, 25.0, 4.0, 4.0])],
        )  # fmt: skip

    with opened(hub, tmp_path) as scene, ExitStack() as stack:
        one, two = (stack.enter_context(TrackPublisher(name, connect=hub.endpoint)) for name in ("r1", "r2"))
        for publisher in (one, two):
            publisher.info(frame=frame, position=(0, 0, 0), period=1.0, motion=schemas.Motion("cv", 1.0))
        scene.service(centre='clock = "message"\nname = "slow"')
        eventually(lambda: len(scene.last_status().sources) == 2 if scene.seen.statuses else False)

        def times() -> list[float]:
            return [(picture.time - start) / second for picture in scene.seen.pictures]

        send(one, 1.0)
        send(two, 0.3)
        send(two, 0.9)
        eventually(lambda: times() and times()[-1] == pytest.approx(0.8))
        for step in range(200):  # the other is silent after a while, and no more waited for
            send(one, 3.2 + step / 1e6)
            time.sleep(0.1)
            if times()[-1] == pytest.approx(3.2):
                break
        assert times() == pytest.approx([*np.arange(0.4, 3.21, 0.2)])


def test_a_step_that_fails_does_not_end_the_service(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from fusion_service.centre import FusionCentre
    from fusion_service.config import load_config
    from fusion_service.service.daemon import Service
    from fusion_service.service.state import open_state

    broken = {"checkpoint": False, "steps": 0}
    make, real = FusionCentre.__init__, FusionCentre.step

    def step(centre: FusionCentre, at: int) -> object:
        if broken["checkpoint"] and centre.restored:  # type: ignore[attr-defined]
            broken["steps"] += 1
            raise RuntimeError("a fault of ours")
        return real(centre, at)

    def init(centre: FusionCentre, config: object, checkpoint: bytes | None = None, **rest: object) -> None:
        make(centre, config, checkpoint, **rest)  # type: ignore[arg-type]
        centre.restored = checkpoint is not None  # type: ignore[attr-defined]

    monkeypatch.setattr(FusionCentre, "__init__", init)
    monkeypatch.setattr(FusionCentre, "step", step)
    path = scene.folder / "centre.toml"
    path.write_text(CONFIG.format(centre="", endpoint=scene.endpoint, state=scene.folder / "state"))
    stop = threading.Event()
    with open_state(str(scene.folder / "state")) as state, open_bus([scene.endpoint], wait=60.0) as bus:
        service = Service(load_config(path), bus, state)
        service._lasting.centre.restored = True  # type: ignore[attr-defined]
        thread = threading.Thread(target=service.run, args=(stop,))
        thread.start()
        try:
            scene.sensor("r1", 0, 1)
            eventually(scene.seen.sees(0, 1))
            before = set(scene.seen.born())
            broken["checkpoint"] = True
            eventually(lambda: broken["steps"] >= 2)
            eventually(lambda: scene.last_status().step_time["failed"] == 1)
            eventually(lambda: scene.seen.sees(0, 1)() and not before & set(scene.seen.confirmed().values()))
        finally:
            stop.set()
            thread.join(20)
    assert not thread.is_alive()
    assert "a fault of ours" in caplog.text


def test_ctrl_c_ends_everything_at_once(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = tmp_path / "centre.toml"
    config.write_text(CONFIG.format(centre="", endpoint=endpoint, state=tmp_path / "state"))
    recording = tmp_path / "mission.rrd"
    commands: Sequence[Sequence[str]] = (
        ("hub", "--listen", endpoint),
        ("run", "--config", str(config)),
        ("record", "--out", str(recording), "--connect", endpoint),
    )
    with ExitStack() as stack:
        programs = [stack.enter_context(Program(COMMAND, *command)) for command in commands]
        sensor = stack.enter_context(Program(SENSOR, endpoint, "r1", "given", "0"))
        assert sensor.line() == "up"
        bus = stack.enter_context(open_bus([endpoint], wait=60.0))
        seen = Observer(bus)
        eventually(lambda: recording.exists() and seen.sees(0)(), 20)
        for program in reversed(programs):
            program.signal(signal.SIGINT)
            assert program.end(5.0)[0] == 0
    from fusion_service.recording import messages

    kinds = {type(message).__name__ for message in messages(recording)}
    assert kinds >= {"GlobalTracks", "LocalTracks", "SensorInfo", "StepLog", "Status"}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "--config", "nowhere.toml"], 2, "cannot be read"),
        (["record", "--out", "/proc/nowhere/x.rrd", "--connect", "tcp/127.0.0.1:1"], 1, "fusion-service record:"),
        (["demo", "--scenario", "moon"], 2, "unknown scenario 'moon'"),
        (["demo", "--scenario", "autoferry:2", "--data", "/nowhere"], 1, "--data names the Autoferry folder"),
    ],
)
def test_mistakes_are_one_line_that_says_how_to_mend_them(arguments: list[str], code: int, words: str) -> None:
    with Program(COMMAND, *arguments) as program:
        got, errors = program.end()
    assert got == code
    assert words in errors
    assert "Traceback" not in errors
    assert len(errors.strip().splitlines()) == 1


def test_a_second_service_on_the_same_state_is_refused(scene: Scene) -> None:
    scene.service()
    eventually(lambda: scene.seen.statuses)
    assert scene.last_status().road == "plain"
    code, errors = scene.service().end()
    assert code == 1
    assert "another service uses the state folder" in errors
