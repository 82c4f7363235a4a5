"""Networks of nodes that filter, send and fuse: what each node's filter has, alone and jointly, and the way of the
estimates to the last node by a rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from sensor_clients.filters import kalman
from studies.consistency import Consistency
from studies.statistics import Estimate
from studies.study import Floats

__all__ = ["PRIORS", "Model", "Network", "Reading", "joint", "known", "local", "walk"]

PRIORS = ("independent", "common")
Network = tuple[tuple[int, tuple[int, ...]], ...]
"""(node, whose results it receives), in the order of fusion; the last node has the result."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What the nodes see: H and R (nodes, 2, 2) at each of `steps` times of x' = F x + w, w ~ N(0, Q), Q diagonal;
    prior: the covariance of an initial estimate of mean (0, 1)."""

    H: Floats
    R: Floats
    prior: Floats
    steps: int
    F: Floats
    Q: Floats


class Reading(NamedTuple):
    """A network, the rules to try in it, and whether a node fuses all it has at once, or two at a time: its own, then
    each that it receives."""

    name: str
    network: Network
    model: Model
    rules: tuple[str, ...]
    at_once: bool = False


def local(
    model: Model, prior: str, rng: np.random.Generator, runs: int
) -> tuple[list[kalman.Estimate], kalman.Estimate]:
    """Errors (2, M) and covariances (2, 2, 1) of every node's own filter, and of the centralised one.

    The truth is taken from the means at the end: every rule is indifferent to a shift of the state."""
    nodes = len(model.H)
    root = np.linalg.cholesky(model.prior)
    P = model.prior[..., None]
    guess = np.broadcast_to(np.array([[0.0], [1.0]]), (2, runs))
    if prior == "common":
        x = guess + root @ rng.standard_normal((2, runs))
        own = [kalman.Estimate(guess, P)] * nodes
        centre = own[0]
    else:
        x = guess
        own = [kalman.Estimate(guess + root @ rng.standard_normal((2, runs)), P) for _ in range(nodes)]
        centre = kalman.Estimate(np.mean([one.mean for one in own], axis=0), P / nodes)
    noise = np.linalg.cholesky(model.R)
    for _ in range(model.steps):
        x = model.F @ x + np.sqrt(model.Q) @ rng.standard_normal((2, runs))
        own = [kalman.predict(one, model.F, model.Q) for one in own]
        centre = kalman.predict(centre, model.F, model.Q)
        for i in range(nodes):
            z = model.H[i] @ x + noise[i] @ rng.standard_normal((2, runs))
            own[i] = kalman.update(own[i], model.H[i], model.R[i], z)
            centre = kalman.update(centre, model.H[i], model.R[i], z)
    return [one._replace(mean=one.mean - x) for one in own], centre._replace(mean=centre.mean - x)


def joint(model: Model, prior: str) -> tuple[Floats, Floats]:
    """Exactly, for comparison: the covariance (2 nodes, 2 nodes) of all nodes' errors together, and what each node
    reports (nodes, 2, 2)."""
    nodes = len(model.H)
    shared = np.ones((nodes, nodes)) if prior == "common" else np.eye(nodes)
    J: Floats = np.kron(shared, model.prior).astype(np.float64)
    P = np.stack([model.prior] * nodes)
    everywhere, Ht = np.kron(np.eye(nodes), model.F), model.H.transpose(0, 2, 1)
    for _ in range(model.steps):
        J = everywhere @ J @ everywhere.T + np.kron(np.ones((nodes, nodes)), model.Q)
        P = model.F @ P @ model.F.T + model.Q
        K = P @ Ht @ np.linalg.inv(model.H @ P @ Ht + model.R)
        keep = np.eye(2) - K @ model.H
        J = block_diag(*keep) @ J @ block_diag(*keep).T + block_diag(*(K @ model.R @ K.transpose(0, 2, 1)))
        P = keep @ P
    return J, P


def known(model: Model, prior: str) -> Consistency:
    """The best linear fusion of what all nodes have, its gains summing to one, with every cross-covariance known
    (Bar-Shalom and Campo)."""
    J, P = joint(model, prior)
    H = np.kron(np.ones((len(P), 1)), np.eye(2))
    C = np.linalg.inv(H.T @ np.linalg.solve(J, H))
    trace = Estimate(float(np.trace(C)), 0.0)
    return Consistency(trace, trace, Estimate(1.0, 0.0), C, C)


def walk(
    reading: Reading, rule: Callable[[Floats, Floats], Any], own: Sequence[kalman.Estimate]
) -> tuple[Floats, Floats]:
    """Mean (2, M) and covariance (2, 2, M) of the last node."""
    held: dict[int, tuple[Floats, Floats]] = {}
    for node, parents in reading.network:
        x, P = own[node - 1].mean, np.broadcast_to(own[node - 1].covariance, (2, *own[node - 1].mean.shape))
        received = [held[parent] for parent in parents]
        for batch in [received] if reading.at_once and received else [[one] for one in received]:
            together = [(x, P), *batch]
            fused = rule(np.stack([one[0] for one in together]), np.stack([one[1] for one in together]))
            x, P = fused.mean, fused.covariance
        held[node] = x, P
    return x, P
