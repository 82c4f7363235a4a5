"""Rerun's command line program, which comes with the SDK: run so that it tells nobody."""

from __future__ import annotations

import json
import os
import sys
from importlib.util import find_spec
from pathlib import Path

__all__ = ["find_program", "quiet"]


def find_program() -> Path | None:
    """The program itself, not its wrapper; None if it did not come with the SDK."""
    spec = find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
    return path if path.is_file() else None


def quiet(home: Path) -> dict[str, str]:
    """An environment in which it sends no usage data, with its settings in the folder `home`."""
    settings = home / "rerun" / "analytics.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    said = {"analytics_enabled": False, "analytics_id": "none", "metadata": {}, "config_file_path": str(settings)}
    settings.write_text(json.dumps(said | {"data_dir_path": str(home / "data")}))
    return os.environ | {"XDG_CONFIG_HOME": str(home)}
