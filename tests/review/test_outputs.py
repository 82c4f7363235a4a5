"""Nothing that is read is written over, and nothing is added to a mission that is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.errors import ReviewError
from fusion_service.review.outputs import check_page, check_recording


def test_a_page_is_never_what_is_read(tmp_path: Path) -> None:
    parts = tmp_path / "mission"
    parts.mkdir()
    part, link, page = parts / "0001.rrd", tmp_path / "link.html", parts / "page.html"
    part.touch()
    link.symlink_to(part)
    for wrong in (part, link):
        with pytest.raises(ReviewError, match="is what is read"):
            check_page(wrong, parts)
    check_page(page, parts, tmp_path / "gone.csv")
    page.touch()
    check_page(page, parts)


def test_a_recording_never_becomes_a_part_of_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "0001.rrd").touch()
    with pytest.raises(ReviewError, match="exists already"):
        check_recording(tmp_path, tmp_path)
    with pytest.raises(ReviewError, match="write it to another folder"):
        check_recording(tmp_path / "0002.rrd", tmp_path)
    check_recording(tmp_path / "0002.rrd", tmp_path / "0001.rrd")
    check_recording(tmp_path / "new" / "out.rrd", tmp_path)
