"""Operators' orders: what each does in a centre that runs, that it goes on doing it, and that all of it is told."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import schemas
from fusion_service.centre import WHAT, FusionCentre, LocalId, Order, StepResult, View, judge, order_of, read_order
from fusion_service.centre.constraints import constraints
from fusion_service.centre.judging import Standing
from fusion_service.centre.orders import Orders
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import empty_tracks
from fusion_service.order import order_event
from schemas.messages import APART, BROKEN, IDENTITY_ORDERED
from tests.centre.worlds import START, centre, give, info, moved, step, tracks, truth

PLACES = np.array([[0.0, 0.0, 0.0, 0.0], [5000.0, 0.0, 0.0, 0.0], [0.0, 8000.0, 0.0, 0.0]])


class World:
    """Three targets at rest, seen by two sources every second under local ids 1, 2, 3 and 11, 12, 13."""

    def __init__(self, **config: Any) -> None:
        self.centre = centre(("r1", "r2"), **config)
        self.second = 0
        self.left_out: set[tuple[str, int]] = set()
        self.results: list[StepResult] = []
        self.given: list[Any] = []

    def go(self, *orders: Order, seconds: int = 1) -> StepResult:
        for _ in range(seconds):
            self.second += 1
            batch: list[Any] = [*orders]
            orders = ()
            for name, base in (("r1", 0), ("r2", 10)):
                ids = [base + k for k in (1, 2, 3) if (name, base + k) not in self.left_out]
                batch.append(tracks(name, self.second, PLACES[[k - base - 1 for k in ids]], ids))
            give(self.centre, *batch)
            self.given.append(batch)
            self.results.append(step(self.centre, self.second))
        return self.results[-1]

    def at(self, target: int, result: StepResult | None = None) -> set[int]:
        """The global ids at a target."""
        picture = (result or self.results[-1]).tracks
        near = np.linalg.norm(picture.means[:, :2] - PLACES[target, :2], axis=1) < 300
        return set(picture.ids[near].tolist())

    def feeders(self, track: int) -> set[tuple[str, int]]:
        picture = self.results[-1].tracks
        owner = np.repeat(picture.ids, picture.contributor_counts) == track
        names = [picture.sources[k] for k in picture.contributor_source[owner]]
        return set(zip(names, picture.contributor_id[owner].tolist(), strict=True))

    def said(self, result: StepResult | None = None) -> list[dict[str, Any]]:
        return [event for event in (result or self.results[-1]).log.events if event["kind"].startswith("order")]


@pytest.fixture
def world() -> World:
    made = World()
    made.go(seconds=4)
    for target in range(3):
        assert len(made.at(target)) == 1
        assert made.feeders(min(made.at(target))) == {("r1", target + 1), ("r2", target + 11)}
    return made


def test_a_deleted_track_stays_away_until_its_local_ids_end(world: World) -> None:
    [track] = world.at(0)
    gone = world.go(Order("delete", track=track, who="anna", why="clutter"))
    assert gone.tracks.ended == ((track, "ordered", None),)
    [event] = world.said(gone)
    assert (event["what"], event["track"], event["who"], event["why"], event["done"], event["number"]) == (
        *("delete", track, "anna", "clutter", True, 1),
    )
    assert "r1 1" in event["outcome"]
    assert "r2 11" in event["outcome"]
    for _ in range(10):
        world.go()
        assert world.at(0) == set()
        assert len(world.at(1)) == len(world.at(2)) == 1
    assert gone.status.tracks["orders"] == 1
    world.left_out = {("r1", 1), ("r2", 11)}
    world.go(seconds=2)
    assert [event["kind"] for event in world.said()] == ["order_ended"]
    world.left_out = set()
    world.go(seconds=3)
    [back] = world.at(0)
    assert back > track


def test_a_deleted_track_stays_away_until_a_time_whatever_its_local_ids_do(world: World) -> None:
    [track] = world.at(0)
    world.go(Order("delete", track=track, until=START + 20 * 10**9))
    world.left_out = {("r1", 1), ("r2", 11)}
    world.go(seconds=2)
    world.left_out = set()
    while world.second < 19:
        world.go()
        assert world.at(0) == set()
    world.go(seconds=2)
    assert len(world.at(0)) == 1


@pytest.mark.parametrize(
    ("order", "why"),
    [
        (Order("delete", track=99), "there is no track 99: known are 1, 2, 3"),
        (Order("delete"), "needs a global track"),
        (Order("delete", track=-4), "no track -4"),
        (Order("explode"), "no order 'explode': known are delete, "),
        (Order("drop", "r9"), "no source 'r9': known are r1, r2"),
        (Order("link", track=1, local=LocalId("r1", -1, 77)), "no local track 77 of r1: known are 1, 2, 3"),
        (Order("link", track=1, local=LocalId("r1", 5, 1)), "epoch 1, not 5"),
        (Order("unlink", track=2, local=LocalId("r1", -1, 1)), "r1 1 belongs to track 1"),
        (Order("merge", track=1, other=2), "both have a local track of r1"),
        (Order("merge", track=1, other=1), "two different tracks"),
        (Order("mute", "no name!"), "bad name"),
        (Order("unmute", "r1"), "r1 is not muted"),
        (Order("withdraw", withdrawn=7), "no standing order 7: known are none"),
        (Order("rename", track=1), "a number or a callsign"),
        (Order("identify", track=1), "needs an identity"),
        (Order("mute", "r1", until=START), "has passed"),
        (Order("mute", "r1", refused="said no"), "said no"),
    ],
)
def test_what_cannot_be_done_is_told_and_changes_nothing(world: World, order: Order, why: str) -> None:
    assert world.at(0) == {1}
    before = [world.feeders(track) for track in (1, 2, 3)]
    result = world.go(order)
    [event] = world.said(result)
    assert not event["done"]
    assert why in event["outcome"]
    assert [world.feeders(track) for track in (1, 2, 3)] == before
    assert world.centre.orders.listed() == []
    assert result.tracks.ended == ()


def test_a_local_track_unlinked_stays_away_and_comes_back_when_that_is_withdrawn(world: World) -> None:
    [track] = world.at(0)
    world.go(Order("unlink", local=LocalId("r2", -1, 11)))
    for _ in range(8):
        world.go()
        assert world.feeders(track) == {("r1", 1)}
        assert len(world.at(0)) == 2
    [listed] = world.centre.orders.listed()
    assert (listed["what"], listed["track"], listed["local"]) == ("unlink", track, ["r2", 1, 11])
    world.go(Order("withdraw", withdrawn=listed["number"]))
    world.go(seconds=8)
    assert world.at(0) == {track}
    assert world.feeders(track) == {("r1", 1), ("r2", 11)}


def test_a_split_track_starts_its_own_and_is_told(world: World) -> None:
    [track] = world.at(1)
    result = world.go(Order("split", track=track, local=LocalId("r2", -1, 12)))
    [(new, old)] = result.tracks.split_from
    assert old == track
    for _ in range(8):
        world.go()
        assert world.at(1) == {track, new}
        assert world.feeders(new) == {("r2", 12)}


def test_two_local_tracks_that_never_belong_together(world: World) -> None:
    [track] = world.at(2)
    world.go(Order("never-link", local=LocalId("r1", -1, 3), against=LocalId("r2", -1, 13)))
    for _ in range(8):
        world.go()
        assert world.feeders(track) == {("r1", 3)}
        [other] = world.at(2) - {track}
        assert world.feeders(other) == {("r2", 13)}


def test_a_link_overrules_what_kept_them_apart_and_the_other_way_round(world: World) -> None:
    [track] = world.at(0)
    local = LocalId("r2", -1, 11)
    world.go(Order("never-link", track=track, local=local))
    world.go(seconds=4)
    assert world.feeders(track) == {("r1", 1)}
    world.go(Order("link", track=track, local=local))
    world.go(seconds=4)
    assert world.feeders(track) == {("r1", 1), ("r2", 11)}
    assert [one["what"] for one in world.centre.orders.listed()] == ["link"]
    world.go(Order("never-link", track=track, local=local))
    world.go(seconds=4)
    assert world.feeders(track) == {("r1", 1)}
    assert [one["what"] for one in world.centre.orders.listed()] == ["never-link"]


def decided(result: StepResult, kind: int) -> list[tuple[str, int]]:
    """The local tracks of which this was decided."""
    one = result.log.decisions
    some = one.kind == kind
    return [(result.log.sources[k], i) for k, i in zip(one.source[some].tolist(), one.id[some].tolist(), strict=True)]


@pytest.mark.parametrize("ordered", [False, True])
def test_an_ordered_link_stands_against_all_evidence_and_is_left_out_while_it_fails(ordered: bool) -> None:
    """r2's track of the first target wanders off 3 km for half a minute, while another of r2 comes up at the target."""
    world = World()
    world.go(seconds=12)
    [track] = world.at(0)
    if ordered:
        world.go(Order("link", track=track, local=LocalId("r2", -1, 11)))
    broken: list[tuple[str, int]] = []
    for _ in range(30):
        world.second += 1
        away, there = PLACES + np.array([0.0, 3000.0, 0.0, 0.0]), PLACES[[1, 2, 0]]
        own = tracks("r1", world.second, PLACES)
        give(world.centre, own, tracks("r2", world.second, np.concatenate([away[:1], there]), [11, 12, 13, 99]))
        world.results.append(step(world.centre, world.second))
        broken += decided(world.results[-1], BROKEN)
        assert ("r2", 11) not in world.feeders(track)
    assert broken == ([] if ordered else [("r2", 11)])
    assert world.feeders(track) == ({("r1", 1)} if ordered else {("r1", 1), ("r2", 99)})
    world.go()
    assert world.feeders(track) == {("r1", 1), ("r2", 11)}


