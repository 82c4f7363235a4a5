"""Identity, class and origin: fused by Bayes, published, a help to association, never mixed where they must not be."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, LocalId, Order, StepResult
from fusion_service.centre.beliefs import CANDIDATES, DEPTH, Beliefs, learned, no_beliefs
from fusion_service.centre.words import MOST_TEXT, NONE, Words
from fusion_service.config import ConfigError
from schemas.messages import IDENTITY_TWICE
from tests.centre.worlds import SIGMA, START, centre, give, info, step, tracks

HERE = np.array([[0.0, 0.0, 0.0, 0.0]])
NEAR = HERE + np.array([[20.0, 0.0, 0.0, 0.0]])
FAR = HERE + np.array([[9000.0, 0.0, 0.0, 0.0]])


def of(result: StepResult, name: str) -> list[Any]:
    """A column of a picture by track, Nones where it has none."""
    column = getattr(result.tracks, name)
    return [None] * len(result.tracks.ids) if column is None else list(column)


def events(result: StepResult, kind: str) -> list[dict[str, Any]]:
    return [event for event in result.log.events if event["kind"] == kind]


# Bayes


def direct(reports: list[tuple[int, float]], classes: int) -> np.ndarray:
    """Posterior over `classes` answers, uniform before, of independent reports (answer, probability of being right)."""
    p = np.full(classes, 1.0 / classes)
    for said, right in reports:
        p *= [right if one == said else (1 - right) / (classes - 1) for one in range(classes)]
        p /= p.sum()
    return p


@pytest.mark.parametrize("classes", [2, 3, 6])
def test_beliefs_against_bayes_in_full(classes: int) -> None:
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print("seed", seed)
    rng = np.random.default_rng(seed)
    for _ in range(50):
        # four reports that agree stay below `DEPTH`, where beliefs are Bayes to the last
        reports = [(int(rng.integers(min(classes, CANDIDATES))), float(rng.uniform(0.4, 0.65))) for _ in range(4)]
        beliefs = no_beliefs()
        for said, right in reports:
            gain = np.log(right * (classes - 1) / (1 - right))
            beliefs = learned(beliefs, np.array([7], "u8"), np.zeros(1, "i4"), np.array([said], "i4"), np.array([gain]))
        p = dict(zip(beliefs.code[:, 0].tolist(), beliefs.probabilities(classes)[:, 0].tolist(), strict=True))
        expected = direct(reports, classes)
        for said in {said for said, _ in reports}:
            assert p[said] == pytest.approx(expected[said], rel=1e-9)


def test_many_beliefs_at_once_are_as_each_alone() -> None:
    rng = np.random.default_rng(11)
    track, question = rng.integers(1, 30, 400).astype(np.uint64), rng.integers(0, 2, 400).astype(np.int32)
    code, gain = rng.integers(0, 9, 400).astype(np.int32), rng.normal(2.0, 2.0, 400)

    def heard(beliefs: Beliefs, rows: Any) -> Beliefs:
        return learned(beliefs, track[rows], question[rows], code[rows], gain[rows])

    whole = heard(heard(no_beliefs(), slice(0, 250)), slice(250, None))
    assert len(whole.track) > 40
    for row in range(len(whole.track)):
        mine = (track == whole.track[row]) & (question == whole.question[row])
        alone = no_beliefs()
        for k in np.flatnonzero(mine):
            alone = heard(alone, [k])
        for name in ("track", "question", "code", "weight"):
            assert getattr(alone, name)[..., 0].tobytes() == getattr(whole, name)[..., row].tobytes()
        assert whole.find(whole.track[row : row + 1], whole.question[row : row + 1]).tolist() == [row]
    assert whole.find(np.array([999], "u8"), np.zeros(1, "i4")).tolist() == [-1]


def test_a_wrong_belief_is_turned_by_a_few_reports_however_old_it_is() -> None:
    gain = float(np.log(0.99 / 0.01))

    def say(beliefs: Beliefs, code: int, times: int) -> Beliefs:
        for _ in range(times):
            beliefs = learned(beliefs, np.ones(1, "u8"), np.zeros(1, "i4"), np.array([code], "i4"), np.array([gain]))
        return beliefs

    old = say(no_beliefs(), 1, 1000)
    assert old.best(2)[1][0] <= 1 / (1 + np.exp(-DEPTH)) + 1e-12
    turned = say(old, 2, 3)
    assert turned.best(2)[0][0] == 2
    for code in range(3, 50):
        turned = say(turned, code, 1)
    assert turned.code.shape == (CANDIDATES, 1)


def test_words_forget_what_nobody_says_and_refuse_what_is_no_text() -> None:
    words = Words()
    codes = words.codes(["mmsi:1", None, "icao:2", "", "x" * (MOST_TEXT + 1), "a\nb", "mmsi:3", "mmsi:1"])
    assert codes.tolist() == [0, NONE, 1, NONE, NONE, NONE, 2, 0]
    assert words.schemes().tolist() == [0, 1, 0]
    assert words.compacted([codes]) is None
    for k in range(5000):
        words.code(f"mmsi:{k}")
    kept = words.codes(["mmsi:4000", "icao:2"])
    new = words.compacted([kept, np.array([NONE], "i4")])
    assert new is not None
    assert len(words.texts) == 2
    assert words.said(new[kept]) == ("mmsi:4000", "icao:2")
    assert new[NONE] == NONE
    assert words.schemes().tolist() == [0, 1]


# In a centre


def test_identity_and_class_come_out_with_their_probabilities() -> None:
    made = centre(("r1", "r2"))
    give(made, tracks("r1", 1, HERE, identity=("mmsi:1",), kind=("ship",), ids=[1]))
    first = step(made, 1)
    assert (of(first, "identity"), of(first, "kind")) == (["mmsi:1"], ["ship"])
    assert of(first, "identity_p") == [pytest.approx(0.99)]
    assert of(first, "kind_p") == [pytest.approx(0.8)]
    give(made, tracks("r1", 2, HERE, ids=[1]), tracks("r2", 2, NEAR, kind=("ship",), kind_p=np.array([0.5]), ids=[1]))
    second = step(made, 2)
    # .5 sure of what is right with .8, of two classes, says nothing
    assert of(second, "kind_p") == [pytest.approx(0.8)]
    give(made, tracks("r2", 3, NEAR, kind=("ship",), ids=[1]))
    third = step(made, 3)
    assert of(third, "kind_p") == [pytest.approx(direct([(0, 0.8), (0, 0.8)], 2)[0])]
    decoded = schemas.decode(schemas.encode(third.tracks))
    assert isinstance(decoded, schemas.GlobalTracks)
    assert decoded.identity == ("mmsi:1",)


def test_each_datum_is_heard_once_however_many_steps_or_copies() -> None:
    made = centre(("r1",))
    at = np.array([START + 10**9])
    for seq in range(3):  # one measurement, sent again and again
        give(made, tracks("r1", 1 + seq, HERE, kind=("ship",), updated=at, ids=[1]))
        result = step(made, 1 + seq)
    assert of(result, "kind_p") == [pytest.approx(0.8)]
    result = step(made, 3.5)
    assert of(result, "kind_p") == [pytest.approx(0.8)]


def test_the_configured_trust_of_a_source_decides_between_two() -> None:
    sources = {"r1": {"identity_trust": 0.6, "kind_accuracy": 0.55}, "r2": {"identity_trust": 0.8}}
    made = FusionCentre({"lateness": 3.0, "sources": sources})
    give(made, info("r1"), info("r2"))
    give(made, tracks("r1", 1, HERE, identity=("mmsi:1",), kind=("ship",), ids=[1]))
    give(made, tracks("r2", 1, NEAR, identity=("mmsi:2",), kind=("boat",), ids=[1]))
    result = step(made, 1)
    assert len(result.tracks.ids) == 1, "neither is trusted enough to forbid"
    assert of(result, "identity") == ["mmsi:2"]
    odds = [0.6 / 0.4, 0.8 / 0.2, 1.0]
    assert of(result, "identity_p") == [pytest.approx(odds[1] / sum(odds))]
    assert of(result, "kind") == ["boat"]
    assert of(result, "kind_p") == [pytest.approx(direct([(0, 0.55), (1, 0.8)], 2)[1])]


def test_different_trusted_identities_are_never_joined() -> None:
    made = centre(("r1", "r2"))
    for second in range(1, 12):
        give(made, tracks("r1", second, HERE, identity=("mmsi:1",), ids=[1]))
        give(made, tracks("r2", second, NEAR, identity=("mmsi:2",), ids=[1]))
        result = step(made, second)
        assert sorted(of(result, "identity")) == ["mmsi:1", "mmsi:2"]
        assert (result.tracks.contributor_counts == 1).all()
    assert result.tracks.ids.tolist() == [1, 2]


@pytest.mark.parametrize("first", ["r1", "r2", "both"])
def test_tracks_that_turn_out_to_be_two_objects_part_at_once(first: str) -> None:
    """Joined while nobody said what they are; then both do, one before the other or in the same step."""
    made = centre(("r1", "r2"))
    names = {"r1": ("mmsi:1",), "r2": ("mmsi:2",)}
    for second in range(1, 12):
        speaks = {name for name in names if second > (3 if name == first or first == "both" else 6)}
        for name, place in (("r1", HERE), ("r2", NEAR)):
            give(made, tracks(name, second, place, identity=names[name] if name in speaks else None, ids=[1]))
        result = step(made, second)
        parted = len(speaks) == 2
        assert result.tracks.contributor_counts.tolist() == ([1, 1] if parted else [2]), second
    stays = "r2" if first == "r2" else "r1"
    said = dict(zip(result.tracks.ids.tolist(), of(result, "identity"), strict=True))
    assert said == {1: names[stays][0], 2: names[{"r1": "r2", "r2": "r1"}[stays]][0]}


def test_a_source_alone_that_corrects_itself_keeps_its_track() -> None:
    made = centre(("r1",))
    for second in range(1, 12):
        give(made, tracks("r1", second, HERE, identity=("mmsi:1" if second < 6 else "mmsi:2",), ids=[1]))
        result = step(made, second)
        assert result.tracks.ids.tolist() == [1]
    assert of(result, "identity") == ["mmsi:2"]


def test_identities_of_different_schemes_do_not_contradict() -> None:
    made = centre(("r1", "r2"))
    for second in range(1, 4):
        give(made, tracks("r1", second, HERE, identity=("mmsi:1",), ids=[1]))
        give(made, tracks("r2", second, NEAR, identity=("imo:9",), ids=[1]))
        result = step(made, second)
    assert result.tracks.contributor_counts.tolist() == [2]


@pytest.mark.parametrize("named", [False, True])
def test_equal_identity_decides_between_neighbours(named: bool) -> None:
    """Two targets 60 m apart, the second source's places nearer to the wrong ones: only identity tells."""
    made = centre(("r1", "r2"))
    first = np.array([[0.0, 0, 0, 0], [60.0, 0, 0, 0]])
    second = np.array([[40.0, 0, 0, 0], [20.0, 0, 0, 0]])
    for t in range(1, 4):
        names = ("mmsi:1", "mmsi:2") if named else None
        give(made, tracks("r1", t, first, identity=names), tracks("r2", t, second, identity=names))
        result = step(made, t)
    owner = np.repeat(result.tracks.ids, result.tracks.contributor_counts)
    pairs = {
        tuple(sorted(result.tracks.contributor_id[owner == track].tolist())) for track in result.tracks.ids.tolist()
    }
    assert pairs == ({(1, 1), (2, 2)} if named else {(1, 2)})


