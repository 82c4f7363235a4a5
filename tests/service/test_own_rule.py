"""A live service whose own rule fails now and then: it says so, counts it, fuses otherwise, and never ends."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np

from schemas import GlobalTracks
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import opened

RULE = """
import numpy as np

MARK = 1e4
calls = 0


class Own(BaseException):
    pass


class Lazy:
    covariance = 0

    @property
    def mean(self):
        raise RuntimeError("not computed")


def fuse(means, covariances):
    global calls
    calls += 1
    mean, covariance = means.mean(axis=1), np.tile(MARK * np.eye(means.shape[-1]), (len(means), 1, 1))
    means[:], covariances[:] = 0, 0
    kind = calls % 9 if calls > 12 else 0  # when a config is read it is tried, and must be right
    if kind == 1:
        raise ValueError("of the rule")
    if kind == 2:
        raise SystemExit(3)
    if kind == 3:
        raise Own("of its own kind")
    if kind == 4:
        return mean[:, :1], covariance
    if kind == 5:
        return Lazy()
    if kind == 6:
        mean[0] = np.nan
    if kind == 7:
        covariance[0] = -covariance[0]
    return mean, covariance
"""
TELLS = (
    "ValueError: of the rule, line ",
    "SystemExit: 3, line ",
    "Own: of its own kind, line ",
    "gives mean (2, 1), covariance (2, 4, 4), not mean (2, 4) and covariance (2, 4, 4)",
    "RuntimeError: not computed, line ",
    "mean or covariance [0] is not finite (1 of 2 in the batch)",
    "covariance [0] is not positive definite (1 of 2 in the batch)",
)


def by_the_rule(picture: GlobalTracks) -> list[bool]:
    """Of each track that two sources have: whether the rule has fused it. The fallback's variances are a few dozen."""
    both = picture.contributor_counts == 2
    return list(picture.covariances[both, 0, 0] == 1e4)


def test_a_rule_that_fails_ends_nothing(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "my_rule.py").write_text(RULE)
    with opened(hub, tmp_path) as scene:
        service = scene.service('rule = "my_rule.py:fuse"')
        scene.sensor("r1", 0, 1)
        scene.sensor("r2", 0, 1)
        eventually(scene.seen.sees(0, 1))
        # each batch as it came out: fused by the rule, one track by the fallback, all of them
        eventually(
            lambda: (
                {(True, True), (False, True), (False, False)}
                <= {tuple(sorted(by_the_rule(one))) for one in list(scene.seen.pictures)}
            )
        )
        eventually(lambda: scene.last_status().refused.get("fusion", 0) >= 9)
        assert scene.last_status().step_time["failed"] == 0
        service.signal(signal.SIGTERM)
        code, told = service.end()
        assert code == 0
        assert [words for words in TELLS if words not in told] == []
        assert told.count("of the rule") == 1, "each kind of fault is said once"
        assert told.count("the centre fuses these tracks by equal-weight intersection") == len(TELLS)
        picture = next(one for one in scene.seen.pictures if by_the_rule(one) == [False, False])
        assert picture.rule.startswith("my_rule.py:fuse#")
        assert np.all(picture.covariances[:, 0, 0] < 1000)
        assert {entry.reason for log in scene.seen.logs for entry in log.refused if entry.reason == "fusion"}
