"""Truth from a file of its own: a recording, a table of tracks (CSV or Parquet) as `schemas.flat` describes it, or a
plain table of fixes (`gps_table`)."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.errors import ReviewError
from fusion_service.extras import install_hint
from fusion_service.review.evaluation.csv_text import SUFFIXES, is_text_table
from fusion_service.review.evaluation.gps_table import GpsTable, is_gps_table, read_gps
from fusion_service.review.evaluation.logbook import Logbook
from schemas import MessageError, Truth, decode
from schemas.flat import frame_of, space_of

__all__ = ["NO_TRUTH", "TruthFile", "read_truth"]

FlatTable = dict[str, list[Any]]
ROWS = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class TruthFile:
    """Truth that was read, none of an empty one. note: what was made of it, in words; empty where nothing was."""

    path: Path | None = None
    told: tuple[Truth, ...] = ()
    table: GpsTable | None = None

    @property
    def names(self) -> dict[int, str]:
        """Of true objects that have some, by id."""
        return self.table.names if self.table is not None else {}

    @property
    def note(self) -> str:
        return f"truth of {self.path}: {self.table.note}" if self.table is not None else ""

    def messages(self, book: Logbook) -> list[Truth]:
        """As messages of the mission of `book`. Raises `ReviewError` where they do not go with it."""
        if self.table is None:
            return list(self.told)
        pictures = [book.first_pictures[name].frame for name in book.centres]
        known = pictures[:1] or [found[0] for found in [book.default_space()] if found]
        if not known:
            raise ReviewError(f"{self.path}: the mission has no tracks, and so no frame")
        return self.table.messages(known[0])


NO_TRUTH = TruthFile()


def read_truth(path: Path) -> TruthFile:
    """Its truth messages; of a table one for each run of rows of one time. Raises `ReviewError` for a file that has
    none or is not as it must be, FileNotFoundError, and what `recording.read` raises."""
    if is_text_table(path) and is_gps_table(path):
        return TruthFile(path, table=read_gps(path))
    return TruthFile(path, told=tuple(_read(path)))


def _read(path: Path) -> list[Truth]:
    if not path.exists() or (path.is_dir() and path.suffix.lower() in (*SUFFIXES, ".parquet")):
        raise FileNotFoundError(f"no truth at {path}")
    if path.suffix.lower() in SUFFIXES:
        found = [truth for table in _csv(path) for truth in _messages(table, path)]
    elif path.suffix.lower() == ".parquet":
        found = [truth for table in _parquet(path) for truth in _messages(table, path)]
    else:
        found = list(_recorded(path))
    if not found:
        raise ReviewError(f"{path} holds no truth: give a recording, or a table with rows of the kind truth")
    return found


def _recorded(path: Path) -> Iterator[Truth]:
    from fusion_service.recording import read

    for raw in read(path):
        try:
            message = decode(raw.data)
        except MessageError:
            continue
        if isinstance(message, Truth):
            yield message


def _csv(path: Path) -> Iterator[FlatTable]:
    try:
        yield from _csv_parts(path)
    except csv.Error as error:
        raise ReviewError(f"{path} is no CSV table ({error})") from None


def _csv_parts(path: Path) -> Iterator[FlatTable]:
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.DictReader(file)
        wanted = _wanted(tuple(reader.fieldnames or ()), path)
        table: FlatTable = {name: [] for name in wanted}
        for row in reader:
            if None in row or None in row.values():
                raise ReviewError(f"{path}: line {reader.line_num} has not as many fields as the first: mend it")
            if row["kind"] == "truth":
                for name in wanted:
                    table[name].append(row[name])
            if len(table["time_ns"]) == ROWS:
                yield table
                table = {name: [] for name in wanted}
        yield table


def _parquet(path: Path) -> Iterator[FlatTable]:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError as error:
        raise ReviewError(f"Parquet needs pyarrow ({error}): {install_hint('record')}") from None
    try:
        file = parquet.ParquetFile(path)
        wanted = _wanted(tuple(file.schema_arrow.names), path)
        for batch in file.iter_batches(ROWS, columns=list(wanted)):
            rows: FlatTable = batch.to_pydict()
            mine = [index for index, kind in enumerate(rows["kind"]) if kind == "truth"]
            yield {name: [column[index] for index in mine] for name, column in rows.items()}
    except ArrowException as error:
        raise ReviewError(f"{path} is no Parquet table ({error})") from None


def _wanted(columns: tuple[str, ...], path: Path) -> tuple[str, ...]:
    try:
        return ("time_ns", "source", "kind", "track_id", "epoch", "frame", *space_of(columns))
    except ValueError as error:
        raise ReviewError(f"{path}: {error}") from None


def _messages(table: FlatTable, path: Path) -> Iterator[Truth]:
    space = tuple(name for name in table if name not in ("time_ns", "source", "kind", "track_id", "epoch", "frame"))
    if not table["time_ns"]:
        return
    try:
        times = np.array([int(time) for time in table["time_ns"]], dtype=np.int64)
        ids = np.array([int(track) for track in table["track_id"]], dtype=np.uint64)
        states = np.array([[float(value) for value in table[name]] for name in space]).T
        frames = {text: frame_of(text) for text in dict.fromkeys(table["frame"])}
    except (ValueError, TypeError, OverflowError) as error:
        raise ReviewError(f"{path}: a row of truth is not as it must be ({error})") from None
    if not np.isfinite(states).all():
        raise ReviewError(f"{path}: a row of truth lacks a number of its state")
    heads = list(zip(times.tolist(), table["source"], table["frame"], strict=True))
    begins = [index for index, head in enumerate(heads) if not index or head != heads[index - 1]]
    for begin, end in zip(begins, [*begins[1:], len(heads)], strict=True):
        time, source, text = heads[begin]
        yield Truth(
            source=source or "truth",
            epoch=0,
            seq=begin,
            sent=time,
            time=time,
            space=space,
            frame=frames[text],
            ids=ids[begin:end],
            means=states[begin:end],
        )
