"""The map is looked at by its pixels: what was given is in it, in its colour and its place, and nothing else."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service.colours import PAPER_FUSED, PAPER_TRUTH, SOURCES, source_colours
from fusion_service.geodesy import enu_to_geodetic, geodetic_to_ecef
from fusion_service.review.map_labels import MapLabel, place_labels
from fusion_service.review.mission_map import mission_map
from schemas import Disk, Ecef, Enu, Local, Message, Polygon, Sector
from tests.helpers.missions import FRAME, info, picture, tracks, truth

image = pytest.importorskip("matplotlib.image")
Pixels = NDArray[np.float64]


def pixels(path: Path) -> Pixels:
    """(rows, columns, 3) in 0..255."""
    return np.asarray(image.imread(path)[..., :3] * 255.0)


def amount(drawn: Pixels, colour: str, alpha: float = 1.0) -> int:
    """How many pixels show `colour` over white."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) * alpha + 255 * (1 - alpha)
    return int((np.abs(drawn - wanted) < 3).all(axis=-1).sum())


def harbour(size: float = 100.0, **rest: Any) -> list[Message]:
    """A lidar and a radar follow one of two boats for 20 s; the fused track is a metre off."""
    mission: list[Message] = [
        info("lidar", coverage=Sector(0.9 * size, azimuth=0.3, width=2.0)),
        info("radar", position=(0.2 * size, 0.1 * size, 3.0), coverage=Disk(1.2 * size, inner=0.1 * size)),
    ]
    for t in range(21):
        boats = [[size * (0.02 * t - 0.2), 0.5 * size], [0.6 * size, size * 0.03 * t]]
        first = np.array(boats[:1])
        mission += [
            truth(t, [1, 2], boats),
            tracks("lidar", t, [1], (first + 2.0).tolist(), sigma=1.5, **rest),
            tracks("radar", t, [4], (first - 3.0).tolist(), sigma=3.0),
            picture(t, [1], (first + 1.0).tolist(), sigma=1.0),
        ]
    return mission


def test_colours_are_fixed_by_name_and_reserved() -> None:
    some = source_colours(["radar", "lidar", "camera"])
    assert some == source_colours({"camera", "lidar", "radar"}) == source_colours(["lidar", "radar", "camera", "lidar"])
    assert list(some) == ["camera", "lidar", "radar"]
    assert len(set(SOURCES)) == len(SOURCES)
    assert not {PAPER_FUSED, PAPER_TRUTH} & set(SOURCES)
    assert len(source_colours(map(str, range(30)))) == 30


def test_nothing_heavy_is_imported_before_a_map_is_drawn() -> None:
    code = "import sys, fusion_service.review.mission_map; sys.exit(bool({'matplotlib', 'rerun'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_map_shows_truth_sources_and_fused_tracks(tmp_path: Path) -> None:
    mission = [message for message in harbour() if message.type != "sensor_info"]
    drawn = pixels(mission_map(mission, tmp_path / "map.png", title="harbour"))
    assert min(drawn.shape[:2]) > 500
    colours = source_colours(["lidar", "radar"])
    for colour in (*colours.values(), PAPER_FUSED):
        assert amount(drawn, colour) > 100
    grey = amount(drawn, PAPER_TRUTH, 0.55)
    fewer = [message for message in mission if message.source not in ("radar", "world")]
    drawn = pixels(mission_map(fewer, tmp_path / "fewer.png"))
    assert amount(drawn, SOURCES[0]) > 100
    assert amount(drawn, colours["radar"]) == 0
    assert grey > 20 * amount(drawn, PAPER_TRUTH, 0.55)


def test_the_order_of_messages_does_not_matter(tmp_path: Path) -> None:
    mission = [*harbour(), info("radar", position=(40.0, 0.0, 0.0), epoch=2)]
    there, back = mission_map(mission, tmp_path / "a.png"), mission_map(mission[::-1], tmp_path / "b.png")
    assert there.read_bytes() == back.read_bytes()


def test_one_frame_for_all(tmp_path: Path) -> None:
    """The lidar's tracks told in ECEF give the same map: at most a few pixels differ by rounding."""

    def ecef(places: Sequence[Sequence[float]]) -> NDArray[np.float64]:
        x, y = np.array(places).T
        return np.stack(geodetic_to_ecef(*enu_to_geodetic(x, y, np.zeros_like(x), FRAME)), axis=-1)

    mission = harbour()
    other = [
        tracks("lidar", t, [1], [], means=ecef([[2.0 * t - 18.0, 52.0]]), space=("x", "y", "z"), frame=Ecef())
        for t in range(21)
    ]
    moved = [m for m in mission if not (m.source == "lidar" and m.type == "local_tracks")] + other
    a, b = (pixels(mission_map(m, tmp_path / "map.png")) for m in (mission, moved))
    assert np.mean(np.abs(a - b).max(axis=-1) > 3) < 1e-4