def test_a_merge_hands_on_what_was_known() -> None:
    made = centre(("r1", "r2"))
    give(made, tracks("r1", 1, HERE, ids=[1]), tracks("r2", 1, NEAR, ids=[1]))
    assert step(made, 1).tracks.contributor_counts.tolist() == [2]
    give(made, Order("split", local=LocalId("r2", -1, 1)))
    give(made, tracks("r1", 2, HERE, ids=[1]), tracks("r2", 2, NEAR, identity=("mmsi:5",), ids=[1]))
    assert of(step(made, 2), "identity") == [None, "mmsi:5"]
    give(made, Order("withdraw", withdrawn=1))
    ended: list[tuple[int, str, int | None]] = []
    for second in range(3, 9):
        give(made, tracks("r1", second, HERE, ids=[1]), tracks("r2", second, NEAR, ids=[1]))
        result = step(made, second)
        ended += result.tracks.ended
    assert ended == [(2, "merged", 1)]
    assert of(result, "identity") == ["mmsi:5"]


def test_an_identity_in_two_places_is_told_once_and_when_it_is_over() -> None:
    made = centre(("r1", "r2"))
    told: list[tuple[int, str]] = []
    for second in range(1, 40):
        give(made, tracks("r1", second, HERE, identity=("mmsi:1",), ids=[1]))
        if second < 15:
            give(made, tracks("r2", second, FAR, identity=("mmsi:1",), ids=[1]))
        result = step(made, second)
        alarms = events(result, "alarm") + events(result, "alarm_over")
        told += [(second, event["kind"]) for event in alarms]
        for event in alarms:
            assert (event["what"], event["identity"], event["tracks"]) == ("identity-twice", "mmsi:1", [1, 2])
        if second == 10:
            assert result.tracks.marks is not None
            assert result.tracks.marks.tolist() == [IDENTITY_TWICE, IDENTITY_TWICE]
            assert result.status.tracks["identity_twice"] == 1
    (begin, first), (end, last) = told
    assert (first, last) == ("alarm", "alarm_over")
    assert 1 <= begin <= 4
    assert 15 < end < 32
    assert result.tracks.marks is None


