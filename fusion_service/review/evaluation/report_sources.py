"""The section of the report about the sources: how they were trusted and shifted, over time, beside their bounds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from fusion_service.colours import line_style
from fusion_service.review.evaluation.figures import chart, legend
from fusion_service.review.evaluation.source_record import SourceRecord, SourceRecords
from fusion_service.source_words import MOST_SIGMAS, Bias

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["source_charts"]

MOST_LINES = 12
"""Sources in one chart, those that deviate most."""
BIASES = (
    ("clock", "Clock offsets", "s", "Offset of each clock with two standard deviations: above 0, stamps are too late."),
    (
        "x",
        "Registration, x",
        "m",
        "How far east of the truth a source reports, with two standard deviations.",
    ),
    ("y", "Registration, y", "m", "The same towards north."),
    ("heading", "Heading", "°", "How far a source is turned, with two standard deviations."),
    ("range", "Range offsets", "m", "How much too long its ranges are, with two standard deviations."),
)


def source_charts(records: SourceRecords, start: int, colours: dict[str, str]) -> list[tuple[str, str]]:
    """(SVG, what it shows and how to read it) over the seconds since `start`, ns; none where nothing is known."""
    found: list[tuple[str, str]] = []
    known = {name: one for name, one in records.by_name.items() if one.samples}
    beside = _most({name: _worst(one) for name, one in known.items()})
    if any(np.isfinite(sample.consistency) for name in beside for sample in known[name].samples):
        text = "Mean normalised square of each source beside the others: 1 is as its covariances say. Dashed: bounds."
        picture = chart(lambda axes: _consistency(axes, known, beside, start, colours), "Sources beside each other")
        found.append((picture, text))
    for key, title, unit, text in BIASES:
        some = {name: _of(one, key) for name, one in known.items()}
        some = {name: there for name, there in some.items() if there}
        if some:
            names = _most({name: max(abs(bias.value) for _, bias in there) for name, there in some.items()})
            shown = {name: some[name] for name in names}
            found.append((chart(partial(_bias, shown, unit, start, colours), title), text))
    return found


def _worst(one: SourceRecord) -> float:
    return max([abs(s.consistency - 1.0) for s in one.samples if np.isfinite(s.consistency)], default=0.0)


def _of(one: SourceRecord, key: str) -> list[tuple[int, Bias]]:
    """A part of the bias, and when, ns."""
    return [(sample.time, sample.biases[key]) for sample in one.samples if key in sample.biases]


def _most(size: dict[str, float]) -> list[str]:
    """The names of the largest, in their order."""
    return sorted(sorted(size, key=lambda name: (-size[name], name))[:MOST_LINES])


def _seconds(times: Sequence[int], start: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return (np.array(times, dtype=np.int64) - start) / 1e9


def _consistency(
    axes: Axes, known: dict[str, SourceRecord], names: list[str], start: int, colours: dict[str, str]
) -> None:
    for name in names:
        samples = known[name].samples
        at = _seconds([one.time for one in samples], start)
        tone = colours.get(name, "black")
        axes.plot(at, [one.consistency for one in samples], color=tone, ls=line_style(tone), label=name)
        for bound in ([one.low for one in samples], [one.high for one in samples]):
            axes.plot(at, bound, color=tone, lw=0.7, ls="--")
    values = np.array([one.consistency for name in names for one in known[name].samples])
    top = float(np.nanquantile(values, 0.98)) * 1.2
    axes.axhline(1.0, color="#999999", lw=0.8)
    axes.set(xlabel="s of the mission", ylabel="normalised square", ylim=(0, max(top, 2.0)))
    legend(axes)


def _bias(some: dict[str, list[tuple[int, Bias]]], unit: str, start: int, colours: dict[str, str], axes: Axes) -> None:
    for name, there in some.items():
        at = _seconds([time for time, _ in there], start)
        value = np.array([one.value for _, one in there])
        reach = MOST_SIGMAS * np.array([one.sigma for _, one in there])
        tone = colours.get(name, "black")
        axes.fill_between(at, value - reach, value + reach, color=tone, alpha=0.15, lw=0)
        axes.plot(at, value, color=tone, ls=line_style(tone), label=name)
    axes.axhline(0.0, color="#999999", lw=0.8)
    axes.set(xlabel="s of the mission", ylabel=unit)
    legend(axes)