def test_a_wide_map_magnifies_its_ellipses_and_shows_details(tmp_path: Path) -> None:
    """With ellipses of metres on a map of 100 km there is a detail of each followed boat, on one of 100 m none."""

    def upright(drawn: Pixels) -> int:
        """Dark pixels in the darkest column right of the map: the sides of details, one above the other."""
        return int((drawn[:, int(drawn.shape[1] * 0.7) :] < 130).all(axis=-1).sum(axis=0).max())

    wide, narrow = (pixels(mission_map(harbour(size), tmp_path / "map.png")) for size in (1e5, 100.0))
    second = [tracks("lidar", t, [7], [[6e4, 3000.0 * t]], complete=False) for t in range(21)]
    two = pixels(mission_map([*harbour(1e5), *second], tmp_path / "map.png"))
    assert upright(narrow) < 100
    assert 150 < upright(wide) < 300
    assert 300 < upright(two) < 600


def test_what_is_tentative_or_no_number_is_not_drawn(tmp_path: Path) -> None:
    bare = harbour()
    status = np.zeros(1, dtype=np.uint8)
    extra: list[Message] = [picture(t + 0.5, [9], [[10.0, -40.0 + t]], status=status) for t in range(20)]
    extra.append(tracks("lidar", 0.5, [1], [[math.nan, 0.0]], complete=False))
    a, b = mission_map(bare, tmp_path / "a.png"), mission_map([*bare, *extra], tmp_path / "b.png")
    assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize(
    "mission",
    [
        [info("alone", position=(5.0, 5.0, 0.0), coverage=Polygon(((0, 0), (10, 0), (0, 10))))],
        [truth(0, [1], [[3.0, 4.0]])],
        [tracks("a", 0, [1], [[3.0, 4.0]])],
        [picture(0, [1], [[0.0, 0.0]])],
        [picture(0, [1], [[0.0, 0.0]], frame=Local("dock")), truth(1, [1], [[9.0, 9.0]], frame=Local("dock"))],
        [info("a", frame=Ecef(), position=(3.0e6, 5.0e5, 5.5e6), coverage=Disk(100.0))],
        [picture(0, [1], [], means=np.array([[3.0e6, 5.0e5, 5.5e6]]), space=("x", "y", "z"), frame=Ecef())],
    ],
)
def test_little_is_enough(mission: list[Message], tmp_path: Path) -> None:
    assert pixels(mission_map(mission, str(tmp_path / "map.png"))).shape[2] == 3


def test_a_source_without_relation_is_named(tmp_path: Path) -> None:
    """Its line stands over the legend, right of the map, which stays as it was but for the colours' order."""
    dock = [tracks("zebra", 0, [1], [[0.0, 0.0]], frame=Local("dock"))]
    a, b = (pixels(mission_map(m, tmp_path / "map.png")) for m in (harbour(), [*harbour(), *dock]))
    dark = [int((one[: one.shape[0] // 3, -one.shape[1] // 3 :] < 100).all(axis=-1).sum()) for one in (a, b)]
    assert dark[1] > dark[0] + 500
    for colour in source_colours(["lidar", "radar"]).values():
        assert amount(b, colour) > 100


def test_nothing_to_draw(tmp_path: Path) -> None:
    for nothing in ([], [picture(0, [], [])], [truth(0, [], [])], [picture(0, [], [], frame=Ecef())]):
        with pytest.raises(ValueError, match="nothing to draw"):
            mission_map(nothing, tmp_path / "map.png")
    assert not (tmp_path / "map.png").exists()
    assert isinstance(mission_map([truth(0, [1], [[1.0, 2.0]])], tmp_path / "map.png", frame=Enu(60.1, 10.0)), Path)


def test_labels_do_not_cover_each_other_and_those_without_room_are_left_out() -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4, 4), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(0, 10), ylim=(0, 10))
    spread = [MapLabel(np.array([k, k]), f"target {k}") for k in (2.0, 5.0, 8.0)]
    heap = [MapLabel(np.array([5.0, 2.0]), f"ship {k}") for k in range(40)]
    out = place_labels(figure, axes, [*spread, *heap])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert [text.get_text() for text in axes.texts][:3] == [label.text for label in spread]
    assert len(boxes) == 43 - out
    assert 4 <= len(boxes) - 3 <= 12
    assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])