# Origin


@pytest.mark.parametrize(("fuse", "expected"), [(False, 2), (True, 1)])
def test_live_and_simulated_are_never_fused_unless_told(fuse: bool, expected: int) -> None:
    made = centre(("r1", "r2"), fuse_origins=fuse)
    for second in range(1, 9):
        give(made, tracks("r1", second, HERE, ids=[1]), tracks("r2", second, NEAR, origin="simulated", ids=[1]))
        result = step(made, second)
        assert len(result.tracks.ids) == expected
    if not fuse:
        assert of(result, "track_origin") == [0, 2]
    assert result.tracks.origin == "simulated"


def test_a_source_that_changes_its_origin_makes_new_tracks() -> None:
    made = centre(("r1",))
    for second in range(1, 7):
        give(made, tracks("r1", second, HERE, origin="live" if second < 5 else "exercise", ids=[1]))
        result = step(made, second)
    picture = result.tracks
    fed = picture.ids[picture.contributor_counts > 0]
    assert fed.tolist() == [2]
    assert dict(zip(picture.ids.tolist(), of(result, "track_origin"), strict=True))[2] == 1


def test_an_origin_that_is_not_allowed_is_refused() -> None:
    made = FusionCentre({"lateness": 3.0, "sources": {"r1": {"allowed_origins": ["live", "exercise"]}}})
    give(made, info("r1"))
    give(made, tracks("r1", 1, HERE, origin="simulated", ids=[1]), tracks("r1", 1.5, HERE, origin="exercise", ids=[1]))
    result = step(made, 2)
    assert result.status.refused == {"origin": 1}
    assert len(result.tracks.ids) == 1
    with pytest.raises(ConfigError, match=r"allowed_origins.*live, exercise, simulated, replay"):
        FusionCentre({"sources": {"r1": {"allowed_origins": ["dream"]}}})


