"""What the pictures of the studies have in common: a colour for each rule, the same everywhere, and ellipses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["colour", "ellipse", "save"]

Floats = NDArray[np.float64]

COLOURS = {
    "truth": "#000000",
    "centralised": "#000000",
    "naive": "#d55e00",
    "ci": "#0072b2",
    "bci": "#56b4e9",
    "fast-ci": "#7570b3",
    "ffcc": "#a6761d",
    "bar-shalom-campo": "#444444",
    "ici": "#e69f00",
    "ei": "#e7298a",
    "hmd-ga": "#009e73",
    "hmd-s": "#66a61e",
    "gmd-s": "#4c78a8",
    "aa": "#cc79a7",
    "cu": "#8c6d31",
}
OTHERS = ("#666666", "#b2182b", "#2166ac", "#1b7837", "#762a83")


def colour(label: str) -> str:
    """The colour of a rule, whatever its options; others get one of their own by their name."""
    name = label.split(":")[0].split(" ")[0]
    return COLOURS.get(name) or OTHERS[sum(map(ord, label)) % len(OTHERS)]


def ellipse(mean: Floats, covariance: Floats, sigmas: float = 2.0) -> Floats:
    """The outline (2, 181) of a 2-D Gaussian at so many sigma (2: 86.5 % lie inside)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    ring = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.asarray(mean)[:, None] + sigmas * np.linalg.cholesky(covariance) @ ring)


def save(draw: Any, size: tuple[float, float], path: Any) -> None:
    """Draw on a new figure and write it as PNG. ImportError without matplotlib (the extra `report`)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    draw(figure)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Software": None})
