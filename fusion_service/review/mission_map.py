"""A mission on one page: a PNG map of truth, local tracks, fused tracks, sensors and what they cover.

Drawn east and north in the frame of the fused tracks. Where a map is so wide that the 95 % ellipses would vanish they
are magnified, and the legend says by how much; details beside the map then show two targets at their true scale.
Matplotlib (the extra `report`) is imported only when a map is drawn.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.colours import PAPER_FUSED, PAPER_TRUTH, source_colours
from fusion_service.geodesy import FrameError, ecef_to_geodetic, transform
from fusion_service.recording.drawing.geometry import QUANTILE, circle, outline
from fusion_service.review.map_labels import MapLabel, place_labels
from fusion_service.review.snapshots import in_frame, order, truth_path, truth_positions
from schemas import Ecef, Enu, Frame, GlobalTracks, LocalTracks, Message, SensorInfo, Truth, check_numbers
from schemas.messages import TENTATIVE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["mission_map"]


RING = np.ascontiguousarray(circle(48).T)
VISIBLE = 0.006
"""The semi-axis an ellipse needs to be seen, as a share of the map's width."""
MAX_LABELS = 60


def mission_map(
    messages: Iterable[Message], path: Path | str, title: str = "", *, frame: Frame | None = None, ellipses: int = 6
) -> Path:
    """Draw a mission's messages, in any order, to the PNG file `path`; return it.

    frame: to draw in, by default that of the fused tracks (else of local ones, of truth, of a sensor); for ECEF, ENU
    about a place. ellipses: about how many for each fused track over the mission. Tentative fused tracks are not
    drawn. A sensor stands where its newest info says. A source whose frame has no relation to the map's is named in
    the legend. Raises ValueError if there is nothing to draw, ImportError without matplotlib.
    """
    from matplotlib.figure import Figure

    mission = _gather(messages, frame)
    low, high = _bounds(mission.places())
    metres, unit = (1000.0, "km") if max(high - low) > 5000 else (1.0, "m")
    scale = _magnification(mission.fused, float(max(high - low)))
    height = 8.4 * float(np.clip((high - low)[1] / (high - low)[0], 0.6, 1.3))
    figure = Figure(figsize=(14.5, height), dpi=120, layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=[2.4, 1], height_ratios=[1, 1.3, 1.3])
    axes = figure.add_subplot(grid[:, 0])
    for name, info in mission.infos.items():
        _draw_sensor(axes, name, info, mission, metres)
    _draw_tracks(axes, mission, metres, _spread_out(mission.fused, ellipses), scale)
    axes.set(xlim=(low[0] / metres, high[0] / metres), ylim=(low[1] / metres, high[1] / metres), aspect="equal")
    axes.set(xlabel=f"east, {unit}", ylabel=f"north, {unit}")
    axes.set_title(title, loc="left", weight="bold")
    legend = figure.add_subplot(grid[0, 1])
    legend.axis("off")
    hidden = "\n".join(line for text in mission.hidden for line in textwrap.wrap(text, 60))
    handles = _handles(mission, scale)
    legend.legend(handles=handles, loc="upper left", frameon=False, fontsize=9, title=hidden, title_fontsize=8)
    for row, target in enumerate(_followed(mission)[:2] if scale > 1 else (), start=1):
        _draw_detail(figure.add_subplot(grid[row, 1]), mission, target)
    place_labels(figure, axes, _names(mission, metres, float(max(high - low))))
    figure.savefig(path, format="png")
    return Path(path)


class _Track(NamedTuple):
    """One track over time: times (L,) ns, positions (L, 2) and their covariances (L, 2, 2)."""

    times: NDArray[np.int64]
    xy: Floats
    covariances: Floats


class _Mission(NamedTuple):
    """All that is drawn, in one ENU or local frame; positions in m."""

    frame: Frame
    truth: dict[int, tuple[NDArray[np.int64], Floats]]
    local: dict[str, list[_Track]]
    fused: list[_Track]
    infos: dict[str, SensorInfo]
    sensors: dict[str, Floats]
    colours: dict[str, str]
    hidden: list[str]

    def places(self) -> Floats:
        tracks = [track.xy for one in (*self.local.values(), self.fused) for track in one]
        return np.concatenate([*tracks, *(xy for _, xy in self.truth.values()), *self.sensors.values()])


