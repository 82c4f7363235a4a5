"""How a package that is missing is installed, as this installation was made."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path

__all__ = ["DISTRIBUTION", "install_hint"]

DISTRIBUTION = "track-fusion-centre"


def install_hint(extra: str) -> str:
    """The command that adds the packages of an extra (see pyproject.toml): from the clone or wheel that this was
    installed from, from the clone that it runs in, or by the name of the distribution."""
    clone = Path(__file__).resolve().parents[1]
    if (clone / "pyproject.toml").is_file():
        return f"pip install -e '{clone}[{extra}]'"
    try:
        said = json.loads(metadata.distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
        url = str(said.get("url", ""))
    except (metadata.PackageNotFoundError, ValueError, AttributeError):
        url = ""
    if url.startswith(("file:", "https:")) and not {"'", " ", "\n"} & set(url):
        return f"pip install '{DISTRIBUTION}[{extra}] @ {url}'"
    return f"pip install '{DISTRIBUTION}[{extra}]'"