def test_a_link_that_an_order_forbids_is_broken_at_once_whoever_made_it() -> None:
    world = World()
    world.go(seconds=4)
    orders = Order("never-link", local=LocalId("r1", -1, 3), against=LocalId("r2", -1, 13))
    world.go(orders, Order("link", track=3, local=LocalId("r2", -1, 13)), seconds=2)
    assert world.feeders(3) == {("r2", 13)}, "what is ordered to be linked stays, the other one leaves"
    assert decided(world.results[-2], BROKEN) == [("r1", 3)]


def test_names_and_identity_go_out_and_follow_a_merge(world: World) -> None:
    [track] = world.at(0)
    world.go(Order("unlink", local=LocalId("r2", -1, 11)))
    world.go()
    [other] = world.at(0) - {track}
    orders = Order("rename", track=other, name="PILOT 2", shown=12), Order("identify", track=other, identity="mmsi:7")
    picture = world.go(*orders).tracks
    row = picture.ids.tolist().index(other)
    assert picture.callsign is not None
    assert picture.number is not None
    assert picture.identity is not None
    assert picture.identity_p is not None
    assert picture.marks is not None
    assert (picture.callsign[row], picture.number[row], picture.identity[row]) == ("PILOT 2", 12, "mmsi:7")
    assert picture.identity_p[row] == 1.0
    assert picture.marks[row] == IDENTITY_ORDERED
    assert [name for name in picture.callsign if name] == ["PILOT 2"]
    again = world.go(Order("rename", track=track, shown=12))
    assert not world.said(again)[0]["done"]
    merged = world.go(Order("withdraw", withdrawn=1), Order("merge", track=track, other=other))
    assert (other, "merged", track) in merged.tracks.ended
    picture = world.go().tracks
    assert world.feeders(track) == {("r1", 1), ("r2", 11)}
    row = picture.ids.tolist().index(track)
    assert picture.callsign is not None
    assert picture.identity is not None
    assert (picture.callsign[row], picture.identity[row]) == ("PILOT 2", "mmsi:7")


