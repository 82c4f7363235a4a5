"""Mixtures are seen as what they are: components by weight, tracks by existence, intensities by mass."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from fusion_service.recording import Recorder, read
from schemas import LocalIntensity, LocalTracks, Message, encode
from tests.helpers import missions
from tests.recording.contents import FIRST, entities, key_of, opacities, record, row, rows, static
from tests.recording.mission import START, Sent

WEIGHTS = np.array([0.6, 0.3, 0.1, 1.0])
PLACES = [(0.0, 0.0), (30.0, 10.0), (-20.0, 50.0), (500.0, 0.0)]
COUNTS = np.array([3, 1], dtype=np.uint16)


def spread() -> np.ndarray[Any, np.dtype[np.float64]]:
    roots = np.random.default_rng(5).normal(0, 4, (4, 4, 4))
    covariances: np.ndarray[Any, np.dtype[np.float64]] = roots @ roots.transpose(0, 2, 1) + 9 * np.eye(4)
    return covariances


def mixture(seconds: float, ids: tuple[int, int] = (7, 8), **rest: Any) -> LocalTracks:
    """A track of three components, and one that is Gaussian."""
    given: dict[str, Any] = {
        "means": missions.states(PLACES),
        "covariances": spread(),
        "counts": COUNTS,
        "weights": WEIGHTS,
    } | rest
    return missions.tracks("a", seconds, ids, [], **given)


def phd(seconds: float, weights: list[float]) -> LocalIntensity:
    plain = missions.tracks("phd", seconds, range(len(weights)), [(5.0 * k, 0.0) for k in range(len(weights))])
    return LocalIntensity(
        source="phd", epoch=1, seq=plain.seq, sent=0, time=plain.time, space=plain.space, frame=plain.frame,
        weights=np.array(weights), means=plain.means, covariances=plain.covariances,
    )  # fmt: skip


def strips(path: Path, entity: str, at: int) -> list[Any]:
    found: list[Any] = row(path, entity, at)["LineStrips2D:strips"]
    return found


def on_ellipse(strip: list[list[float]], mean: Any, covariance: Any) -> bool:
    apart = np.array(strip) * (1, -1) - mean
    return np.allclose(np.einsum("ki,ij,kj->k", apart, np.linalg.inv(covariance), apart), chi2.ppf(0.95, 2), rtol=1e-3)


@pytest.mark.parametrize("scope", ["local", "global"])
def test_components_are_drawn_by_their_weights_under_their_track(tmp_path: Path, scope: str) -> None:
    path = tmp_path / "a.rrd"
    message: Any = mixture(0)
    if scope == "global":
        given = {name: getattr(message, name) for name in ("means", "covariances", "counts", "weights")}
        message = missions.picture(0, [7, 8], [], centre="a", **given)
    record(path, message, frame=missions.FRAME)
    entity = f"/picture/{scope}/a"
    drawn = row(path, f"{entity}/components", message.time)
    assert drawn["Points2D:labels"] == ["7: 0.60", "7: 0.30", "7: 0.10"]
    np.testing.assert_allclose(drawn["Points2D:positions"], np.array(PLACES[:3]) * (1, -1), atol=1e-5)
    assert len(drawn["GeoPoints:positions"]) == 3
    shades = opacities(path, entity)
    alphas = [shades[level] for level in drawn["Points2D:class_ids"]]
    np.testing.assert_allclose(alphas, 40 + 215 * WEIGHTS[:3], atol=10)
    lines = row(path, f"{entity}/components/ellipses", message.time)
    assert lines["LineStrips2D:class_ids"] == drawn["Points2D:class_ids"]
    assert lines["LineStrips2D:radii"] == lines["GeoLineStrings:radii"]
    assert all(heavy < light < 0 for heavy, light in pairwise(lines["LineStrips2D:radii"]))  # of the screen
    for strip, mean, covariance in zip(lines["LineStrips2D:strips"], PLACES, spread(), strict=False):
        assert on_ellipse(strip, mean, covariance[::2, ::2])
    # the track itself: its moments, above
    w, means = WEIGHTS[:3], np.array(PLACES[:3])
    mean = w @ means
    second = np.einsum("c,cij->ij", w, spread()[:3, ::2, ::2] + np.einsum("ci,cj->cij", means, means))
    own = strips(path, f"{entity}/ellipses", message.time)
    assert len(own) == 2
    assert on_ellipse(own[0], mean, second - np.outer(mean, mean))
    below = static(path, f"{entity}/components/ellipses")["LineStrips2D:draw_order"][0]
    assert static(path, "/grid")["LineStrips2D:draw_order"][0] < below < 20  # that of lines unless said otherwise


def test_nothing_static_hides_what_the_rows_say(tmp_path: Path) -> None:
    """Rerun shows what is static whatever the rows say."""
    path, message = tmp_path / "a.rrd", mixture(0)
    given = {name: getattr(message, name) for name in ("means", "covariances", "counts", "weights")}
    record(path, missions.picture(0, [7, 8], [], **given), message, phd(0, [0.5, 1.5]))
    for entity in entities(path):
        if entity.startswith("/picture/"):
            said = {name for item in rows(path, entity) for name, value in item.items() if value is not None}
            assert not said & static(path, entity).keys()
            if any(name.endswith(":class_ids") for name in said):
                assert not {"Points2D:colors", "GeoPoints:colors", "LineStrips2D:colors"} & static(path, entity).keys()


def test_components_go_when_a_track_is_gaussian_and_when_its_source_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    said = [mixture(0), missions.tracks("a", 1, [7], [(0, 0)]), mixture(2)]
    with Recorder(path, frame=missions.FRAME) as recorder:
        for number, message in enumerate(said):
            recorder.handle(key_of(message), encode(message), FIRST + number)
        recorder.tick()
        recorder.alive("fusion/v1/local/a/alive", False, FIRST + 9)
    assert [len(item["Points2D:labels"]) for item in rows(path, "/picture/local/a/components")] == [3, 0, 3, 0]
    assert [len(item["Points2D:labels"]) for item in rows(path, "/picture/local/a")] == [2, 1, 2, 0]
    assert "/picture/local/b/components" not in entities(path)


def test_a_source_of_gaussians_has_no_components(flown: tuple[Path, list[Sent]]) -> None:
    assert not [name for name in entities(flown[0]) if "components" in name or "intensity" in name]


def test_components_stay_as_long_as_their_track(tmp_path: Path) -> None:
    """Three periods in an incomplete message; not once the track is listed as something else."""
    path = tmp_path / "a.rrd"
    said: list[Message] = [missions.info("a", period=1.0), mixture(0)]
    said += [missions.tracks("a", s, [8], [(500, 0)], complete=False) for s in (1, 3, 4)]
    said += [mixture(5), missions.tracks("a", 6, [7], [(0, 0)], complete=False)]
    record(path, *said, frame=missions.FRAME)
    held = {(item["time"] - missions.at(0)) // 10**9: item for item in rows(path, "/picture/local/a/components")}
    assert {s: len(item["Points2D:labels"]) for s, item in held.items()} == {0: 3, 1: 3, 3: 3, 4: 0, 5: 3, 6: 0}


def test_an_intensity_shows_where_it_expects_something_and_how_much(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    record(path, phd(0, [0.9, 0.001, 1.3]), phd(1, [0.02]), phd(2, []))
    first, second, third = rows(path, "/picture/local/phd/intensity")
    assert first["Points2D:labels"] == ["0.90", "1.30"]
    shades = opacities(path, "/picture/local/phd")
    heavy, heaviest = (shades[level] for level in first["Points2D:class_ids"])
    (light,) = (shades[level] for level in second["Points2D:class_ids"])
    assert light < 60 < 220 < heavy < heaviest == 255
    assert third["Points2D:positions"] == []
    mass = [item["Scalars:scalars"][0] for item in rows(path, "/counts/local/phd/mass")]
    assert mass == pytest.approx([2.201, 0.02, 0.0])


def test_a_point_says_how_sure_its_track_is(tmp_path: Path) -> None:
    path, places = tmp_path / "a.rrd", [(0, 0), (9, 9), (50, 50)]
    existence = np.array([0.1, 0.5, 1.0])
    picture = missions.picture(0, [1, 2, 3], places, existence=existence)
    record(path, picture, missions.tracks("a", 0, [1, 2, 3], places, existence=existence[::-1]))
    record(tmp_path / "b.rrd", missions.tracks("a", 0, [1], [(0, 0)]))
    for entity, expected in (("global/centre", existence), ("local/a", existence[::-1])):
        shades = opacities(path, f"/picture/{entity}")
        (drawn,) = rows(path, f"/picture/{entity}")
        np.testing.assert_allclose([shades[k] for k in drawn["Points2D:class_ids"]], 40 + 215 * expected, atol=10)
    (untold,) = rows(tmp_path / "b.rrd", "/picture/local/a")
    assert opacities(tmp_path / "b.rrd", "/picture/local/a")[untold["Points2D:class_ids"][0]] == 255


def test_existence_over_time_of_each_confirmed_track(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    said = []
    for s, values in enumerate([(0.5, 0.2), (0.9, 0.3), (0.8, 0.7)]):
        status = np.array([min(s, 1), 0], dtype=np.uint8)
        said.append(missions.picture(s, [1, 2], [(0, 0), (99, 0)], existence=np.array(values), status=status))
    record(path, *said)
    series = [(item["time"], item["Scalars:scalars"][0]) for item in rows(path, "/existence/centre/1")]
    assert series == [(missions.at(1), 0.9), (missions.at(2), 0.8)]
    assert "/existence/centre/2" not in entities(path)  # tentative all the time


def test_a_flood_of_components_and_tracks_is_drawn_by_the_heaviest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_service.recording.drawing.tables.MAX_COMPONENTS", 2)
    monkeypatch.setattr("fusion_service.recording.drawing.charts.MAX_RUNNING", 3)
    monkeypatch.setattr("fusion_service.recording.drawing.charts.MAX_SERIES", 4)
    path = tmp_path / "a.rrd"
    pictures = [missions.picture(s, ids, np.zeros((len(ids), 2))) for s, ids in enumerate([range(5), range(2, 9)])]
    said: list[Message] = [*pictures, mixture(0), phd(0, [0.2, 0.9, 0.1, 0.5])]
    recorder = record(path, *said)
    assert [raw.data for raw in read(path)] == [encode(message) for message in said]
    assert rows(path, "/picture/local/a/components")[0]["Points2D:labels"] == ["7: 0.60", "7: 0.30"]
    assert rows(path, "/picture/local/phd/intensity")[0]["Points2D:labels"] == ["0.90", "0.50"]
    shown = {name: len(rows(path, name)) for name in entities(path) if name.startswith("/existence/")}
    assert shown == {f"/existence/centre/{k}": 2 if k == 2 else 1 for k in (0, 1, 2, 3)}
    assert recorder.undrawn == {"too many components": 1 + 2, "too many series of existence": 2 + 5}


def test_a_thousand_mixtures_a_second_take_little_of_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    given: dict[str, Any] = {
        "means": np.repeat(missions.states(rng.uniform(-1e4, 1e4, (100, 2)).tolist()), 3, axis=0),
        "covariances": np.tile(np.eye(4), (300, 1, 1)),
        "counts": np.full(100, 3, dtype=np.uint16),
        "weights": np.tile([0.6, 0.3, 0.1], 100),
    }
    said = [(s, missions.tracks(f"radar{n}", s, range(100), [], **given)) for s in range(10) for n in range(10)]
    coded = [(key_of(message), encode(message), START + s * 10**9) for s, message in said]
    with Recorder(tmp_path / "a.rrd", frame=missions.FRAME) as recorder:
        begin = time.process_time()
        for number, (key, data, received) in enumerate(coded):
            recorder.handle(key, data, received)
            if number % 10 == 9:
                recorder.tick()
        used = time.process_time() - begin
    assert not recorder.undrawn
    assert used < 5.0  # of ten seconds
