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
from fusion_service.recording.drawing.labels import Labels
from fusion_service.review.explain import explanation, listing, read_mission
from schemas import GlobalTracks, LocalTracks, StepLog, Truth
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, tracks
from tests.helpers.flown import Flight, places, raws

GATE, KEEP = (f"{chi2.ppf(p, 4):.1f}" for p in (0.999, 0.9999))


def told(path: Path, track: str, **asked: Any) -> str:
    return explanation(read_mission(path, track=track, **asked))


def line(text: str, words: str) -> str:
    """The one line of the timeline with these words."""
    (found,) = (one for one in text.splitlines() if words in one and re.match(r"\d", one))
    return found


def spread(at: float) -> Sequence[float]:
    return (at, 0.0)


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Flight]:
    """r1 and r2 see one target as two for 3 s: tracks 1 and 2 are merged; r3 comes at 6 s; from 10 s on r2 sees its
    track 2 km away: the link is broken after three steps, and track 3 is split off. r3 is silent from 14 s."""
    flight = Flight({"coast": 3.0, "merge_after": 3, "break_after": 3})

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        if name == "r1":
            return {11: spread(0)}
        if name == "r2":
            return {22: spread(5000 if second == 1 else 20 if second < 10 else 1900 + 10 * second)}
        return {33: spread(-20)} if 6 <= second < 14 else {}

    places(flight, range(1, 17), seen_by)
    return flight.record(tmp_path_factory.mktemp("explain") / "joined.rrd"), flight


