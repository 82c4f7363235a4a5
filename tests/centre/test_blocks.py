"""Sources that do not know the same components, fused by every rule, against dense algebra without any padding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusion_service import linalg
from fusion_service.centre.blocks import fuse_known
from fusion_service.centre.partial import SIGMA, Unknown
from fusion_service.rules import RULES, fuse, fuse_last

SPACE = ("x", "y", "z", "vx", "vy")
UNKNOWN = Unknown.of(SPACE)
NONE: dict[str, Any] = {}


def spd(rng: np.random.Generator, n: int) -> np.ndarray:
    """A covariance (n, n) with correlations, of places to tens of m and speeds to a few m/s."""
    A = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
    scale = np.array([30.0, 30.0, 80.0, 3.0, 3.0])[:n]
    return np.asarray((A @ A.T) * np.outer(scale, scale))


class Group:
    """N sources that know the components `kinds`, one element: dense, and padded, batch-last."""

    def __init__(self, seed: int, kinds: list[tuple[int, ...]]) -> None:
        rng = np.random.default_rng(seed)
        self.kinds = [np.array(kind) for kind in kinds]
        truth = rng.normal(size=5) * [1e4, 1e4, 1e3, 50, 50]
        whole = [spd(rng, 5) for _ in kinds]
        self.P = [P[np.ix_(kind, kind)] for P, kind in zip(whole, self.kinds, strict=True)]
        self.x = [rng.multivariate_normal(truth[kind], P) for P, kind in zip(self.P, self.kinds, strict=True)]
        self.means = np.zeros((len(kinds), 5, 1))
        self.covariances = np.zeros((len(kinds), 5, 5, 1))
        for i, kind in enumerate(self.kinds):
            for k in range(5):
                if k not in kind:
                    self.covariances[i, k, k, 0] = SIGMA[SPACE[k]] ** 2
            self.means[i, kind, 0] = self.x[i]
            self.covariances[i, :, :, 0][np.ix_(kind, kind)] = self.P[i]

    def fused(self, name: str, **options: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Mean, covariance, influences and the weights of the last call of the rule."""
        used = []

        def rule(x: Any, P: Any, w: Any, components: Any, at: Any) -> Any:
            out = fuse_last(name, x, P, w, influence=True, **options)
            used.append(out.weights[:, 0])
            assert out.influence is not None
            return out.mean, out.covariance, np.nan_to_num(out.influence)

        one, spread, gains = fuse_known(self.means, self.covariances, None, UNKNOWN, RULES[name].information, rule)
        return one[:, 0], spread[:, :, 0], gains[:, 0], used[-1]

    def weighted(self, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """sum scale_i P_i^-1 with exactly no information where a source knows nothing."""
        Y, y = np.zeros((5, 5)), np.zeros(5)
        for c, kind, P, x in zip(scale, self.kinds, self.P, self.x, strict=True):
            A = np.linalg.inv(P)
            Y[np.ix_(kind, kind)] += c * A
            y[kind] += c * (A @ x)
        there = np.flatnonzero(np.diag(Y) > 0)
        some = np.ix_(there, there)
        return np.linalg.solve(Y[some], y[there]), np.linalg.inv(Y[some])


FULL, FLAT, PLACE, HIGH = (0, 1, 2, 3, 4), (0, 1, 3, 4), (0, 1), (0, 1, 2)
GROUPS = [[FULL, PLACE], [PLACE, FULL, FLAT], [HIGH, FLAT], [FLAT, PLACE], [HIGH, FLAT, PLACE, FULL], [PLACE, PLACE]]


@pytest.mark.parametrize("kinds", GROUPS, ids=str)
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("naive", NONE),
        ("ci", {"criterion": "det"}),
        ("ci", {"criterion": "trace"}),
        ("bci", {"max_correlation": 0.4}),
        ("fast-ci", NONE),
        ("fast-ci", {"criterion": "trace"}),
        ("ffcc", {"delta": 0.8}),
    ],
)
def test_rules_in_information_form_are_exact_with_no_information(
    name: str, options: dict[str, Any], kinds: list[tuple[int, ...]]
) -> None:
    """With the weights that the rule has used, to 1e-7 of each sigma."""
    for seed in range(5):
        print("seed", seed)
        group = Group(seed, kinds)
        mean, covariance, gains, w = group.fused(name, **options)
        scale = np.ones(len(kinds)) if name == "naive" else w
        if name == "bci":
            scale = w / (0.6 * w + 0.4)
        x, P = group.weighted(scale)
        there = np.flatnonzero(np.isin(np.arange(5), np.concatenate(kinds)))
        sigma = np.sqrt(np.diag(P))
        assert (np.abs(mean[there] - x) < 1e-7 * sigma).all()
        np.testing.assert_allclose(
            covariance[np.ix_(there, there)] / np.outer(sigma, sigma), P / np.outer(sigma, sigma), atol=1e-7
        )
        absent = np.setdiff1d(np.arange(5), there)
        assert (covariance[absent, absent] == UNKNOWN.pad[absent]).all()
        assert (mean[absent] == 0).all()
        assert gains.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_the_weights_are_the_best_on_what_is_known(criterion: str) -> None:
    """For two sources, against a fine grid of the exact information form."""
    for seed in range(5):
        group = Group(seed, [FULL, PLACE])
        _, covariance, _, _ = group.fused("ci", criterion=criterion)
        size = np.linalg.det if criterion == "det" else np.trace
        best = min(size(group.weighted(np.array([w, 1 - w]))[1]) for w in np.linspace(1e-4, 1, 4001))
        assert size(covariance) <= best * (1 + 1e-9)
        assert size(covariance) >= best * (1 - 1e-3)


