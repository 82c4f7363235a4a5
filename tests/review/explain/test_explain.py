"""Where a global track came from: scripted missions, whose story is known, told in words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import schemas
from fusion_service.centre import Order
from fusion_service.cli import main
from fusion_service.errors import ReviewError
from fusion_service.labels import Labels
from fusion_service.order import LocalId
from fusion_service.review.explain import explanation, listing, read_mission
from schemas import GlobalTracks, LocalTracks, StepLog, Truth
from schemas.messages import BROKEN, EXCHANGED, GATE_FAILED, MERGED, SPLIT
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, tracks
from tests.helpers.flown import Flight, places, raws

GATE, KEEP, MERGE = (f"{chi2.ppf(p, 4):.1f}" for p in (0.999, 0.9999, 0.999))


def told(path: Path, track: str, **asked: Any) -> str:
    return explanation(read_mission(path, track=track, **asked))


def line(text: str, words: str) -> str:
    """The one line of the timeline with these words."""
    (found,) = (one for one in text.splitlines() if words in one and re.match(r"\d", one))
    return found


def spread(at: float) -> Sequence[float]:
    return (at, 0.0)


def decided(flight: Flight, kind: int) -> list[tuple[str, float]]:
    """The second, as the story tells it, and the d2 of every decision of this kind."""
    return [
        (f"{step:.1f}", float(value))
        for step, one in enumerate(flight.steps)
        for value in one.log.decisions.value[one.log.decisions.kind == kind]
    ]


def only(flight: Flight, kind: int) -> str:
    """The second of the one decision of this kind."""
    ((second, _),) = decided(flight, kind)
    return second


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Flight]:
    """r1 and r2 see one target as two that come together: tracks 1 and 2 are merged; r3 comes at 8 s; from 12 s on r2
    sees its track too far away, from 15 s on 2 km away: the link is broken, and track 3 is split off. r3 is silent from
    18 s."""
    flight = Flight({"coast": 3.0})
    far = {1: 300, 2: 200, 3: 120, 4: 50, 12: 340, 13: 350, 14: 360}

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        if name == "r1":
            return {11: spread(0)}
        if name == "r2":
            return {22: spread(far.get(round(second), 20 if second < 12 else 2000))}
        return {33: spread(-20)} if 8 <= second < 18 else {}

    places(flight, range(1, 21), seen_by)
    return flight.record(tmp_path_factory.mktemp("explain") / "joined.rrd"), flight


LAST = "19.0"
"""Second of the last step of that mission."""


def test_a_merge_is_told_of_both_tracks(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    at = only(flight, MERGED)
    younger = told(path, "2")
    assert line(younger, "born").split() == ["0.0", "born"]
    assert line(younger, "r2 22 linked").startswith("0.0")
    merged = line(younger, "merged into 1")
    assert merged.startswith(at)
    assert f"of gate {MERGE}" in merged
    assert f"It ended at {at} s: merged into track 1, the older one, with which it agreed." in younger
    assert f"Track 1, from r1, r2, r3, lived from 0.0 to {LAST} s." in younger
    older = told(path, "1")
    assert line(older, "took in 2").startswith(at)
    assert line(older, "r2 22 comes over from 2").startswith(at)
    assert f"It took in track 2 at {at} s." in older
    assert "r2 22 and r3 33 joined later." in older
    ((_, _, heir),) = flight.steps[int(float(at))].tracks.ended
    assert heir == flight.steps[0].tracks.ids[0]


def test_a_broken_link_and_a_split_are_told_with_their_distances(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    text = told(path, "1")
    failed = decided(flight, GATE_FAILED)
    assert len(failed) == 3
    low, high = min(value for _, value in failed), max(value for _, value in failed)
    assert low < high
    outside = line(text, "r2 22 outside its gate")
    assert outside.startswith(f"{failed[0][0]}-{failed[-1][0]}")
    assert f"3 steps, d2 {low:.1f}-{high:.1f} of gate {KEEP}" in outside
    ((at, value),) = decided(flight, BROKEN)
    assert at == only(flight, SPLIT)
    broken = line(text, "r2 22 broken off")
    assert broken.startswith(at)
    assert f"d2 {value:.1f} of gate {KEEP}" in broken
    assert "r2 22 leaves" not in text
    assert line(text, "split off it: 3").startswith(at)
    assert f"r2 22 was broken off at {at} s: too far from the others. Track 3 was split off it at {at} s." in text
    child = told(path, "3")
    assert f"Track 3 was born at {at} s from r2 22, split from track 1 with which it no longer agreed" in child
    assert f"Track 1, from r1, r2, r3, lived from 0.0 to {LAST} s." in child
    assert "It was still there at the end of the recording." in child


def test_an_exchange_is_told_of_both_tracks(tmp_path: Path) -> None:
    """r2 changes the numbers of two targets abeam of each other: the sources' pairs are exchanged, the tracks stay."""
    flight = Flight({"coast": 3.0})
    seen = {"r1": ((0, 0), (0, 90)), "r2": ((0, 10), (0, 80)), "r3": ()}

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        at = seen[name] if second < 3 or name != "r2" else seen[name][::-1]
        return dict(enumerate(at, 1))

    places(flight, range(1, 9), seen_by)
    path = flight.record(tmp_path / "mission.rrd")
    moves = {
        (f"{step:.1f}", log.sources[source], local, track & 0xFF, other & 0xFF, f"{value:.1f}")
        for step, log in enumerate(one.log for one in flight.steps)
        for kind, track, source, local, other, value in zip(
            *(getattr(log.decisions, name).tolist() for name in ("kind", "track", "source", "id", "other", "value")),
            strict=True,
        )
        if kind == EXCHANGED
    }
    assert {(one[3], one[4]) for one in moves} == {(1, 2), (2, 1)}
    for at, source, local, to, was, d2 in moves:
        new, old = told(path, str(to)), told(path, str(was))
        came = line(new, f"{source} {local} comes over by exchange from {was}")
        assert came.startswith(at)
        assert f"d2 {d2} of gate {GATE}" in came
        assert line(old, f"{source} {local} goes over by exchange to {to}").startswith(at)
        assert f"{source} {local} came over from track {was} at {at} s: it fits better here." in new
        assert f"{source} {local} went over to track {to} at {at} s: it fits better there." in old
        for text in (new, old):
            assert "is a part" not in text
            assert f"{source} {local} leaves" not in text


