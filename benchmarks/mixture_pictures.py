"""The pictures and the table of docs/mixtures.md: `python -m benchmarks.mixture_pictures [folder]`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusion_service.arrays import Floats
from fusion_service.densities import Mixture
from fusion_service.existence import fuse_existence
from fusion_service.rules import fuse_mixtures

A, B = np.array([[2.5, -1.0], [-1.0, 1.2]]), np.array([[0.8, -0.5], [-0.5, 4.0]])
P1 = Mixture([0.3, 0.7], [[-0.5, 3.0], [2.0, 0.3]], [A, B])
P2 = Mixture([0.4, 0.6], [[-1.5, 1.0], [3.0, -4.0]], [A, B])
"""The mixtures of Sharma 5.2."""
GM1 = Mixture([0.7, 0.6, 0.5], [[10.0], [50.0], [90.0]], [[[100.0]], [[100.0]], [[200.0]]])
GM2 = Mixture([0.9, 0.8], [[11.0], [52.0]], [[[100.0]], [[120.0]]])
"""The intensities of Li-2nd Fig. 7."""
BLUE, RED, GREY = "#2c6fbb", "#c0392b", "#555555"
AXIS = np.linspace(-12.0, 12.0, 481)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), axis=-1)
CELL = (AXIS[1] - AXIS[0]) ** 2
UNIFORM: dict[str, Any] = {"weights": "uniform"}
CASES: tuple[tuple[str, str, dict[str, Any], str | None], ...] = (
    ("aa", "arithmetic mean", {}, "aa"),
    ("gm-ga", "geometric, cross terms dropped", UNIFORM, "ga"),
    ("gm-ga", "geometric, cross terms sampled", UNIFORM | {"cross_terms": "sampled"}, "ga"),
    ("gmd-s", "geometric, sampled", UNIFORM, "ga"),
    ("hmd-s", "harmonic, sampled", UNIFORM, "hmd"),
    ("cu-modes", "union of conflicting modes", {}, None),
    ("ci", "covariance intersection of the moments", UNIFORM, "ga"),
    ("hmd-ga", "harmonic, of the moments", UNIFORM, "hmd"),
    ("cu", "covariance union of the moments", {}, None),
)


def exact() -> dict[str, Floats]:
    f, g = P1.pdf(GRID), P2.pdf(GRID)
    out = {"aa": 0.5 * (f + g), "ga": np.sqrt(f * g), "hmd": 2.0 * f * g / (f + g)}
    return {name: density / (density.sum() * CELL) for name, density in out.items()}


def levels(density: Floats) -> Floats:
    """Heights whose regions hold 90, 60 and 30 % of the mass."""
    ordered = np.sort(density.ravel())[::-1]
    held = np.cumsum(ordered) * CELL
    return np.array([ordered[np.searchsorted(held, share)] for share in (0.9, 0.6, 0.3)])


def contours(axes: Axes, density: Floats, colour: str, style: str = "solid") -> None:
    axes.contour(AXIS, AXIS, density.T, levels=levels(density), colors=colour, linestyles=style, linewidths=1.0)


def rules(folder: Path) -> None:
    """Every rule on the same two mixtures, beside the exact densities; prints how far it is from them."""
    truth = exact()
    figure = Figure(figsize=(9.0, 11.8), layout="constrained")
    panels = figure.subplots(4, 3, sharex=True, sharey=True).ravel()
    for axes, m, colour, name in ((panels[0], P1, BLUE, "source 1"), (panels[1], P2, RED, "source 2")):
        contours(axes, m.pdf(GRID), colour)
        axes.set_title(name, fontsize=10)
    for density, colour in ((P1.pdf(GRID), BLUE), (P2.pdf(GRID), RED)):
        contours(panels[2], density, colour)
    panels[2].set_title("both", fontsize=10)
    print("| rule | | components | mean | standard deviations | distance from the exact density |")
    print("|---|---|---|---|---|---|")
    for axes, (rule, title, options, against) in zip(panels[3:], CASES, strict=True):
        fused = fuse_mixtures(rule, [P1, P2], **options)
        density = fused.pdf(GRID)
        axes.contourf(AXIS, AXIS, density.T, levels=[*levels(density), density.max()], cmap="Greens", alpha=0.8)
        far = "none exists"
        if against:
            contours(axes, truth[against], "black", "dashed")
            far = f"{0.5 * np.abs(density - truth[against]).sum() * CELL:.3f}"
        axes.set_title(f"{rule}: {title}", fontsize=10)
        mean, P = fused.moments()
        deviations = np.sqrt(np.diagonal(P))
        print(
            f"| `{rule}` | {title} | {len(fused.weights)} | {mean[0]:.2f}, {mean[1]:.2f} "
            f"| {deviations[0]:.2f}, {deviations[1]:.2f} | {far} |"
        )
    for axes in panels:
        axes.set(xlim=(-6, 8), ylim=(-10, 7), aspect="equal")
        axes.tick_params(labelsize=8)
        for m, colour in ((P1, BLUE), (P2, RED)):
            axes.plot(*m.means.T, "+", color=colour, markersize=8)
    figure.savefig(folder / "mixtures-rules.png", dpi=110)


def cross_terms(folder: Path) -> None:
    """Li-2nd Fig. 7, with the exact geometric mean."""
    x = np.linspace(-40.0, 150.0, 3801)[:, None]
    step = float(x[1, 0] - x[0, 0])
    f, g = GM1.pdf(x), GM2.pdf(x)
    cases: tuple[tuple[str, dict[str, Any]], ...] = (("gm-ga", {}), ("gm-ga", {"cross_terms": "sampled"}), ("aa", {}))
    published, sampled, union = (
        fuse_mixtures(rule, [GM1, GM2], normalise=False, weights="uniform", **options) for rule, options in cases
    )
    true = np.sqrt(f * g)
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(x, f, color=BLUE, lw=0.8, label=f"source 1, mass {GM1.mass:.2f}")
    axes.plot(x, g, color=RED, lw=0.8, label=f"source 2, mass {GM2.mass:.2f}")
    axes.plot(x, union.pdf(x), color=GREY, lw=1.2, label=f"aa, mass {union.mass:.3f}")
    axes.plot(x, published.pdf(x), color="darkorange", label=f"gm-ga, cross terms dropped, mass {published.mass:.4f}")
    axes.plot(x, sampled.pdf(x), color="green", label=f"gm-ga, cross terms sampled, mass {sampled.mass:.4f}")
    axes.plot(x, true, "k--", lw=1.0, label=f"exact geometric mean, mass {true.sum() * step:.4f}")
    axes.set(xlim=(-40, 150), ylim=(0, None), xlabel="place", ylabel="intensity")
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(folder / "mixtures-cross-terms.png", dpi=110)
    print(f"\nmass: dropped {published.mass:.4f}, sampled {sampled.mass:.4f}, exact {true.sum() * step:.4f}")


def existence(folder: Path) -> None:
    """Uney's Fig. 6: two sources with existence 0.8, whose aspects differ more and more."""
    kappas = np.linspace(1.0, 40.0, 118)
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    overlaps = []
    for kappa in kappas:
        S = np.diag([1.0, 1.0 / kappa])
        sources = [Mixture([1.0], [m], [R @ S @ R.T]) for m, R in (([0.25, 0.25], turn), ([-0.75, -0.25], turn.T))]
        overlaps.append(fuse_mixtures("gm-ga", sources, weights="uniform", normalise=False).mass)
    lost = fuse_existence([0.8, 0.8], "geometric", overlap=overlaps)
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.axhline(float(fuse_existence([0.8, 0.8])), color="green", label="consistent")
    axes.plot(kappas, lost, color=RED, label="exponential mixture (geometric)")
    axes.plot(kappas, overlaps, color=GREY, lw=0.8, label="overlap z")
    axes.axhline(0.5, color="black", ls=":", lw=0.8)
    axes.set(xlim=(1, 40), ylim=(0, 1), xlabel="ratio of the variances along the two axes", ylabel="existence")
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(folder / "mixtures-existence.png", dpi=110)
    crossing = kappas[np.flatnonzero(lost < 0.5)[0]]
    print(
        f"\nexistence 0.8 and 0.8: {lost[0]:.3f} at ratio 1, below one half from {crossing:.0f}, {lost[-1]:.3f} at 40"
    )


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "docs" / "pictures")
    folder.mkdir(parents=True, exist_ok=True)
    rules(folder)
    cross_terms(folder)
    existence(folder)


if __name__ == "__main__":
    main()
