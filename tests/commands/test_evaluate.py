"""`fusion-service evaluate` on recordings written by the recorder: what it says, in words, JSON and on a page."""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.cli import main
from fusion_service.commands import evaluate as command
from fusion_service.recording import Recorder, messages
from fusion_service.review.evaluation import assess, evaluate
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.export import export
from schemas import Entry, GlobalTracks, Message, StepLog, Truth, digest, global_key
from tests.helpers.missions import info, picture, tracks
from tests.recording.mission import START, Sent, mission

CUTOFF, STEPS = 500.0, 100
SECOND = 10**9


def record(path: Path, said: Iterable[Sent], garbage: int = 0) -> Path:
    with Recorder(path, draw=False) as recorder:
        for sent in said:
            recorder.handle(sent.key, sent.data, sent.received)
        for _ in range(garbage):
            recorder.handle("fusion/v1/local/radar1/tracks", b"\xc1", START)
    return path


def renamed(sent: Sent, centre: str, rule: str, off: float = 0.0) -> Sent:
    """The centre's pictures as another centre's, moved east by `off` metres."""
    message = sent.message
    assert isinstance(message, GlobalTracks)
    means = message.means + np.array([off, 0, 0, 0])
    return Sent(global_key(centre, "tracks"), replace(message, source=centre, rule=rule, means=means), sent.received)


@pytest.fixture(scope="module")
def said() -> list[Sent]:
    """One of radar3's messages is lost; a step log says what it took."""
    found, lost = [], 0
    for sent in mission(STEPS):
        message = sent.message
        if message.source == "radar3" and getattr(message, "time", 0) == START + 50 * SECOND:
            lost += 1
            continue
        found.append(sent)
    assert lost == 1
    return found


@pytest.fixture(scope="module")
def flown(said: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("evaluate") / "flown.rrd", said, garbage=3)


@pytest.fixture(scope="module")
def blind(said: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without truth."""
    seen = [sent for sent in said if not isinstance(sent.message, Truth)]
    return record(tmp_path_factory.mktemp("evaluate") / "blind.rrd", seen)


def scored(*arguments: str | Path, folder: Path) -> dict[str, Any]:
    out = folder / "scores.json"
    assert main(["evaluate", *map(str, arguments), "--json", str(out), "--cutoff", str(CUTOFF)]) == 0
    found: dict[str, Any] = json.loads(out.read_text(), parse_constant=lambda name: pytest.fail(name))
    return found


def test_a_recording_scores_as_its_messages_do(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = scored(flown, folder=tmp_path)
    text = capsys.readouterr().out
    (row,) = found["rows"]
    want = evaluate(messages(flown), c=CUTOFF, every=None).as_json("flown", "ci", str(flown))
    assert {key: row[key] for key in want} == want
    assert text.startswith("Fused tracks (ci) followed 5 of 5 targets; RMSE ")
    assert "not read: 3 messages: not-msgpack" in text
    assert "Refused: 4 tracks of radar3: not-finite" in text
    more = row["more"]
    assert len(more["times_ns"]) == len(more["fused"]["series"]["gospa"]) == STEPS
    assert np.mean(more["fused"]["series"]["gospa"]) == pytest.approx(row["fused"]["gospa"], rel=1e-5)
    assert more["time_to_confirm"] == dict.fromkeys("12345", 3.0), "seen at once, tentative for three steps"
    (recording,) = found["recordings"]
    assert recording["not_read"] == {"not-msgpack": 3}
    assert recording["latency"]["bus/radar1"]["median"] == pytest.approx(0.05)
    assert recording["traffic"]["local/radar3"]["missing"] == 1
    assert recording["traffic"]["local/radar1"]["missing"] == 0
    silent = recording["traffic"]["local/radar2"]
    assert (silent["silent"], silent["silences_ns"]) == (1, [[START + 59 * SECOND, START + 90 * SECOND]])
    refused = recording["centres"]["main"]["refused"]
    assert refused == [{"source": "radar3", "reason": "not-finite", "what": "tracks", "count": 4}]


def test_the_order_of_arrival_does_not_matter(said: list[Sent], flown: Path, tmp_path: Path) -> None:
    """What is behind waits for its turn: the same numbers of a recording in any order."""
    mixed = [said[index] for index in np.random.default_rng(3).permutation(len(said))]
    other = scored(record(tmp_path / "flown.rrd", mixed), folder=tmp_path)["rows"][0]
    one = scored(flown, folder=tmp_path)["rows"][0]
    assert {**one, "recording": ""} == {**other, "recording": ""}


def test_without_truth_the_sources_are_held_against_each_other(
    blind: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their errors are independent and as large as they say: the mean of d2 over 2 has the standard error
    1 / sqrt(pairs), and the bounds hold it."""
    found = scored(blind, folder=tmp_path)
    assert found["rows"] == []
    assert "no truth to score against" in capsys.readouterr().out
    (recording,) = found["recordings"]
    assert recording["unscored"] == "no truth to score against"
    agreement = recording["centres"]["main"]["agreement"]
    assert [pair["sources"] for pair in agreement] == [
        ["radar1", "radar2"], ["radar1", "radar3"], ["radar2", "radar3"],
    ]  # fmt: skip
    assert agreement[0]["pairs"] == 0, "radar1 and radar2 see no target in common"
    assert agreement[0]["mean"] is None
    for pair in agreement[1:]:
        assert pair["pairs"] > 50
        assert pair["mean"] == pytest.approx(1.0, abs=4 / np.sqrt(pair["pairs"]))
        assert pair["bounds"][0] < 1 < pair["bounds"][1]
    shown = recording["centres"]["main"]["confirmed_by_sources"]
    assert shown == {"3": (STEPS - 3) * 5 - 20}, "all but the tentative and what coasts"


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".rrd"])
def test_truth_from_another_file(flown: Path, blind: Path, tmp_path: Path, suffix: str) -> None:
    truth = flown
    if suffix != ".rrd":
        truth = tmp_path / f"truth{suffix}"
        export(flown, truth, "truth")
    one = scored(blind, "--truth", truth, folder=tmp_path)["rows"][0]
    other = scored(flown, folder=tmp_path)["rows"][0]
    assert one["fused"] == pytest.approx(other["fused"])
    assert one["more"]["fused"]["rmse_velocity"] == pytest.approx(other["more"]["fused"]["rmse_velocity"])


