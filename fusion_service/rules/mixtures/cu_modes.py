"""Covariance union of modes that conflict, covariance intersection of those that agree.

For each choice of a component from every source, weighed by the product of the alphas: covariance intersection of the
modes if every two of them agree, (m_i - m_j)' (P_i + P_j)^-1 (m_i - m_j) within the quantile `gate` of chi-square, and
their covariance union if they conflict. A mode of any source keeps its weight, spread over components that cover it
where the others conflict with it; where they agree, all are taken for right.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures, log_sum
from fusion_service.linalg import total
from fusion_service.rules.base.options import CRITERION, Case, Option, RuleError
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.face.gaussians import fuse_last

__all__ = ["RULE", "cu_modes"]


def cu_modes(
    sources: Sequence[Mixtures], weights: Floats | None, prune: float, *, criterion: str, gate: float
) -> tuple[Mixtures, Floats]:
    """Covariance union or intersection of modes. What will be pruned, which the weights tell, is not computed."""
    N, n, B = len(sources), len(sources[0].means), len(sources[0])
    w = np.full((N, B), 1.0 / N) if weights is None else weights
    choice = np.indices([len(f.log_weights) for f in sources]).reshape(N, -1)
    logs = total(np.stack([f.log_weights[c] for f, c in zip(sources, choice, strict=True)]))
    light = (logs < log_sum(logs) + np.log(prune)) & (logs < logs.max(axis=0))
    logs = np.where(light, -np.inf, logs)
    part, b = np.nonzero(~np.isneginf(logs))
    x = np.stack([f.means[:, c[part], b] for f, c in zip(sources, choice, strict=True)])
    P = np.stack([f.covariances[:, :, c[part], b] for f, c in zip(sources, choice, strict=True)])
    limit = 2.0 * gammaincinv(n / 2.0, gate)
    conflict = np.zeros(len(part), dtype=np.bool_)
    for i in range(N):
        for j in range(i):
            conflict |= linalg.quadratic(P[i] + P[j], x[i] - x[j]) > limit
    means = np.zeros((n, *logs.shape))
    covariances = np.zeros((n, n, *logs.shape))
    covariances[range(n), range(n)] = 1.0
    for rule, at in (("ci", ~conflict), ("cu", conflict)):
        given = w[:, b[at]] if rule == "cu" or weights is not None else None
        fused = fuse_last(rule, x[..., at], P[..., at], given, criterion=criterion)
        means[:, part[at], b[at]], covariances[:, :, part[at], b[at]] = fused.mean, fused.covariance
    return Mixtures(logs, means, covariances), w


def _gate(name: str, value: Any, case: Case) -> float:
    if not (isinstance(value, float) and 0.0 < value < 1.0):
        raise RuleError(f"{name} {value!r}: a probability between 0 and 1")
    return value


RULE = MixtureRule(
    name="cu-modes",
    order=5,
    title="union of modes that conflict, intersection of those that agree",
    promise="conservative where modes conflict if one of them is, and where they agree if all are",
    source="covariance union of modes that conflict, covariance intersection of those that agree",
    fuse=cu_modes,
    takes={"criterion": CRITERION, "gate": Option(0.99, _gate)},
    intensities=False,
)