def test_bar_shalom_campo_takes_padded_sources() -> None:
    """The best linear estimate from y = H x + e with the joint covariance of the errors, none made up."""
    for seed in range(5):
        group = Group(seed, [FULL, FLAT])
        rng = np.random.default_rng(100 + seed)
        L = [np.linalg.cholesky(P) for P in group.P]
        cross = 0.3 * L[0] @ np.linalg.qr(rng.normal(size=(5, 5)))[0][:, :4] @ L[1].T
        padded = np.zeros((5, 5, 1))
        padded[:, FLAT, 0] = cross
        mean, covariance, _, _ = group.fused("bar-shalom-campo", cross_covariance=padded)
        J = np.block([[group.P[0], cross], [cross.T, group.P[1]]])
        H = np.vstack([np.eye(5), np.eye(5)[list(FLAT)]])
        Y = H.T @ np.linalg.solve(J, H)
        x = np.linalg.solve(Y, H.T @ np.linalg.solve(J, np.concatenate(group.x)))
        sigma = np.sqrt(np.diag(np.linalg.inv(Y)))
        assert (np.abs(mean - x) < 1e-6 * sigma).all()
        np.testing.assert_allclose(
            covariance / np.outer(sigma, sigma), np.linalg.inv(Y) / np.outer(sigma, sigma), atol=1e-6
        )


def test_blocks_of_the_product_are_the_product() -> None:
    """Placed block by block the naive rule gives what it gives in information form, where one source tells the rest."""
    for kinds in ([FULL, PLACE], [PLACE, HIGH, PLACE], [FLAT, PLACE, PLACE]):
        for seed in range(5):
            group = Group(seed, kinds)

            def rule(x: Any, P: Any, w: Any, components: Any, at: Any) -> Any:
                out = fuse_last("naive", x, P, w, influence=True)
                return out.mean, out.covariance, out.influence

            mean, covariance, gains = fuse_known(group.means, group.covariances, None, UNKNOWN, False, rule)
            x, P = group.weighted(np.ones(len(kinds)))
            sigma = np.sqrt(np.diag(P))
            there = np.flatnonzero(mean[:, 0])
            some = np.ix_(there, there)
            assert (np.abs(mean[there, 0] - x) < 1e-9 * sigma).all()
            both = np.outer(sigma, sigma)
            np.testing.assert_allclose(covariance[:, :, 0][some] / both, P / both, atol=1e-9)
            assert gains.sum() == pytest.approx(1.0)


BLOCKED = [name for name, rule in RULES.items() if not rule.information]


