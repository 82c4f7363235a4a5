"""The arithmetic average (AA) w1 f1 + w2 f2 and the normalised geometric average (GA) f1^w1 f2^w2 of two densities:
Figs. 5 and 6, remarks 5 to 8, appendix B, and what (49) leaves out.

Fig. 5: N(50, 100) and N(60, 200); Fig. 6: N(50, 400) and N(60, 200); w1 swept over (0, 1), the true value theta over
[40, 80]. "MSE" is that of the paper, (3): the mean squared distance of the fused density's argument from theta, its
variance plus its squared bias. The moments are those of the product's `fuse_mixtures` (rules `aa` and `gm-ga`), a
grid integral of the same densities and, at w1 = 1/2, samples stand beside them. AA's MSE minus GA's is linear in theta,

    Var AA - Var GA + m_AA^2 - m_GA^2 - 2 theta (m_AA - m_GA),

so for each w1 there is one theta*(w1) at which it changes its sign, and the MSEs cross over, as w1 goes from 0 to 1,
for exactly those theta that lie between the least and the greatest theta*. The published figures of that band and of
Fig. 7's masses are of an independent derivation, not of the paper. Random pairs: N(0, 1) and N(d, a), d uniform on
(0, 4), a log-uniform on (1/9, 9), theta uniform on (-4, 8).

(49) takes the power of a sum as the sum of the powers. Of a density with itself, with equal weights, the GA is that
density. Two equal modes of unit variance, d apart, get the mass 1 + exp(-d^2 / 8) by (49).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad

from fusion_service.densities import Mixture, Mixtures
from fusion_service.rules import fuse_mixtures
from fusion_service.rules.mixtures import fuse_mixtures_last
from studies.pictures import colour
from studies.study import Floats, Result, Row, Run, Study

W = np.linspace(0.0, 1.0, 1001)[1:-1]
THETA = np.linspace(40.0, 80.0, 401)
SHOWN = (40.0, 50.0, 60.0, 70.0, 80.0)
EXAMPLES = {"Fig. 5": ((50.0, 60.0), (100.0, 200.0)), "Fig. 6": ((50.0, 60.0), (400.0, 200.0))}
FIG7 = (
    ((0.7, 10.0, 100.0), (0.6, 50.0, 100.0), (0.5, 90.0, 200.0)),
    ((0.9, 11.0, 100.0), (0.8, 52.0, 120.0)),
)
"""GM 1 and GM 2 of Fig. 7: (weight, mean, variance) of each component."""
APART = np.linspace(0.0, 8.0, 33)
RULES = {"AA": "aa", "GA": "gm-ga"}


class Moments(NamedTuple):
    """Of AA and of GA, (2, ...)."""

    mean: Floats
    variance: Floats

    def mse(self, theta: Floats | float) -> Floats:
        """(4)."""
        return np.asarray(self.variance + (self.mean - theta) ** 2)


def mixture(parts: tuple[tuple[float, float, float], ...]) -> Mixture:
    """A scalar mixture of (weight, mean, variance)."""
    w, m, P = np.array(parts).T
    return Mixture(w, m[:, None], P[:, None, None])


def gaussians(mean: Floats, variance: Floats) -> Mixtures:
    """A batch (B,) of one-component scalar densities."""
    return Mixtures(np.zeros((1, len(mean))), mean[None, None].copy(), variance[None, None, None].copy())


def fused(means: tuple[Floats, Floats], variances: tuple[Floats, Floats], w1: Floats) -> Moments:
    """The product's AA and GA of B pairs of Gaussians, each argument (B,)."""
    sources = [gaussians(m, P) for m, P in zip(means, variances, strict=True)]
    weights = np.stack([w1, 1 - w1])
    both = [fuse_mixtures_last(rule, sources, weights)[0].moments() for rule in RULES.values()]
    return Moments(np.stack([m[0] for m, _ in both]), np.stack([P[0, 0] for _, P in both]))