def test_a_source_in_quarantine_has_tracks_of_its_own_marked_and_comes_back(world: World) -> None:
    before = {target: min(world.at(target)) for target in range(3)}
    assert world.go().tracks.marks is None
    world.go(Order("quarantine", "r2"))
    for _ in range(6):
        picture = world.go().tracks
        assert picture.marks is not None
        for target, track in before.items():
            assert world.feeders(track) == {("r1", target + 1)}
            [own] = world.at(target) - {track}
            assert world.feeders(own) == {("r2", target + 11)}
            assert picture.marks[picture.ids == own] == APART
            assert picture.marks[picture.ids == track] == 0
    assert world.results[-1].status.tracks["apart"] == 3
    world.go(Order("release", "r2"))
    world.go(seconds=8)
    for target, track in before.items():
        assert world.feeders(track) == {("r1", target + 1), ("r2", target + 11)}
        assert world.at(target) == {track}
    assert world.results[-1].tracks.marks is None


def test_drop_forgets_the_tracks_of_a_source_now(world: World) -> None:
    give(world.centre, Order("drop", "r2"))
    result = step(world.centre, world.second + 0.5)
    [event] = world.said(result)
    assert event["outcome"] == "forgets 3 tracks of r2"
    names = {result.tracks.sources[k] for k in result.tracks.contributor_source}
    assert names == {"r1"}