@pytest.mark.parametrize("name", BLOCKED)
def test_other_rules_fuse_the_common_block_and_keep_how_the_rest_goes_with_it(name: str) -> None:
    """Of a full source, one on the plane and one of places: densities multiplied out by hand."""
    options: dict[str, Any] = {"samples": 2000, "seed": 3} if name in ("hmd-s", "gmd-s") else {}

    def by_rule(group: Group, sources: list[int], components: list[int]) -> tuple[np.ndarray, np.ndarray]:
        x = [group.means[i, components, 0] for i in sources]
        P = [group.covariances[i][np.ix_(components, components)][:, :, 0] for i in sources]
        out = fuse(name, np.array(x), np.array(P), **options)
        return out.mean, out.covariance

    for seed in range(3):
        group = Group(seed, [FULL, FLAT, PLACE])
        mean, covariance, _, _ = group.fused(name, **options)

        common, P_common = by_rule(group, [0, 1, 2], [0, 1])
        np.testing.assert_allclose(mean[:2], common, rtol=1e-9)
        np.testing.assert_allclose(covariance[:2, :2], P_common, rtol=1e-9)
        # p(v | place) of the two that know it, then p(z | place, v) of the one that does
        order = [0, 1, 3, 4, 2]
        x, P = common, P_common
        for sources, count in (([0, 1], 4), ([0], 5)):
            own, P_own = by_rule(group, sources, order[:count])
            k = len(x)
            turn = P_own[k:, :k] @ np.linalg.inv(P_own[:k, :k])
            rest = P_own[k:, k:] - turn @ P_own[:k, k:]
            x = np.concatenate([x, own[k:] + turn @ (x - own[:k])])
            P = np.block([[P, P @ turn.T], [turn @ P, rest + turn @ P @ turn.T]])
        sigma = np.sqrt(np.diag(P))
        assert (np.abs(mean[order] - x) < 1e-8 * sigma).all()
        np.testing.assert_allclose(
            covariance[np.ix_(order, order)] / np.outer(sigma, sigma), P / np.outer(sigma, sigma), atol=1e-8
        )
        assert np.linalg.eigvalsh(covariance / np.outer(sigma[[0, 1, 4, 2, 3]], sigma[[0, 1, 4, 2, 3]])).min() > 0


@pytest.mark.parametrize("name", list(RULES))
def test_sources_that_know_the_same_are_fused_as_if_there_were_no_more(name: str) -> None:
    if name == "bar-shalom-campo":
        pytest.skip("needs a cross-covariance")
    for kind in (PLACE, FLAT, HIGH):
        group = Group(7, [kind, kind])
        mean, covariance, _, _ = group.fused(name)
        alone = fuse(name, np.array(group.x), np.array(group.P))
        at = list(kind)
        np.testing.assert_array_equal(mean[at], alone.mean)
        np.testing.assert_array_equal(covariance[np.ix_(at, at)], alone.covariance)


def test_kinds_in_one_batch_do_not_touch_each_other() -> None:
    """Bits of an element are the same in any batch, whatever the others know."""
    several: list[list[tuple[int, ...]]] = [[FULL, PLACE], [FLAT, FULL], [PLACE, PLACE]]
    groups = [Group(seed, kinds) for seed, kinds in enumerate(several)]
    means = np.concatenate([one.means for one in groups], axis=-1)
    covariances = np.concatenate([one.covariances for one in groups], axis=-1)
    for name in ("ci", "ici"):

        def rule(x: Any, P: Any, w: Any, components: Any, at: Any, name: str = name) -> Any:
            out = fuse_last(name, x, P, w, influence=True)
            return out.mean, out.covariance, out.influence

        whole = fuse_known(means, covariances, None, UNKNOWN, RULES[name].information, rule)
        for k, one in enumerate(groups):
            mean, covariance, _, _ = one.fused(name)
            np.testing.assert_array_equal(whole[0][:, k], mean)
            np.testing.assert_array_equal(whole[1][:, :, k], covariance)


def test_padding_costs_no_digits() -> None:
    """The condition that decides whether a fusion is refused is that of the correlations."""
    group = Group(1, [FULL, PLACE])
    P = group.covariances[1]
    assert linalg.condition(P, linalg.inverse(P))[0] == pytest.approx(
        linalg.condition(P[:2, :2], linalg.inverse(P[:2, :2]))[0]
    )
