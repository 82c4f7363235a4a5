"""Recordings that were kept are fused again to the bit: each was recorded by version 0.1.0, before the restructuring.

A centre that makes other tracks of them computes something else than it did: that is a change to be told, with a new
recording, never to be tolerated here.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.review.replay import run_replay

KEPT = sorted((Path(__file__).parents[2] / "recordings").glob("*.rrd"))


def test_there_are_kept_recordings() -> None:
    assert {path.stem for path in KEPT} >= {"intensity", "memory", "mixtures", "tracks"}


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_a_kept_recording_is_made_again_to_the_bit(path: Path) -> None:
    replay = run_replay(path, verify=True, say=lambda line: None)
    assert replay.verdict is not None
    assert replay.verdict.compared > 0
    assert replay.verdict.equal == replay.verdict.compared
    assert replay.passed
    assert "recorded by version 0.1.0" in " ".join(replay.remarks)
