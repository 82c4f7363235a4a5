"""Hypothesis strategies shared by the tests."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

Array = NDArray[np.float64]

seeds = st.integers(0, 2**32 - 1)
dimensions = st.integers(1, 5)


def covariance(rng: np.random.Generator, n: int, decades: float = 2.0) -> Array:
    """A random covariance (n, n) whose variances along its axes spread over so many decades."""
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    P = (q * 10.0 ** rng.uniform(-decades / 2, decades / 2, size=n)) @ q.T
    return np.asarray(0.5 * (P + P.T))


def sources(rng: np.random.Generator, N: int, n: int, decades: float = 2.0) -> tuple[Array, Array]:
    """Means (N, n) and covariances (N, n, n) of random estimates of one state."""
    P = np.stack([covariance(rng, n, decades) for _ in range(N)])
    return rng.normal(size=(N, n)), P


@st.composite
def estimates(draw: st.DrawFn, min_sources: int = 1, max_sources: int = 4, decades: float = 2.0) -> tuple[Array, Array]:
    """Means (N, n) and covariances (N, n, n). Shrinks in N and n; the numbers come from a drawn seed."""
    N, n = draw(st.integers(min_sources, max_sources)), draw(dimensions)
    return sources(np.random.default_rng(draw(seeds)), N, n, decades)
