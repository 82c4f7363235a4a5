"""Rows of tracks as a table in a file: CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fusion_service.errors import ReviewError
from fusion_service.extras import install_hint
from fusion_service.review.export_rows import TableRow
from schemas import COMPONENTS
from schemas.flat import safe_text

__all__ = ["Write", "csv_table", "parquet_table"]

Write = Callable[[list[TableRow]], None]
ROWS = 20_000
"""Rows of a row group of a Parquet file."""
INTEGERS, SIGNED = ("track_id", "epoch", "number"), ("time_ns", "updated_ns")
SAID = ("callsign", "identity", "class")
"""Texts that anybody on the bus may have said."""
TEXTS = ("time", "source", "kind", "status", "sources", "lineage", "frame", "label", "track_hex", *SAID)


@contextmanager
def csv_table(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()

        def write(rows: list[TableRow]) -> None:
            writer.writerows(row | {name: safe_text(row[name]) for name in SAID if row[name]} for row in rows)

        yield write


@contextmanager
def parquet_table(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise ReviewError(f"Parquet needs pyarrow ({error}): {install_hint('record')}") from None

    def kind(name: str) -> Any:
        if name in INTEGERS:
            return pa.uint64()
        return pa.int64() if name in SIGNED else pa.string() if name in TEXTS else pa.float64()

    units = {b"units": b"SI, radians; latitude and longitude in degrees"}
    schema = pa.schema(
        [pa.field(n, kind(n), metadata={b"unit": COMPONENTS[n].encode()} if n in COMPONENTS else None) for n in names],
        metadata=units,
    )
    waiting: list[TableRow] = []
    with parquet.ParquetWriter(path, schema) as writer:

        def flush() -> None:
            if waiting:
                columns = {name: [row[name] for row in waiting] for name in names}
                writer.write_table(pa.table(columns, schema=schema))
                waiting.clear()

        def write(rows: list[TableRow]) -> None:
            waiting.extend(rows)
            if len(waiting) >= ROWS:
                flush()

        yield write
        flush()
