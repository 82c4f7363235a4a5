"""Certificates that are renewed on disk while a process runs: they are read when a session is opened, so a restart
takes them. What can be done before is to say so, and whether they can be read."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from pathlib import Path

from fusion_service.bus.security import SecurityError, maybe_security

__all__ = ["certificates_changed", "fingerprint"]

log = logging.getLogger(__name__)


def fingerprint(security: str | Path | None) -> dict[str, str]:
    """What the security file and the files that it names hold, by path; empty where there is none, or they are no good
    now."""
    try:
        read = maybe_security(security)
    except SecurityError:
        return {}
    if read is None:
        return {}
    found = {}
    for path in (read.path, read.ca, read.certificate, read.key):
        try:
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError:
            found[str(path)] = ""
    return found


def certificates_changed(before: Mapping[str, str], security: str | Path | None) -> bool:
    """Log which of these files are others now than in the fingerprint `before`; whether any are."""
    now = fingerprint(security)
    if security is not None and not now:
        try:
            maybe_security(security)
        except SecurityError as error:
            log.error("a restart would fail: %s; until then what was read at the start goes on", error)
        return True
    new = sorted(path for path in now if before.get(path) != now[path])
    if new:
        words = "changed on disk, and taken by a restart only: %s (a link stands until its certificate ends)"
        log.warning(words, ", ".join(new))
    return bool(new)
