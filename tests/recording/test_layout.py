"""Lines to the local tracks, several centres side by side, and the layout of one track, against the messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from fusion_service import colours
from fusion_service.recording import Recorder
from fusion_service.recording.drawing.geometry import Chart, rings
from schemas import Enu, GlobalTracks, Message, StepLog, encode, global_key, local_key
from schemas.messages import BROKEN, KEPT, LINKED, MERGED, NO_SOURCE
from tests.recording.contents import entities, key_of, row, rows, static, texts
from tests.recording.mission import GENERATION, RADARS, START, Sent, mission, positions

SECOND = 10**9


def at(said: list[Sent], key: str, step: int) -> Any:
    return next(s.message for s in said if s.key == key and getattr(s.message, "time", 0) == START + step * SECOND)


def test_a_line_leads_from_each_local_track_to_what_was_fused_from_it(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    step = 30
    time = START + step * SECOND
    fused = at(said, global_key("main", "tracks"), step)
    whole = dict(zip(fused.ids.tolist(), row(path, "/picture/global/main", time)["Points2D:positions"], strict=True))
    for number, name in enumerate(RADARS):
        own = at(said, local_key(name, "tracks"), step)
        near = dict(zip(own.ids.tolist(), row(path, f"/picture/local/{name}", time)["Points2D:positions"], strict=True))
        owner = np.repeat(fused.ids, fused.contributor_counts)
        pairs = [
            (near[local], whole[track])
            for track, source, local in zip(
                owner.tolist(), fused.contributor_source.tolist(), fused.contributor_id.tolist(), strict=True
            )
            if source == number and local in near
        ]
        strips = row(path, f"/picture/global/main/links/{name}", time)["LineStrips2D:strips"]
        assert pairs
        np.testing.assert_array_equal(np.array(strips), np.array(pairs))
        shade = static(path, f"/picture/global/main/links/{name}")["LineStrips2D:colors"]
        assert shade[0] >> 8 == static(path, f"/picture/local/{name}/ellipses")["LineStrips2D:colors"][0] >> 8


def test_links_leave_with_their_source_and_go_to_tracks_of_the_steps_own_time(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    found = {item["time"]: item["LineStrips2D:strips"] for item in rows(path, "/picture/global/main/links/radar2")}
    assert found[START + 50 * SECOND]
    assert not found[START + 75 * SECOND]  # lost since 60, known at 66
    assert found[START + 95 * SECOND]


def test_a_step_is_linked_to_what_it_could_know(tmp_path: Path) -> None:
    """Local tracks that came before the step's result but are newer than it are not those it was fused from."""
    said = list(mission(20))
    late = [s for s in said if s.key == global_key("main", "tracks")]
    rest = [s for s in said if s.key != global_key("main", "tracks")]
    path = tmp_path / "a.rrd"
    fly(path, [*rest, *late])
    third = START + 3 * SECOND
    strips = np.array(row(path, "/picture/global/main/links/radar1", third)["LineStrips2D:strips"])
    drawn = np.array(row(path, "/picture/local/radar1", third)["Points2D:positions"])
    np.testing.assert_array_equal(strips[:, 0], drawn)


def fly(path: Path, said: list[Sent], **options: Any) -> None:
    with Recorder(path, **options) as recorder:
        for sent in said:
            recorder.handle(sent.key, sent.data, sent.received)


def second(said: list[Sent], name: str) -> list[Sent]:
    """What another centre would publish beside "main"."""
    moved = [replace(s.message, source=name) for s in said if isinstance(s.message, GlobalTracks)]
    return [Sent(key_of(message), message, message.time + 60_000_000) for message in moved]


def test_several_centres_have_colours_and_pictures_of_their_own(tmp_path: Path) -> None:
    said, path = list(mission(10)), tmp_path / "a.rrd"
    fly(path, sorted([*said, *second(said, "again")], key=lambda s: s.received))
    wanted = colours.centre_colours(["main", "again"])
    assert len(set(wanted.values())) == 2
    for name in ("main", "again"):
        packed = static(path, f"/picture/global/{name}/trail")["LineStrips2D:colors"][0]
        assert packed >> 8 == colours.packed(wanted[name]) >> 8
        assert static(path, f"/anees/{name}/mean")["SeriesLines:colors"][0] >> 8 == packed >> 8
        assert rows(path, f"/picture/global/{name}/links/radar1")
    shown = layout(path)
    for name in ("main alone", "again alone", "Error per target (m): again", "Influence (weights per source): main"):
        assert name in shown
    fly(tmp_path / "b.rrd", said)
    assert "main alone" not in layout(tmp_path / "b.rrd")
    packed = static(tmp_path / "b.rrd", "/picture/global/main/trail")["LineStrips2D:colors"][0]
    assert packed >> 8 == colours.packed(colours.SCREEN_FUSED) >> 8


def layout(path: Path) -> str:
    """All layouts that were said, in no order."""
    reader = RrdReader(path)
    return " ".join(str(chunk.to_record_batch()) for one in reader.blueprints() for chunk in reader.stream(store=one))


# ------------------------------------------------------------------ one track

TRACK = GENERATION + 3


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Sent]]:
    path, said = tmp_path_factory.mktemp("one") / "a.rrd", list(mission(40))
    fly(path, [*said, decided()], focus=TRACK)
    return path, said


