"""An order that was answered "done" stands, whatever is killed when; and the answer says what the step made of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

import schemas
from fusion_service.centre import FusionCentre, Order
from fusion_service.order import order_event
from fusion_service.service.held import HeldOrders
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.promises import FOLLOWED, MOST_WAITING, PATIENCE, Promises
from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import Scene, opened

KILLS = 3


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def ask(scene: Scene, **request: Any) -> dict[str, Any]:
    key = schemas.global_key("centre", "orders")
    [(_, answer)] = scene.bus.ask(key, msgpack.packb(request), 20.0)
    read: dict[str, Any] = msgpack.unpackb(answer)
    return read


def ready(scene: Scene, centre: str = "") -> Program:
    """A service that answers."""
    service = scene.service(centre)

    def answers() -> bool:
        try:
            return bool(ask(scene, what="list")) if scene.bus.connected else False
        except ValueError:
            return False

    eventually(answers, 20)
    return service


def standing(scene: Scene) -> dict[int, str]:
    return {one["number"]: one["source"] for one in ask(scene, what="list")["orders"]}


def both(scene: Scene, *names: str) -> dict[str, dict[str, Any]]:
    """Mute these at once: the answers by name."""
    answers: dict[str, dict[str, Any]] = {}

    def mute(key: str, name: str) -> None:
        answers[key] = ask(scene, what="mute", source=name)

    several = [threading.Thread(target=mute, args=(f"{name} {k}", name)) for k, name in enumerate(names)]
    for one in several:
        one.start()
    for one in several:
        one.join()
    return answers


def test_what_was_answered_stands_after_kill_9_at_once(scene: Scene) -> None:
    given: dict[int, str] = {}
    for k in range(KILLS):
        service = ready(scene)
        answers = both(scene, *(f"s{k}-{j}" for j in range(3)))
        service.kill()
        assert len(answers) == 3
        assert all(one["done"] and one["kept"] and "pending" not in one for one in answers.values())
        given |= {one["number"]: name.split()[0] for name, one in answers.items()}
    ready(scene)
    assert len(given) == 3 * KILLS
    assert standing(scene) == given


def test_what_waits_for_a_step_stands_after_kill_9_at_once(scene: Scene) -> None:
    """By the clock of the messages no step comes without a message: it is written down by itself."""
    given: dict[int, str] = {}
    for k in range(2):
        service = ready(scene, 'clock = "message"')
        begin = time.monotonic()
        answer = ask(scene, what="mute", source=f"quiet{k}")
        assert time.monotonic() - begin >= PATIENCE
        assert answer["done"]
        assert answer["kept"]
        assert answer["pending"]
        service.kill()
        given[answer["number"]] = f"quiet{k}"
    ready(scene, 'clock = "message"')
    assert standing(scene) == {}, "no step was made"
    scene.sensor("radar", 0)
    eventually(lambda: standing(scene) == given, 20)
    eventually(lambda: not (scene.folder / "state" / "orders").read_bytes())
    told = {e["number"]: e for e in heard(scene, given)}
    assert all(told[number]["done"] for number in given)


def test_the_answer_is_what_the_step_made_of_it(scene: Scene) -> None:
    """Two equal orders for one step, of which the second cannot be obeyed after the first."""
    ready(scene)
    answers = [*both(scene, "r9", "r9").values()]
    assert sorted(one["done"] for one in answers) == [False, True]
    told = {e["number"]: e for e in heard(scene, [one["number"] for one in answers])}
    for one in answers:
        assert (one["done"], one["outcome"]) == (told[one["number"]]["done"], told[one["number"]]["outcome"])
    undone = ask(scene, what="unmute", source="r9", who="eve")
    assert undone["done"]
    [last] = [e for e in heard(scene, [undone["number"]]) if e["number"] == undone["number"]]
    assert last["who"] == "eve"
    assert "proven" not in last


def heard(scene: Scene, numbers: Iterable[int]) -> list[dict[str, Any]]:
    """The orders that step logs have told, those of these numbers among them."""
    found: list[dict[str, Any]] = []

    def all_there() -> bool:
        found[:] = [e for log in list(scene.seen.logs) for e in log.events if e["kind"] == "order"]
        return set(numbers) <= {e["number"] for e in found}

    eventually(all_there)
    return found


def test_nobody_says_of_itself_that_it_is_proven(scene: Scene) -> None:
    ready(scene)
    assert ask(scene, what="mute", source="r9", who="eve", proven=True)["done"]
    [one] = ask(scene, what="list")["orders"]
    assert one["who"] == "eve"
    assert "proven" not in one


def test_held_orders_are_read_as_far_as_they_are_whole(tmp_path: Path) -> None:
    held = HeldOrders(tmp_path)
    assert held.read(1) == []
    orders = [Order("mute", f"r{k}", number=k, who="anna", proven=True) for k in range(1, 6)]
    assert held.add(orders[:3])
    assert held.add(orders[3:])
    assert HeldOrders(tmp_path).read(1) == orders
    assert HeldOrders(tmp_path).read(4) == orders[3:]
    path = tmp_path / "orders"
    assert path.stat().st_mode & 0o777 == 0o600
    whole = path.read_bytes()
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        assert HeldOrders(tmp_path).read(1) == orders[: len(HeldOrders(tmp_path).read(1))]
    path.write_bytes(whole + b"\xc1\xff")
    again = HeldOrders(tmp_path)
    assert again.read(1) == orders
    again.saved(5)
    assert path.stat().st_size > 0
    again.saved(6)
    assert path.stat().st_size == 0
    assert not HeldOrders(None).add(orders)
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError):
        held.add(orders)


def test_promises_are_bounded_and_each_is_answered_once() -> None:
    now = [0.0]
    promises = Promises(lambda: now[0])
    said: list[Any] = []
    orders = [Order("mute", "r", number=k) for k in range(1, MOST_WAITING + 1)]
    for order in orders:
        assert not promises.full
        promises.make(order, "will be", said.append)
    assert promises.full
    assert promises.overdue() == []
    promises.settle([{"number": 1, "done": False, "outcome": "no"}], kept=True)
    promises.settle([{"number": 1, "done": True, "outcome": "yes"}], kept=True)
    promises.release()
    promises.lose([orders[1]])
    now[0] = PATIENCE
    assert promises.wait() == 0.0
    assert promises.overdue() == orders[2:]
    promises.hold(orders[2:-1], kept=False)
    promises.close()
    promises.close()
    read = [msgpack.unpackb(one) for one in said[:-1]]
    assert [(one["number"], one["done"], one["kept"]) for one in read[:3]] == [
        (1, False, True),
        (2, False, False),
        (3, True, False),
    ]
    assert read[2]["pending"]
    assert isinstance(said[-1], ValueError)
    assert len(said) == MOST_WAITING
    assert promises.wait() == float("inf")


def test_a_certificate_proves_who_ordered_and_with_certificates_nobody_else_does() -> None:
    centre, said, put = FusionCentre({}), list[Any](), list[Order]()
    desk = OrderDesk(put.append, secured=True)
    desk.follow(centre)
    request = msgpack.packb({"what": "mute", "source": "r1", "who": "eve", "proven": False})
    with pytest.raises(ValueError, match="by certificate"):
        desk.answer(request, said.append)
    desk.answer(None, said.append)
    assert msgpack.unpackb(said.pop())["orders"] == []
    desk.answer(request, said.append, "alice")
    [order] = put
    assert (order.who, order.proven, order.giver) == ("alice", True, "alice")
    centre.handle(order, 0)
    log = centre.step(10**18).log
    desk.follow(centre)
    desk.promises.settle(log.events, kept=True)
    assert said == [], "its step is not published yet"
    desk.promises.release()
    assert msgpack.unpackb(said.pop()) == {
        "number": 1,
        "done": True,
        "track": None,
        "kept": True,
        "outcome": "refuses what r1 sends, of which nothing was heard yet",
    }
    desk.answer(None, said.append)
    [listed] = msgpack.unpackb(said.pop())["orders"]
    assert (listed["who"], listed["proven"]) == ("alice", True)
    again = FusionCentre({}, checkpoint=centre.checkpoint())
    assert again.orders.listed() == [listed]
    open_desk = OrderDesk(put.append)
    open_desk.follow(FusionCentre({}))
    open_desk.answer(msgpack.packb({"what": "mute", "source": "r1", "proven": True}), said.append, "alice")
    assert (put[-1].who, put[-1].proven, put[-1].giver) == ("alice", False, "alice (unproven)")


def test_a_process_that_lost_the_name_promises_nothing() -> None:
    promises, said = Promises(), list[Any]()
    promises.make(Order("mute", "r", number=1), "will be", said.append)
    promises.may = lambda: False
    promises.settle([{"number": 1, "done": True, "outcome": "yes"}], kept=True)
    promises.release()
    [error] = said
    assert isinstance(error, ValueError)


def test_an_answer_waits_for_who_stands_by_but_not_for_long() -> None:
    now, known, said = [0.0], [0], list[Any]()
    promises = Promises(lambda: now[0])
    promises.followed = lambda: known[0]
    orders = [Order("mute", "r", number=k) for k in range(1, 4)]
    for order in orders:
        promises.make(order, "will be", said.append)
    promises.settle([{"number": k, "done": True, "outcome": "yes"} for k in (1, 2)], kept=True)
    promises.release()
    assert said == []
    known[0] = 1
    promises.release()
    assert [msgpack.unpackb(one)["number"] for one in said] == [1]
    assert promises.wait() == FOLLOWED
    now[0] = FOLLOWED
    promises.release()
    assert [msgpack.unpackb(one).get("followed") for one in said] == [None, False]
    # one that is answered though it waits for its step is told to others until that
    now[0] = PATIENCE
    assert promises.held() == []
    promises.hold(promises.overdue(), kept=True)
    assert promises.held() == [order_event(orders[2])]
    promises.release()
    assert len(said) == 2
    known[0] = 3
    promises.release()
    assert msgpack.unpackb(said[-1])["pending"]
    promises.settle([{"number": 3, "done": True, "outcome": "yes"}], kept=True)
    promises.release()
    assert len(said) == 3
    assert promises.held() == []
