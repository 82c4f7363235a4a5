"""The pictures of docs/rules.md: `python -m benchmarks.rule_pictures [--out docs/pictures]`.

Ellipses hold 86.5 % (two sigma) in the plane. It also prints the numbers that the page quotes.
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

from fusion_service.arrays import Floats
from fusion_service.rules import fuse

MEANS = np.array([[0.5, 1.0], [2.0, 1.0]])
COVARIANCES = np.array([[[2.5, -1.0], [-1.0, 1.2]], [[0.8, -0.5], [-0.5, 4.0]]])
"""Sharma (75), (76)."""
CROSS = 0.5 * np.linalg.cholesky(COVARIANCES[0]) @ np.linalg.cholesky(COVARIANCES[1]).T

CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("naive", {}),
    ("bar-shalom-campo", {"cross_covariance": CROSS}),
    ("bci", {"max_correlation": 0.5}),
    ("ci", {}),
    ("fast-ci", {}),
    ("ffcc", {"delta": 0.7}),
    ("ici", {}),
    ("ei", {}),
    ("hmd-ga", {}),
    ("hmd-s", {}),
    ("gmd-s", {}),
    ("hmd-s", {"alpha": 1.5}),
    ("aa", {}),
    ("cu", {}),
    ("cu", {"bound": "min"}),
)
TRUE, REPORTED, SOURCES = "#c0392b", "#1f6fb2", ("#7f8c8d", "#b8a06a")


def ellipse(mean: Floats, P: Floats) -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    return np.asarray(mean[:, None] + 2.0 * np.linalg.cholesky(P) @ np.stack([np.cos(angle), np.sin(angle)]))


def sources(ax: Any) -> None:
    for mean, P, colour in zip(MEANS, COVARIANCES, SOURCES, strict=True):
        ax.plot(*ellipse(mean, P), color=colour, lw=1.2)
        ax.plot(*mean, "+", color=colour)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])


def title(rule: str, options: dict[str, Any]) -> str:
    shown = [f"{k.removeprefix('max_')} {v}" for k, v in options.items() if np.ndim(v) == 0]
    return ", ".join([rule, *shown])


def every_rule(out: Path) -> None:
    fig, axes = plt.subplots(3, 5, figsize=(12, 9.0))
    print("area of the ellipse over the naive one's")
    unit = np.sqrt(np.linalg.det(fuse("naive", MEANS, COVARIANCES).covariance))
    for ax, (rule, options) in zip(axes.flat, CASES, strict=True):
        fused = fuse(rule, MEANS, COVARIANCES, **options)
        sources(ax)
        ax.set_xlim(-4.2, 6.0)
        ax.set_ylim(-4.2, 5.8)
        ax.fill(*ellipse(fused.mean, fused.covariance), color=REPORTED, alpha=0.25)
        ax.plot(*ellipse(fused.mean, fused.covariance), color=REPORTED, lw=2)
        ax.plot(*fused.mean, ".", color=REPORTED)
        area = np.sqrt(np.linalg.det(fused.covariance)) / unit
        ax.set_title(f"{title(rule, options)}\narea {area:.2f}", fontsize=10)
        print(f"  {title(rule, options):<26}{area:6.2f}")
    fig.suptitle("The pair of Sharma (75), (76) under every rule; area relative to naive", fontsize=12)
    fig.tight_layout()
    fig.savefig(out / "rules-pair.png", dpi=110)


def bounded(out: Path) -> None:
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.8), width_ratios=(1, 1.15))
    sources(left)
    bounds = np.linspace(0.0, 1.0, 11)
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, len(bounds)))
    for rho, colour in zip(bounds, colours, strict=True):
        fused = fuse("bci", MEANS, COVARIANCES, max_correlation=rho)
        left.plot(*ellipse(fused.mean, fused.covariance), color=colour, lw=1.4)
    left.set_title("bci: from naive (rho = 0) to CI (rho = 1)", fontsize=10)

    grid = np.linspace(0.0, 1.0, 51)
    unit = np.sqrt(np.linalg.det(fuse("naive", MEANS, COVARIANCES).covariance))

    def area(rule: str, **options: Any) -> float:
        return float(np.sqrt(np.linalg.det(fuse(rule, MEANS, COVARIANCES, **options).covariance)) / unit)

    right.plot(grid, [area("bci", max_correlation=r) for r in grid], color=REPORTED, lw=2.5, label="bci at this bound")
    for rule, style in (("ci", "-"), ("ici", "--"), ("hmd-ga", "-."), ("ei", ":"), ("naive", "-")):
        right.axhline(area(rule), color="#555", ls=style, lw=1)
        right.annotate(rule, (1.01, area(rule)), fontsize=9, va="center", annotation_clip=False)
    right.set_xlim(0, 1)
    right.set_xlabel("max_correlation")
    right.set_ylabel("area of the ellipse over naive's")
    right.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.04))
    right.set_title("what a bound on the correlation buys", fontsize=10)
    fig.tight_layout()
    fig.savefig(out / "rules-bounded.png", dpi=110)


def counter_example(out: Path) -> None:
    """P_1 = diag(4, 1), P_2 = diag(1, 4), E[e1_2 e2_1] = .9: what is reported and what is true."""
    P = np.stack([np.diag([4.0, 1.0]), np.diag([1.0, 4.0])])
    joint = np.zeros((4, 4))
    joint[:2, :2], joint[2:, 2:] = P
    joint[1, 2] = joint[2, 1] = 0.9
    errors = np.random.default_rng(1).multivariate_normal(np.zeros(4), joint, size=200_000).reshape(-1, 2, 2)
    batch = np.broadcast_to(P, (len(errors), 2, 2, 2))
    cases: tuple[tuple[str, dict[str, Any]], ...]
    cases = (("naive", {}), ("ei", {}), ("ici", {}), ("hmd-ga", {}), ("bci", {"max_correlation": 0.9}), ("ci", {}))
    fig, axes = plt.subplots(1, len(cases), figsize=(14, 3.7), sharex=True, sharey=True)
    print("largest eigenvalue of the true error relative to the reported covariance; mean NEES / n; rms error")
    for ax, (rule, options) in zip(axes, cases, strict=True):
        fused = fuse(rule, errors, batch, **options)
        true, reported = fused.mean.T @ fused.mean / len(errors), fused.covariance.mean(axis=0)
        worst = np.linalg.eigvals(np.linalg.solve(reported, true)).real.max()
        nees = np.einsum("bi,bi->b", fused.mean, np.linalg.solve(fused.covariance, fused.mean[..., None])[..., 0])
        ax.plot(*ellipse(np.zeros(2), reported), color=REPORTED, lw=2, label="reported")
        ax.plot(*ellipse(np.zeros(2), true), color=TRUE, lw=2, label="true")
        ax.set_aspect("equal")
        ax.set_title(f"{title(rule, options)}\n{worst:.2f} times the variance", fontsize=10)
        rms = np.sqrt(np.trace(true))
        print(f"  {title(rule, options):<24}{worst:6.2f}{nees.mean() / 2:8.2f}{rms:8.3f}")
    axes[0].set_ylim(-3.0, 3.9)
    axes[0].legend(fontsize=8, loc="upper left", frameon=False, ncols=2, columnspacing=0.8, handlelength=1.2)
    fig.suptitle("One cross-correlation of .9: the worst direction's true variance over the reported one", fontsize=11)
    fig.tight_layout()
    fig.savefig(out / "rules-counter-example.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Pictures of the fusion rules", epilog="python -m benchmarks.rule_pictures"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    mpl.use("Agg")
    for draw in (every_rule, bounded, counter_example):
        draw(out)


if __name__ == "__main__":
    main()
