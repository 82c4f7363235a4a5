"""What a rule declares of itself, in the one file that it is.

    RULE = Rule(
        name="mean",
        title="plain mean",
        promise="none",
        source="folklore",
        fuse=mean,
        takes={"power": Option(1.0, positive)},
    )

`fuse(sources, weights, influence, **options) -> Result` takes a block of estimates (`block.Sources`), given weights
(N, B) or None, whether influences are wanted, and its options, checked. It is called with NumPy's warnings off, and
trusted to say in `Result.condition` and `Result.gap` how far its answer can be relied on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures
from fusion_service.rules.base.block import Result
from fusion_service.rules.base.options import Option

__all__ = ["Declaration", "MixtureRule", "Option", "Rule"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """A rule, for people and programs to choose by."""

    name: str
    title: str = ""
    """What it is, in a few words"""
    promise: str
    source: str
    takes: Mapping[str, Option] = field(default_factory=dict)
    """Its options, with their checks"""
    n_way: bool = True
    """False for a rule for two sources; `base.chain` applies such a one to more"""
    order: int = 100
    """Where it stands among the others in lists: the smaller the earlier, equal ones by name"""

    @property
    def options(self) -> dict[str, Any]:
        """Option names with their defaults."""
        return {name: option.default for name, option in self.takes.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule(Declaration):
    """A rule for Gaussians."""

    fuse: Callable[..., Result]
    takes_weights: bool = True
    information: bool = False
    """Whether it takes sources that do not know of all components, padded with variances so large that they are no
    information: its formula must be one of inverse covariances"""
    at_once: Callable[[Floats, Floats], tuple[Floats, Floats, Floats] | None] | None = None
    """A faster road, where there is one, from means (B, N, n) and covariances (B, N, n, n) to mean (B, n), covariance
    (B, n, n) and condition (B,), NaN for what it cannot do: the same bits; for a rule without options and weights. None
    where it cannot be taken now."""
    refusal: str = "is too ill-conditioned to fuse to within 1e-6"
    """Why a fusion of sound sources is refused."""

    def part(self, chosen: dict[str, Any], index: Any) -> dict[str, Any]:
        """The chosen options of some elements of the batch."""
        each = [
            name
            for name, option in self.takes.items()
            if option.per_element and np.ndim(chosen[name]) > option.per_element
        ]
        return chosen | {name: chosen[name][..., index] for name in each} if each else chosen


@dataclass(frozen=True, slots=True, kw_only=True)
class MixtureRule(Declaration):
    """A rule for Gaussian mixtures.

    `fuse(sources, weights, prune, **options)` takes N batches of B mixtures, weights (N, B) or None, and the share of
    the mass below which a component is dropped afterwards. It returns the fused mixtures, not yet normalised or
    reduced, and the weights it used (N, B).
    """

    fuse: Callable[..., tuple[Mixtures, Floats]]
    intensities: bool = True
    """Whether it fuses intensities too, whose masses count"""
    information: bool = False
    """As for `Rule`"""
    multiplies: bool = True
    """Whether the fused components are all combinations of the sources' components, not their union"""
