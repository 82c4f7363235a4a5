"""The pictures of the report, each an SVG for the middle of a page, drawn with Matplotlib (the extra `report`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.colours import (
    BLUE,
    GREEN,
    ORANGE,
    PAPER_FUSED,
    PAPER_TRUTH,
    SKY,
    VERMILION,
    line_style,
    paper_colour,
    source_colours,
)
from fusion_service.review.evaluation.figures import chart, legend, thin
from fusion_service.review.evaluation.latency import BINS
from fusion_service.review.evaluation.scoring import WINDOW, Scores
from fusion_service.review.evaluation.tables import ScoredCentre, power_of_ten, row_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fusion_service.review.evaluation.latency import Latency

__all__ = ["charts", "delay_chart"]


PARTS = {"localisation": SKY, "missed": ORANGE, "false": VERMILION}
Line = tuple[str, str, float, Scores, Floats]
"""Name, colour, width, scores, and seconds (K,) since the first scored time."""


def charts(rows: Sequence[ScoredCentre]) -> list[tuple[str, str]]:
    """(SVG, what it shows and how to read it) of scored rows, which must not be none: of one row with its sources, of
    several beside each other. Without a centre: of its sources alone."""
    lines = _lines(rows)
    if not lines:
        return []
    fused = rows[0].evaluation.centre is not None
    found = [_parts_chart(rows)] if fused else []
    found += _error_charts(rows, lines)
    if fused:
        found += _number_charts(rows)
    found.append(
        (
            chart(lambda axes: _over_time(axes, lines, "ospa2", "OSPA(2), m"), "OSPA(2): tracks, not points"),
            f"Compares whole tracks over {WINDOW} scored times: a track that changes its target or breaks costs too. "
            "Lower is better.",
        )
    )
    if any(np.isfinite(row.evaluation.confirm).any() for row in rows):
        text = "Share of the targets that a source covered or tracked which had a fused track after so many seconds."
        found.append((chart(lambda axes: _confirm(axes, rows), "Time to confirm"), text))
    return found


def _parts_chart(rows: Sequence[ScoredCentre]) -> tuple[str, str]:
    return (
        chart(lambda axes: _parts(axes, rows[0]), f"GOSPA², its parts{_of(rows)}"),
        "Its parts: errors of position, targets missed, false tracks. The tallest layer is what to mend.",
    )


def _error_charts(rows: Sequence[ScoredCentre], lines: Sequence[Line]) -> list[tuple[str, str]]:
    """GOSPA, RMSE and ANEES over time."""
    beside = "the fused tracks of each row" if len(rows) > 1 else "each source and the fused tracks"
    return [
        (
            chart(lambda axes: _over_time(axes, lines, "gospa", "GOSPA, m"), "GOSPA over time"),
            f"All faults in one number for {beside}. Lower is better.",
        ),
        (
            chart(lambda axes: _over_time(axes, lines, "rmse", "RMSE, m"), "Error of position over time"),
            "Only of targets that are followed at that time: a source that follows only easy ones looks good here.",
        ),
        (
            chart(lambda axes: _nees(axes, lines), "Consistency: ANEES over time"),
            "1 is ideal. Above the band the covariances are too small (overconfident), below it too large (cautious).",
        ),
    ]


def _number_charts(rows: Sequence[ScoredCentre]) -> list[tuple[str, str]]:
    """How many fused tracks there are, and how many of them are right."""
    return [
        (
            chart(lambda axes: _cardinality(axes, rows), "How many there are"),
            "Targets that exist, and fused tracks that are shown. Shown below true: missed; above: false or double. "
            "Expected: the sum of existence probabilities, tentative tracks included.",
        ),
        (
            chart(lambda axes: _siap(axes, rows[0]), f"SIAP of the fused tracks{_of(rows)}"),
            "Complete: share of targets with a track. Spurious: share of tracks without a target. Tracks per "
            "target that has one: 1 is ideal.",
        ),
    ]


def delay_chart(delays: dict[str, Latency], colours: dict[str, str], title: str) -> str:
    """Histograms of delays, each as shares of its own messages; what has no colour of its own is black."""

    def draw(axes: Axes) -> None:
        for name, delay in delays.items():
            wide = next((wide for wide in (8, 5, 4, 2, 1) if BINS // wide >= np.sqrt(delay.n)), 1)
            wide = 8 if delay.n < 64 else wide
            share = np.array(delay.counts).reshape(-1, wide).sum(axis=1) / delay.n
            edges = 1000 * np.array(delay.edges)[::wide]
            tone = colours.get(name, PAPER_FUSED)
            axes.stairs(100 * share, edges, color=tone, ls=line_style(tone), label=name, lw=1.4)
        axes.set(xlabel="delay, ms", ylabel="messages, %", ylim=(0, None))
        legend(axes)

    return chart(draw, title)


def _of(rows: Sequence[ScoredCentre]) -> str:
    return f" ({rows[0].rule})" if len(rows) > 1 else ""


def _lines(rows: Sequence[ScoredCentre]) -> list[Line]:
    """Of a chart over time: of one row its sources and fused tracks, else the fused tracks of each."""
    first = rows[0].evaluation
    if len(rows) == 1:
        colours = source_colours(first.sources)
        seconds = _seconds(first.times)
        lines = [(name, colours[name], 1.2, scores, seconds) for name, scores in first.sources.items()]
        if first.centre is None:
            return lines
        return [*lines, (f"fused, {rows[0].rule}", PAPER_FUSED, 2.0, first.fused, seconds)]
    return [
        (row_name(row, rows), _tone(k), 1.5, row.evaluation.fused, _seconds(row.evaluation.times))
        for k, row in enumerate(rows)
    ]


def _tone(k: int) -> str:
    """Of the k-th row."""
    return paper_colour(k - 1) if k else PAPER_FUSED


def _seconds(times: NDArray[np.int64]) -> Floats:
    seconds: Floats = (times - times[0]) / 1e9
    return seconds


def _parts(axes: Axes, row: ScoredCentre) -> None:
    series, seconds = row.evaluation.fused.series, _seconds(row.evaluation.times)
    power = 3 * int(np.floor(np.log10(max(float((series.gospa**2).max()), 1.0)) / 3))
    layers = [thin(seconds, getattr(series, name))[1] / 10**power for name in PARTS]
    axes.stackplot(thin(seconds, series.gospa)[0], *layers, labels=list(PARTS), colors=list(PARTS.values()), lw=0)
    unit = f"{power_of_ten(power)} m²" if power else "m²"
    axes.set(xlabel="s since the first scored time", ylabel=unit, ylim=(0, None))
    legend(axes)


def _over_time(axes: Axes, lines: Sequence[Line], what: str, unit: str) -> None:
    for name, colour, width, scores, seconds in lines:
        values = getattr(scores.series, what)
        if what == "ospa2":
            seconds = seconds[scores.series.windows]
        axes.plot(*thin(seconds, values), color=colour, lw=width, ls=line_style(colour), label=name)
    axes.set(xlabel="s since the first scored time", ylabel=unit, ylim=(0, None))
    legend(axes)


def _nees(axes: Axes, lines: Sequence[Line]) -> None:
    _, _, _, fused, seconds = lines[-1] if lines[-1][0].startswith("fused") else lines[0]
    x, low = thin(seconds, fused.series.low)
    axes.fill_between(x, low, thin(seconds, fused.series.high)[1], color=GREEN, alpha=0.18, lw=0, label="95 %")
    axes.axhline(1.0, color=GREEN, lw=0.8)
    for name, colour, width, scores, at in lines:
        axes.plot(*thin(at, scores.series.anees), color=colour, lw=width, ls=line_style(colour), label=name)
    values = np.concatenate([scores.series.anees[np.isfinite(scores.series.anees)] for *_, scores, _ in lines])
    top = float(np.quantile(values, 0.99)) * 1.15 if len(values) else 2.0
    axes.set(xlabel="s since the first scored time", ylabel="NEES / dimension", ylim=(0, max(top, 2.0)))
    legend(axes)


def _cardinality(axes: Axes, rows: Sequence[ScoredCentre]) -> None:
    first = rows[0].evaluation
    seconds = _seconds(first.times)
    axes.plot(*thin(seconds, first.exists.sum(axis=1).astype(float)), color=PAPER_TRUTH, lw=4, alpha=0.6, label="true")
    if len(rows) == 1:
        axes.plot(*thin(seconds, first.fused.series.shown.astype(float)), color=PAPER_FUSED, label="shown")
        if np.isfinite(first.fused.series.expected).any():
            axes.plot(*thin(seconds, first.fused.series.expected), "--", color=BLUE, lw=1.2, label="expected")
    else:
        for name, colour, width, scores, at in _lines(rows):
            axes.plot(
                *thin(at, scores.series.shown.astype(float)), color=colour, lw=width, ls=line_style(colour), label=name
            )
    axes.set(xlabel="s since the first scored time", ylabel="targets, tracks", ylim=(0, None))
    legend(axes)


def _siap(axes: Axes, row: ScoredCentre) -> None:
    series, seconds = row.evaluation.fused.series, _seconds(row.evaluation.times)
    for name, label, colour in (
        ("completeness", "complete", GREEN),
        ("spuriousness", "spurious", VERMILION),
        ("ambiguity", "tracks per target", BLUE),
    ):
        axes.plot(*thin(seconds, getattr(series, name)), color=colour, label=label)
    axes.set(xlabel="s since the first scored time", ylabel="share, number", ylim=(-0.03, None))
    legend(axes)


def _confirm(axes: Axes, rows: Sequence[ScoredCentre]) -> None:
    for k, row in enumerate(rows):
        known = int((row.evaluation.begins >= 0).sum())
        after = np.sort(row.evaluation.confirm[np.isfinite(row.evaluation.confirm)])
        if not known or not len(after):
            continue
        x, y = np.append(after, after[-1] * 1.08 + 1), np.append(np.arange(1, len(after) + 1), len(after))
        label = row_name(row, rows) if len(rows) > 1 else None
        axes.step([0, *x], [0, *(100 * y / known)], where="post", color=_tone(k), ls=line_style(_tone(k)), label=label)
    axes.set(xlabel="s since it could be known", ylabel="targets confirmed, %", ylim=(0, 104), xlim=(0, None))
    if len(rows) > 1:
        legend(axes)
