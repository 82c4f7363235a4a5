"""A reference where nobody carried a GPS: the targets' trajectories, smoothed from what all sources told of them."""

from fusion_service.review.smoothing.reference import smoothed_truth

__all__ = ["smoothed_truth"]
