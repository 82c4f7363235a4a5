"""Two estimates of one state, P1 = diag(a, 1) and P2 = diag(1, a), whose errors share one cross-term only:
E[e1_2 e2_1] = rho, in the components where each is the better one. With a = 4 and rho = 0.9 the table gives the largest
eigenvalue of the true mean squared error relative to the reported covariance (for HMD-GA the mean of what it
reports, which depends on the random difference of the means): above 1 the rule is too sure of itself in some
direction. The mean NEES does not show it: it averages over directions.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from studies.consistency import consistency, draw, moments
from studies.rules import fuser
from studies.study import Floats, Result, Row, Run, Study

RULES = ("naive", "ei", "ici", "hmd-ga:weights=uniform", "hmd-ga", "ci")
INDEPENDENT = {
    "naive": 1.72,
    "ei": 1.90,
    "ici": 1.44,
    "hmd-ga:weights=uniform": 1.45,
    "hmd-ga": 1.45,
    "ci": 0.86,
}
A, RHO = 4.0, 0.9


def errors(rng: np.random.Generator, runs: int) -> tuple[Floats, Floats]:
    """Errors (2, 2, M) of the two sources and their covariances (2, 2, 2, M)."""
    P = np.diag([A, 1.0, 1.0, A])
    P[1, 2] = P[2, 1] = RHO
    e = np.linalg.cholesky(P) @ rng.standard_normal((4, runs))
    covariances = np.broadcast_to(np.stack([np.diag([A, 1.0]), np.diag([1.0, A])])[..., None], (2, 2, 2, runs))
    return e.reshape(2, 2, runs), np.ascontiguousarray(covariances)


def run(run: Run) -> Result:
    e, P = errors(run.rng(), run.runs)
    rows, shown = [], {}
    for rule in (*map(fuser, RULES), *run.rules):
        fused = rule(e, P)
        one = shown[rule.label] = consistency(moments(fused.mean, fused.covariance))
        published = INDEPENDENT.get(rule.label)
        rows.append(Row(rule.label, "largest eigenvalue of MSE / reported", published, *one.excess, decimals=2))
    notes = ("The published column is that of the independent derivation that found the counter-example.",)
    title = "Reported (solid) and true (dashed) covariance, 86.5 %; grey: the naive rule's true one; red: too sure"
    return Result(tuple(rows), notes, partial(draw, shown=shown, title=title, columns=3), (9.0, 6.8))


STUDIES = (
    Study(
        name="sharma-counter-example",
        title="HMD-GA, ICI and EI are not conservative for every correlation",
        source="against Sharma 4",
        about=__doc__ or "",
        run=run,
        runs=400_000,
        quick=20_000,
        seconds=3.0,
        takes_rules=True,
    ),
)
