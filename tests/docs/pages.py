"""The pages of the repository, and the code blocks in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ROOT", "Block", "blocks", "pages"]

ROOT = Path(__file__).parents[2]
ELSEWHERE = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "docker/README.md",
    "deploy/README.md",
    "schemas/WIRE.md",
)
FENCE = re.compile(r"(?:^<!-- (needs|not run): (.+?) -->\n)?^```([\w-]*)\n(.*?)^```$", re.M | re.S)


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block. language: "" where none is said; needs: names that stand for what is the reader's; not_run: why
    it is not run, or None."""

    page: str
    line: int
    language: str
    text: str
    needs: tuple[str, ...] = ()
    not_run: str | None = None

    @property
    def name(self) -> str:
        return f"{self.page}:{self.line}"


def pages() -> list[str]:
    """Paths of all pages, from the top of the repository."""
    return [*ELSEWHERE, *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))]


def blocks(page: str) -> list[Block]:
    """The blocks of a page, in order."""
    text = (ROOT / page).read_text("utf-8")
    found = []
    for fence in FENCE.finditer(text):
        mark, words, language, code = fence.groups()
        needs = tuple(word.strip() for word in words.split(",")) if mark == "needs" else ()
        line = text.count("\n", 0, fence.start(3)) + 1
        found.append(Block(page, line, language, code, needs, words if mark == "not run" else None))
    return found