def _gather(messages: Iterable[Message], frame: Frame | None) -> _Mission:
    local: dict[str, list[LocalTracks]] = {}
    pictures: list[GlobalTracks] = []
    truths: list[Truth] = []
    infos: dict[str, SensorInfo] = {}
    for message in messages:
        if isinstance(message, LocalTracks):
            local.setdefault(message.source, []).append(message)
        elif isinstance(message, GlobalTracks):
            pictures.append(message)
        elif isinstance(message, Truth):
            truths.append(message)
        elif isinstance(message, SensorInfo):
            known = infos.get(message.source, message)
            infos[message.source] = max(known, message, key=lambda info: (info.epoch, info.seq))
    located: list[LocalTracks | GlobalTracks | Truth | SensorInfo] = [
        *pictures,
        *(scan for scans in local.values() for scan in scans),
        *truths,
        *infos.values(),
    ]
    if not located:
        raise ValueError("nothing to draw: no track, truth or sensor")
    frame = _level(frame or located[0].frame, located)
    tracks: dict[str, list[_Track]] = {}
    sensors: dict[str, Floats] = {}
    hidden: list[str] = []
    for name, scans in sorted(local.items()):
        try:
            tracks[name] = _tracks(scans, frame)
        except FrameError as error:
            hidden.append(f"not drawn: {name}: {error}")
    for name, info in sorted(infos.items()):
        try:
            sensors[name] = _moved(np.array([info.position]), info.frame, frame)
        except FrameError as error:
            hidden.append(f"not drawn: sensor {name}: {error}")
    mission = _Mission(
        frame=frame,
        truth=truth_path(truths, frame, ("x", "y")),
        local=tracks,
        fused=_tracks(pictures, frame),
        infos={name: infos[name] for name in sensors},
        sensors=sensors,
        colours=source_colours([*local, *infos]),
        hidden=hidden,
    )
    if not (mission.sensors or mission.truth or mission.fused or any(mission.local.values())):
        raise ValueError("nothing to draw: no track, truth or sensor")
    return mission


def _level(frame: Frame, located: Sequence[LocalTracks | GlobalTracks | Truth | SensorInfo]) -> Frame:
    """`frame`, or for ECEF an ENU frame about the first place that is told in ECEF."""
    if not isinstance(frame, Ecef):
        return frame
    for one in located:
        if isinstance(one.frame, Ecef) and isinstance(one, SensorInfo):
            place = one.position
        elif isinstance(one.frame, Ecef) and not isinstance(one, SensorInfo) and len(one.means):
            place = tuple(one.means[0, [one.space.index(name) for name in "xyz"]])
        else:
            continue
        lat, lon, _ = ecef_to_geodetic(*place)
        return Enu(float(lat), float(lon))
    raise ValueError("nothing to draw: no place in ECEF, the frame of the map")


def _moved(places: Floats, source: Frame, target: Frame) -> Floats:
    """Positions (T, 3) -> (T, 2)."""
    return transform(places, np.zeros((len(places), 3, 3)), ("x", "y", "z"), source, target)[0][:, :2]


def _tracks(messages: Sequence[LocalTracks | GlobalTracks], frame: Frame) -> list[_Track]:
    """The tracks of one source, or of the centre without its tentative ones, in the order of their keys."""
    messages = sorted(messages, key=order)
    rows: dict[tuple[str, int, int], list[tuple[int, Floats, Floats]]] = {}
    for space, indices, means, covariances in in_frame(messages, frame):
        at = [space.index("x"), space.index("y")]
        xy, P = means[:, at], covariances[:, at][:, :, at]
        row = 0
        for index, faults in zip(indices, check_numbers([messages[index] for index in indices]), strict=True):
            message = messages[index]
            shown = faults == 0
            if isinstance(message, GlobalTracks):
                shown &= message.status != TENTATIVE
            for k, id_ in enumerate(message.ids.tolist(), start=row):
                if shown[k - row] and np.isfinite(xy[k]).all():
                    epoch = 0 if isinstance(message, GlobalTracks) else message.epoch
                    rows.setdefault((message.source, epoch, id_), []).append((message.time, xy[k], P[k]))
            row += len(message.ids)
    found = []
    for _, versions in sorted(rows.items()):
        times, places, spreads = zip(*sorted(versions, key=lambda version: version[0]), strict=True)
        found.append(_Track(np.array(times), np.stack(places), np.stack(spreads)))
    return found