def grid_moments(f: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Mass, mean and variance of functions (..., X) on an even grid."""
    mass = f.sum(axis=-1)
    mean = f @ x / mass
    return mass * (x[1] - x[0]), mean, np.asarray(f @ x**2 / mass - mean**2)


def grid_pair(mean: tuple[float, float], variance: tuple[float, float], w1: Floats) -> Moments:
    """The same moments by integrals over a grid."""
    x = np.linspace(-250.0, 350.0, 6001)
    logs = [mixture(((1.0, m, P),)).log_pdf(x[:, None]) for m, P in zip(mean, variance, strict=True)]
    aa = w1[:, None] * np.exp(logs[0]) + (1 - w1[:, None]) * np.exp(logs[1])
    ga = np.exp(w1[:, None] * logs[0] + (1 - w1[:, None]) * logs[1])
    both = [grid_moments(f, x)[1:] for f in (aa, ga)]
    return Moments(np.stack([m for m, _ in both]), np.stack([P for _, P in both]))


def indifferent(moments: Moments) -> Floats:
    """theta* (B,), at which AA and GA have the same MSE."""
    gap = moments.mean[0] - moments.mean[1]
    return np.asarray((moments.mse(0.0)[0] - moments.mse(0.0)[1]) / (2 * gap))


def self_average(apart: float) -> float:
    """The mass that (49) gives the GA of two equal unit modes, so far apart, with itself."""
    f = mixture(((0.5, 0.0, 1.0), (0.5, apart, 1.0)))
    return fuse_mixtures("gm-ga", [f, f], weights="uniform", normalise=False).mass


def random_pairs(rng: np.random.Generator, count: int) -> tuple[Moments, Floats, Floats, Floats]:
    """Moments (2, 49, M) over 49 weights of M random pairs, their d, a and theta (M,)."""
    d, a = rng.uniform(0, 4, count), np.exp(rng.uniform(-np.log(9), np.log(9), count))
    w = np.linspace(0.02, 0.98, 49)
    size = count * len(w)
    grid = [np.broadcast_to(one, (len(w), count)).reshape(size) for one in (0 * d, d, 1 + 0 * a, a, w[:, None])]
    found = fused((grid[0], grid[1]), (grid[2], grid[3]), grid[4])
    return Moments(*(one.reshape(2, len(w), count) for one in found)), d, a, rng.uniform(-4, 8, count)


def share(values: NDArray[np.bool_]) -> tuple[float, float]:
    """Of runs (M,), with its standard error."""
    p = float(values.mean())
    return p, float(np.sqrt(p * (1 - p) / len(values)))


def examples(run: Run) -> tuple[dict[str, Moments], list[Row]]:
    """Figs. 5 and 6: the moments over W, and the rows."""
    found: dict[str, Moments] = {}
    rows: list[Row] = []
    off = 0.0
    for number, (name, (mu, sigma2)) in enumerate(EXAMPLES.items()):
        ones = np.ones_like(W)
        moments = fused((mu[0] * ones, mu[1] * ones), (sigma2[0] * ones, sigma2[1] * ones), W)
        found[name] = moments
        grid = grid_pair(mu, sigma2, W[9::10])
        for ours, true in zip(moments, grid, strict=True):
            off = max(off, float(np.abs(ours[:, 9::10] / true - 1).max()))
        half = len(W) // 2
        for rule, label in enumerate(RULES):
            rng = run.rng(number, rule)
            if rule == 0:
                which = (rng.random(run.runs) < 0.5).astype(int)
                x = np.array(mu)[which] + np.sqrt(sigma2)[which] * rng.standard_normal(run.runs)
            else:  # (34), (35)
                P = 1 / (0.5 / sigma2[0] + 0.5 / sigma2[1])
                x = P * (0.5 * mu[0] / sigma2[0] + 0.5 * mu[1] / sigma2[1]) + np.sqrt(P) * rng.standard_normal(run.runs)
            square = (x - x.mean()) ** 2
            rows += [
                Row(f"{name}: {label}, w1 = 1/2", "mean", None, moments.mean[rule, half]),
                Row(f"{name}: {label}, w1 = 1/2", "variance", None, moments.variance[rule, half]),
                Row(
                    f"{name}: {label}, w1 = 1/2",
                    "sampled variance",
                    None,
                    float(square.mean()),
                    float(square.std() / np.sqrt(run.runs)),
                ),
            ]
        for at in SHOWN:
            rows += [
                Row(f"{name}, w1 = 1/2, theta {at:g}", f"MSE {label}", None, moments.mse(at)[rule, half])
                for rule, label in enumerate(RULES)
            ]
        star = indifferent(moments)
        better = (moments.mse(THETA[:, None, None])[:, 0] > moments.mse(THETA[:, None, None])[:, 1]).mean()
        band = (65.5, 69.5) if name == "Fig. 5" else (None, None)
        rows += [
            Row(f"{name}: MSEs cross over", "from theta", band[0], float(star.min()), decimals=1),
            Row(f"{name}: MSEs cross over", "to theta", band[1], float(star.max()), decimals=1),
            Row(f"{name}: MSEs cross over", "GA better, share of (theta, w1)", None, float(better)),
        ]
    rows.append(Row("moments against a grid integral", "largest relative difference", None, off))
    return found, rows


def random_checks(run: Run) -> tuple[list[Row], bool, float]:
    """Remarks 5 to 8 on random pairs: the rows, whether remark 5 holds, how exact remark 6 is."""
    count = min(run.runs, 20_000)
    pairs, d, a, theta = random_pairs(run.rng(7), count)
    gap = pairs.mse(theta)[0] - pairs.mse(theta)[1]
    sign = np.sign(gap)
    crossing = share((sign.min(axis=0) < 0) & (sign.max(axis=0) > 0))
    never = share((sign < 0).all(axis=0))
    other_side = share((sign < 0).all(axis=0) & np.where(a > 1, theta < d, theta > 0))
    excess = float((pairs.variance[1] / pairs.variance[0]).max())
    bounds = pairs.variance[1] / np.maximum(1, a)
    alike = fused((0 * d, d), (a, a), np.full(count, 0.3))
    unbiased = fused((d, d), (1 + 0 * a, a), np.full(count, 0.3))
    seven = max(
        float((alike.mse(theta)[1] / alike.mse(theta)[0]).max()),
        float((unbiased.mse(d)[1] / unbiased.mse(d)[0]).max()),
    )
    least = min(float((alike.mse(theta)[1] / a).min()), float((unbiased.mse(d)[1] / np.minimum(1, a)).min()))
    weights = np.linspace(0.02, 0.98, 49)[:, None]
    six = float(
        np.abs(pairs.mse(theta)[0] / (weights * (1 + theta**2) + (1 - weights) * (a + (d - theta) ** 2)) - 1).max()
    )
    rows = [
        Row("random pairs", "GA/AA variance, most", None, excess),
        Row("random pairs", "GA/greatest variance, most", None, float(bounds.max())),
        Row("random pairs", "share with a cross-over", None, *crossing),
        Row("random pairs", "share AA better at every w1", None, *never),
        Row("random pairs", "the same, theta not beyond the wider one's mean", None, *other_side),
        Row("random pairs, remark 7's cases", "GA/AA MSE, most", None, seven),
        Row("random pairs, remark 7's cases", "GA MSE/least variance, least", None, least),
    ]
    return rows, excess <= 1 + 1e-9 and float(bounds.max()) <= 1 + 1e-9, six


def cross_terms(run: Run) -> tuple[Floats, Floats, dict[str, Mixture], list[Row]]:
    """Fig. 7: a grid (X,), the exact GA on it, the product's, and the rows."""
    f, g = (mixture(parts) for parts in FIG7)
    x = np.linspace(-150.0, 250.0, 40_001)
    exact = np.exp(0.5 * (f.log_pdf(x[:, None]) + g.log_pdf(x[:, None])))
    truth = grid_moments(exact, x)
    ways = {
        "cross terms dropped, (49)": fuse_mixtures("gm-ga", [f, g], weights="uniform", normalise=False),
        "cross terms sampled": fuse_mixtures(
            "gm-ga",
            [f, g],
            weights="uniform",
            normalise=False,
            cross_terms="sampled",
            samples=min(run.runs, 50_000),
            seed=run.seed,
        ),
    }
    rows = [
        Row("Fig. 7, grid integral", quantity, known, float(value), decimals=4 if known else None)
        for quantity, known, value in zip(("GA mass", "mean", "variance"), (1.5634, None, None), truth, strict=True)
    ]
    for name, fusion in ways.items():
        mean, covariance = fusion.moments()
        printed_mass = 1.8964 if "dropped" in name else None
        apart = np.abs(fusion.pdf(x[:, None]) / fusion.mass - exact / truth[0]).sum() * (x[1] - x[0]) / 2
        rows += [
            Row(f"Fig. 7, {name}", "GA mass", printed_mass, fusion.mass, decimals=4 if printed_mass else None),
            Row(f"Fig. 7, {name}", "mean", None, float(mean[0])),
            Row(f"Fig. 7, {name}", "variance", None, float(covariance[0, 0])),
            Row(f"Fig. 7, {name}", "total variation from exact", None, float(apart)),
        ]
    return x, exact, ways, rows


def asides() -> list[Row]:
    """Remark 5 of mixtures, and appendix B."""
    spread = [
        mixture(((0.25, -20.0, 1.0), (0.5, 0.0, 1.0), (0.25, 20.0, 1.0))),
        mixture(((0.5, -20.0, 1.0), (0.5, 20.0, 1.0))),
    ]
    y = np.linspace(-60.0, 60.0, 60_001)[:, None]
    three = [
        float(grid_moments(one, y[:, 0])[2])
        for one in (
            0.5 * (spread[0].pdf(y) + spread[1].pdf(y)),
            np.exp(0.5 * (spread[0].log_pdf(y) + spread[1].log_pdf(y))),
        )
    ]
    rows = [Row("three modes against two", f"variance {label}", None, three[rule]) for rule, label in enumerate(RULES)]

    root2 = np.sqrt(2.0)
    norm = quad(lambda t: np.sqrt(3 * root2 / 8 * t), 0, root2)[0]
    biased = quad(lambda t: t * np.sqrt(3 * root2 / 8 * t), 0, root2)[0] / norm
    plain = 0.5 * quad(lambda t: t * 3 * root2 / 8, 0, 4 * root2 / 3)[0] + 0.5 * quad(lambda t: t * t, 0, root2)[0]
    rows += [
        Row("appendix B", "mean AA", round(2 * root2 / 3, 4), float(plain), decimals=4),
        Row("appendix B", "mean GA", round(3 * root2 / 5, 4), float(biased), decimals=4),
    ]
    return rows


def run(run: Run) -> Result:
    found, rows = examples(run)
    checks, five, six = random_checks(run)
    x, exact, ways, fig7 = cross_terms(run)
    rows += checks + fig7
    masses = np.array([self_average(one) for one in APART])
    rows += [
        Row(f"GA of a density with itself, modes {APART[i]:g} sigma apart", "mass by (49)", None, masses[i])
        for i in (0, 8, 16, 24, 32)
    ]
    rows += asides()
    known = {(row.name, row.quantity): row.ours for row in rows}
    three = [known["three modes against two", f"variance {label}"] for label in RULES]
    seven = known["random pairs, remark 7's cases", "GA/AA MSE, most"]
    least = known["random pairs, remark 7's cases", "GA MSE/least variance, least"]
    never = known["random pairs", "share AA better at every w1"]
    other_side = known["random pairs", "the same, theta not beyond the wider one's mean"]
    truth, dropped = known["Fig. 7, grid integral", "GA mass"], ways["cross terms dropped, (49)"].mass
    (low, high), (low6, high6) = (
        tuple(known[f"{name}: MSEs cross over", end] for end in ("from theta", "to theta")) for name in EXAMPLES
    )
    notes = (
        f"Remark 5 {'holds' if five else 'fails'} for Gaussians. It is of "
        f"Gaussians only: modes at -20, 0, 20 with weights 1/4, 1/2, 1/4 and modes at -20, 20 with 1/2 each, of unit "
        f"variance, give the exact GA the variance {three[1]:.1f}, AA {three[0]:.1f}: the GA loses the middle mode.",
        f"Remark 6 {'holds' if six < 1e-9 else 'fails'}: it is an identity (relative difference {six:.0e}).",
        f"Remark 7 {'holds' if seven <= 1 + 1e-9 and least >= 1 - 1e-9 else 'fails'} (largest ratio of the MSEs "
        f"{seven:.4f}, at most 1; least ratio of GA's to the smallest variance {least:.4f}, at least 1).",
        f"Remark 8 fails in its second half, in its own Fig. 5: for theta from {low:.2f} to {high:.2f} the MSEs cross "
        f"over as w1 goes from 0 to 1 (open ends at 65 and 70; the independent derivation's 65.5 to 69.5 would be "
        "those theta of a grid of step 0.5 that lie inside); in "
        f"Fig. 6 they do from {low6:.2f} to {high6:.2f}, at and below the edge of its range of theta, so that the "
        "figure cannot show it. The first half holds ('in most cases'), but its 'unless' has a mirror image: AA is "
        "better too where theta is well below the lesser mean and the density of the lesser mean has the greater "
        f"variance (below {low6:.1f} in Fig. 6). With it the 'unless' is complete: of random pairs AA is better at "
        f"every weight in {100 * never:.0f} %, and in no other place than beyond the mean of the wider one "
        f"({other_side:.4f}).",
        f"(49): its mass is {dropped:.4f}, {100 * (dropped / truth - 1):.0f} % above the exact "
        f"{truth:.4f}. It makes sense, as the paper says, for modes well apart: a density of two equal modes averaged "
        f"with itself gains less than 1 % beyond {np.sqrt(8 * np.log(100)):.1f} sigma only, and 14 % at 4 sigma.",
        "4.1, appendix B: AA keeps the mean, GA does not. Its f1 is said to be uniform on (0, 1]; by its formula it is "
        "on (0, 4 sqrt(2) / 3], which gives the mean that it needs.",
    )
    return Result(tuple(rows), notes, lambda figure: _draw(figure, found, x, exact, ways, masses), (13.0, 8.0))


def _draw(
    figure: Any, found: dict[str, Moments], x: Floats, exact: Floats, ways: dict[str, Mixture], masses: Floats
) -> None:
    axes: NDArray[Any] = figure.subplots(2, 3)
    shades = {"AA": colour("aa"), "GA": colour("ci")}
    for row, (name, moments) in enumerate(found.items()):
        mu, sigma2 = EXAMPLES[name]
        ax = axes[row, 0]
        for rule, label in enumerate(RULES):
            ax.plot(W, moments.variance[rule], color=shades[label], label=label)
        ax.set(title=f"{name}: N(50, {sigma2[0]:g}), N(60, {sigma2[1]:g})", xlabel="weight $w_1$", ylabel="variance")
        ax.legend(frameon=False)
        ax = axes[row, 1]
        mse = moments.mse(THETA[:, None, None])
        gap = mse[:, 0] - mse[:, 1]
        reach = float(np.abs(gap).max())
        picture = ax.pcolormesh(W, THETA, gap, cmap="RdBu", vmin=-reach, vmax=reach, shading="auto", rasterized=True)
        ax.contour(W, THETA, gap, levels=[0.0], colors="black")
        ax.axhline(mu[0], color="grey", lw=0.8, ls=":")
        ax.axhline(mu[1], color="grey", lw=0.8, ls=":")
        figure.colorbar(picture, ax=ax, label="MSE of AA - MSE of GA")
        ax.set(title=f"{name}: red, AA is better; black, equal", xlabel="weight $w_1$", ylabel="true value $\\theta$")
    ax = axes[0, 2]
    near = (x > -40) & (x < 140)
    ax.plot(x[near], exact[near], color="black", label="exact")
    ax.plot(x[near], ways["cross terms dropped, (49)"].pdf(x[near, None]), "--", color=shades["GA"], label="(49)")
    ax.set(title="Fig. 7: GA of the two intensities", xlabel="x", ylabel="intensity")
    ax.legend(frameon=False)
    ax = axes[1, 2]
    ax.plot(APART, masses, color=shades["GA"], label="(49)")
    ax.axhline(1.0, color="black", label="exact")
    ax.set(title="GA of a two-mode density with itself", xlabel="distance of the modes [sigma]", ylabel="mass")
    ax.legend(frameon=False)


STUDIES = (
    Study(
        name="li-densities",
        title="AA and GA of two densities: variance, MSE, cross terms",
        source="Li-2nd 4, 5.1, Figs. 5 and 6, remarks 5-8",
        about=__doc__ or "",
        run=run,
        runs=1_000_000,
        quick=4_000,
        seconds=6.0,
    ),
)