def test_a_merge_is_told_of_both_tracks(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    younger = told(path, "2")
    assert line(younger, "born").split() == ["0.0", "born"]
    assert line(younger, "r2 22 linked").startswith("0.0")
    merged = line(younger, "merged into 1")
    assert merged.startswith("3.0")
    assert f"of gate {GATE}" in merged
    assert "It ended at 3.0 s: merged into track 1, the older one, with which it agreed." in younger
    assert "Track 1, from r1, r2, r3, lived from 0.0 to 15.0 s." in younger
    older = told(path, "1")
    assert line(older, "took in 2").startswith("3.0")
    assert line(older, "r2 22 comes over from 2").startswith("3.0")
    assert "It took in track 2 at 3.0 s." in older
    assert "r2 22 and r3 33 joined later." in older
    ((_, _, heir),) = flight.steps[3].tracks.ended
    assert heir == flight.steps[0].tracks.ids[0]


def test_a_broken_link_and_a_split_are_told_with_their_distances(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    text = told(path, "1")
    logs = [one.log for one in flight.steps]
    failed = [log.decisions.value[(log.decisions.kind == 3) & (log.decisions.id == 22)] for log in logs]
    (first, second, third) = (float(values[0]) for values in failed if len(values))
    low, high = min(first, second, third), max(first, second, third)
    outside = line(text, "r2 22 outside its gate")
    assert outside.startswith("9.0-11.0")
    assert f"3 steps, d2 {low:.1f}-{high:.1f} of gate {KEEP}" in outside
    broken = line(text, "r2 22 broken off")
    assert broken.startswith("11.0")
    assert f"d2 {third:.1f} of gate {KEEP}" in broken
    assert line(text, "split off it: 3").startswith("11.0")
    assert "r2 22 was broken off at 11.0 s: too far from the others. Track 3 was split off it at 11.0 s." in text
    child = told(path, "3")
    assert "Track 3 was born at 11.0 s from r2 22, split from track 1 with which it no longer agreed" in child
    assert "Track 1, from r1, r2, r3, lived from 0.0 to 15.0 s." in child
    assert "It was still there at the end of the recording." in child


def test_contributions_are_those_of_the_picture(joined: tuple[Path, Flight]) -> None:
    path, flight = joined
    text = told(path, "1", at="7")
    picture = flight.steps[7].tracks
    influence = picture.contributor_influence[: picture.contributor_counts[0]]
    assert "contributions at 7.0 s (step 8, confirmed)" in text
    for name, part in zip(("r1 11", "r2 22", "r3 33"), influence.tolist(), strict=True):
        (row,) = (one for one in text.splitlines() if re.match(rf"{name}\s+\d", one))
        cells = row.split()[2:]
        assert cells[0] == f"{part:.2f}"
        assert cells[-1] == "30"  # m, the standard deviation that the sources state
        assert cells[-2] == "0.0"
    same = told(path, "1", at="2023-11-14T22:13:28Z")
    assert START == 1_700_000_000 * SECOND
    assert "contributions at 7.0 s" in same
    with pytest.raises(ReviewError, match=r"was not there at 5.0 s: it lived from 11.0 to 15.0 s"):
        told(path, "3", at="5")
    for wrong in ("soon", "nan", "1e30"):
        with pytest.raises(ReviewError, match="--at"):
            told(path, "1", at=wrong)


def test_who_leaves_and_why(joined: tuple[Path, Flight]) -> None:
    text = told(joined[0], "1")
    assert "r3 33 leaves: the source lists it no more" in line(text, "r3 33 leaves")
    assert line(text, "r3 33 leaves").startswith("13.0")
    assert re.search(r"r1 11 kept \d+ steps?, d2 [\d.]+", text)


def test_a_coasting_end_an_order_a_silence_and_refusals(tmp_path: Path) -> None:
    """r1's track is lost at 5 s: it coasts for 3 s and ends; r2 is muted at 8 s: its track goes the same way; track 3
    of r3 is deleted by order at 12 s."""
    flight = Flight({"coast": 3.0})

    def seen_by(name: str, second: float) -> dict[int, Sequence[float]]:
        if name == "r1":
            return {5: spread(0)} if second < 5 else {}
        return {6: spread(20_000)} if name == "r2" else {7: spread(40_000)}

    places(flight, range(1, 8), seen_by)
    flight.centre.handle(Order("mute", "r2", who="anna", why="noise"), START)
    places(flight, range(8, 12), seen_by)
    flight.centre.handle(Order("delete", track=int(flight.steps[-1].tracks.ids[-1])), START)
    places(flight, range(12, 14), lambda name, second: seen_by(name, second) if name != "r3" else {})
    path = flight.record(tmp_path / "mission.rrd")

    text = told(path, "1")
    assert line(text, "r1 5 leaves: the source lists it no more").startswith("4.0")
    assert line(text, "coasts: no source has it").startswith("4.0")
    assert "ended: no source had it for 4.0 s, longer than 3 s (coast)" in line(text, "ended")
    assert line(text, "ended").startswith("7.0")
    assert "It coasted for 3 of its 7 steps." in text

    text = told(path, "2")
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
    assert rows["1"].split()[1:4] == ["0.0", "7.0", "7.0"]
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
    assert [row.split()[0] for row in listing(read_mission(path)).splitlines()[2:-1]] == ["1", "2.1"]
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
    """r2 is far off at every other step: never three times in a row, so that its link stands."""
    flight = Flight({})
    far = {"r1": lambda s: 0.0, "r2": lambda s: 3000.0 if s > 3 and s % 2 else 10.0, "r3": lambda s: -10.0}
    places(flight, range(1, 31), lambda name, second: {1: spread(far[name](second))})
    text = told(flight.record(tmp_path / "mission.rrd"), "1")
    one = line(text, "r2 1 kept")
    assert re.search(r"^1\.0-29\.0 +r2 1 kept 16 steps, outside its gate 13 in 13 spells, d2 ", one)


def test_the_view_holds_the_track_its_members_and_its_truth(joined: tuple[Path, Flight], tmp_path: Path) -> None:
    path, flight = joined
    out = tmp_path / "track.rrd"
    assert main(["explain", str(path), "--track", "3", "--out", str(out)]) == 0
    messages = [schemas.decode(raw.data) for raw in raws(out)]
    child = int(flight.steps[-1].tracks.ids[-1])
    shown = [message for message in messages if isinstance(message, GlobalTracks)]
    assert [len(message.ids) for message in shown] == [0] * 11 + [1] * 5
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
    assert line(text, "r3 33 is a part").startswith("5.0")
    only = record(
        tmp_path / "local.rrd", [(schemas.local_key("r1", "tracks"), schemas.encode(tracks("r1", 1, [])), START)]
    )
    with pytest.raises(ReviewError, match="holds no tracks of a centre: fuse it with fusion-service replay first"):
        read_mission(only)
