"""How fast the fusion rules are: `python -m benchmarks.rules [--quick] [--road on]`.

Public layout in and out, one thread, its CPU time. Each rule is timed in turn with two yardsticks, and the
best of several rounds of each is compared, since a shared machine drifts by more than the rules differ:

  (a) the same B fusions by the naive rule with stacked `np.linalg.inv`,
  (b) a loop over fusions that finds the weights with `scipy.optimize` (some of them, scaled up),
  (c) where `stonesoup` can be imported: a loop of its `ChernoffUpdater`, which has fixed weights.

"own": a bound, or a cross-covariance, of each fusion's own. `/(a)` is time over (a)'s: smaller is better. `x(b)`,
`x(c)`: how many times faster than these. Goals stand at the end of a line.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from fusion_service.arrays import Floats
from fusion_service.compiled import CHOICES, use
from fusion_service.rules import fuse

Case = tuple[str, dict[str, Any]]

CASES: tuple[Case, ...] = (
    ("naive", {}),
    ("ci", {"weights": "uniform"}),
    ("ci", {"criterion": "det"}),
    ("ci", {"criterion": "trace"}),
    ("bci", {"criterion": "det", "max_correlation": 0.5}),
    ("bci", {"criterion": "trace", "max_correlation": 0.5}),
    ("bci", {"max_correlation": "own"}),
    ("bar-shalom-campo", {"cross_covariance": "own"}),
    ("hmd-ga", {"criterion": "det"}),
    ("hmd-ga", {"criterion": "trace"}),
    ("ici", {"criterion": "det"}),
    ("ici", {"criterion": "trace"}),
    ("ei", {}),
    ("fast-ci", {}),
    ("aa", {}),
    ("aa", {"criterion": "diversity"}),
    ("cu", {}),
)


GOALS = {
    "naive": "/(a) <= 0.25",
    "ci det": "/(a) <= 0.5, x(b) >= 150",
    **dict.fromkeys(("ci trace", "bci det 0.5", "ici det", "hmd-ga det"), "/(a) <= 0.9, x(b) >= 80"),
    **dict.fromkeys(("bci trace 0.5", "ici trace", "hmd-ga trace"), "x(b) >= 80"),
}
"""At n = 4, N = 2, B = 10,000."""


def estimates(rng: np.random.Generator, B: int, N: int, n: int) -> tuple[Floats, Floats]:
    """Random estimates: standard deviations over two decades, means a few of them apart."""
    q, _ = np.linalg.qr(rng.normal(size=(B, N, n, n)))
    P = (q * 10.0 ** rng.uniform(-1, 1, size=(B, N, 1, n))) @ q.swapaxes(-1, -2)
    return rng.normal(size=(B, N, n)), 0.5 * (P + P.swapaxes(-1, -2))


def own(name: str, P: Floats) -> Floats:
    """The option `name` with an element of its own for each of the fusions of P (B, N, n, n)."""
    B, N, n, _ = P.shape
    if name == "cross_covariance":
        return np.zeros((B, N, N, n, n))
    R = np.random.default_rng(2).uniform(0.1, 1.0, (B, N, N))
    R = np.maximum(R, R.swapaxes(1, 2))
    R[:, range(N), range(N)] = 1.0
    return np.asarray(R)


def stacked(x: Floats, P: Floats) -> tuple[Floats, Floats]:
    """Yardstick (a)."""
    A = np.linalg.inv(P)
    fused = np.linalg.inv(A.sum(axis=1))
    return (fused @ (A @ x[..., None]).sum(axis=1))[..., 0], fused


def one_by_one(x: Floats, P: Floats, rule: str, options: dict[str, Any]) -> None:
    """Yardstick (b): what a script would do."""
    _, N, _ = x.shape
    criterion, rho = options["criterion"], options.get("max_correlation", 1.0)
    for means, covariances in zip(x, P, strict=True):
        A = np.linalg.inv(covariances)
        if rule == "hmd-ga":
            total, y = A.sum(axis=0), np.einsum("ijk,ik->ij", A, means)
            C = np.linalg.inv(total - A)
            c = np.einsum("ijk,ik->ij", C, y.sum(axis=0) - y)

        dets = np.linalg.slogdet(covariances)[1]

        def information(w: Floats) -> Floats:
            if rule == "ici":
                return np.asarray(A.sum(axis=0) - np.linalg.inv(np.einsum("i,ijk->jk", w, covariances)))  # noqa: B023
            if rule == "aa":
                r = means - w @ means  # noqa: B023
                return np.asarray(np.einsum("i,ijk->jk", w, covariances) + (r.T * w) @ r)  # noqa: B023
            if rule == "hmd-ga":
                r = c - w @ c  # noqa: B023
                return np.asarray(np.einsum("i,ijk->jk", w, C) + (r.T * w) @ r)  # noqa: B023
            return np.asarray(np.einsum("i,ijk->jk", w / ((1 - rho) * w + rho), A))  # noqa: B023

        def cost(w: Floats) -> float:
            M = information(w)
            if rule == "aa":
                return float(w @ dets - np.linalg.slogdet(M)[1])  # noqa: B023
            return float(-np.linalg.det(M) if criterion == "det" else np.trace(np.linalg.inv(M)))

        if N == 2:
            minimize_scalar(lambda t: cost(np.array([t, 1 - t])), bounds=(0, 1), method="bounded")
        else:
            minimize(
                cost,
                np.full(N, 1 / N),
                bounds=[(0, 1)] * N,
                constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
                method="SLSQP",
            )


def chernoff() -> Callable[[Floats, Floats], None] | None:
    """Yardstick (c), for pairs; None without Stone Soup."""
    try:
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.types.detection import GaussianDetection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.prediction import GaussianStatePrediction
        from stonesoup.updater.chernoff import ChernoffUpdater
    except ImportError:
        return None

    def loop(x: Floats, P: Floats) -> None:
        n = x.shape[-1]
        model = LinearGaussian(ndim_state=n, mapping=list(range(n)), noise_covar=np.zeros((n, n)))
        updater = ChernoffUpdater(measurement_model=model)
        for means, covariances in zip(x, P, strict=True):
            one = GaussianStatePrediction(means[0][:, None], covariances[0])
            other = GaussianDetection(means[1][:, None], covar=covariances[1], measurement_model=model)
            updater.update(SingleHypothesis(one, other))

    return loop


def clock(run: Callable[[], object]) -> float:
    start = time.thread_time()
    run()
    return time.thread_time() - start


def measure(
    x: Floats, P: Floats, rounds: int, third: Callable[[Floats, Floats], None] | None
) -> Iterator[tuple[str, float, float, float, float]]:
    """For each case: its name, seconds per batch, ratio to (a), speed-up over (b) and (c) (NaN: not there)."""
    B, N, _ = x.shape
    some = max(1, min(B, 60 // N))
    c = (
        np.nan
        if third is None or N != 2
        else min(clock(lambda: third(x[:some], P[:some])) for _ in range(3)) * B / some
    )
    for rule, options in CASES:
        ours: list[float] = []
        a: list[float] = []
        b: list[float] = []
        given: dict[str, Any] = {key: own(key, P) if value == "own" else value for key, value in options.items()}
        for _ in range(rounds):
            ours.append(clock(lambda: fuse(rule, x, P, **given)))  # noqa: B023
            a.append(clock(lambda: stacked(x, P)))
            if "criterion" in options and len(b) < 3:
                b.append(clock(lambda: one_by_one(x[:some], P[:some], rule, options)) * B / some)  # noqa: B023
        name = " ".join((rule, *(str(v) for v in options.values())))
        yield name, min(ours), min(ours) / min(a), min(b) / min(ours) if b else np.nan, c / min(ours)


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the fusion rules", epilog="python -m benchmarks.rules")
    parser.add_argument("--quick", action="store_true", help="n = 4 and N = 2 only")
    parser.add_argument(
        "--road", choices=CHOICES, default="off", help="small matrices by NumPy (off), or compiled (on)"
    )
    given = parser.parse_args()
    quick, road = given.quick, use(given.road)
    print(f"small matrices by {road}; load of the machine {os.getloadavg()[0]:.1f}")
    rng = np.random.default_rng(1)
    sizes = [(4, 2, B) for B in (1, 20, 1000, 10_000)]
    if not quick:
        sizes += [(n, 2, B) for n in (2, 6) for B in (1, 20, 1000, 10_000)]
        sizes += [(4, N, B) for N in (3, 5, 20) for B in (1, 1000)]
    third = chernoff()
    print(f"{'n':>2} {'N':>3} {'B':>6}  {'rule':<20} {'us/fusion':>10} {'/(a)':>7} {'x(b)':>7} {'x(c)':>7}")
    for n, N, B in sizes:
        x, P = estimates(rng, B, N, n)
        rounds = 30 if B * N <= 2000 else 15
        for name, seconds, over_a, *times in measure(x, P, 3 if N > 5 else rounds, third):
            others = " ".join(" " * 7 if np.isnan(t) else f"{t:7.0f}" for t in times)
            goal = {(4, 2, 1): "us <= 500", (4, 2, 10_000): GOALS.get(name, "")}.get((n, N, B), "")
            cells = f"{1e6 * seconds / B:10.2f} {over_a:7.2f} {others:<15}  {goal}"
            print(f"{n:>2} {N:>3} {B:>6}  {name:<20} {cells}".rstrip(), flush=True)


if __name__ == "__main__":
    main()
