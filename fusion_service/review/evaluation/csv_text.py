"""How a table in text is opened, whatever program wrote it: what its characters are in, what stands before the heading,
what the columns are apart by, and how a number is read.

Spreadsheets write a mark at the beginning (UTF-8) or another encoding (UTF-16, "Unicode text"), a line `sep=;`, a comma
for the point where the columns are apart by semicolons; loggers write lines of comment, and units behind the names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TextIO

__all__ = ["SUFFIXES", "Heading", "decimal", "in_degrees", "is_text_table", "open_table"]

SUFFIXES = (".csv", ".tsv", ".txt")
UTF16 = (b"\xff\xfe", b"\xfe\xff")
LONGEST_LINE = 1 << 20
"""Characters of a heading that are looked at."""
UNIT = re.compile(r"\s*[(\[](?:degrees|deg|°|utc|wgs ?84|ns|s|m|m/s)[)\]]$")
"""Behind a name, and what is supposed anyway; of another unit the name stays as it is, and is not found."""
COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
ANGLE = re.compile(
    r"([NSEW+-]?)\s*(\d+(?:\.\d+)?)\s*°?\s*(?:(\d+(?:\.\d+)?)\s*['′’]?\s*)?(?:(\d+(?:\.\d+)?)\s*(?:\"|″|'')?\s*)?([NSEW]?)",
    re.IGNORECASE,
)


class Heading(NamedTuple):
    """The line that names the columns: its number, what they are apart by, the names in small letters."""

    line: int
    delimiter: str
    names: list[str]


def is_text_table(path: Path) -> bool:
    """Whether the file's name is that of such a table."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


@contextmanager
def open_table(path: Path) -> Iterator[tuple[TextIO, Heading]]:
    """The file behind its heading, and the heading; of an empty one no names. What is no text is read all the same,
    with marks in the place of what cannot be. Raises OSError."""
    with path.open("rb") as raw:
        encoding = "utf-16" if raw.read(2) in UTF16 else "utf-8-sig"
    with path.open(newline="", encoding=encoding, errors="replace") as file:
        line, text = 1, file.readline(LONGEST_LINE)
        while text and (not text.strip(" \r\n,;\t") or text.lstrip().lower().startswith(("#", "sep="))):
            line, text = line + 1, file.readline(LONGEST_LINE)
        delimiter = max(",;\t", key=text.count)
        names = [name.strip().strip('"').strip().lower() for name in text.rstrip("\r\n").split(delimiter)]
        yield file, Heading(line, delimiter, [UNIT.sub("", name) for name in names])


def decimal(text: str, delimiter: str) -> str:
    """With a point, where a comma can be nothing else."""
    return text.replace(",", ".") if delimiter != "," and COMMA.fullmatch(text) else text


def in_degrees(text: str) -> float | None:
    """Degrees of an angle that is written in degrees, minutes and seconds, or with a letter for the side of the Earth;
    None for another text."""
    found = ANGLE.fullmatch(text.strip())
    if found is None:
        return None
    before, degrees, minutes, seconds, behind = found.groups()
    value = float(degrees) + float(minutes or 0) / 60 + float(seconds or 0) / 3600
    return -value if {before.upper(), behind.upper()} & {"-", "S", "W"} else value
