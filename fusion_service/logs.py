"""Logs of every process of ours: lines for people, or one JSON object a line with stable fields for machines.

`time` (RFC 3339, UTC, ms), `level` (debug, info, warning, error, critical), `logger`, `message`; where they are known
`source`, of whom it is, and `reason`, the word by which a refusal is counted; `trace`, of a fault of ours. All of it is
ASCII: what a sender wrote is escaped. Under systemd every line begins with its priority, which the journal takes off.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from datetime import UTC, datetime

from fusion_service.escape import escaped

__all__ = ["FIELDS", "FORMATS", "set_up_logging"]

FORMATS = ("auto", "text", "json")
FIELDS = ("source", "reason")
"""What a line may say beside its message: given as `extra` where it is logged."""
PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
"""Of sd-daemon(3), from a level on."""


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        when = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        entry = {"time": when, "level": record.levelname.lower(), "logger": record.name}
        entry["message"] = record.getMessage()
        for name in FIELDS:
            if isinstance(value := getattr(record, name, None), str):
                entry[name] = value
        if record.exc_info:
            entry["trace"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class _TextFormatter(logging.Formatter):
    """A message that holds new lines cannot look like several."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        record.message = escaped(record.message).replace("\n", "\n    ")
        return super().formatMessage(record)


class _JournalFormatter(logging.Formatter):
    """Lines of another formatter, each with the priority by which the journal sorts it."""

    def __init__(self, inner: logging.Formatter) -> None:
        super().__init__()
        self._inner = inner

    def format(self, record: logging.LogRecord) -> str:
        priority = next(one for level, one in PRIORITIES if record.levelno >= level)
        return f"<{priority}>" + self._inner.format(record).replace("\n", f"\n<{priority}>")


def set_up_logging(verbose: bool = False, form: str = "auto") -> None:
    """Log to stderr. form: one of `FORMATS`; auto: text, or JSON under a service manager (systemd sets
    JOURNAL_STREAM)."""
    as_json = form == "json" or (form == "auto" and bool(os.environ.get("JOURNAL_STREAM")))
    plain = _TextFormatter("%(asctime)s %(levelname)-7s %(message)s", "%H:%M:%S")
    formatter: logging.Formatter = _JsonFormatter() if as_json else plain
    handler = logging.StreamHandler()
    handler.setFormatter(_JournalFormatter(formatter) if _is_journal() else formatter)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler], force=True)


def _is_journal() -> bool:
    """Whether stderr goes to the journal, and nowhere else."""
    try:
        said = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{said.st_dev}:{said.st_ino}"