def test_several_centres_and_recordings_are_rows_of_one_table(
    said: list[Sent], flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = [sent for sent in said if isinstance(sent.message, GlobalTracks)]
    worse = [renamed(sent, "worse", "naive", 100.0) for sent in pictures]
    better = [renamed(sent, "zero", "hmd-ga") for sent in pictures]
    both = record(tmp_path / "both.rrd", [*said, *worse, *better])
    found = scored(both, flown, folder=tmp_path)
    text = capsys.readouterr().out
    assert text.startswith("4 fusions, which followed 5 of 5 targets; smallest GOSPA: both, main (ci)")
    assert [(row["rule"], row["more"]["centre"]) for row in found["rows"]] == [
        ("ci", "main"), ("naive", "worse"), ("hmd-ga", "zero"), ("ci", "main"),
    ]  # fmt: skip
    main_, worse_, zero, again = (row["fused"] for row in found["rows"])
    assert main_ == zero == again
    assert worse_["rmse_position"] == pytest.approx(np.hypot(main_["rmse_position"], 100), rel=0.05)
    only = scored(both, "--centre", "worse", folder=tmp_path)
    assert [row["fused"] for row in only["rows"]] == [worse_]


def test_the_cut_off_is_chosen_and_said(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten times 15 m, rounded up to 200 m."""
    assert main(["evaluate", str(flown)]) == 0
    text = capsys.readouterr().out
    assert "cut-off 200 m (chosen" in text
    assert "c = 200 m" in text
    assert main(["evaluate", str(flown), "--every", "7"]) == 0
    assert f"Scored at {len(range(-START // SECOND % 7, STEPS, 7))} times" in capsys.readouterr().out


def test_a_torn_recording_is_scored_as_far_as_it_goes(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = tmp_path / "torn.rrd"
    torn.write_bytes(flown.read_bytes()[: -flown.stat().st_size // 8])
    assert main(["evaluate", str(torn)]) == 0
    assert "Fused tracks (ci) followed" in capsys.readouterr().out


@pytest.mark.parametrize("place", ["header", "field"])
def test_a_table_with_a_field_too_long_is_told_in_one_line(
    place: str, flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Longer than Python's `csv` takes."""
    table = tmp_path / "truth.csv"
    export(flown, table)
    lines = table.read_text("utf-8").splitlines()
    number = 0 if place == "header" else 5
    table.write_text("\n".join([*lines[:number], lines[number] + "x" * 140_000, *lines[number + 1 :]]), "utf-8")
    assert main(["evaluate", str(flown), "--truth", str(table)]) == 1
    told = capsys.readouterr().err
    assert "truth.csv is no CSV table (field larger than field limit" in told
    assert told.count("\n") == 1


def test_reactions_need_the_log_of_the_step() -> None:
    """The last message of a step came 0.2 s before its picture, by the recorder's clock."""
    sent = [one for one in mission(4) if not isinstance(one.message, StepLog)]
    logs = [one for one in mission(4) if isinstance(one.message, StepLog)]
    book = Logbook()
    for arrival, one in enumerate([*sent, *logs]):
        message = one.message
        late = 200_000_000 if isinstance(message, GlobalTracks) else 0
        if isinstance(message, GlobalTracks) and message.step:
            message = replace(message, sent=message.time + 1)
        if isinstance(message, StepLog):
            message = replace(message, taken=(Entry("radar1", START, message.step, 0),))
        book._note(message, arrival, one.received + late)
    book._close()
    found = book.latency["reaction", "main"]
    assert found.n == 3, "the first picture is as of a replay: sent at the time of its step"
    assert found.median == pytest.approx(0.2)
    assert sum(found.counts) == 3


def test_the_reaction_to_an_info_is_not_that_to_tracks_of_its_number() -> None:
    """A step that took an info alone: tracks of the same source, epoch and number came a minute before."""
    book, second = Logbook(), 10**9
    said = tracks("a", 0, [1], [[0.0, 0.0]])
    told = replace(info("a"), epoch=said.epoch, seq=said.seq)
    shown = replace(picture(60, [1], [[0.0, 0.0]]), sent=START + 1)
    log = next(one.message for one in mission(4) if isinstance(one.message, StepLog))
    taken = Entry("a", told.epoch, told.seq, digest(told))
    log = replace(log, source=shown.source, epoch=shown.epoch, step=shown.step, taken=(taken,))
    came: list[tuple[Message, float]] = [(said, 0.0), (told, 60.0), (log, 60.1), (shown, 60.1)]
    for arrival, (message, at) in enumerate(came):
        book._note(message, arrival, START + round(at * second))
    book._close()
    assert book.latency["reaction", shown.source].largest == pytest.approx(0.1)


def test_what_cannot_be_evaluated_is_told_in_one_line(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = record(tmp_path / "empty.rrd", [sent for sent in mission(2) if isinstance(sent.message, StepLog)])
    no = tmp_path / "no.rrd"
    no.write_text("nothing of the kind")
    table = tmp_path / "truth.csv"
    table.write_text("a,b\n1,2\n")
    short = tmp_path / "short.csv"
    export(flown, short, "truth")
    short.write_text(short.read_text().replace(",circles,truth,1,", ",circles,truth,one,", 1))
    cut = tmp_path / "cut.csv"
    cut.write_text("\n".join(short.read_text().splitlines()[:4]).rpartition(",")[0])
    none = tmp_path / "none.csv"
    none.write_text((short.read_text().splitlines() or [""])[0] + "\n")
    for arguments, says in (
        ([tmp_path / "gone.rrd"], "no recording at"),
        ([no], "is not a recording"),
        ([empty], "holds no tracks"),
        ([flown, "--centre", "other"], "has no centre 'other'; there are: main"),
        ([flown, "--truth", tmp_path / "gone.csv"], "no truth at"),
        ([flown, "--truth", table], "not a table of tracks"),
        ([flown, "--truth", short], "a row of truth is not as it must be"),
        ([flown, "--truth", none], "holds no truth"),
        ([flown, "--truth", no], "is not a recording"),
        ([flown, "--truth", cut], "line 4 has not as many fields as the first"),
        ([flown, "--html", tmp_path / "gone" / "page.html"], "in a folder that exists"),
        ([flown, "--json", flown], "is what is read"),
        ([flown, "--truth", cut, "--html", cut], "is what is read"),
    ):
        assert main(["evaluate", *map(str, arguments)]) == 1, says
        error = capsys.readouterr().err
        assert says in error
        assert error.count("\n") == 1
    old = tmp_path / "old.csv"
    lines = none.read_text() + short.read_text().splitlines()[2].replace(str(START), "1000") + "\n"
    old.write_text(lines)
    assert main(["evaluate", str(flown), "--truth", str(old)]) == 1
    assert "the given truth does not go with this mission: no time to score" in capsys.readouterr().err
    for wrong in ("0", "-3", "nan", "far"):
        with pytest.raises(SystemExit) as caught:
            main(["evaluate", str(flown), "--cutoff", wrong])
        assert caught.value.code == 2


def test_a_signal_ends_it_with_what_was_done(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    command.add(parser)
    stop = threading.Event()
    stop.set()
    command.run(parser.parse_args([str(flown)]), stop)
    assert capsys.readouterr().out == "stopped: 0 of 1 recordings are scored\n"


def test_agreement_grows_with_a_bias(said: list[Sent]) -> None:
    """One source is 60 m off: the d2 of its pairs is above the bounds, that of the others is not."""
    moved = [
        replace(sent.message, means=sent.message.means + np.array([60.0, 0, 0, 0]))  # type: ignore[union-attr]
        if sent.key == "fusion/v1/local/radar1/tracks"
        else sent.message
        for sent in said
    ]
    pairs = assess(Logbook(moved), c=CUTOFF).agreements["main"].pairs
    assert pairs["radar1", "radar3"].mean > 2 * pairs["radar1", "radar3"].bounds[1]
    low, high = pairs["radar2", "radar3"].bounds
    assert low < pairs["radar2", "radar3"].mean < high


@pytest.mark.parametrize(("module", "extra"), [("rerun", "record"), ("matplotlib", "report")])
def test_an_extra_that_is_missing_is_named(
    flown: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    extra: str,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["evaluate", str(flown), "--html", str(tmp_path / "page.html")]) == 1
    error = capsys.readouterr().err
    assert f"[{extra}]'" in error
    assert error.count("\n") == 1