def _bounds(places: Floats) -> tuple[Floats, Floats]:
    """Corners of the map: all places with a margin, and not too narrow a strip."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half * 1.12, max(0.4 * float(half.max()), 1.0))
    return middle - half, middle + half


def _semi_axes(tracks: Sequence[_Track]) -> Floats:
    """Larger semi-axes of all 95 % ellipses, m."""
    spreads = np.concatenate([track.covariances for track in tracks] or [np.zeros((0, 2, 2))])
    return np.sqrt(QUANTILE * np.linalg.eigvalsh(spreads)[:, 1])


def _magnification(fused: Sequence[_Track], width: float) -> int:
    """1, 2, 5, 10, ...: the least with which the median ellipse can be seen."""
    sizes = _semi_axes(fused)
    wanted = VISIBLE * width / float(np.median(sizes)) if len(sizes) else 1.0
    steps = (step * 10**power for power in range(4) for step in (1, 2, 5))
    return next((step for step in steps if step >= wanted), 10_000)


def _spread_out(fused: Sequence[_Track], count: int) -> set[int]:
    """About `count` of the times at which there are fused tracks, the last among them."""
    times = np.unique(np.concatenate([track.times for track in fused] or [np.zeros(0, dtype=np.int64)]))
    return set(times[:: -max(1, math.ceil(len(times) / max(1, count)))].tolist())


def _draw_sensor(axes: Axes, name: str, info: SensorInfo, mission: _Mission, metres: float) -> None:
    strips, frame = outline(info)
    colour, place = mission.colours[name], mission.sensors[name][0] / metres
    level = info.position[2] if frame == info.frame else 0.0
    for index, strip in enumerate(strips):
        edge = _moved(np.column_stack([strip, np.full(len(strip), level)]), frame, mission.frame) / metres
        axes.plot(*edge.T, "--", color=colour, lw=1.0, alpha=0.8, zorder=1)
        axes.fill(*edge.T, color=colour if index == 0 else "none", alpha=0.04, lw=0, zorder=0)
    axes.plot(*place, "^", color=colour, ms=10, mec="black", mew=0.8, zorder=6)


def _names(mission: _Mission, metres: float, width: float) -> list[MapLabel]:
    """Of sensors, of those that stand together, within a hundredth of the map's width, on one line; then of targets."""
    together: list[tuple[Floats, list[str]]] = []
    for name, (place,) in mission.sensors.items():
        near = (names for at, names in together if math.dist(at, place) < width / 100)
        names = next(near, None)
        if names is None:
            together.append((place, [name]))
        else:
            names.append(name)
    labels = [MapLabel(at / metres, ", ".join(names), 9, "black", under=True) for at, names in together]
    if len(mission.truth) <= MAX_LABELS:
        labels += [MapLabel(xy[0] / metres, str(target)) for target, (_, xy) in mission.truth.items()]
    return labels


def _draw_tracks(axes: Axes, mission: _Mission, metres: float, when: set[int] | None, scale: float) -> None:
    from matplotlib.collections import LineCollection

    axes.grid(color="#e8e8e8", lw=0.6)
    axes.set_axisbelow(True)
    paths = [xy / metres for _, xy in mission.truth.values()]
    axes.add_collection(LineCollection(paths, colors=PAPER_TRUTH, lw=5, alpha=0.55, capstyle="round", zorder=2))
    axes.plot(*np.array([path[0] for path in paths]).reshape(-1, 2).T, "o", color=PAPER_TRUTH, ms=6, zorder=2)
    for name, tracks in mission.local.items():
        lines = [track.xy / metres for track in tracks]
        axes.add_collection(LineCollection(lines, colors=mission.colours[name], lw=2.2, alpha=0.8, zorder=3))
        dots = np.concatenate(lines or [np.zeros((0, 2))])
        axes.plot(*dots.T, ".", color=mission.colours[name], ms=5, alpha=0.9, zorder=3)
    lines = [track.xy / metres for track in mission.fused]
    axes.add_collection(LineCollection(lines, colors=PAPER_FUSED, lw=1.0, zorder=4))
    rings = [ring / metres for ring in _rings(mission.fused, when, scale)]
    axes.add_collection(LineCollection(rings, colors=PAPER_FUSED, lw=0.9, zorder=5))


