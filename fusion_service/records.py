"""Frozen dataclasses whose fields are columns, many times a step: `dataclasses.replace` and `fields` look at each field
anew in each call, which for a table of thirty columns costs more than what is done with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from operator import attrgetter
from typing import Any, TypeVar

__all__ = ["altered", "columns_of", "names_of"]

Record = TypeVar("Record")


@cache
def names_of(kind: Any) -> tuple[str, ...]:
    """The fields of a dataclass, in order."""
    return tuple(one.name for one in fields(kind))


@cache
def _reader(kind: Any) -> Callable[[Any], tuple[Any, ...]]:
    names = names_of(kind)
    return attrgetter(*names) if len(names) > 1 else lambda record: tuple(getattr(record, name) for name in names)


def columns_of(record: Any) -> tuple[Any, ...]:
    """The values of the fields of a dataclass, in order: those themselves, no copies."""
    kind: Any = type(record)
    return _reader(kind)(record)


def altered(record: Record, /, **new: Any) -> Record:
    """The same with other values of these fields: `dataclasses.replace`."""
    kind: Any = type(record)
    made: Record = kind(**{**dict(zip(names_of(kind), columns_of(record), strict=True)), **new})
    return made
