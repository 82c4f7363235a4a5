"""The picture of docs/tracklets.md: `python -m benchmarks.tracklet_pictures [--out docs/pictures]`.

Targets far apart move with nearly constant velocity (q = 1 m2/s3); three sensors measure the place of each every second
with standard deviations of 10, 15 and 20 m, each has a Kalman filter of its own, and centres hear the tracks. Left: the
error beside that of one filter with all measurements. Right: what the watch sees of three other sensors, of which two
measure worse than they say. It prints the numbers too.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre
from fusion_service.colours import BLUE, GREEN, ORANGE, VERMILION

SECOND = 10**9
FRAME = schemas.Enu(59.0, 10.0)
SIGMAS = (10.0, 15.0, 20.0)
Q, TARGETS, STEPS, SEED = 1.0, 300, 60, 3
SETTLED = 20
H = np.eye(4)[:2]
F = np.eye(4) + np.eye(4, k=2)
NOISE = Q * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
WAYS: dict[str, dict[str, Any]] = {
    "ci": {"rule": "ci"},
    "naive": {"rule": "naive"},
    "tracklet": {"rule": "ci", "memory": "tracklet"},
}
LOOKS = {
    "ci": (BLUE, "-"),
    "best sensor": ("0.1", ":"),
    "naive": (ORANGE, "-"),
    "tracklet": (VERMILION, "-"),
    "centralised": ("k", "--"),
}
CLAIMS = {"as it says": 1.0, "1.25 times worse": 1.25, "2 times worse": 2.0}
"""Standard deviation of the measurements over what the tracker assumes."""


class Kalman:
    """A filter of all targets, places measured with standard deviation `sigma` (as it assumes)."""

    def __init__(self, sigma: float) -> None:
        self.R = sigma**2 * np.eye(2)
        self.x, self.P = np.zeros((TARGETS, 4)), np.diag([*np.diag(self.R), 225.0, 225.0])

    def take(self, z: Floats, first: bool) -> None:
        if first:
            self.x = np.hstack([z, np.zeros_like(z)])
            return
        x, P = self.x @ F.T, F @ self.P @ F.T + NOISE
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + self.R)
        self.x, self.P = x + (z - x @ H.T) @ K.T, (np.eye(4) - K @ H) @ P
        self.P = (self.P + self.P.T) / 2


def truth(rng: np.random.Generator) -> Iterator[Floats]:
    """States (TARGETS, 4), second by second."""
    x = np.hstack([20e3 * np.arange(TARGETS)[:, None] * [1.0, 0.0], rng.normal(0, 15, (TARGETS, 2))])
    L = np.linalg.cholesky(NOISE)
    for _ in range(STEPS):
        yield x
        x = x @ F.T + rng.standard_normal(x.shape) @ L.T


def said(name: str, step: int, tracker: Kalman) -> schemas.LocalTracks:
    return schemas.LocalTracks(
        source=name, epoch=1, seq=step, sent=step * SECOND, time=step * SECOND, complete=True,
        space=("x", "y", "vx", "vy"), frame=FRAME, ids=np.arange(1, TARGETS + 1, dtype=np.uint64),
        means=tracker.x, covariances=np.tile(tracker.P, (TARGETS, 1, 1)),
    )  # fmt: skip


def introduce(centre: FusionCentre, names: list[str]) -> None:
    for name in names:
        info = schemas.SensorInfo(
            source=name, epoch=1, seq=0, sent=0, frame=FRAME, position=(0.0, 0.0, 0.0), period=1.0,
            motion=schemas.Motion("cv", Q),
        )  # fmt: skip
        centre.handle(info, 0)


def errors(out: Any) -> None:
    rng = np.random.default_rng(SEED)
    names = [f"sensor {sigma:g} m" for sigma in SIGMAS]
    trackers = dict(zip(names, map(Kalman, SIGMAS), strict=True))
    best, together = trackers[names[0]], Kalman(float(np.sum(1 / np.square(SIGMAS)) ** -0.5))
    centres = {name: FusionCentre({"frame": FRAME, **way}) for name, way in WAYS.items()}
    for centre in centres.values():
        introduce(centre, [name.replace(" ", "-") for name in names])
    square: dict[str, list[float]] = {name: [] for name in LOOKS}
    nees: dict[str, list[float]] = {name: [] for name in LOOKS}
    for step, x in enumerate(truth(rng), 1):
        seen = [x[:, :2] + rng.normal(0, sigma, (TARGETS, 2)) for sigma in SIGMAS]
        for tracker, z in zip(trackers.values(), seen, strict=True):
            tracker.take(z, step == 1)
        weight = 1 / np.square(SIGMAS)
        together.take(np.average(seen, axis=0, weights=weight), step == 1)
        found = {"best sensor": (best.x, best.P), "centralised": (together.x, together.P)}
        for name, centre in centres.items():
            for source, tracker in trackers.items():
                centre.handle(said(source.replace(" ", "-"), step, tracker), step * SECOND)
            picture = centre.step(step * SECOND).tracks
            order = np.argsort(picture.means[:, 0])
            assert len(order) == TARGETS, "a track for each target"
            found[name] = picture.means[order], picture.covariances[order]
        for name, (mean, covariance) in found.items():
            e = mean - x
            square[name].append(float((e[:, :2] ** 2).sum(axis=1).mean()))
            weighed = np.linalg.solve(np.broadcast_to(covariance, (TARGETS, 4, 4)), e[..., None])[..., 0]
            nees[name].append(float((e * weighed).sum(axis=1).mean()) / 4)
    print(f"RMSE in m and NEES / 4 from {SETTLED} to {STEPS} s, {TARGETS} targets")
    for name, (colour, style) in LOOKS.items():
        rmse, honest = float(np.sqrt(np.mean(square[name][SETTLED:]))), float(np.mean(nees[name][SETTLED:]))
        print(f"  {name:<14}{rmse:6.2f}{honest:6.2f}")
        wide = 4.0 if name == "tracklet" else 1.6
        alpha = 0.55 if name == "tracklet" else 1.0
        label = f"{name}: NEES / 4 {honest:.2f}"
        out.plot(range(1, STEPS + 1), np.sqrt(square[name]), style, color=colour, lw=wide, alpha=alpha, label=label)
    out.set(xlabel="s", ylabel="RMSE of position, m", ylim=(5.5, 13), xlim=(0, STEPS))
    out.set_title("sensors of 10, 15 and 20 m", fontsize=10)
    out.legend(frameon=False, fontsize=9)


def watched(out: Any) -> None:
    rng = np.random.default_rng(SEED + 1)
    trackers = {name.replace(" ", "-"): Kalman(10.0) for name in CLAIMS}
    centre = FusionCentre({"frame": FRAME, "memory": "tracklet"})
    introduce(centre, list(trackers))
    ratio: dict[str, list[float]] = {name: [] for name in trackers}
    bounds, told = [], {}
    for step, x in enumerate(truth(rng), 1):
        for (name, tracker), worse in zip(trackers.items(), CLAIMS.values(), strict=True):
            tracker.take(x[:, :2] + rng.normal(0, 10.0 * worse, (TARGETS, 2)), step == 1)
            centre.handle(said(name, step, tracker), step * SECOND)
        result = centre.step(step * SECOND)
        for event in result.log.events:
            if event["kind"] == "tracklets":
                told[event["source"]] = step, event["why"]
        status = result.status.sources
        for name in trackers:
            ratio[name].append(status[name].get("innovation", np.nan))
        one = status[next(iter(trackers))]
        bounds.append((one.get("innovation_low", np.nan), one.get("innovation_high", np.nan)))
    print("normalised innovations at the end, by what the measurements are")
    seconds = range(1, STEPS + 1)
    out.fill_between(seconds, *np.transpose(bounds), color="0.9", label="bounds")
    out.axhline(2.0, color="0.4", ls="--", lw=1)
    out.annotate("above: no tracklets", (STEPS - 1, 2.05), fontsize=9, ha="right", color="0.3")
    out.annotate("between: inflated", (STEPS - 1, 1.85), fontsize=9, ha="right", color="0.3")
    for (name, values), colour, text in zip(ratio.items(), (GREEN, ORANGE, VERMILION), CLAIMS, strict=True):
        out.plot(seconds, values, color=colour, lw=2, label=text)
        print(f"  {text:<18}{values[-1]:6.2f}  {told.get(name, '')}")
        if name in told:
            out.plot(told[name][0], values[told[name][0] - 1], "o", color=colour, ms=9, label="taken out")
    out.set(xlabel="s", ylabel="mean normalised innovation", xlim=(0, STEPS), ylim=(0.6, 5.2))
    out.set_title("what the watch sees of sensors that measure", fontsize=10)
    out.legend(frameon=False, fontsize=9, loc="upper left", ncols=2)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="The picture of tracklets", epilog="python -m benchmarks.tracklet_pictures"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    mpl.use("Agg")
    fig, (left, right) = plt.subplots(1, 2, figsize=(11.5, 4.4))
    errors(left)
    watched(right)
    fig.tight_layout()
    fig.savefig(out / "tracklets.png", dpi=110)


if __name__ == "__main__":
    main()
