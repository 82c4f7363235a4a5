"""What mixtures cost: `python -m benchmarks.mixtures [--quick]`.

1,000 tracks of 3 sources at n = 4, with 4 components each beside the same with 1 component, both in and out (the
result is merged back to as many). One thread, its CPU time, best of several rounds, taken in turns. `ratio` is 4
components over 1; `us/track` is the time of the former.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from typing import Any

import numpy as np

from fusion_service.densities import Mixtures
from fusion_service.rules.mixtures import fuse_mixtures_last

CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("aa", {}),
    ("aa", {"reduction": "salmond"}),
    ("aa", {"reduction": "truncate"}),
    ("gm-ga", {"weights": "uniform", "prune": 1e-3}),
    ("gm-ga", {"prune": 1e-3}),
    ("ci", {}),
    ("bci", {"max_correlation": 0.5}),
    ("hmd-ga", {}),
    ("cu-modes", {"prune": 1e-3}),
    ("gmd-s", {"weights": "uniform", "samples": 200, "prune": 1e-3}),
)
SLOW = ("cu-modes", "gmd-s")


def tracks(rng: np.random.Generator, T: int, N: int, C: int, n: int = 4) -> list[Mixtures]:
    """As of an IMM: T tracks, of each N sources with C modes of unequal weight, about a standard deviation apart."""
    truth = 1e4 * rng.normal(size=(T, n))
    sources = []
    for _ in range(N):
        q, _ = np.linalg.qr(rng.normal(size=(T, C, n, n)))
        P = (q * 10.0 ** rng.uniform(-0.5, 1.0, size=(T, C, 1, n))) @ q.swapaxes(-1, -2)
        error = np.linalg.cholesky(P[:, :1]) @ rng.normal(size=(T, 1, n, 1))
        x = truth[:, None] + error[..., 0] + rng.normal(size=(T, C, n))
        w = rng.dirichlet(np.full(C, 0.7), size=T)
        rows = w.ravel(), x.reshape(-1, n), (0.5 * (P + P.swapaxes(-1, -2))).reshape(-1, n, n)
        sources.append(Mixtures.from_rows(*rows, np.full(T, C)))
    return sources


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of mixture fusion", epilog="python -m benchmarks.mixtures")
    parser.add_argument("--quick", action="store_true", help="200 tracks, without the slow rules")
    quick = parser.parse_args().quick
    T = 200 if quick else 1000
    rng = np.random.default_rng(1)
    many, one = tracks(rng, T, 3, 4), tracks(rng, T, 3, 1)
    print(f"{T} tracks, 3 sources, 4 components\n{'rule':<52} {'us/track':>9} {'ratio':>7}")
    for rule, options in CASES:
        if quick and rule in SLOW:
            continue
        best = [np.inf, np.inf]
        for _ in range(1 if rule in SLOW else 5):
            for k, (sources, most) in enumerate(((many, 4), (one, 1))):
                start = time.thread_time()
                fuse_mixtures_last(rule, sources, max_components=most, **options)
                best[k] = min(best[k], time.thread_time() - start)
        name = " ".join((rule, *(f"{k}={v}" for k, v in options.items())))
        print(f"{name:<52} {1e6 * best[0] / T:9.1f} {best[0] / best[1]:7.1f}", flush=True)


if __name__ == "__main__":
    main()
