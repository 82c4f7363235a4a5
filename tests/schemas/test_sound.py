"""What is published is not read again to be sure of it, but where a reader might not take it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import schemas
from schemas import Enu, LocalTracks, MessageError, codec


def scan(count: int) -> LocalTracks:
    return LocalTracks(
        source="s", epoch=1, seq=1, sent=0, time=0, complete=True, space=("x", "y", "vx", "vy"),
        frame=Enu(59.0, -55.0), ids=np.arange(count, dtype=np.uint64), means=np.zeros((count, 4)),
        covariances=np.tile(np.eye(4), (count, 1, 1)),
    )  # fmt: skip


def test_a_sound_message_is_read_again_only_where_a_reader_may_refuse_it(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    decode = codec.decode

    def noted(data: bytes) -> schemas.Message:
        read.append(len(data))
        return decode(data)

    monkeypatch.setattr(codec, "decode", noted)
    large = scan(5000)
    assert codec.encode(large, sound=True) == codec.encode(large)
    assert len(read) == 1, "the one that is not known to be sound"
    texts = replace(scan(codec.MAX_ITEMS + 1), kind=("ship",) * (codec.MAX_ITEMS + 1))
    with pytest.raises(MessageError):
        codec.encode(texts, sound=True)
    monkeypatch.setattr(codec, "MAX_BYTES", 100_000)
    with pytest.raises(MessageError):
        codec.encode(large, sound=True)
