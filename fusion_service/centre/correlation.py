"""What a step's fusion is told of the correlation of local tracks: bounds between declared groups of sources.

A source's group is what its SensorInfo says (`correlation_group`), else what the config says of it, with `override` the
other way round; a source without one is a group of its own, named as itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_service.arrays import Floats, Ints
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import Rows
from fusion_service.config import CentreConfig
from fusion_service.config.correlation import group_bounds
from fusion_service.rules import Fused, fuse_last

__all__ = ["Correlation", "declared_correlation"]


@dataclass(frozen=True, slots=True)
class Correlation:
    """How the rows of a step are fused by the rule of the config, with what is known of their correlation.

    groups (S,): of each source, by sorted name, the number of its group; bounds (G, G): between two of the groups.
    None where nothing is declared by groups.
    """

    config: CentreConfig
    groups: Ints | None = None
    bounds: Floats | None = None

    def fuse(self, rows: Rows, members: Ints, means: Floats, covariances: Floats, weights: Floats | None) -> Fused:
        """Fuse rows `members` (B, N), of means (N, n, B) and covariances (N, n, n, B); what cannot be fused is NaN."""
        options = dict(self.config.rule_options)
        if self.groups is not None and self.bounds is not None:
            group = self.groups[rows.source[members.T]]
            R = self.bounds[group[:, None], group[None]]
            R[range(len(R)), range(len(R))] = 1.0
            options["max_correlation"] = R
        return fuse_last(self.config.rule, means, covariances, weights, influence=True, **options)


def declared_correlation(intake: Intake, config: CentreConfig) -> Correlation:
    """What the sources declare of it now."""
    bounds = group_bounds(config.rule_options) if config.rule == "bci" else None
    if bounds is None:
        return Correlation(config)
    named = [intake.declared(source).correlation_group or name for name, source in sorted(intake.sources.items())]
    groups = sorted(set(named))
    number = {name: i for i, name in enumerate(groups)}
    between = np.array([[bounds.of(first, second) for second in groups] for first in groups]).reshape(
        len(groups), len(groups)
    )
    return Correlation(config, np.array([number[name] for name in named], dtype=np.intp), between)
