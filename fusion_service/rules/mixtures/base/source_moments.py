"""The sources' moments, for rules for Gaussians."""

from collections.abc import Sequence

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures

__all__ = ["source_moments"]


def source_moments(sources: Sequence[Mixtures]) -> tuple[Floats, Floats]:
    """Means (N, n, B) and covariances (N, n, n, B) of N batches of B mixtures."""
    both = [f.moments() for f in sources]
    return np.stack([b[0] for b in both]), np.stack([b[1] for b in both])
