"""The inbox against a plain model, under threads, and under sources that want all of it."""

import signal
import threading
import time
from collections import Counter

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fusion_service.bus.inbox import Inbox
from tests.helpers.processes import slowness

SLOT = 10


class InboxModel(RuleBasedStateMachine):
    """A list of (source, item, slots) in the order of arrival is all there is to know."""

    capacity = 6

    def __init__(self) -> None:
        super().__init__()
        self.inbox: Inbox[int] = Inbox(self.capacity, slot_bytes=SLOT)
        self.waiting: list[tuple[str, int, int]] = []
        self.dropped: Counter[str] = Counter()
        self.since: dict[str, int] = {}  # when the load of a source last changed
        self.clock = 0
        self.number = 0
        self.peak = 0

    def load(self, source: str) -> int:
        return sum(slots for name, _, slots in self.waiting if name == source)

    def changed(self, source: str) -> None:
        self.clock += 1
        self.since[source] = self.clock

    @rule(source=st.sampled_from("abc"), size=st.sampled_from([0, 5, SLOT, 25, 200]))
    def put(self, source: str, size: int) -> None:
        self.number += 1
        self.inbox.put(source, self.number, size)
        self.waiting.append((source, self.number, 1 + size // SLOT))
        self.changed(source)
        while sum(slots for _, _, slots in self.waiting) > self.capacity:
            busiest = min({name for name, _, _ in self.waiting}, key=lambda name: (-self.load(name), self.since[name]))
            self.waiting.remove(next(entry for entry in self.waiting if entry[0] == busiest))
            self.dropped[busiest] += 1
            self.changed(busiest)
        self.peak = max(self.peak, sum(slots for _, _, slots in self.waiting))

    @precondition(lambda self: self.waiting)
    @rule()
    def take(self) -> None:
        assert self.inbox.take(0) == [(source, item) for source, item, _ in self.waiting]
        self.waiting.clear()

    @invariant()
    def counts(self) -> None:
        assert len(self.inbox) == len(self.waiting)
        assert self.inbox.dropped == +self.dropped
        assert self.inbox.high_water == self.peak


TestInboxModel = InboxModel.TestCase
TestInboxModel.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)


def test_a_flood_costs_only_the_one_who_makes_it() -> None:
    inbox: Inbox[int] = Inbox(100)
    for i in range(40):
        inbox.put("quiet", i)
        for _ in range(50):
            inbox.put("flood", i)
    taken = inbox.take(0)
    assert [item for source, item in taken if source == "quiet"] == list(range(40))
    assert inbox.dropped == {"flood": 40 * 50 - 60}


def test_large_items_cost_what_they_weigh() -> None:
    inbox: Inbox[str] = Inbox(10, slot_bytes=1000)
    for i in range(5):
        inbox.put("small", f"s{i}", 10)
    for i in range(4):
        inbox.put("large", f"l{i}", 2500)
    assert [item for _, item in inbox.take(0)] == ["s0", "s1", "s2", "s3", "s4", "l3"]
    inbox.put("huge", "h", 10**9)
    assert inbox.take(0) == []
    assert inbox.dropped == {"large": 3, "huge": 1}


def test_names_without_end_share_one_account() -> None:
    inbox: Inbox[int] = Inbox(200, max_sources=8)
    for i in range(5):
        inbox.put("known", i)
    for i in range(10_000):
        inbox.put(f"name-{i}", i)
    taken = inbox.take(0)
    assert len(taken) == 200
    assert [item for source, item in taken if source == "known"] == list(range(5))
    assert inbox.dropped == {Inbox.OTHERS: 10_005 - 200}
    # Nor do the counters grow without limit when names come one after another.
    small: Inbox[int] = Inbox(1, max_sources=8)
    for i in range(1000):
        small.put(f"name-{i}", i)
    assert len(small.dropped) <= 9
    assert sum(small.dropped.values()) == 999


def test_nothing_is_lost_or_made_up_between_threads() -> None:
    inbox: Inbox[int] = Inbox(300)
    senders, each = 4, 5000
    taken: list[tuple[str, int]] = []
    finished = threading.Event()

    def send(name: str) -> None:
        for i in range(each):
            inbox.put(name, i)

    def receive() -> None:
        while not finished.is_set() or len(inbox):
            taken.extend(inbox.take(0.05))

    receiver = threading.Thread(target=receive)
    receiver.start()
    threads = [threading.Thread(target=send, args=(f"s{i}",)) for i in range(senders)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    finished.set()
    receiver.join()
    assert len(taken) + sum(inbox.dropped.values()) == senders * each
    for i in range(senders):
        items = [item for source, item in taken if source == f"s{i}"]
        assert items == sorted(set(items))
        assert len(items) + inbox.dropped.get(f"s{i}", 0) == each
    assert inbox.high_water <= 300


def test_take_waits_no_longer_than_told() -> None:
    inbox: Inbox[int] = Inbox(4)
    begin = time.monotonic()
    assert inbox.take(0.1) == []
    assert 0.1 <= time.monotonic() - begin < 1.0 * slowness()


@pytest.mark.parametrize("act", ["put", "wake"])
def test_take_for_ever_ends_with_an_item_or_wake(act: str) -> None:
    inbox: Inbox[int] = Inbox(4)
    timer = threading.Timer(0.05, lambda: inbox.put("a", 1) if act == "put" else inbox.wake())
    timer.start()
    assert inbox.take(None) == ([("a", 1)] if act == "put" else [])
    timer.join()


def test_wake_before_take_is_not_lost_and_counts_once() -> None:
    inbox: Inbox[int] = Inbox(4)
    inbox.wake()
    begin = time.monotonic()
    assert inbox.take(30) == []
    assert time.monotonic() - begin < 5 * slowness()
    assert inbox.take(0.01) == []


def test_a_signal_handler_may_wake_the_thread_it_interrupts() -> None:
    inbox: Inbox[int] = Inbox(4)
    old = signal.signal(signal.SIGALRM, lambda *_: inbox.wake())
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        assert inbox.take(None) == []
        # In the middle of puts, where this same thread holds the lock.
        signal.setitimer(signal.ITIMER_REAL, 0.0005, 0.0005)
        for i in range(20_000):
            inbox.put("a", i)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    assert [item for _, item in inbox.take(0)] == [19_996, 19_997, 19_998, 19_999]


@pytest.mark.parametrize(
    "arguments", [{"capacity": 0}, {"capacity": 1, "slot_bytes": 0}, {"capacity": 1, "max_sources": 0}]
)
def test_an_inbox_without_room_is_refused(arguments: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="at least one"):
        Inbox(**arguments)
