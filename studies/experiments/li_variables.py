"""The second-order statistics of the arithmetic average (AA) w1 X1 + w2 X2 and of the geometric average (GA)
X1^w1 X2^w2 of two positive random variables, w2 = 1 - w1 swept over (0, 1): Figs. 1 to 4 and remarks 1 to 4.

Figs. 1, 3 and 4: Gaussians of means 50 and 60 and variances 100 and 200, cut off below 0 as a pair. Fig. 2: Poisson
variables of means 10 and 12 (the text has them the other way about, which changes w1 to w2). Figs. 1 and 2 have three
correlations each, of which the text names one, 0.70846, just above 1/sqrt(2), where (21) takes over from (20). Ours
are -0.5, 0 and that; for the Poisson variables, whose threshold is sqrt(10/12) = 0.913, they are -0.5, 0 and 0.95,
made by a Gaussian copula (the paper does not say how it correlates them). Fig. 3 is of independent variables, Fig. 4
of correlation 0.70736, both about a true value theta of 45, 55 or 65.

The paper samples. Here every moment is also a sum over a quadrature: Gauss-Legendre products for the Gaussians, the
copula's probabilities, integrated cell by cell, for the Poisson variables; "least" is over 1,001 weights from 0 to 1.
The paper prints no number of its curves: the published values are its formulas' constants, and the two numbers for
Exp(1), which are of an independent derivation. For two independent variables alike, of mean mu, small coefficient of
variation c and skewness s, an expansion gives at w1 = 1/2

    Var GA - Var AA = -(s/c - 3/2) (mu c^2 / 2)^2 + terms of higher order in c:

which average varies less is a matter of their skewness. Gaussians have s = 0, Poisson variables s = c, gamma variables
s = 2c, log-normal ones s about 3c.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import gammaln, ndtr, ndtri
from scipy.stats import poisson

from studies.study import Floats, Result, Row, Run, Study

MU, SIGMA2 = (50.0, 60.0), (100.0, 200.0)
RATES = (10.0, 12.0)
GAUSSIAN_RHO, POISSON_RHO, FIG4_RHO = (-0.5, 0.0, 0.70846), (-0.5, 0.0, 0.95), 0.70736
THETA = (45.0, 55.0, 65.0)
W = np.linspace(0.0, 1.0, 1001)
"""w1 of the exact curves."""
SAMPLED = slice(50, -50, 50)
"""Those of W that are sampled too."""
CHUNK = 50_000
NAMES = ("AA", "GA")


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two variables as a sum: values (A,) and (B,), probabilities (A, B), and `draw(rng, M)` -> (2, M)."""

    x1: Floats
    x2: Floats
    p: Floats
    draw: Callable[[np.random.Generator, int], Floats]


class Curves(NamedTuple):
    """Mean and variance of AA and GA, (2, len(W)) each."""

    mean: Floats
    variance: Floats

    def mse(self, theta: float) -> Floats:
        """(4)."""
        return np.asarray(self.variance + (self.mean - theta) ** 2)