def test_a_merge_and_a_split_by_order_are_told_as_such(tmp_path: Path) -> None:
    """An operator says that two tracks 20 km apart are one, and another that the older source's goes its own way: of
    agreement and disagreement nothing is said."""
    flight = Flight({"coast": 3.0})
    at: dict[str, dict[int, Sequence[float]]] = {"r1": {1: spread(0)}, "r2": {2: spread(20_000)}, "r3": {3: spread(10)}}
    places(flight, range(1, 4), lambda name, second: at[name])
    first, second = flight.steps[-1].tracks.ids.tolist()
    flight.centre.handle(Order("merge", track=first, other=second, who="anna", why="one hull"), START)
    flight.centre.handle(Order("split", track=first, local=LocalId("r3", -1, 3), who="anna"), START)
    places(flight, range(4, 6), lambda name, second: at[name])
    path = flight.record(tmp_path / "mission.rrd")
    orders = [event for event in flight.steps[3].log.events if event["kind"] == "order"]
    assert [event["done"] for event in orders] == [True, True]
    text = told(path, "2")
    assert "It ended at 3.0 s: merged into track 1 by an operator's order." in text
    assert line(text, "order to merge it by anna (one hull)").startswith("3.0")
    assert "agreed" not in text
    text = told(path, "3")
    assert "Track 3 was born at 3.0 s from r3 3, split from track 1 by an operator's order" in text
    assert "agreed" not in text