# The guarantees


def flight(arrange: Any, until: int = 9) -> tuple[FusionCentre, list[StepResult], list[list[Any]]]:
    """Three sources, four targets: names and classes said by some, some of them wrong, one simulated."""
    rng = np.random.default_rng(8)
    places = np.array([[3000.0 * k, 0, 0, 0] for k in range(4)])
    made, results, given = centre(("r1", "r2", "r3")), [], []
    for second in range(1, until):
        batch = []
        for name, origin in (("r1", "live"), ("r2", "live"), ("r3", "simulated")):
            said = [f"mmsi:{k}" if rng.random() < 0.5 else None for k in range(4)]
            kind = [str(rng.choice(["ship", "boat", "buoy"])) if rng.random() < 0.7 else None for _ in range(4)]
            means = places + rng.normal(size=(4, 4)) * SIGMA
            batch.append(tracks(name, second, means, identity=tuple(said), kind=tuple(kind), kind_p=rng.random(4),
                                origin=origin))  # fmt: skip
        given.append(batch)
        give(made, *arrange(batch))
        results.append(step(made, second))
    return made, results, given


def test_the_order_of_arrival_does_not_matter() -> None:
    wanted = [schemas.encode(one.tracks) for one in flight(list)[1]]
    for order in itertools.permutations(range(3)):
        assert [schemas.encode(one.tracks) for one in flight(lambda b, o=order: [b[k] for k in o])[1]] == wanted


def test_a_checkpoint_goes_on_bit_for_bit() -> None:
    _, expected, given = flight(list)
    made, _, _ = flight(list, until=5)
    other = FusionCentre({"lateness": 3.0}, made.checkpoint())
    for second in range(5, 9):
        give(other, *given[second - 1])
        picture = dataclasses.replace(step(other, second).tracks, seq=second - 1)
        assert schemas.encode(picture) == schemas.encode(expected[second - 1].tracks)
    assert any(expected[-1].tracks.identity or ())
    assert any(expected[-1].tracks.kind or ())


def test_texts_without_end_do_not_fill_the_memory() -> None:
    made = centre(("r1",))
    ids = np.arange(1, 501)
    means = np.array([[1000.0 * k, 0, 0, 0] for k in range(500)])
    for second in range(1, 15):
        names = tuple(f"mmsi:{second * 1000 + k}" for k in range(500))
        give(made, tracks("r1", second, means, ids, identity=names, kind=tuple(f"kind {n}" for n in names)))
        result = step(made, second)
    assert len(made.checkpoint()) < 2_000_000
    assert of(result, "identity")[7] is not None
    strange: Any = ([1], {"a": 2}, "x" * 1000)
    give(made, tracks("r1", 15, means[:3], [1, 2, 3], identity=strange))
    assert step(made, 15).status.refused == {"length": 1}
