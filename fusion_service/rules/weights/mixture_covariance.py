"""The covariance of a mixture sum v_j N(c_j, C_j) as a function of its weights: concave in v as a matrix."""

from dataclasses import dataclass, replace
from typing import Self

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import total
from fusion_service.rules.base.matrices import weighted_sum

__all__ = ["MixtureCovariance"]


@dataclass(frozen=True, slots=True)
class MixtureCovariance:
    """A model (see `simplex`): M(v) is that covariance."""

    C: Floats  # (n, n, N, B)
    c: Floats  # (n, N, B)

    def mean(self, v: Floats) -> Floats:
        """sum v_j c_j (n, B)."""
        return total((self.c * v).swapaxes(0, 1))

    def __call__(self, v: Floats) -> tuple[Floats, Floats]:
        r = self.c - self.mean(v)[:, None]
        D = self.C + linalg.outer(r, r)
        return weighted_sum(D, v), D

    def bend(self, v: Floats, G: Floats) -> Floats:
        r = self.c - self.mean(v)[:, None]
        Gr = linalg.matvec(G[:, :, None], r)
        return 2.0 * total(r[:, :, None] * Gr[:, None])

    def take(self, index: Bools) -> Self:
        return replace(self, C=self.C[..., index], c=self.c[..., index])
