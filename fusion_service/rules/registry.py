"""The rules there are: what each is and promises, and the function that computes it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from fusion_service.rules.average import aa
from fusion_service.rules.closed_form import fast_ci, ffcc
from fusion_service.rules.dispersion import hmd_ga
from fusion_service.rules.ellipsoidal import ei
from fusion_service.rules.intersection import bci, ci
from fusion_service.rules.inverse import ici
from fusion_service.rules.known import bar_shalom_campo
from fusion_service.rules.product import naive
from fusion_service.rules.sampled import gmd_s, hmd_s
from fusion_service.rules.sources import Result
from fusion_service.rules.union import cu
from fusion_service.rules.units import in_units


@dataclass(frozen=True, slots=True)
class Rule:
    """A fusion rule, for people and programs to choose by."""

    name: str
    promise: str
    n_way: bool
    options: Mapping[str, Any]
    """Option names with their defaults."""
    source: str
    takes_weights: bool = True
    refusal: str = "is too ill-conditioned to fuse to within 1e-6"
    """Why a fusion of sound sources is refused."""


FUNCTIONS: dict[str, Callable[..., Result]] = {
    "naive": naive,
    "ci": in_units(ci),
    "bci": in_units(bci),
    "fast-ci": in_units(fast_ci),
    "ffcc": in_units(ffcc),
    "bar-shalom-campo": bar_shalom_campo,
    "ici": in_units(ici),
    "ei": ei,
    "hmd-ga": in_units(hmd_ga),
    "hmd-s": in_units(hmd_s),
    "gmd-s": in_units(gmd_s),
    "aa": aa,
    "cu": in_units(cu),
}
_SAMPLED = {"criterion": "det", "scales": None, "samples": 5000, "alpha": 1.0, "seed": 0}
_TOO_FAR = "is too ill-conditioned to fuse, or its sources are too far apart for this many samples"

RULES: Mapping[str, Rule] = MappingProxyType(
    {
        rule.name: rule
        for rule in (
            Rule("naive", "right only for independent tracks", True, {}, "product of the densities", False),
            Rule(
                "ci",
                "conservative for every correlation",
                True,
                {"criterion": "det", "scales": None},
                "covariance intersection (Julier and Uhlmann 1997; Sharma (4); Li-AA)",
            ),
            Rule(
                "bci",
                "conservative for every correlation within the bound; tight for two sources",
                True,
                {"criterion": "det", "scales": None, "max_correlation": 1.0},
                "bounded covariance inflation (Reece and Roberts 2005), N-way",
            ),
            Rule(
                "fast-ci",
                "conservative for every correlation",
                True,
                {"criterion": "det", "scales": None},
                "CI, weights in closed form: Franken and Huepper 2005 (det), Niehsen 2002 (trace)",
            ),
            Rule(
                "ffcc",
                "conservative for every correlation, also of sources that understate their covariance by delta",
                True,
                {"criterion": "det", "scales": None, "delta": 0.9},
                "CI, weights in closed form that sum to delta (Wang and Li 2009; Li-AA after (18))",
            ),
            Rule(
                "bar-shalom-campo",
                "optimal (linear) for the cross-covariance given",
                False,
                {"cross_covariance": None},
                "Bar-Shalom and Campo 1986; two sources",
                False,
                "is too ill-conditioned to fuse, or its joint covariance is not positive definite",
            ),
            Rule(
                "ici",
                "conservative under its own correlation structure only",
                False,
                {"criterion": "det", "scales": None},
                "inverse covariance intersection (Noack et al. 2017; Sharma (47), (55)); smallest det first",
            ),
            Rule(
                "ei",
                "none in general",
                False,
                {},
                "ellipsoidal intersection (Sijs and Lazar 2012); smallest det first",
                False,
            ),
            Rule(
                "hmd-ga",
                "tight; none in general",
                True,
                {"criterion": "det", "scales": None, "constants": True},
                "harmonic mean density, Gaussian approximation: Sharma (31), (77); Dubey (14)-(29)",
            ),
            Rule(
                "hmd-s",
                "as conservative as alpha makes it",
                True,
                dict(_SAMPLED),
                "harmonic mean density, sampled: Sharma (21), (66)-(72)",
                refusal=_TOO_FAR,
            ),
            Rule(
                "gmd-s",
                "as conservative as alpha makes it",
                True,
                dict(_SAMPLED),
                "geometric mean density, sampled: Sharma (61)-(65)",
                refusal=_TOO_FAR,
            ),
            Rule(
                "aa",
                "fault tolerant; a mixture keeps modes",
                True,
                {"criterion": "uniform"},
                "arithmetic average, merged: Li-AA (5), (10), (40), (45)",
            ),
            Rule(
                "cu",
                "conservative if one source is (max)",
                True,
                {"criterion": "det", "scales": None, "bound": "max"},
                "covariance union (Uhlmann; Li-AA (7)-(9))",
            ),
        )
    }
)
