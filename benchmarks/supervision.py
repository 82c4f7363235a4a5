"""How often sound sources are taken for unsound ones, and how soon an unsound one is named:

    python -m benchmarks.supervision [--hours 2] [--seed 1] [--sources 20] [--targets 5]

Simulated sources that share all targets are put before `supervision.honesty` as a centre does it, without the centre
around it (so that an hour takes seconds). "white": errors are drawn anew at every report, by the covariance that is
sent. "trackers": Kalman filters of `sensor_clients` on targets of nearly constant velocity, so errors are correlated
over time, and between sources by the targets' own process noise; every 1, 2 or 4 s, of a third of the sources a second
late, predicted to the step. It prints false alarms per hour and source, at the configured rate and at looser ones (at
which there is more to count), with bounds of 95 %; then after how many scans one source of several that sends a factor
in standard deviation too little is named, and whether another one was.
"""

import argparse
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.centre.rows import Rows
from fusion_service.centre.supervision.honesty import Honesty
from fusion_service.centre.supervision.shared import shared_pairs
from fusion_service.centre.tracks import empty_tracks
from fusion_service.motion import transition
from schemas import Motion
from sensor_clients.filters.kalman import Estimate, predict, update

SPACE = ("x", "y", "vx", "vy")
H = np.eye(4)[:2]
RATES = (0.001, 1.0, 100.0)


class World:
    """S sources that see T targets: `step` gives the rows of the next second. claim (S,): factor on standard
    deviations that each sends."""

    def __init__(self, kind: str, sources: int, targets: int, claim: Floats, seed: int) -> None:
        self.rng, self.kind, self.shape = np.random.default_rng(seed), kind, (sources, targets)
        self.claim, self.time = np.repeat(claim**2, targets), 0
        self.sigma = np.repeat(self.rng.uniform(10.0, 20.0, sources), targets)
        slow = kind == "trackers"
        self.period = np.repeat(self.rng.choice([1, 2, 4] if slow else [1], sources), targets)
        self.late = np.repeat(self.rng.random(sources) < 1 / 3, targets) & slow
        self.motion = Motion("cv", float(10.0 ** self.rng.uniform(-1.0, 1.0)))
        moves, noise = transition(self.motion, SPACE, np.zeros((4, 1)), np.ones(1), None)
        self.F, self.Q = moves[:, :, 0], noise[:, :, 0]
        self.root: Floats = np.linalg.cholesky(self.Q).astype(np.float64)
        truth = self.rng.normal(size=(4, targets)) * np.array([1e4, 1e4, 30.0, 30.0])[:, None]
        self.truth = truth
        size = sources * targets
        start = np.diag([1.0, 1.0, 0.0, 0.0])[:, :, None] * self.sigma**2 + np.diag([0, 0, 900.0, 900.0])[:, :, None]
        mean = np.tile(truth, sources) + np.sqrt(linalg_diagonal(start)) * self.rng.normal(size=(4, size))
        self.state = Estimate(mean, start)
        self.heard = self.state
        index = np.repeat(np.arange(sources), targets)
        ids = np.tile(np.arange(1, targets + 1, dtype=np.uint64), sources)
        none = np.zeros(size, dtype=np.bool_)
        self.rows = Rows(
            index, np.zeros(size, dtype=np.uint64), replace(empty_tracks(4), id=ids, link=ids), none,
            np.zeros(size, dtype=np.int64), none, np.zeros((5, size)), none, {},
        )  # fmt: skip

    def step(self) -> Rows:
        """The rows of the next second."""
        self.time += 1
        noise = self.rng.normal(size=self.truth.shape)
        self.truth = linalg.matvec(self.F, self.truth) + linalg.matvec(self.root, noise)
        shown = self._trackers() if self.kind == "trackers" else self._white()
        fresh = (self.time - self.late) % self.period == 0
        tracks = replace(self.rows.tracks, mean=shown.mean, covariance=shown.covariance * self.claim)
        return replace(self.rows, tracks=tracks, fresh=fresh)

    def _white(self) -> Estimate:
        size = len(self.sigma)
        sigma = np.stack([self.sigma, self.sigma, self.sigma / 10, self.sigma / 10])
        covariance = np.zeros((4, 4, size))
        covariance[range(4), range(4)] = sigma**2
        mean = np.tile(self.truth, self.shape[0]) + sigma * self.rng.normal(size=(4, size))
        return Estimate(mean, covariance)

    def _trackers(self) -> Estimate:
        before = self.state
        state = predict(before, self.F, self.Q)
        now = self.time % self.period == 0
        z = np.tile(self.truth[:2], self.shape[0]) + self.sigma * self.rng.normal(size=(2, len(self.sigma)))
        R = np.eye(2)[:, :, None] * self.sigma**2
        new = update(state, H, R, z)
        self.state = Estimate(np.where(now, new.mean, state.mean), np.where(now, new.covariance, state.covariance))
        old = predict(before, self.F, self.Q)
        return Estimate(
            np.where(self.late, old.mean, self.state.mean), np.where(self.late, old.covariance, self.state.covariance)
        )