def test_contributions_are_those_of_the_picture(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    text = told(path, "1", at="9")
    picture = flight.steps[9].tracks
    influence = picture.contributor_influence[: picture.contributor_counts[0]]
    assert "contributions at 9.0 s (step 10, confirmed)" in text
    for name, part in zip(("r1 11", "r2 22", "r3 33"), influence.tolist(), strict=True):
        (row,) = (one for one in text.splitlines() if re.match(rf"{name}\s+\d", one))
        cells = row.split()[2:]
        assert cells[0] == f"{part:.2f}"
        assert cells[-1] == "30"  # m, the standard deviation that the sources state
        assert cells[-2] == "0.0"
    same = told(path, "1", at="2023-11-14T22:13:30Z")
    assert START == 1_700_000_000 * SECOND
    assert "contributions at 9.0 s" in same
    split = only(flight, SPLIT)
    with pytest.raises(ReviewError, match=rf"was not there at 5.0 s: it lived from {split} to {LAST} s"):
        told(path, "3", at="5")
    for wrong in ("soon", "nan", "1e30"):
        with pytest.raises(ReviewError, match="--at"):
            told(path, "1", at=wrong)


def test_who_leaves_and_why(joined: tuple[Path, Flight]) -> None:
    text = told(joined[0], "1")
    assert "r3 33 leaves: the source lists it no more" in line(text, "r3 33 leaves")
    assert line(text, "r3 33 leaves").startswith("17.0")
    assert re.search(r"r1 11 kept \d+ steps?, d2 [\d.]+", text)


def test_a_coasting_end_an_order_a_silence_and_refusals(tmp_path: Path) -> None:
    """r1, which judges existence, lists its track no more at 5 s: it ends with the next report; r2 is muted at 8 s:
    its track coasts for 3 s; track 3 of r3 is deleted by order at 12 s."""
    flight = Flight({"coast": 3.0})

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        if name == "r1":
            return {5: spread(0)} if second < 5 else {}
        return {6: spread(20_000)} if name == "r2" else {7: spread(40_000)}

    places(flight, range(1, 8), seen_by, ["r1"])
    flight.centre.handle(Order("mute", "r2", who="anna", why="noise"), START)
    places(flight, range(8, 12), seen_by)
    flight.centre.handle(Order("delete", track=int(flight.steps[-1].tracks.ids[-1])), START)
    places(flight, range(12, 14), lambda name, second: seen_by(name, second) if name != "r3" else {})
    path = flight.record(tmp_path / "mission.rrd")

    text = told(path, "1")
    assert line(text, "r1 5 leaves: the source lists it no more").startswith("4.0")
    assert line(text, "coasts: no source has it").startswith("4.0")
    assert "ended: its sources list it no more, and for 3.0 s no report has brought it back" in line(text, "ended")
    assert line(text, "ended").startswith("6.0")
    assert "It coasted for 2 of its 6 steps." in text

    text = told(path, "2")
    assert "ended: no source had it for 4.0 s, longer than 3 s (coast)" in line(text, "ended")
    assert line(text, "r2 6 leaves: the source was muted by order").startswith("7.0")
    assert line(text, "order to mute r2").startswith("7.0")
    assert "order to mute r2 by anna (noise): refuses what r2 sends" in text
    refused = line(text, "refused (muted)")
    assert re.search(r"r2: \d+ messages refused \(muted\)", refused)

    text = told(path, "3")
    assert "deleted by an operator's order" in line(text, "ended")
    assert "order to delete it: ends track" in text
    table = listing(read_mission(path))
    rows = {one.split()[0]: one for one in table.splitlines()[2:-1]}
    assert rows["1"].split()[1:4] == ["0.0", "6.0", "6.0"]
    assert rows["1"].endswith("r1       lost")
    assert rows["3"].rstrip().endswith("ordered")
    assert table.splitlines()[-1].startswith("3 tracks")


def test_names_are_those_that_the_recording_shows(tmp_path: Path) -> None:
    """Ids of a second generation are called 2.n; whole ids are understood; unknown ones are told."""
    flight = Flight({"coast": 3.0}, generation=900)
    one = {"r1": {1: spread(0)}, "r2": {1: spread(0)}, "r3": {}}
    places(flight, range(1, 5), lambda name, second: one[name])
    flight.begin(flight.centre.checkpoint(), 901)
    two = {"r1": {1: spread(0)}, "r2": {1: spread(0)}, "r3": {4: spread(30_000)}}
    places(flight, range(5, 9), lambda name, second: two[name])
    path = flight.record(tmp_path / "mission.rrd", draw=True)
    old, new = flight.steps[-1].tracks.ids.tolist()
    assert (old >> 32, new >> 32) == (900, 901)
    assert "track 2.1 (id" in told(path, "2.1")
    assert told(path, str(new)) == told(path, "2.1")
    assert told(path, str(old)) == told(path, "1")
    assert line(told(path, "1"), "the service began anew from its checkpoint").startswith("4.0")
    assert [row.split()[0] for row in listing(read_mission(path)).splitlines()[2:4]] == ["1", "2.1"]
    from tests.recording.contents import rows

    (shown,) = {tuple(row["Points2D:labels"]) for row in rows(path, "/picture/global/centre")[-1:]}
    assert shown == ("1", "2.1")
    for unknown in ("2", "3.1", "2.7", str(new + 5)):
        with pytest.raises(
            ReviewError, match=rf"centre centre has no track {re.escape(unknown)}: it has 2, from 1 to 2.1"
        ):
            told(path, unknown)
    for wrong in ("seven", "-1", "1.2.3", str(2**64)):
        with pytest.raises(ReviewError, match="is no track: give the number that the recording shows"):
            told(path, wrong)


def test_labels_are_found_as_they_are_given() -> None:
    labels = Labels()
    assert labels.find("2.7") is None
    ids = [(5 << 32) + 7, (9 << 32) + 7, (5 << 32) + 8, (2**32 - 1 << 32) + 1]
    names = [labels(track) for track in ids]
    assert names == ["7", "2.7", "8", "3.1"]
    assert [labels.find(name) for name in names] == ids
    assert [labels.find(str(track)) for track in ids] == ids


def test_many_spells_outside_the_gate_are_one_line(tmp_path: Path) -> None:
    """r2 is 250 m off at every other step: outside its gate, but never so far that the link breaks."""
    flight = Flight({"supervision": "off"})
    far = {"r1": lambda s: 0.0, "r2": lambda s: 250.0 if s > 3 and s % 2 else 10.0, "r3": lambda s: -10.0}
    places(flight, range(1, 31), lambda name, second: {1: spread(far[name](second))})
    assert len(decided(flight, GATE_FAILED)) == 13
    assert not decided(flight, BROKEN)
    text = told(flight.record(tmp_path / "mission.rrd"), "1")
    one = line(text, "r2 1 kept")
    assert re.search(r"^1\.0-29\.0 +r2 1 kept 16 steps, outside its gate 13 in 13 spells, d2 ", one)
    assert "leaves" not in text


def test_what_is_left_out_and_then_dropped_leaves(tmp_path: Path) -> None:
    """r2's track is far off at 4 and 5 s, and in its next scan no more."""
    flight = Flight({"coast": 3.0})

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        if name == "r2":
            return {2: spread(250.0 if second > 3 else 0.0)} if second < 6 else {}
        return {1: spread(0)}

    places(flight, range(1, 9), seen_by)
    failed = decided(flight, GATE_FAILED)
    assert failed
    text = told(flight.record(tmp_path / "mission.rrd"), "1")
    assert line(text, "r2 2 outside its gate").startswith(failed[0][0])
    assert line(text, "r2 2 leaves: the source lists it no more").startswith("5.0")


def test_the_view_holds_the_track_its_members_and_its_truth(joined: tuple[Path, Flight], tmp_path: Path) -> None:
    path, flight = joined
    out = tmp_path / "track.rrd"
    assert main(["explain", str(path), "--track", "3", "--out", str(out)]) == 0
    messages = [schemas.decode(raw.data) for raw in raws(out)]
    child = int(flight.steps[-1].tracks.ids[-1])
    shown = [message for message in messages if isinstance(message, GlobalTracks)]
    split = int(float(only(flight, SPLIT)))
    assert [len(message.ids) for message in shown] == [0] * split + [1] * (20 - split)
    assert {track for message in shown for track in message.ids.tolist()} == {child}
    assert all(len(message.contributor_id) == len(message.ids) for message in shown)
    whole = flight.steps[-1].tracks
    np.testing.assert_array_equal(shown[-1].means[0], whole.means[whole.ids == child][0])
    local = [message for message in messages if isinstance(message, LocalTracks)]
    assert {(message.source, *message.ids.tolist()) for message in local} == {("r2", 22)}
    assert {tuple(message.ids.tolist()) for message in messages if isinstance(message, Truth)} == {(1,)}
    logs = [message for message in messages if isinstance(message, StepLog)]
    assert {track for log in logs for track in (*log.decisions.track.tolist(), *log.decisions.other.tolist())} <= {
        child, 0, int(whole.ids[0]),
    }  # fmt: skip
    received = {raw.data: raw.received for raw in raws(path)}
    assert all(raw.received in set(received.values()) for raw in raws(out))
    assert told(out, "3").splitlines()[-3] == told(path, "3").splitlines()[-3]


def test_what_the_command_cannot_do_is_told(joined: tuple[Path, Flight], tmp_path: Path, capsys: Any) -> None:
    path = str(joined[0])
    for arguments, words in (
        (["--at", "5"], "name it with --track"),
        (["--track", "77"], "has no track 77: it has 3, from 1 to 3"),
        (["--track", "1", "--centre", "nobody"], "holds no centre 'nobody': name one of its centres (centre)"),
        (["--track", "1", "--out", path], "exists already"),
        (["--track", "1", "--out", str(tmp_path)], "exists already"),
    ):
        assert main(["explain", path, *arguments]) == (2 if "--track" not in arguments else 1)
        errors = capsys.readouterr().err
        assert words in errors
        assert len(errors.strip().splitlines()) == 1
    assert main(["explain", path]) == 0
    assert "3 tracks. Ask for one:" in capsys.readouterr().out


def test_tracks_of_intensities_have_sources_alone(tmp_path: Path) -> None:
    flight = Flight({"kind": "intensity", "coast": 3.0})
    for name in ("r1", "r2"):
        flight.put(info(name), 0.5)
    for second in range(1, 8):
        for name, weight in (("r1", 0.9), ("r2", 0.9 if second < 5 else 1e-6)):
            message = schemas.LocalIntensity(
                source=name, epoch=1, seq=second, sent=0, time=START + second * SECOND, space=SPACE, frame=FRAME,
                weights=np.array([weight]), means=np.zeros((1, 4)), covariances=np.diag([9.0, 9, 1, 1])[None],
            )  # fmt: skip
            flight.put(message, second)
        flight.step(second)
    text = told(flight.record(tmp_path / "mission.rrd"), "1")
    assert "Track 1 was born at 0.0 s from r1 and r2, and confirmed at once." in text
    assert line(text, "r2 leaves: the source expects too little there").startswith("4.0")
    assert "gate" not in text


def test_without_logs_the_pictures_tell_what_they_can(joined: tuple[Path, Flight], tmp_path: Path) -> None:
    """And a recording that begins in the middle says that the track was there already."""
    from tests.helpers.flown import edited, record

    _, flight = joined
    late = [one for one in flight.log if one[2] > START + 5.5 * SECOND]
    path = record(tmp_path / "late.rrd", late)
    text = told(path, "1")
    assert "Track 1 was there already at 0.0 s, when the recording of it begins." in text
    assert line(text, "there already").startswith("0.0")
    bare = record(tmp_path / "bare.rrd", edited(flight.log, lambda m: None if isinstance(m, StepLog) else m))
    text = told(bare, "1")
    assert "gates" not in text
    assert line(text, "r3 33 is a part").startswith("7.0")
    only = record(
        tmp_path / "local.rrd", [(schemas.local_key("r1", "tracks"), schemas.encode(tracks("r1", 1, [])), START)]
    )
    with pytest.raises(ReviewError, match="holds no tracks of a centre: fuse it with fusion-service replay first"):
        read_mission(only)
