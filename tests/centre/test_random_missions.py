"""Whatever comes in, under whatever settings: a step is made, and what it says is sound, repeatable and replayable."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, LocalId, Order, SourceFound, StepResult
from fusion_service.centre.candidates import MOST_RIVALS
from schemas.messages import IDENTITY_ORDERED, KEPT, MERGED, SPLIT
from tests.centre.worlds import centre, give, info, step, tracks
from tests.helpers import random_missions
from tests.helpers.random_missions import Mission

QUICK = range(6)


def said(result: StepResult, *, restarted: bool = False) -> tuple[bytes, bytes]:
    """Picture and log as bytes; of a centre that began again without what only tells of that."""
    log, picture = result.log, result.tracks
    if restarted:
        events = tuple(event for event in log.events if event["kind"] != "start")
        log, picture = dataclasses.replace(log, seq=0, events=events), dataclasses.replace(picture, seq=0)
    return schemas.encode(picture), schemas.encode(log)


def check_sound(mission: Mission) -> None:
    """Every message of every step can be sent and says nothing impossible; ids go up and never come again."""
    newest, over = 0, set[int]()
    for result in mission.results:
        for message in (result.tracks, result.log, result.status):
            assert schemas.encode(schemas.decode(schemas.encode(message))) == schemas.encode(message)
        picture, log = result.tracks, result.log
        ids = picture.ids.tolist()
        assert ids == sorted(set(ids))
        kind, track = log.decisions.kind, log.decisions.track
        born = track[kind == schemas.messages.BORN].tolist()
        assert born == sorted(set(born))
        assert all(one > newest for one in born)
        newest = max([newest, *born])
        assert all(one <= newest for one in ids)
        ended = [old for old, _, _ in picture.ended]
        assert len(ended) == len(set(ended))
        over |= set(ended)
        assert not over & set(ids)
        assert set(track.tolist()) <= set(range(random_missions.GENERATION << 32, newest + 1)) | over
        assert np.isfinite(picture.means).all()
        assert np.isfinite(picture.covariances).all()
        sigma = np.sqrt(np.diagonal(picture.covariances, axis1=1, axis2=2))
        assert (np.linalg.eigvalsh(picture.covariances / sigma[:, :, None] / sigma[:, None]) > 0).all()
        assert ((picture.existence >= 0) & (picture.existence <= 1)).all()
        check_contributors(picture, log)


def check_contributors(picture: schemas.GlobalTracks, log: schemas.StepLog) -> None:
    """One local track of a source in a global one at most, each in one only, and known to the log."""
    owner = np.repeat(picture.ids, picture.contributor_counts)
    assert len(owner) == len(picture.contributor_source) == len(picture.contributor_id)
    pairs = list(zip(owner.tolist(), picture.contributor_source.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))
    local = list(zip(picture.contributor_source.tolist(), picture.contributor_id.tolist(), strict=True))
    assert len(local) == len(set(local))
    assert all(source < len(picture.sources) for source, _ in local)
    influence = picture.contributor_influence
    assert np.isfinite(influence).all()
    decisions = log.decisions
    kept = np.isin(decisions.kind, [schemas.messages.KEPT, schemas.messages.LINKED, schemas.messages.EXCHANGED])
    known = set(zip(decisions.source[kept].tolist(), decisions.id[kept].tolist(), strict=True))
    assert set(local) <= known


def check(seed: int, partial: bool = False) -> Mission:
    return check_mission(random_missions.fly(seed, partial=partial), seed)


def check_mission(mission: Mission, seed: int) -> Mission:
    """It is sound, and comes out the same in another order, from its logs, and of a centre that begins anew."""
    check_sound(mission)
    recorded = [said(result) for result in mission.results]
    rng = np.random.default_rng(seed)
    assert [said(result) for result in random_missions.again(mission, rng)] == recorded, "order of arrival"
    pictures = [picture for picture, _ in recorded]
    assert [said(result)[0] for result in random_missions.from_logs(mission)] == pictures, "from the logs"
    after = int(rng.integers(1, len(mission.given)))
    as_it_comes = dataclasses.replace(mission, config=dataclasses.replace(mission.config, revise=0.0))
    whole = [said(result, restarted=True) for result in random_missions.again(as_it_comes)[after:]]
    assert [said(result, restarted=True) for result in random_missions.restarted(as_it_comes, after)] == whole, after
    return mission


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in QUICK[2:])])
def test_any_mission(seed: int) -> None:
    print("seed", seed)
    check(seed)


@pytest.mark.parametrize("seed", range(8))
def test_any_mission_of_sources_that_do_not_tell_all(seed: int) -> None:
    print("seed", seed)
    mission = check(seed, partial=True)
    if seed == 0:
        spaces = {
            event.space
            for one in (random_missions.fly(k, partial=True) for k in range(8))
            for given in one.given
            for event, _ in given.events
            if isinstance(event, schemas.LocalTracks)
        }
        assert len(spaces) > 4
        assert any((result.tracks.contributor_counts > 1).any() for result in mission.results)


@pytest.mark.parametrize("seed", [1098, 1102])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_missions_that_were_not_sound(seed: int) -> None:
    """Mixtures that rule each other out; a row that has failed its gate in a track that is merged: it stays out."""
    check_sound(random_missions.fly(seed))


def test_the_missions_hold_what_they_should() -> None:
    """They are not empty: tracks of several sources, links changed, orders obeyed and refused, refusals."""
    kinds, events, reasons, together = set[int](), set[str](), set[str](), 0
    for seed in QUICK:
        for result in random_missions.fly(seed).results:
            kinds |= set(result.log.decisions.kind.tolist())
            events |= {event["kind"] + str(event.get("done", "")) for event in result.log.events}
            reasons |= {entry.reason for entry in result.log.refused}
            together += int((result.tracks.contributor_counts > 1).sum())
    assert together > 60
    assert kinds >= {schemas.messages.BROKEN, schemas.messages.EXCHANGED, schemas.messages.DELETED}
    assert events >= {"orderTrue", "orderFalse", "restarted", "found"}
    assert reasons >= {"late", "repeat", "not-finite", "future"}


class World:
    """Two targets that two sources see, with ids that a float does not hold."""

    def __init__(self, **config: Any) -> None:
        self.centre = FusionCentre({"lateness": 3.0, **config}, generation=random_missions.GENERATION)
        give(self.centre, info("r1"), info("r2"))
        self.places = np.array([[0.0, 0, 0, 0], [8000.0, 0, 0, 0]])

    def go(self, second: int, *events: Any, **changes: Any) -> StepResult:
        sent = [tracks(name, second, self.places, [2**63 + 1, 2**64 - 1], **changes) for name in ("r1", "r2")]
        give(self.centre, *events, *sent)
        return step(self.centre, second)


def test_what_is_said_beside_the_densities_is_of_the_tracks_that_go_out() -> None:
    """Origins and marks are those of the tracks in a region, one of two, and not of the other, which is ordered."""
    near = World(publish_region={"kind": "disk", "radius": 1000.0})
    near.go(1, origin="exercise")
    shown = near.go(2, origin="exercise").tracks
    assert len(shown.ids) == 1
    far = int(near.centre.view().ids[1])
    order = Order("identify", track=far, identity="mmsi:1")
    quarantine = Order("quarantine", source="r1")
    shown = near.go(3, order, quarantine, origin="exercise").tracks
    schemas.encode(shown)
    assert shown.marks is not None
    assert len(shown.marks) == len(shown.ids)
    assert not (shown.marks & IDENTITY_ORDERED).any()
    none = World(publish_status=["coasting"])
    none.go(1)
    shown = none.go(2, Order("identify", track=int(none.centre.view().ids[0]), identity="mmsi:1")).tracks
    assert len(shown.ids) == 0
    schemas.encode(shown)


def test_a_log_holds_ids_to_the_last_bit() -> None:
    """In a step with a merge too, whose numbers are not of one type."""
    world = World()
    world.go(1)
    world.go(2)
    split = world.go(3, Order("split", local=LocalId("r2", -1, 2**63 + 1))).log
    old, new = (int(one) for one in world.centre.view().ids[[0, -1]])
    log = world.go(4, Order("merge", track=old, other=new)).log.decisions
    assert split.decisions.track[split.decisions.kind == SPLIT].tolist() == [new]
    assert log.track[log.kind == MERGED].tolist() == [new]
    assert log.other[log.kind == MERGED].tolist() == [old]
    assert set(log.id[log.kind == KEPT].tolist()) == {2**63 + 1, 2**64 - 1}
    assert set(log.track[log.kind == KEPT].tolist()) <= set(world.centre.view().ids.tolist())


def test_a_source_that_is_known_but_was_never_heard() -> None:
    """Its token is there, and the config says what it is: it may be used, and has nothing."""
    world = World(sources={"r9": {"override": True}})
    assert len(world.go(1, SourceFound("r9")).tracks.ids) == 2


def test_rivals_are_few_where_all_tracks_coincide() -> None:
    """100 coincident tracks of two sources, each followed under its own id: sums for the nearest of them alone."""
    crowd = centre(("r1", "r2"))
    for second in range(1, 4):
        give(crowd, *(tracks(name, second, np.zeros((100, 4))) for name in ("r1", "r2")))
        assert len(step(crowd, second).tracks.ids) == 100
    known = msgpack.unpackb(crowd.checkpoint())["own"]["rivals"]
    assert [name for name, *_ in known] == ["r1", "r2"]
    assert all(0 < len(ids) // 8 <= 100 * MOST_RIVALS for _, ids, _, _ in known)
