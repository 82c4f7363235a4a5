from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.recording import Recorder
from tests.recording.mission import Sent, mission


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Sent]]:
    """The whole made-up mission, recorded with a tick every few messages."""
    path, said = tmp_path_factory.mktemp("recordings") / "flown.rrd", list(mission())
    with Recorder(path) as recorder:
        for number, sent in enumerate(said):
            recorder.handle(sent.key, sent.data, sent.received)
            if number % 50 == 0:
                recorder.tick()
    assert not recorder.undecodable
    assert not recorder.undrawn
    return path, said