def test_a_mute_ends_at_its_time_and_when_withdrawn(world: World) -> None:
    world.go(Order("mute", "r2", until=START + 8 * 10**9))

    def refused() -> int:
        return world.results[-1].status.refused.get("muted", 0)

    world.go(seconds=2)
    assert (world.second, refused()) == (7, 3)
    world.go(seconds=2)
    assert refused() == 3
    world.go(Order("mute", "r2"))
    [one] = world.centre.orders.listed()
    world.go(Order("mute", "r2"))
    assert "muted already by order" in world.said()[0]["outcome"]
    world.go(Order("withdraw", withdrawn=one["number"]))
    assert refused() == 5
    world.go()
    assert refused() == 5


def test_the_config_ignores_a_source_whatever_a_checkpoint_or_an_order_says() -> None:
    world = World()
    world.go(seconds=3)
    blob = world.centre.checkpoint()
    world.centre = FusionCentre({"lateness": 3.0, "sources": {"r2": {"ignore": True}}}, blob)
    result = world.go(Order("unmute", "r2"))
    assert not world.said(result)[0]["done"]
    assert result.status.sources["r2"]["muted"] is True
    assert result.status.refused == {"muted": 1}
    other = FusionCentre({"lateness": 3.0}, world.centre.checkpoint())
    assert step(other, world.second + 1).status.sources["r2"]["muted"] is False


ALL = (
    Order("unlink", local=LocalId("r2", -1, 11), who="b", why="w"),
    Order("delete", track=2, until=START + 30 * 10**9),
    Order("never-link", local=LocalId("r1", -1, 3), against=LocalId("r2", -1, 13)),
    Order("rename", track=1, name="A", shown=3),
    Order("identify", track=1, identity="icao:4ca7b4"),
    Order("quarantine", "r2"),
    Order("mute", "r9"),
    Order("explode"),
)


def test_orders_are_in_the_checkpoint_and_obeyed_from_it_bit_for_bit() -> None:
    world = World()
    world.go(seconds=3)
    world.go(*ALL)
    assert [event["done"] for event in world.said()] == [True] * 7 + [False]
    assert len(world.centre.orders.listed()) == 7
    other = FusionCentre({"lateness": 3.0}, world.centre.checkpoint())
    assert other.orders.listed() == world.centre.orders.listed()
    for _ in range(6):
        expected = world.go()
        give(other, *world.given[-1])
        made = step(other, world.second)
        published = dataclasses.replace(made.tracks, seq=expected.tracks.seq)
        assert schemas.encode(published) == schemas.encode(expected.tracks)
    assert other.checkpoint() == world.centre.checkpoint()


