"""Mutated messages through `schemas.decode`: a message or a `MessageError`, at a cost in proportion to its bytes."""

from __future__ import annotations

import random
import time
import traceback
from collections import Counter
from typing import Any

import schemas
from tests.chaos.mutations import BASES, mutated
from tests.chaos.report import Report

__all__ = ["fuzz_decoding"]

SLOW = 0.5
"""Processor seconds that one message may take at most (none is above 1 MB here)."""
BATCH = 1000
AGAIN = 0.1
"""Of what is read, so much is written again."""


def fuzz_decoding(seed: int, until: float, most: int = 2**62) -> Report:
    """Messages until `until`, of the monotonic clock, or `most` of them. What is read is written again and is read
    then; the second time as it was the first."""
    report = Report("decode")
    rng = random.Random(seed)
    bases = list(BASES.values())
    reasons: Counter[str] = Counter()
    tried, slowest, begin = 0, 0.0, time.process_time()
    while tried < most and time.monotonic() < until:
        for _ in range(min(BATCH, most - tried)):
            data = mutated(rng, rng.choice(bases))
            before = time.process_time()
            try:
                message = schemas.decode(data)
            except schemas.MessageError as error:
                reasons[error.reason] += 1
            except Exception:
                report.escaped(f"decode: {traceback.format_exc(limit=-3)}", data)
            else:
                reasons["read"] += 1
                if rng.random() < AGAIN:
                    _again(report, message, data)
            slowest = max(slowest, time.process_time() - before)
        tried += min(BATCH, most - tried)
    unknown = set(reasons) - {"read", *schemas.REASONS}
    if unknown:
        report.escaped(f"reasons that are not known: {sorted(unknown)}")
    if slowest > SLOW:
        report.escaped(f"a message took {slowest:.2f} s")
    took = time.process_time() - begin
    report.tried = tried
    report.say(f"{tried / max(took, 1e-9):,.0f} a second of one processor, the slowest {1e3 * slowest:.1f} ms")
    report.say(", ".join(f"{reason} {count:,}" for reason, count in reasons.most_common()))
    return report


def _again(report: Report, message: Any, data: bytes) -> None:
    """What is read can be written, if its numbers are sound, and is the same then."""
    try:
        once = schemas.encode(message)
    except schemas.MessageError:
        return
    except Exception:
        report.escaped(f"encode: {traceback.format_exc(limit=-3)}", data)
        return
    try:
        twice = schemas.encode(schemas.decode(once))
    except Exception:
        report.escaped(f"what encode gave is not read: {traceback.format_exc(limit=-3)}", data)
        return
    if once != twice:
        report.escaped("what encode gave is read as something else", data)
