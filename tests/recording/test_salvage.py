"""A recording that is damaged within: what is whole is read, what is not is said in one line."""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.recording import RawMessage, read
from fusion_service.recording.salvage import HEADER, RECORD, salvage
from tests.helpers.damage import spans

WHOLE = Path(__file__).parents[1] / "recordings" / "tracks.rrd"
Damage = Callable[[bytearray, int, int], None]


def flipped(data: bytearray, begin: int, end: int) -> None:
    for at in range(begin + RECORD.size, end, 7):
        data[at] ^= 0x55


def wiped(data: bytearray, begin: int, end: int) -> None:
    data[begin:end] = bytes(end - begin)


def cut(data: bytearray, begin: int, end: int) -> None:
    del data[begin + (end - begin) // 2 : end - 3]


def inserted(data: bytearray, begin: int, end: int) -> None:
    middle = (begin + end) // 2
    data[middle:middle] = random.Random(1).randbytes(777)


def too_long(data: bytearray, begin: int, end: int) -> None:
    data[begin + 8 : begin + 16] = (2**40).to_bytes(8, "little")


def too_short(data: bytearray, begin: int, end: int) -> None:
    data[begin + 8 : begin + 16] = (100).to_bytes(8, "little")


DAMAGES = (flipped, wiped, cut, inserted, too_long, too_short)


def without(place: int, folder: Path) -> list[RawMessage]:
    """What the recording says without one of its records."""
    data = WHOLE.read_bytes()
    begin, end = spans(data)[place]
    kept = data[:begin] + data[end:]
    last = spans(kept)[-1][1]
    return list(read(written(folder, f"without-{place}", kept[:last])))


def written(folder: Path, name: str, data: bytes | bytearray) -> Path:
    path = folder / f"{name}.rrd"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_what_is_whole_beside_a_damage_is_read(
    damage: Damage, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = bytearray(WHOLE.read_bytes())
    records = spans(data)
    longest = max(range(len(records)), key=lambda k: records[k][1] - records[k][0])
    expected = without(longest, tmp_path)
    assert 0 < len(expected) < len(list(read(WHOLE))), "the record holds messages"
    damage(data, *records[longest])
    with caplog.at_level(logging.WARNING):
        found = list(read(written(tmp_path, "damaged", data)))
    assert found == expected
    said = [record.getMessage() for record in caplog.records]
    assert 1 <= len(said) <= 2, "that it is damaged, and where it seems to end"
    assert "damaged.rrd is damaged" in said[-1]


def test_each_record_may_be_the_damaged_one(tmp_path: Path) -> None:
    original = {raw.arrival: raw for raw in read(WHOLE)}
    for place in range(3, len(spans(WHOLE.read_bytes()))):
        data = bytearray(WHOLE.read_bytes())
        flipped(data, *spans(data)[place])
        found = list(read(written(tmp_path, "damaged", data)))
        assert found == without(place, tmp_path)
        assert all(original[raw.arrival] == raw for raw in found)


def test_of_random_damages_none_ends_in_a_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every command that opens a recording ends with a line, whatever was written over it."""
    rng = random.Random(4)
    for k in range(6):
        data = bytearray(WHOLE.read_bytes())
        for _ in range(rng.choice([1, 30])):
            at = rng.randrange(HEADER, len(data) - 600)
            data[at : at + rng.choice([1, 500])] = rng.randbytes(rng.choice([0, 1, 500]))
        path = written(tmp_path, f"random-{k}", data)
        for command in (["explain", str(path)], ["export", str(path), "--out", str(tmp_path / f"{k}.csv")]):
            assert main(command) in (0, 1), f"seed 4, damage {k}"
        told = capsys.readouterr().err
        assert "Traceback" not in told


def test_repair_puts_what_is_whole_in_its_place_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(WHOLE.read_bytes())
    records = spans(data)
    flipped(data, *records[6])
    path = written(tmp_path, "mission", data)
    expected = without(6, tmp_path)
    assert main(["repair", str(path)]) == 0
    assert "1 records that do not decode; the damaged file is kept as *.damaged" in capsys.readouterr().out
    assert (tmp_path / "mission.rrd.damaged").read_bytes() == data
    assert list(read(path)) == expected
    assert main(["repair", str(path)]) == 0
    assert "nothing to be done" in capsys.readouterr().out


def test_of_nothing_but_garbage_nothing_is_kept(tmp_path: Path) -> None:
    garbage = b"RRF2" + random.Random(2).randbytes(5000)
    lost = salvage(written(tmp_path, "garbage", garbage), tmp_path / "nothing.rrd")
    assert lost.bytes == len(garbage) - HEADER
    assert (tmp_path / "nothing.rrd").read_bytes() == garbage[:HEADER]