@lru_cache
def gaussian_pair(rho: float) -> Pair:
    """Two Gaussians of correlation rho, restricted to x1, x2 > 0."""
    t, weight = np.polynomial.legendre.leggauss(240)
    sigma = np.sqrt(SIGMA2)
    upper = np.array(MU) + 9.0 * sigma
    x = upper[:, None] * (t + 1.0) / 2.0
    z = (x - np.array(MU)[:, None]) / sigma[:, None]
    density = np.exp(-(z[0][:, None] ** 2 - 2 * rho * np.outer(z[0], z[1]) + z[1] ** 2) / (2 * (1 - rho**2)))
    p = np.outer(weight, weight) * density

    def draw(rng: np.random.Generator, count: int) -> Floats:
        z = rng.standard_normal((2, count + count // 50 + 50))
        z[1] = rho * z[0] + np.sqrt(1 - rho**2) * z[1]
        x = np.array(MU)[:, None] + sigma[:, None] * z
        return np.ascontiguousarray(x[:, (x > 0).all(axis=0)][:, :count])

    return Pair(x[0], x[1], p / p.sum(), draw)


@lru_cache
def poisson_pair(rho: float) -> Pair:
    """Two Poisson variables whose Gaussian copula has the parameter that gives them the correlation rho."""
    values = np.arange(61.0)
    edges = [ndtri(np.concatenate([[0.0], poisson.cdf(values, rate)])) for rate in RATES]
    t, weight = np.polynomial.legendre.leggauss(24)
    low, high = np.clip(edges[0][:-1], -9, 9), np.clip(edges[0][1:], -9, 9)
    z = ((high - low)[:, None] * t + (high + low)[:, None]) / 2.0
    mass = (high - low)[:, None] / 2.0 * weight * np.exp(-z * z / 2) / np.sqrt(2 * np.pi)

    def probabilities(r: float) -> Floats:
        below = ndtr((edges[1] - r * z[..., None]) / np.sqrt(1 - r * r))
        return np.asarray(np.einsum("at,atb->ab", mass, np.diff(below, axis=-1)))

    def correlation(r: float) -> float:
        return float((values - RATES[0]) @ probabilities(r) @ (values - RATES[1]) / np.sqrt(RATES[0] * RATES[1]))

    r = 0.0 if rho == 0 else float(brentq(lambda one: correlation(one) - rho, -0.9999, 0.9999))

    def draw(rng: np.random.Generator, count: int) -> Floats:
        z = rng.standard_normal((2, count))
        z[1] = r * z[0] + np.sqrt(1 - r * r) * z[1]
        cells = [np.searchsorted(edge[1:], one, side="right") for edge, one in zip(edges, z, strict=True)]
        return np.asarray(np.minimum(np.stack(cells), len(values) - 1).astype(np.float64))

    return Pair(values, values, probabilities(r), draw)


@lru_cache
def curves(pair: Pair) -> Curves:
    """AA by (12), (13), GA by E X1^w1 X2^w2 and E X1^2w1 X2^2w2."""
    powers1, powers2 = pair.x1 ** W[:, None], pair.x2 ** (1 - W)[:, None]
    first = np.einsum("wa,wb,ab->w", powers1, powers2, pair.p, optimize=True)
    second = np.einsum("wa,wb,ab->w", powers1**2, powers2**2, pair.p, optimize=True)
    m1, m2 = pair.p.sum(axis=1) @ pair.x1, pair.p.sum(axis=0) @ pair.x2
    d1, d2 = pair.x1 - m1, pair.x2 - m2
    v1, v2, cov = pair.p.sum(axis=1) @ d1**2, pair.p.sum(axis=0) @ d2**2, d1 @ pair.p @ d2
    aa = W**2 * v1 + (1 - W) ** 2 * v2 + 2 * W * (1 - W) * cov
    return Curves(np.stack([W * m1 + (1 - W) * m2, first]), np.stack([aa, second - first**2]))


def sampled(item: tuple[str, float, int, tuple[int, ...]]) -> Floats:
    """Sums of the powers 1 to 4 of AA's and GA's deviation from their exact means, (4, 2, K), K weights."""
    kind, rho, count, key = item
    pair = gaussian_pair(rho) if kind == "gaussian" else poisson_pair(rho)
    centre = curves(pair).mean[:, SAMPLED]
    x1, x2 = pair.draw(np.random.default_rng(key), count)
    with np.errstate(divide="ignore"):
        log1, log2 = np.log(x1), np.log(x2)
    out = np.zeros((4, 2, centre.shape[1]))
    for k, w in enumerate(W[SAMPLED]):
        for rule, value in enumerate((w * x1 + (1 - w) * x2, np.exp(w * log1 + (1 - w) * log2))):
            e = value - centre[rule, k]
            square = e * e
            out[:, rule, k] = e.sum(), square.sum(), square @ e, square @ square
    return out


class Sample(NamedTuple):
    """Sampled mean, variance and MSE about each theta, (2, K) and (T, 2, K), each with its standard error."""

    mean: tuple[Floats, Floats]
    variance: tuple[Floats, Floats]
    mse: tuple[Floats, Floats]


def monte_carlo(exact: Curves, sums: Floats, runs: int) -> Sample:
    """From sums of powers (4, 2, K)."""
    m1, m2, m3, m4 = sums / runs
    bias = exact.mean[:, SAMPLED] - np.array(THETA)[:, None, None]
    spread = (m4 - m2**2) + 4 * bias**2 * (m2 - m1**2) + 4 * bias * (m3 - m1 * m2)
    return Sample(
        (exact.mean[:, SAMPLED] + m1, np.sqrt((m2 - m1**2) / runs)),
        (m2 - m1**2, np.sqrt((m4 - m2**2) / runs)),
        (m2 + 2 * bias * m1 + bias**2, np.sqrt(spread / runs)),
    )


def power_moments(family: str, mean: float, variance: float) -> Callable[[Floats], Floats]:
    """s -> E X^s of a gamma or log-normal variable."""
    if family == "gamma":
        k, scale = mean**2 / variance, variance / mean
        return lambda s: np.asarray(np.exp(gammaln(k + s) - gammaln(k) + s * np.log(scale)))
    v = np.log1p(variance / mean**2)
    return lambda s: np.asarray(np.exp(s * (np.log(mean) - v / 2) + s * s * v / 2))


def independent(family: str, mean: tuple[float, float], variance: tuple[float, float]) -> Curves:
    """The curves of two independent variables of a family with closed-form power moments."""
    M1, M2 = (power_moments(family, m, v) for m, v in zip(mean, variance, strict=True))
    first = M1(W) * M2(1 - W)
    aa = W**2 * variance[0] + (1 - W) ** 2 * variance[1]
    return Curves(
        np.stack([W * mean[0] + (1 - W) * mean[1], first]), np.stack([aa, M1(2 * W) * M2(2 - 2 * W) - first**2])
    )


def crossings(curve: Floats) -> Floats:
    """w1 in (0, 1) at which AA - GA of a curve (2, len(W)) changes its sign."""
    gap = (curve[0] - curve[1])[1:-1]
    i = np.flatnonzero(np.sign(gap[1:]) * np.sign(gap[:-1]) < 0)
    return np.asarray(W[1:-1][i] + gap[i] / (gap[i] - gap[i + 1]) * (W[1] - W[0]))


def h(w: Floats, alpha: Floats, rho: Floats) -> Floats:
    """(18)."""
    return np.asarray(1 - 2 * w + w * w + w * w * alpha + 2 * rho * np.sqrt(alpha) * (w - w * w))


def bounds_hold(rng: np.random.Generator, pairs: int = 2_000) -> float:
    """The largest relative difference between the least h over W and (20), (21), over random alpha >= 1 and rho."""
    alpha, rho = np.exp(rng.uniform(0, 3, pairs)), rng.uniform(-1, 1, pairs)
    least = h(W[:, None], alpha, rho).min(axis=0)
    root = rho * np.sqrt(alpha)
    bound = np.where(root < 1, alpha * (1 - rho**2) / (1 + alpha - 2 * root), 1.0)
    return float((np.abs(least - bound) / np.maximum(bound, 0.05)).max())


CASES = tuple(
    [(f"Fig. 1, rho {rho:g}", "gaussian", rho) for rho in GAUSSIAN_RHO]
    + [(f"Fig. 2, rho {rho:g}", "poisson", rho) for rho in POISSON_RHO]
    + [(f"Fig. 4, rho {FIG4_RHO:g}", "gaussian", FIG4_RHO)]
)


def run(run: Run) -> Result:
    counts = [min(CHUNK, run.runs - at) for at in range(0, run.runs, CHUNK)]
    items = [
        (kind, rho, count, (run.seed, case, part))
        for case, (_, kind, rho) in enumerate(CASES)
        for part, count in enumerate(counts)
    ]
    sums = np.array(run.map(sampled, items, "sampling")).reshape(len(CASES), len(counts), 4, 2, -1).sum(axis=1)
    exact = {name: curves(gaussian_pair(rho) if kind == "gaussian" else poisson_pair(rho)) for name, kind, rho in CASES}
    drawn = {name: monte_carlo(exact[name], sums[case], run.runs) for case, (name, _, _) in enumerate(CASES)}
    half, K = len(W) // 2, len(W[SAMPLED]) // 2
    rows, off = [], 0.0
    for name, curve in exact.items():
        sample = drawn[name]
        for (value, error), true in ((sample.mean, curve.mean), (sample.variance, curve.variance)):
            off = max(off, float((np.abs(value - true[:, SAMPLED]) / error).max()))
        for rule in range(2) if not name.startswith("Fig. 4") else ():
            best = int(curve.variance[rule].argmin())
            label = f"{name}: {NAMES[rule]}"
            rows += [
                Row(label, "mean at w1 = 1/2", None, curve.mean[rule, half]),
                Row(label, "sampled mean", None, sample.mean[0][rule, K], sample.mean[1][rule, K]),
                Row(label, "variance at w1 = 1/2", None, curve.variance[rule, half]),
                Row(label, "sampled variance", None, sample.variance[0][rule, K], sample.variance[1][rule, K]),
                Row(label, "least variance", None, curve.variance[rule, best]),
                Row(label, "at w1", None, W[best]),
            ]
    figures = {"Fig. 3": "Fig. 1, rho 0", "Fig. 4": f"Fig. 4, rho {FIG4_RHO:g}"}
    least_mse: dict[tuple[str, float], list[tuple[float, float]]] = {}
    mse_crossings: dict[tuple[str, float], Floats] = {}
    for figure, name in figures.items():
        for t, theta in enumerate(THETA):
            mse = exact[name].mse(theta)
            value, error = (part[t] for part in drawn[name].mse)
            off = max(off, float((np.abs(value - mse[:, SAMPLED]) / error).max()))
            mse_crossings[figure, theta] = crossings(mse)
            least_mse[figure, theta] = [(float(one.min()), float(W[one.argmin()])) for one in mse]
            for rule in range(2):
                label = f"{figure}, theta {theta:g}: {NAMES[rule]}"
                rows += [
                    Row(label, "MSE at w1 = 1/2", None, mse[rule, half]),
                    Row(label, "sampled MSE", None, float(value[rule, K]), float(error[rule, K])),
                    Row(label, "least MSE", None, least_mse[figure, theta][rule][0]),
                    Row(label, "at w1", None, least_mse[figure, theta][rule][1]),
                ]
    others = {
        "two independent Exp(1)": independent("gamma", (1.0, 1.0), (1.0, 1.0)),
        "gamma, means and variances of Fig. 1": independent("gamma", MU, SIGMA2),
        "log-normal, means and variances of Fig. 1": independent("lognormal", MU, SIGMA2),
    }
    for name, curve in others.items():
        for rule in range(2):
            printed = (0.50, 0.38)[rule] if "Exp" in name else None
            label, least = f"{name}: {NAMES[rule]}", float(curve.variance[rule].min())
            rows += [
                Row(label, "least variance", printed, least, decimals=2),
                Row(label, "crossings with the other", None, float(len(crossings(curve.variance)))),
            ]
    x = run.rng(99).exponential(size=(2, run.runs))
    for rule, value in enumerate((x.mean(axis=0), np.sqrt(x[0] * x[1]))):
        e2 = (value - value.mean()) ** 2
        label = f"two independent Exp(1): {NAMES[rule]}"
        rows.append(Row(label, "sampled variance", None, float(e2.mean()), float(e2.std() / np.sqrt(run.runs))))
    worst_bound = bounds_hold(run.rng(98))
    cov, gap = FIG4_RHO * np.sqrt(SIGMA2[0] * SIGMA2[1]), MU[1] - MU[0]
    beta = float(cov / np.sqrt(SIGMA2[0] * (SIGMA2[1] + gap**2)))
    limit = float(np.sqrt(SIGMA2[0] / (SIGMA2[1] + gap**2)))
    g9 = (3 - 9) / (2 * np.sqrt(9))
    rows += [
        Row("(22), threshold of rho, Fig. 1", "value", None, float(np.sqrt(SIGMA2[0] / SIGMA2[1]))),
        Row("(20), (21) against the least of (18)", "value", None, worst_bound),
        Row("g(9) of (28)", "value", -1.0, float(g9)),
        Row("Fig. 4 at theta = 50: beta", "value", None, beta),
        Row("Fig. 4 at theta = 50: bound (26)", "value", None, limit),
        Row("most |sampled - exact| / std. err.", "value", None, off),
    ]
    notes = _notes(exact, others, least_mse, mse_crossings, worst_bound, beta, limit)
    return Result(tuple(rows), notes, lambda figure: _draw(figure, exact), (11.0, 8.0))


def _notes(
    exact: dict[str, Curves],
    others: dict[str, Curves],
    least_mse: dict[tuple[str, float], list[tuple[float, float]]],
    mse_crossings: dict[tuple[str, float], Floats],
    worst: float,
    beta: float,
    limit: float,
) -> tuple[str, ...]:
    def where(found: Floats) -> str:
        return "none" if not len(found) else " and ".join(f"{one:.3f}" for one in found)

    variances = {name: curve for name, curve in exact.items() if name[:6] in ("Fig. 1", "Fig. 2")}
    ordered = all(curve.variance[0].min() <= curve.variance[1].min() + 1e-9 for curve in variances.values())
    crossed = "; ".join(f"{name} {where(crossings(curve.variance))}" for name, curve in variances.items())
    mse_crossed = "; ".join(f"{k[0]} theta {k[1]:g} {where(v)}" for k, v in mse_crossings.items())
    smaller = [
        f"{figure} theta {theta:g} (AA {aa:.1f} at {w:.2f}, GA {ga:.1f} at {v:.2f})"
        for (figure, theta), ((aa, w), (ga, v)) in least_mse.items()
        if ga < aa - 1e-9
    ]
    (aa55, w55), _ = least_mse["Fig. 3", 55.0]
    unbiased = exact["Fig. 1, rho 0"].mse(55.0)[0, len(W) // 2]
    bias = max(float((curve.mean[1] - curve.mean[0]).max()) for curve in exact.values())
    exp, gamma, lognormal = others.values()
    both = exact["Fig. 1, rho 0"].variance.min(axis=1)
    return (
        f"Remark 1 {'holds' if worst < 1e-3 else 'fails'}: over 2,000 random alpha and rho the least of (18) over the "
        f"weights is (20) or (21) to {worst:.0e} (the step of the weights).",
        f"3.1, the GA's mean is below the AA's: {'holds' if bias < 1e-9 else 'fails'} in every example.",
        f"Remark 2, one cross-over of the variances as w1 goes from 0 to 1, at w1: {crossed}. Those close to 0 are of "
        "the value 0, which Poisson variables have: 0^w1 jumps there. The least AA variance is "
        f"{'never' if ordered else 'not always'} above the least GA variance in these six cases. It is not general, "
        f"though section 6 says 'for any two variables'. Two independent Exp(1): least variance AA "
        f"{exp.variance[0].min():.2f}, GA {exp.variance[1].min():.2f}, cross-over {where(crossings(exp.variance))}. "
        f"Independent with the means and variances of Fig. 1: AA {gamma.variance[0].min():.2f} against GA "
        f"{gamma.variance[1].min():.2f} for gamma variables, {lognormal.variance[1].min():.2f} for log-normal ones, "
        f"{both[1]:.2f} for the (cut off) Gaussians, AA there {both[0]:.2f}. It holds for little skewed variables only "
        "(by the expansion above, s < 3c/2).",
        f"Remark 3, cross-over of the MSEs, at w1: {mse_crossed}: 'greater or smaller' holds where there is one. The "
        "greatest discrepancy inside (0, 1) is trivial: at 0 and 1 both averages are the same variable. Its last "
        "sentence, a smaller least MSE for AA, fails in its own examples: "
        f"{'; '.join(smaller) if smaller else 'nowhere'}: the GA's bias is downwards, which helps where theta is low. "
        f"Nor is the least MSE where AA is unbiased: Fig. 3 theta 55, {aa55:.2f} at w1 {w55:.3f} against "
        f"{unbiased:.2f} at 1/2, where it is.",
        f"Remark 4 holds, being remark 1 with beta and gamma. The sentence after it, that (26) always holds for theta "
        f"on or between the means, needs uncorrelated or negatively correlated errors: in Fig. 4 with theta = 50 beta "
        f"is {beta:.5f} {'>' if beta > limit else '<'} {limit:.5f}.",
        "3.3.2 holds: with equal weights AA cannot be better than the better estimator when gamma > 9, g(9) = -1.",
    )


def _draw(figure: Any, exact: dict[str, Curves]) -> None:
    axes: NDArray[Any] = figure.subplots(2, 2)
    colours = ("#0072b2", "#009e73", "#d55e00")
    line = ("-", "--")
    panels = [
        (axes[0, 0], "Fig. 1: Gaussians, N(50, 100) and N(60, 200)", "Fig. 1"),
        (axes[0, 1], "Fig. 2: Poisson variables, rates 10 and 12", "Fig. 2"),
    ]
    for ax, title, key in panels:
        for colour, (name, curve) in zip(colours, ((n, c) for n, c in exact.items() if n.startswith(key)), strict=True):
            for rule in range(2):
                label = f"{NAMES[rule]}, $\\rho$ = {name.split('rho ')[1]}"
                ax.plot(W, curve.variance[rule], line[rule], color=colour, label=label, lw=1.5)
        ax.set_title(title)
        ax.set_ylabel("variance")
    for ax, title, name in (
        (axes[1, 0], "Fig. 3: independent Gaussians", "Fig. 1, rho 0"),
        (axes[1, 1], f"Fig. 4: Gaussians, $\\rho$ = {FIG4_RHO:g}", f"Fig. 4, rho {FIG4_RHO:g}"),
    ):
        for colour, theta in zip(colours, THETA, strict=True):
            for rule, mse in enumerate(exact[name].mse(theta)):
                label = f"{NAMES[rule]}, $\\theta$ = {theta:g}"
                ax.plot(W, mse, line[rule], color=colour, label=label, lw=1.5)
        ax.set_title(title)
        ax.set_ylabel("mean squared error")
    for ax in axes.flat:
        ax.set_xlabel("weight $w_1$")
        ax.set_xlim(0, 1)
        ax.legend(fontsize=8, ncols=3, frameon=False, loc="upper center")
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.22 * (high - low))


STUDIES = (
    Study(
        name="li-variables",
        title="AA and GA of two random variables: mean, variance, MSE",
        source="Li-2nd 3, Figs. 1-4, remarks 1-4",
        about=__doc__ or "",
        run=run,
        runs=1_000_000,
        quick=20_000,
        seconds=35.0,
    ),
)