def decided() -> Sent:
    """Of the last step: three decisions on the track, one on another, one that is no news."""
    kinds = [LINKED, BROKEN, MERGED, KEPT, LINKED]
    said: Any = next(s.message for s in reversed(list(mission(40))) if isinstance(s.message, StepLog))
    rows = replace(
        said.decisions,
        kind=np.array(kinds, dtype=np.uint8),
        track=np.array([TRACK, TRACK, GENERATION + 1, TRACK, GENERATION + 2], dtype=np.uint64),
        source=np.array([1, 0, NO_SOURCE, 2, 2], dtype=np.uint16),
        epoch=np.full(5, START, dtype=np.uint64),
        id=np.array([12, 13, 0, 14, 15], dtype=np.uint64),
        other=np.array([0, 0, TRACK, 0, 0], dtype=np.uint64),
        value=np.array([1.25, 31.0, np.nan, 0.5, 2.0]),
    )
    message = replace(said, decisions=rows, seq=said.seq + 1)
    return Sent(global_key("main", "log"), message, message.time + 50_000_000)


def test_a_recording_of_one_track_has_its_series(followed: tuple[Path, list[Sent]]) -> None:
    path, said = followed
    step = 30
    time = START + step * SECOND
    fused = at(said, global_key("main", "tracks"), step)
    number = fused.ids.tolist().index(TRACK)
    apart = (fused.means[number] - positions(float(step))[number])[::2]
    P = fused.covariances[number][::2, ::2]

    def value(name: str) -> float:
        return float(row(path, f"/track/main/{name}", time)["Scalars:scalars"][0])

    assert value(f"error/{number + 1}") == pytest.approx(np.hypot(*apart))
    assert value("nees/track") == pytest.approx(apart @ np.linalg.solve(P, apart) / 2)
    assert value("sigma") == pytest.approx(np.sqrt(np.trace(P)))
    assert value("existence") == 0.95
    assert [value(f"influence/{name}") for name in RADARS] == [0.5, 0.3, 0.2]
    others = {name for name in entities(path) if name.startswith("/track/main/error/")}
    assert others == {f"/track/main/error/{number + 1}"}
    shown = layout(path)
    for name in ("Track 3: NEES", "Seen from track 3", "Track 3: log"):
        assert name in shown


def test_its_log_says_the_decisions_on_it_alone(followed: tuple[Path, list[Sent]]) -> None:
    told = [text.split("  ", 1)[1] for text in texts(followed[0], "track")]
    assert sorted(told) == [
        "main: broken radar1 track 13 (31)",
        "main: linked radar2 track 12 (1.25)",
        "main: merged, other track 1",
    ]


def test_the_view_along_with_a_track_shows_its_sources_and_the_truth_at_their_distance(
    followed: tuple[Path, list[Sent]],
) -> None:
    path, said = followed
    step = 30
    time = START + step * SECOND
    fused = at(said, global_key("main", "tracks"), step)
    number = fused.ids.tolist().index(TRACK)
    own = fused.means[number, ::2]
    assert row(path, "/near/main", time)["Points2D:positions"] == [[0.0, 0.0]]
    there = row(path, "/near/main/truth/circles", time)["Points2D:positions"]
    expected = (positions(float(step))[number, ::2] - own) * (1, -1)
    np.testing.assert_allclose(there, [expected], atol=1e-3)
    local = at(said, local_key("radar1", "tracks"), step)
    chart = Chart(fused.frame)
    place = chart.place(local.means, local.covariances, local.space, local.frame)
    index = local.ids.tolist().index(number + 10)
    seen = row(path, "/near/main/local/radar1", time)["Points2D:positions"]
    np.testing.assert_allclose(seen, [(place.xy[index] - own) * (1, -1)], atol=1e-3)


def test_a_track_that_never_comes_leaves_a_recording_that_opens(tmp_path: Path) -> None:
    fly(tmp_path / "a.rrd", list(mission(3)), focus=GENERATION + 77)
    assert RrdReader(tmp_path / "a.rrd").blueprints()
    assert not any(name.startswith("/track/") for name in entities(tmp_path / "a.rrd"))


@pytest.mark.parametrize("reach", [0.3, 1.0, 9.9, 123.0, 4321.0, 1.7e5])
def test_circles_of_distance_are_few_and_within_the_view(reach: float) -> None:
    radii, labels = rings(reach)
    assert 1 <= len(radii) <= 4
    assert len(labels) == len(radii)
    assert radii[-1] <= max(reach, 1.0)


def test_memory_of_names_and_generations_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.labels.MAX_GENERATIONS", 3)
    monkeypatch.setattr("fusion_service.recording.drawing.scene.MAX_CENTRES", 2)
    base: Any = next(s.message for s in mission(1) if isinstance(s.message, GlobalTracks))
    said: list[Message] = [replace(base, source=f"centre{n}", seq=n) for n in range(4)]
    said += [replace(base, source="centre0", seq=9 + n, ids=base.ids + np.uint64(n << 32)) for n in range(6)]
    with Recorder(tmp_path / "a.rrd", frame=Enu(59.0, 10.5)) as recorder:
        for number, message in enumerate(said):
            recorder.handle(key_of(message), encode(message), START + number)
    assert recorder.undrawn["more than 2 centres"] == 2
    labels = [item["Points2D:labels"][0] for item in rows(tmp_path / "a.rrd", "/picture/global/centre0")]
    assert sorted(set(labels)) == ["1", "2.1", "3.1", "4.1", "5.1", "6.1"]
