"""Fusion rules: several estimates of one state, whose errors may be correlated, become one.

`fuse` checks its input and takes any batch shape; `fuse_last` trusts it, batch-last. `RULES` tells what
each rule is and what it promises.

    fused = fuse("ci", means, covariances, criterion="det")
    fused.mean, fused.covariance, fused.weights

A rule is one file here that declares `RULE = Rule(...)` (`base.rule`); nothing else needs to know of it. What rules
share stands in `base`, the searches for weights in `weights`, rules for mixtures in `mixtures`, what callers see in
`face`. A rule of one's own, in a file anywhere, is loaded by `load_own`. `python -m fusion_service.rules` writes the
tables of README.md and docs/rules.md anew.
"""

from fusion_service.rules.base.options import RuleError
from fusion_service.rules.base.rule import MixtureRule, Option, Rule
from fusion_service.rules.face.gaussians import Fused, fuse, fuse_last
from fusion_service.rules.face.own import is_own, load_own
from fusion_service.rules.face.registry import RULES
from fusion_service.rules.mixtures import MIXTURE_RULES, fuse_mixtures

__all__ = [
    "MIXTURE_RULES",
    "RULES",
    "Fused",
    "MixtureRule",
    "Option",
    "Rule",
    "RuleError",
    "fuse",
    "fuse_last",
    "fuse_mixtures",
    "is_own",
    "load_own",
]
