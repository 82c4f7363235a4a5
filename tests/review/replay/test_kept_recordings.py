"""Recordings that were kept: those of this release are fused again to the bit, those of earlier ones are fused again.

A centre that makes other tracks of a recording of its own release computes something else than it did: that is a change
to be told, with a new release and new recordings (`python -m tests.recordings.make`), never to be tolerated here.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.review.replay import run_replay

FOLDER = Path(__file__).parents[2] / "recordings"
KEPT = sorted(FOLDER.glob("*.rrd"))
EARLIER = sorted(FOLDER.glob("*/*.rrd"))
NAMES = {"intensity", "memory", "mixtures", "tracks"}


def test_there_are_kept_recordings() -> None:
    assert {path.stem for path in KEPT} == {path.stem for path in EARLIER} == NAMES


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_a_kept_recording_is_made_again_to_the_bit(path: Path) -> None:
    replay = run_replay(path, verify=True, say=lambda line: None)
    assert replay.verdict is not None
    assert replay.verdict.compared > 0
    assert replay.verdict.equal == replay.verdict.compared
    assert replay.passed
    assert replay.remarks == []


@pytest.mark.parametrize("path", EARLIER, ids=lambda path: f"{path.parent.name} {path.stem}")
def test_a_recording_of_an_earlier_release_is_fused_again(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.rrd"
    replay = run_replay(path, settings=["coast=6.0"], out=out, draw=False, say=lambda line: None)
    assert f"recorded by version {path.parent.name}" in " ".join(replay.remarks)
    assert [player.steps > 10 for player in replay.players] == [True]
    assert out.exists()
