"""All that is wrong with one message, field by field."""

from __future__ import annotations

from typing import NamedTuple

from fusion_service.hints.finding import Finding
from fusion_service.hints.numbers import number_finding
from fusion_service.hints.payload import raw_map, read_finding
from fusion_service.hints.refusals import refusal_finding
from fusion_service.hints.words import key_finding
from schemas import FAULTS, LocalIntensity, LocalTracks, Message, MessageError, check_numbers, decode, parse_key
from schemas.tables import CLASSES, FIELDS

__all__ = ["Inspected", "inspect"]

SOON, LATE = 2.0, 10.0
"""Seconds ahead and behind of its reception from which a time is taken for wrong."""


class Inspected(NamedTuple):
    """A payload: the message in it, where it can be read, and what is wrong with it."""

    message: Message | None
    findings: list[Finding]


def inspect(data: bytes, now: int, key: str = "", realm: str = "", live: bool = True) -> Inspected:
    """What is wrong with `data`, that came at `now`, ns, on `key`; live: whether its times should be about now. Never
    raises."""
    findings = []
    if key and realm and (odd := key_finding(key, realm)) is not None:
        findings.append(odd)
    try:
        message = decode(data)
    except MessageError as error:
        return Inspected(None, [*findings, *_unread(data, error, now)])
    try:
        said = parse_key(key).name if key else message.source
    except ValueError:
        said = message.source
    if said != message.source:
        words = f'it is of "{message.source}", its key of "{said}": make `source` the name in the key'
        findings.append(Finding("source", "source", message.source, words))
    if isinstance(message, (LocalTracks, LocalIntensity)):
        codes = check_numbers([message])[0]
        findings += [number_finding(message, FAULTS[code]) for code in sorted(set(codes[codes > 0].tolist()))]
        if live and message.origin == "live":
            ahead = (message.time - now) / 1e9
            reason = "future" if ahead > SOON else "late" if ahead < -LATE else ""
            findings += [refusal_finding(reason, message, now)] if reason else []
    return Inspected(message, findings)


def _unread(data: bytes, error: MessageError, now: int) -> list[Finding]:
    """What is wrong with a payload that cannot be read: every field of it, where it can be looked at field by field."""
    first = read_finding(data, error, now)
    raw = raw_map(data)
    name = raw.get("type")
    kind = CLASSES.get(name) if isinstance(name, str) else None
    if kind is None or error.reason not in ("missing", "bad-field"):
        return [first]
    found = []
    for field in FIELDS[kind]:
        value = raw.get(field.key)
        try:
            if value is not None:
                field.unpack(value)
            elif not field.optional:
                found.append(read_finding(data, MessageError("missing", f"{name} without {field.key}"), now))
        except (ValueError, TypeError) as one:
            found.append(read_finding(data, MessageError("bad-field", f"{name}.{field.key}: {one}"), now))
    return found or [first]
