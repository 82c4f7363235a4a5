"""The page of `fusion-service evaluate --html`: whole by itself, well-formed, and saying the numbers."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from fusion_service.review.evaluation import Assessment, assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.report import report
from fusion_service.review.evaluation.report_text import WORDS
from fusion_service.review.evaluation.tables import digits
from schemas import GlobalTracks, Message, Truth
from tests.recording.mission import mission

STEPS = 40
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Checks that tags are closed in order; keeps the text of every cell by row, headings, and what is loaded."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: list[list[str]] = []
        self.classes: list[list[str]] = []
        self.headings: list[str] = []
        self.loaded: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.tags.add(tag)
        self.loaded += [value or "" for key, value in attrs if key in ("src", "href", "xlink:href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
            self.classes.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.classes[-1].append(named.get("class") or "")
        if tag in ("h1", "h2", "h3"):
            self.headings.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings[-1] += data


def centre(message: Message, name: str, rule: str, off: float) -> Message:
    assert isinstance(message, GlobalTracks)
    return replace(message, source=name, rule=rule, means=message.means + np.array([off, 0, 0, 0]))


@pytest.fixture(scope="module")
def flown() -> list[Message]:
    return [sent.message for sent in mission(STEPS)]


@pytest.fixture(scope="module")
def assessed(flown: list[Message]) -> Assessment:
    return assess(Logbook(flown), c=300.0, rows=2000)


@pytest.fixture(scope="module")
def text(assessed: Assessment) -> str:
    return report([assessed])


def test_it_needs_nothing_else_and_is_small(text: str) -> None:
    page = Page(text)
    assert not {"script", "link", "iframe", "object"} & page.tags
    assert [where for where in page.loaded if not where.startswith(("data:image/png;base64,", "#"))] == []
    assert "http" not in text
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    assert len(text) < 3 * 2**20
    assert 'name="viewport"' in text
    assert "@media print" in text


def test_what_is_referred_to_within_it_is_there(text: str) -> None:
    ids = set(re.findall(r'\sid="([^"]+)"', text))
    wanted = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    assert wanted <= ids


def test_it_says_the_numbers(text: str, assessed: Assessment) -> None:
    page = Page(text)
    evaluation = assessed.evaluations["main"]
    fused = next(row for row in page.rows if row and row[0] == "fused (ci)")
    assert fused[1:3] == [digits(evaluation.fused.rmse_position), digits(evaluation.fused.gospa)]
    assert fused[6] == f"{evaluation.fused.anees:.2f}"
    for name, one in evaluation.sources.items():
        row = next(row for row in page.rows if row and row[0] == name and len(row) == len(fused))
        assert row[1] == digits(one.rmse_position)
    for heading in (
        "Map",
        "Tracks against the truth",
        "Over time",
        "Sources against each other",
        "Refused and dropped",
        "Gaps",
    ):
        assert heading in page.headings
    assert ["refused", "radar3", "not-finite", "2 tracks"] in page.rows
    assert text.count("<svg") == 8 + 1, "charts, and the delays of the sources"
    for word in WORDS:
        assert f"<dt>{word}</dt>" in text


def test_rules_stand_beside_each_other_with_the_best_marked(flown: list[Message]) -> None:
    pictures = [message for message in flown if isinstance(message, GlobalTracks)]
    other = [centre(message, "far & <off>", '$x_{"<b>', 60.0) for message in pictures]
    page = Page(report([assess(Logbook([*flown, *other]), c=300.0, rows=500)]))
    head = next(row for row in page.rows if "RMSE" in row)
    at = page.rows.index(head)
    first, second = page.rows[at + 1], page.rows[at + 2]
    assert {first[0], second[0]} == {"main", "far & <off>"}
    column = head.index("RMSE")
    good = first if first[0] == "main" else second
    marked = page.classes[page.rows.index(good)][column]
    assert "best" in marked
    bad = second if good is first else first
    assert "best" not in page.classes[page.rows.index(bad)][column]


def test_without_truth_and_without_tracks_of_a_centre(flown: list[Message]) -> None:
    blind = [message for message in flown if not isinstance(message, Truth)]
    page = Page(report([assess(Logbook(blind), rows=500)]))
    assert "Tracks against the truth" not in page.headings
    assert "Sources against each other" in page.headings
    assert "Map" in page.headings
    one = [message for message in blind if message.source != "main"]
    page = Page(report([assess(Logbook(one), rows=500)]))
    assert "Gaps" in page.headings
    alone = [message for message in flown if message.source != "main"]
    page = Page(report([assess(Logbook(alone), c=300.0, rows=500)]))
    assert {"Tracks against the truth", "Over time"} <= set(page.headings)
    assert not any(row and row[0].startswith("fused") for row in page.rows)
    with pytest.raises(ValueError, match="no global tracks"):
        assess(Logbook([]))
