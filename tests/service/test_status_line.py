"""The line that the service manager shows, and what the service logs of tracklets."""

from __future__ import annotations

import dataclasses

from fusion_service.service.status import NAMED, status_line
from tests.helpers.tracklets import fly


def test_it_says_tracks_sources_and_whose_tracks_are_no_tracklets() -> None:
    status = fly(6, fed=4).steps[-1].status
    sources = {name: said | {"alive": True} for name, said in status.sources.items()}
    line = status_line(dataclasses.replace(status, sources=sources))
    assert line.startswith("0 tentative, 3 confirmed, 0 coasting; 3 of 3 sources alive; tracklets of 2; none of r3: ")
    assert "\n" not in line
    many = {f"r{k}": sources["r3"] for k in range(NAMED + 1)}
    assert status_line(dataclasses.replace(status, sources=many)).endswith(f"tracklets of 0, none of {NAMED + 1}")


def test_without_tracklets_it_says_nothing_of_them() -> None:
    status = fly(3, memory="restart").steps[-1].status
    assert "tracklets" not in status_line(status)
    assert status_line(dataclasses.replace(status, sources={}, tracks={})) == "no step yet; 0 of 0 sources alive"