def linalg_diagonal(P: Floats) -> Floats:
    """The diagonals (n, B)."""
    return np.moveaxis(np.diagonal(P), -1, 0)


def false_alarms(kind: str, hours: float, sources: int, targets: int, seed: int) -> None:
    """Count alarms about sound sources."""
    names = tuple(f"s{i:02d}" for i in range(sources))
    counts, last = np.zeros(len(RATES)), np.zeros((len(RATES), sources), dtype=np.bool_)
    worst = 0.0
    for part in range(max(round(hours * 4), 1)):  # a new world every quarter of an hour
        world = World(kind, sources, targets, np.ones(sources), seed + part)
        honesty = Honesty(SPACE)
        for step in range(900):
            rows = world.step()
            honesty.observe(rows, names, shared_pairs(rows, step), np.ones((2, sources)))
            for i, rate in enumerate(RATES):
                told = honesty.opinions(rate / 3600.0, {})
                wrong = np.array([any(told[name].wrong) if name in told else False for name in names])
                counts[i] += (wrong & ~last[i]).sum()
                last[i] = wrong
            if told:
                worst = max(worst, *(max(one.factor) for one in told.values()))
    time = max(round(hours * 4), 1) / 4 * sources
    for rate, count in zip(RATES, counts, strict=True):
        low = chi2.ppf(0.025, 2 * count) / 2 / time if count else 0.0
        high = chi2.ppf(0.975, 2 * count + 2) / 2 / time
        print(
            f"{kind:<9} {sources:>2} x {targets:<3} asked {rate:>6g} /h: {int(count):>4} in {time:g} source-hours, "
            f"{count / time:.4f} /h ({low:.4f} to {high:.4f})"
        )
    print(f"{kind:<9} largest factor found wrong: {worst:.2f}")


def named_after(kind: str, sources: int, targets: int, factor: float, seeds: range, most: int = 600) -> None:
    """After how many scans a source that sends `factor` times its standard deviations is named."""
    names = tuple(f"s{i:02d}" for i in range(sources))
    found, others = [], 0
    for seed in seeds:
        claim = np.ones(sources)
        claim[0] = factor
        world, honesty, when = World(kind, sources, targets, claim, seed), Honesty(SPACE), np.inf
        for step in range(most):
            rows = world.step()
            honesty.observe(rows, names, shared_pairs(rows, step), np.ones((2, sources)))
            told = honesty.opinions(RATES[0] / 3600.0, {})
            others += any(any(one.wrong) and one.decided for name, one in told.items() if name != names[0])
            if names[0] in told and any(told[names[0]].wrong):
                when = max((step + 1) // world.period[0], 1)
                break
        found.append(when)
    tenth, middle, ninth = np.quantile(found, [0.1, 0.5, 0.9], method="nearest")
    print(
        f"{kind:<9} {sources:>2} x {targets:<3} sigma x {factor:<6.3g} named after {middle:.0f} scans ({tenth:.0f} to "
        f"{ninth:.0f}; {int(np.isinf(found).sum())} of {len(found)} not in {most} s), another one before: {others}"
    )


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sources", type=int, default=20)
    parser.add_argument("--targets", type=int, default=5)
    parser.add_argument("--runs", type=int, default=20)
    args = parser.parse_args()
    for kind in ("white", "trackers"):
        false_alarms(kind, args.hours, args.sources, args.targets, args.seed)
        false_alarms(kind, args.hours, 4, 1, args.seed + 1000)
    for kind in ("white", "trackers"):
        for factor in (1 / 3, 1 / 2, 0.7, 3.0):
            for sources, targets in ((3, 20), (3, 1), (10, 20), (2, 20)):
                most = 200 if factor > 1 or sources == 10 else 600
                named_after(kind, sources, targets, factor, range(args.seed, args.seed + args.runs), most)


if __name__ == "__main__":
    main()