def test_who_obeys_the_log_makes_the_same_steps() -> None:
    world = World()
    world.go(seconds=3)
    world.go(*ALL)
    world.go(Order("withdraw", withdrawn=1), Order("release", "r2"), seconds=4)
    again = FusionCentre({"lateness": 3.0})
    for name in ("r1", "r2"):
        give(again, info(name))
    for batch, recorded in zip(world.given, world.results, strict=True):
        orders = [order for event in schemas_events(recorded) if (order := order_of(event)) is not None]
        give(again, *orders, *[one for one in batch if not isinstance(one, Order)])
        made = again.step(recorded.log.time)
        assert schemas.encode(made.tracks) == schemas.encode(recorded.tracks)
        assert schemas.encode(made.log) == schemas.encode(recorded.log)


def schemas_events(result: StepResult) -> tuple[dict[str, Any], ...]:
    """The events of a log as they come from the wire."""
    log = schemas.decode(schemas.encode(result.log))
    assert isinstance(log, schemas.StepLog)
    return log.events


def test_the_order_events_of_old_logs_are_read() -> None:
    assert order_of({"kind": "order", "what": "mute", "source": "r2", "track": None}) == Order("mute", "r2")
    assert order_of({"kind": "order", "what": "delete", "source": "", "track": 5}) == Order("delete", track=5)
    for strange in (
        {},
        {"kind": "order"},
        {"kind": "order", "what": 3},
        {"kind": "order", "what": "mute", "source": 5},
    ):
        assert order_of(strange) is None


TEXTS = st.text(st.characters(codec="utf-8", categories=["L", "N"]), max_size=20)
LOCALS = st.builds(LocalId, TEXTS, st.integers(-1, 2**64 - 1), st.integers(0, 2**64 - 1))
ORDERS = st.builds(
    Order,
    st.sampled_from(list(WHAT)) | TEXTS,
    st.sampled_from(["r1", "r2"]) | TEXTS,
    track=st.none() | st.integers(0, 2**64 - 1) | st.integers(0, 4),
    other=st.none() | st.integers(0, 4),
    who=TEXTS,
    why=TEXTS,
    until=st.none() | st.integers(0, 2**63 - 1),
    local=st.none() | LOCALS | st.builds(LocalId, st.sampled_from(["r1", "r2"]), st.just(-1), st.integers(0, 14)),
    against=st.none() | LOCALS,
    name=TEXTS,
    shown=st.integers(0, 2**32 - 1),
    identity=TEXTS,
    withdrawn=st.integers(0, 2**63 - 1),
    number=st.integers(0, 2**40),
)


@given(ORDERS)
def test_an_order_comes_back_from_its_event(order: Order) -> None:
    assert order_of(order_event(order)) == order


@settings(max_examples=25, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.lists(ORDERS, max_size=6))
def test_no_order_raises_and_all_are_told(orders: list[Order]) -> None:
    world = World()
    world.go(seconds=2)
    result = world.go(*orders)
    told = [event for event in result.log.events if event["kind"] == "order"]
    assert [event["what"] for event in told] == [order.what for order in orders]
    assert all(event["outcome"] for event in told)
    assert sorted({event["number"] for event in told}) == [event["number"] for event in told]
    world.go(seconds=2)
    schemas.encode(result.log)
    FusionCentre({"lateness": 3.0}, world.centre.checkpoint())


@given(st.dictionaries(st.sampled_from([one.name for one in dataclasses.fields(Order)]), st.from_type(object) | TEXTS))
def test_a_request_of_any_form_is_an_order_or_told_in_a_line(raw: dict[str, Any]) -> None:
    try:
        order = read_order(raw)
    except ValueError as error:
        told = str(error)
    else:
        told = judge(order, View(0, np.zeros(0, dtype=np.uint64), {}, {})).text
    assert told
    assert "\n" not in told


