"""Fusion rules: several Gaussian estimates of one state, whose errors may be correlated, become one.

`fuse` checks its input and takes any batch shape; `fuse_last` trusts it, batch-last. `RULES` tells what
each rule is and what it promises.

    fused = fuse("ci", means, covariances, criterion="det")
    fused.mean, fused.covariance, fused.weights
"""

from fusion_service.rules.face import Fused, fuse, fuse_last
from fusion_service.rules.mixtures import fuse_mixtures
from fusion_service.rules.options import RuleError
from fusion_service.rules.registry import RULES, Rule

__all__ = ["RULES", "Fused", "Rule", "RuleError", "fuse", "fuse_last", "fuse_mixtures"]
