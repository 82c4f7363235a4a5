"""The Rerun viewer on a mission that is flown: opened where there is a screen, else named."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping

from fusion_service.recording.program import find_program

__all__ = ["look_on"]


def look_on(url: str, environment: Mapping[str, str] = os.environ) -> str:
    """Open a viewer on `url`, which stays when the demo ends; what was done, or the line that does it."""
    line = f"rerun --connect {url}"
    binary = find_program()
    if binary is None:
        return f"look on: {line}   (no viewer is opened: rerun's program is not installed)"
    if sys.platform.startswith("linux") and not (environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY")):
        return f"look on: {line}   (no viewer is opened: there is no screen here)"
    try:
        subprocess.Popen(
            [str(binary), "--connect", url],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=dict(environment),
            start_new_session=True,
        )
    except OSError as error:
        return f"look on: {line}   (no viewer is opened: {error})"
    return f"a viewer opens; another one: {line}"