def test_constraints_against_a_plain_search() -> None:
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print("seed", seed)
    rng = np.random.default_rng(seed)
    some = 0
    for _ in range(50):
        names = ("a", "b", "c")
        source = np.sort(rng.integers(0, 3, 12))
        ids = np.concatenate([np.sort(rng.choice(20, int(n), replace=False)) for n in np.bincount(source, minlength=3)])
        link = rng.integers(0, 5, 12).astype(np.uint64)
        epoch = (source + 5).astype(np.uint64)
        table = dataclasses.replace(empty_tracks(2), id=ids.astype(np.uint64), link=link)
        every, interval = np.ones(12, dtype=np.bool_), np.full(12, 10**9)
        rows = Rows(source, epoch, table, every, interval, lost=~every, gate=np.ones(12), fresh=every, kept={})
        who = [LocalId(names[s], int(e), int(i)) for s, e, i in zip(source, epoch, ids, strict=True)]

        def pick(k: int, who: list[LocalId] = who) -> LocalId:
            one = who[rng.integers(len(who))]
            return one if rng.random() < 0.8 else one._replace(epoch=99 + k)

        orders = Orders()
        held: list[LocalId] = []
        never: set[tuple[LocalId, int]] = set()
        forced: set[tuple[LocalId, int]] = set()
        beside: set[frozenset[LocalId]] = set()
        for number in range(1, 9):
            what = ("delete", "unlink", "link", "never-link")[number % 4]
            local, other, track = pick(number), pick(number), int(rng.integers(1, 5))
            if what == "delete":
                orders.standing[number] = Standing(Order("delete", number=number), (local, other))
                held += [local, other]
            elif what == "never-link" and local != other:
                orders.standing[number] = Standing(Order(what, local=local, against=other, number=number))
                beside.add(frozenset((local, other)))
            elif what != "never-link":
                orders.standing[number] = Standing(Order(what, local=local, track=track, number=number))
                (forced if what == "link" else never).add((local, track))
        found = constraints(orders, rows, names)
        assert found.held.tolist() == [one in held for one in who]
        expected = {(k, t) for k, one in enumerate(who) for t in range(1, 5) if (one, t) in never}
        expected |= {
            (k, int(link[m])) for k in range(12) for m in range(12) if {who[k], who[m]} in beside and k != m and link[m]
        }
        assert list(zip(found.forbidden_row.tolist(), found.forbidden_track.tolist(), strict=True)) == sorted(expected)
        pairs = [(k, t) for k in range(12) for t in range(1, 6)]
        row, track_of = np.array([k for k, _ in pairs]), np.array([t for _, t in pairs], dtype=np.uint64)
        assert found.forbids(row, track_of).tolist() == [pair in expected for pair in pairs]
        got = list(zip(found.forced_row.tolist(), found.forced_track.tolist(), strict=True))
        assert got == sorted((k, t) for k, one in enumerate(who) for t in range(1, 5) if (one, t) in forced)
        i, j = (np.array(side) for side in zip(*[(k, m) for k in range(12) for m in range(12) if k != m], strict=True))
        assert found.parts(i, j).tolist() == [{who[k], who[m]} in beside for k, m in zip(i, j, strict=True)]
        separate = {tuple(sorted((int(link[k]), t))) for k, t in expected if link[k] and link[k] != t}
        assert [tuple(pair) for pair in found.separate.tolist()] == sorted(separate)
        some += len(expected)
    assert some > 50


def test_orders_of_a_step_hold_whatever_order_the_messages_come_in() -> None:
    states = truth(6)
    made = []
    for turned in (False, True):
        one = centre(("r1", "r2"))
        for second in range(1, 8):
            batch = [tracks(name, second, moved(states, second)) for name in ("r1", "r2")]
            orders = [Order("delete", track=2), Order("quarantine", "r1")] if second == 4 else []
            give(one, *(reversed(batch) if turned else batch), *orders)
            result = step(one, second)
            made.append((turned, schemas.encode(result.tracks), schemas.encode(result.log)))
    assert [one[1:] for one in made if one[0]] == [one[1:] for one in made if not one[0]]
