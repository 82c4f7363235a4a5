"""What is derived of the correlation of local tracks, beside the joint covariance that there is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.arrays import Floats
from fusion_service.centre import FusionCentre
from fusion_service.centre.correlation import Correlation
from fusion_service.centre.derived import Derived, Followed, _largest
from fusion_service.centre.shared_noise import SharedNoise
from fusion_service.config import centre_config
from fusion_service.rules import fuse
from schemas import Motion
from tests.centre.worlds import FRAME, START
from tests.helpers.filters import SPACE, Filters, moved, steps

SEED = 12
NAMES = ("s0", "s1", "s2")
SIGMAS = np.array([[1.0, 5.0], [3.0, 5.0], [10.0, 5.0]])
WORLDS: dict[str, dict[str, Any]] = {
    "together": {"periods": (1.0, 1.0, 1.0), "offsets": (1.0, 1.0, 1.0)},
    "unequal periods": {"periods": (0.5, 1.0, 3.0), "offsets": (0.5, 1.0, 3.0)},
    "asynchronous": {"periods": (0.7, 1.1, 2.3), "offsets": (0.13, 0.9, 1.7)},
    "misses": {"periods": (1.0, 1.0, 1.3), "offsets": (0.5, 1.0, 0.2), "lost": 0.3},
}


def noise(q: float = 0.5, count: int = 3) -> SharedNoise:
    return SharedNoise([Motion("cv", q)] * count, SPACE)


def followed(filters: Filters, seconds: int, derived: Derived | None = None) -> list[tuple[Followed, Floats]]:
    """What is known after each step, and the truth."""
    derived = derived or Derived(4)
    out = []
    for time, heard in steps(filters, seconds):
        rows = filters.rows()
        sound = np.ones(len(rows.source), dtype=np.bool_)
        now = derived.follow(rows, NAMES[: len(filters.sigma)], heard, noise(filters.q), sound, time)
        out.append((now, filters.blocks()))
    return out


def whitened(filters: Filters, C: Floats) -> Floats:
    """L_i^-1 C_ij L_j^-T (N, N, T, n, n)."""
    N, T = filters.sigma.shape
    W = np.linalg.inv(np.linalg.cholesky(filters.rows().tracks.covariance.transpose(2, 0, 1))).reshape(N, T, 4, 4)
    return np.asarray(np.einsum("itab,ijbct,jtdc->ijtad", W, C, W))


@pytest.mark.parametrize("world", WORLDS)
def test_it_is_the_true_cross_covariance_once_the_start_is_forgotten(world: str) -> None:
    filters = Filters(SIGMAS, **WORLDS[world])
    ((now, true),) = followed(filters, 200)[-1:]
    R, C, unknown = now.of(filters.members())
    assert unknown.max() == 0.0
    for i, j in ((0, 1), (0, 2), (1, 2)):
        scale = np.sqrt(np.einsum("aat,bbt->abt", true[i, i], true[j, j]))
        assert (np.abs(C[i, j] - true[i, j]) <= 1e-9 * scale).all()
        np.testing.assert_array_equal(C[j, i], C[i, j].swapaxes(0, 1))
    assert 0.2 < R[0, 1].min() < R[0, 1].max() < 1.0


@pytest.mark.parametrize("world", WORLDS)
def test_the_bound_holds_from_the_first_step(world: str) -> None:
    """All three start from one and the same estimate, the worst start there is."""
    filters = Filters(SIGMAS, **WORLDS[world])
    derived = Derived(4)
    loose = []
    for time, heard in steps(filters, 40):
        rows = filters.rows()
        now = derived.follow(rows, NAMES, heard, noise(), np.ones(len(rows.source), dtype=np.bool_), time)
        R, C, unknown = now.of(filters.members())
        true = whitened(filters, filters.blocks())
        largest = np.linalg.norm(true, 2, axis=(-2, -1))
        rest = np.linalg.norm(true - whitened(filters, C), 2, axis=(-2, -1))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            assert (largest[i, j] <= R[i, j] + 1e-9).all()
            assert (rest[i, j] <= unknown + 1e-9).all()
            loose.append(R[i, j] - largest[i, j])
    assert np.max(loose[-3:]) < 0.05


def excess(filters: Filters, rule: str, now: Followed) -> Floats:
    """The largest eigenvalue (T,) of the true error of the fusion relative to the one reported."""
    N, T = filters.sigma.shape
    options = {"max_correlation": "derived"} if rule == "bci" else {"cross": "derived"}
    known = Correlation(centre_config({"rule": rule, "rule_options": options}), followed=now)
    rows, members = filters.rows(), filters.members()
    P = np.moveaxis(rows.tracks.covariance[:, :, members], 3, 0)
    gains, reported = np.zeros((4, N * 4, T)), np.zeros((4, 4, T))
    for column in range(N * 4):  # the gains are those of unit errors
        means = np.zeros((N, 4, T))
        means[column // 4, column % 4] = 1.0
        fused, _ = known.fuse(rows, members, means, np.ascontiguousarray(P), None, np.arange(4))
        gains[:, column], reported = fused.mean, fused.covariance
    K, S = gains.transpose(2, 0, 1), reported.transpose(2, 0, 1)
    W = np.linalg.inv(np.linalg.cholesky(S))
    return np.asarray(np.linalg.eigvalsh(W @ K @ filters.J @ K.swapaxes(1, 2) @ W.swapaxes(1, 2))[:, -1])


@pytest.mark.parametrize("world", WORLDS)
def test_fusion_by_it_is_as_good_as_it_says(world: str) -> None:
    filters = Filters(SIGMAS, **WORLDS[world])
    ((now, _),) = followed(filters, 80)[-1:]
    assert now.of(filters.members())[2].max() < 1e-5
    np.testing.assert_allclose(excess(filters, "bar-shalom-campo", now), 1.0, atol=1e-4)
    honest = excess(filters, "bci", now)
    assert (honest <= 1.0 + 1e-9).all()
    assert (honest > 0.6).all()


def test_before_the_start_is_forgotten_the_cross_covariance_is_not_taken_as_known() -> None:
    filters = Filters(SIGMAS, **WORLDS["together"])
    seen = followed(filters, 2)
    assert seen[0][0].of(filters.members())[2].max() == 1.0
    assert (excess(filters, "bar-shalom-campo", seen[-1][0]) <= 1.0 + 1e-9).all()


def test_messages_that_are_not_heard_make_it_less_than_exact() -> None:
    """Two updates told as one are not one update. This is how far it is off at 30 % of loss."""
    filters = Filters(SIGMAS, **WORLDS["together"], unheard=0.3)
    derived, found = Derived(4), []
    for time, heard in steps(filters, 120):
        rows = filters.rows()
        now = derived.follow(rows, NAMES, heard, noise(), np.ones(len(rows.source), dtype=np.bool_), time)
        if time > 60 * 10**9 and time // 10**9 % 3 == 0:
            found.append([excess(filters, rule, now).max() for rule in ("bar-shalom-campo", "bci")])
    optimal, honest = np.array(found).T
    assert len(optimal) == 20
    assert 1.02 < optimal.max() < 1.2
    assert optimal.mean() < 1.06
    assert honest.max() < 1.03


def test_the_larger_of_two_declared_noises_counts_and_different_motions_have_none() -> None:
    motions = [Motion("cv", 0.5), Motion("cv", 2.0), None, Motion("ct", 1.0, 0.1)]
    shared = SharedNoise(motions, (*SPACE, "turn_rate"))
    assert shared.of(np.array([0, 1, 0, 2]), np.array([1, 1, 3, 0])).tolist() == [1, 1, -1, -1]
    flat = SharedNoise(motions, SPACE)
    F, Q = flat.between(flat.of(np.array([0, 0]), np.array([0, 1])), np.array([1.5, 0.5]))
    for k, (q, dt) in enumerate(((0.5, 1.5), (2.0, 0.5))):
        np.testing.assert_allclose(F[:, :, k], moved(q, dt)[0])
        np.testing.assert_allclose(Q[:, :, k], moved(q, dt)[1])


def test_a_chain_that_is_broken_begins_anew() -> None:
    """An old update that comes after a newer one of the other source, a relink, a restart."""
    filters = Filters(SIGMAS[:2], periods=(1.0, 1.0), offsets=(0.5, 1.0))
    derived = Derived(4)
    first, *_ = followed(filters, 30, derived)[-1:]
    assert first[0].unknown.max() < 0.05
    heard = filters.until(31.0)
    late = heard.time - np.where(heard.row < 2, 2 * 10**9, 0)
    rows = filters.rows()
    every = np.ones(4, dtype=np.bool_)
    broken = derived.follow(
        rows, NAMES[:2], type(heard)(**{**vars(heard), "time": late}), noise(count=2), every, 31 * 10**9
    )
    np.testing.assert_array_equal(broken.bound, 1.0)
    apart = filters.rows(np.array([1, 2, 3, 4], dtype=np.uint64))
    none = derived.follow(apart, NAMES[:2], filters.until(32.0), noise(count=2), every, 32 * 10**9)
    assert not len(none.key)
    assert not len(derived)


def test_a_packed_state_goes_on_bit_by_bit() -> None:
    one, other = (Filters(SIGMAS, **WORLDS["asynchronous"]) for _ in range(2))
    first, second = Derived(4), Derived(4)
    followed(one, 12, first)
    followed(other, 12, second)
    restored = Derived(4)
    restored.restore(second.packed())
    for k in range(13, 20):
        results = []
        for filters, state in ((one, first), (other, restored)):
            heard, rows = filters.until(float(k)), filters.rows()
            results.append(state.follow(rows, NAMES, heard, noise(), np.ones(6, dtype=np.bool_), k * 10**9))
        for name in ("key", "cross", "bound", "unknown"):
            np.testing.assert_array_equal(getattr(results[0], name), getattr(results[1], name))
    assert first.packed() == restored.packed()
    strange = Derived(6)
    strange.restore(first.packed())
    assert not len(strange)


def test_rows_that_are_no_filter_have_a_bound_of_one_and_room_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    filters = Filters(SIGMAS, **WORLDS["together"])
    derived = Derived(4)
    sound = np.array([True, True, True, True, False, True])
    for time, heard in steps(filters, 40):
        now = derived.follow(filters.rows(), NAMES, heard, noise(), sound, time)
    R, _, unknown = now.of(filters.members())
    assert (R[0, 1] < 1.0).all()
    assert R[0, 2, 0] == R[1, 2, 0] == unknown[0] == 1.0
    assert R[0, 2, 1] < 1.0
    assert derived.beyond == 0
    monkeypatch.setattr("fusion_service.centre.derived.MOST_PAIRS", 2)
    derived.follow(filters.rows(), NAMES, filters.until(41.0), noise(), sound, 41 * 10**9)
    assert (len(derived), derived.beyond) == (2, 2)


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_the_largest_singular_value_is_never_below_the_true_one(n: int) -> None:
    rng = np.random.default_rng(SEED)
    M = rng.normal(size=(500, n, n)) * 10.0 ** rng.uniform(-8, 3, size=(500, 1, 1))
    M[:50] = np.linalg.qr(M[:50])[0]  # all singular values equal
    M[50] = 0.0
    found, true = _largest(M.transpose(1, 2, 0)), np.linalg.norm(M, 2, axis=(1, 2))
    assert (found >= true).all()
    assert (found <= true * n ** (1 / 128) * (1 + 1e-8)).all()


def messages(filters: Filters, seconds: int) -> list[schemas.Message]:
    T = filters.sigma.shape[1]
    means = np.stack([1000.0 * np.arange(T), np.zeros(T), np.zeros(T), np.zeros(T)], axis=1)
    return [
        schemas.LocalTracks(
            source=name,
            epoch=1,
            seq=seconds,
            sent=START,
            time=START + round(time * 10**9),
            complete=True,
            space=SPACE,
            frame=FRAME,
            ids=np.arange(1, T + 1).astype(np.uint64),
            means=means,
            covariances=P,
        )
        for name, (time, P) in zip(NAMES, filters.told, strict=False)
    ]


@pytest.mark.parametrize(
    ("rule", "options"), [("bar-shalom-campo", {"cross": "derived"}), ("bci", {"max_correlation": "derived"})]
)
def test_a_centre_fuses_by_it_and_goes_on_after_a_restart(rule: str, options: dict[str, str]) -> None:
    """What it publishes is what the truth makes of the tracks, and is the same in any order of arrival and from a
    checkpoint."""
    config = {"rule": rule, "rule_options": options, "space": SPACE, "frame": FRAME, "lateness": 1.0}
    whole, turned = (FusionCentre(config) for _ in range(2))
    filters = Filters(SIGMAS, periods=(1.0, 1.1, 2.3), offsets=(0.13, 0.9, 1.7))  # no two updates between two steps
    for one in (whole, turned):
        for name in NAMES:
            info = schemas.SensorInfo(
                source=name, epoch=1, seq=0, sent=START, frame=FRAME, period=1.0, motion=Motion("cv", 0.5),
                position=(0.0, 0.0, 0.0),
            )  # fmt: skip
            one.handle(info, START)
    restarted, compared = 20, 35  # s; the other goes no further: by 60 s the start is forgotten
    for time, _ in steps(filters, 60):
        sent = messages(filters, time // 10**9)
        results = []
        for one in (whole, *([turned] if time <= compared * 10**9 else [])):
            for message in sent if one is whole else sent[::-1]:
                one.handle(message, START + time)
            results.append(one.step(START + time).tracks)
        for other in results[1:]:
            for name in ("ids", "means", "covariances", "contributor_influence"):
                np.testing.assert_array_equal(getattr(other, name), getattr(results[0], name))
        assert (len(results) == 2) is (time <= compared * 10**9)
        if time == restarted * 10**9:
            turned = FusionCentre(config, turned.checkpoint())
    published = results[0]
    true = filters.J
    H = np.tile(np.eye(4), (3, 1))
    best = np.linalg.inv(H.T @ np.linalg.inv(true) @ H)
    assert len(published.ids) == 2
    ratio = np.trace(published.covariances, axis1=1, axis2=2) / np.trace(best, axis1=1, axis2=2)
    if rule == "bar-shalom-campo":
        np.testing.assert_allclose(published.covariances, best, rtol=1e-4, atol=1e-6)
    else:
        P = np.moveaxis(filters.rows().tracks.covariance[:, :, filters.members()], (2, 3), (0, 1))
        ci = fuse("ci", np.zeros(P.shape[:-1]), P).covariance
        assert (ratio >= 1.0).all()
        assert (np.linalg.det(published.covariances) < [1.0 + 1e-5, 0.9] * np.linalg.det(ci)).all()