def _rings(tracks: Sequence[_Track], when: set[int] | None, scale: float = 1.0) -> list[Floats]:
    """95 % ellipses (points, 2), m, of the tracks at the times in `when`, None for all."""
    return [
        xy + scale * math.sqrt(QUANTILE) * RING @ np.linalg.cholesky(P).T
        for track in tracks
        for time, xy, P in zip(*track, strict=True)
        if when is None or int(time) in when
    ]


def _detail(mission: _Mission) -> float:
    """Half the width of a detail, m: a few ellipses of the local tracks."""
    return 3 * float(np.median(_semi_axes([track for tracks in mission.local.values() for track in tracks])))


def _followed(mission: _Mission) -> list[int]:
    """The targets that sources follow, that which most of them follow first."""
    if not any(mission.local.values()):
        return []
    near = _detail(mission)

    def follows(track: _Track, target: int) -> bool:
        apart = np.linalg.norm(track.xy - truth_positions(*mission.truth[target], track.times, math.inf), axis=1)
        return bool(np.sum(apart < near) > len(apart) / 2)

    followers = {
        target: sum(any(follows(track, target) for track in tracks) for tracks in mission.local.values())
        for target in list(mission.truth)[:MAX_LABELS]
    }
    return sorted((target for target, count in followers.items() if count), key=lambda target: -followers[target])


def _draw_detail(axes: Axes, mission: _Mission, target: int) -> None:
    """The middle of a target's path at true scale, the local tracks with their ellipses too."""
    from matplotlib.collections import LineCollection

    half, path = _detail(mission), mission.truth[target][1]
    middle = path[len(path) // 2]
    mission = _within(mission, middle - 2 * half, middle + 2 * half)
    _draw_tracks(axes, mission, 1.0, None, 1.0)
    for name, tracks in mission.local.items():
        colour = mission.colours[name]
        axes.add_collection(LineCollection(_rings(tracks, None), colors=colour, lw=1.0, zorder=3))
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    axes.set_title(f"target {target}, true scale, m", loc="left", size=10)
    axes.tick_params(labelsize=8)


def _within(mission: _Mission, low: Floats, high: Floats) -> _Mission:
    """Of the paths and tracks those whose bounding boxes meet the box from `low` to `high`."""

    def meets(xy: Floats) -> bool:
        return bool((xy.min(axis=0) <= high).all() and (xy.max(axis=0) >= low).all())

    return mission._replace(
        truth={target: path for target, path in mission.truth.items() if meets(path[1])},
        local={name: [track for track in tracks if meets(track.xy)] for name, tracks in mission.local.items()},
        fused=[track for track in mission.fused if meets(track.xy)],
    )


def _handles(mission: _Mission, scale: int) -> list[object]:
    from matplotlib.lines import Line2D

    handles = []
    if mission.truth:
        handles.append(Line2D([], [], color=PAPER_TRUTH, lw=5, alpha=0.55, label="truth, a dot where it starts"))
    for name, colour in mission.colours.items():
        count = len(mission.local.get(name, ()))
        handles.append(Line2D([], [], color=colour, lw=2.2, marker=".", label=f"{name}, local tracks: {count}"))
    handles.append(Line2D([], [], color=PAPER_FUSED, lw=1.0, label=f"fused tracks: {len(mission.fused)}"))
    magnified = f", drawn {scale} times as large" if scale > 1 else ""
    ring: dict[str, Any] = {"marker": "o", "mfc": "none", "mec": PAPER_FUSED, "ms": 11, "ls": "none"}
    handles.append(Line2D([], [], label=f"95 % ellipse of a fused track{magnified}", **ring))
    if mission.sensors:
        handles.append(Line2D([], [], color="#555555", marker="^", ms=9, ls="--", label="sensor and its field of view"))
    return list(handles)
