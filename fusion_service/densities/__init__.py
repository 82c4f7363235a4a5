"""Gaussians and mixtures as arrays: moments, products, divergences, reduction, sampling.

mixture = Mixture(weights, means, covariances)         # one, checked
batch = Mixtures.of([mixture, ...])                    # many, batch-last, trusted
reduce_mixture(mixture, max_components=4, prune=1e-4)
"""

from fusion_service.densities.divergence import (
    chernoff_discrete,
    chernoff_gaussians,
    chernoff_mixtures,
    kl_bounds,
    kl_gaussians,
    overlap_gaussians,
)
from fusion_service.densities.mixture import (
    DensityError,
    Mixture,
    Mixtures,
    log_gaussian,
    log_sum,
    moments,
    power_product,
)
from fusion_service.densities.reduction import reduce_mixture, reduce_mixtures
from fusion_service.densities.sampling import draws, halved_sum, sampled_moments

__all__ = [
    "DensityError",
    "Mixture",
    "Mixtures",
    "chernoff_discrete",
    "chernoff_gaussians",
    "chernoff_mixtures",
    "draws",
    "halved_sum",
    "kl_bounds",
    "kl_gaussians",
    "log_gaussian",
    "log_sum",
    "moments",
    "overlap_gaussians",
    "power_product",
    "reduce_mixture",
    "reduce_mixtures",
    "sampled_moments",
]
