"""A config with every setting, to begin with."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from fusion_service.config.config import BusConfig, CentreConfig, DaemonConfig, LimitsConfig, SourceConfig
from fusion_service.config.toml_text import toml_value

__all__ = ["example_toml"]


def example_toml() -> str:
    """A config with every setting at its default, commented with its help."""
    tables: list[tuple[str, Any]] = [
        ("centre", CentreConfig()),
        ("centre.source_defaults", SourceConfig()),
        ("bus", BusConfig()),
        ("service", DaemonConfig()),
        ("limits", LimitsConfig()),
    ]
    lines: list[str] = []
    for name, table in tables:
        lines += [f"[{name}]"]
        for one in fields(table):
            if one.name in ("source_defaults", "sources"):
                continue
            value = getattr(table, one.name)
            text = f"{one.name} = {toml_value(value)}" if value is not None else f"# {one.name} ="
            known = one.metadata["read"].__doc__ or ""
            lines.append(f"{text:<44} # {one.metadata['help']}{f' ({known})' if '|' in known else ''}")
        lines.append("")
    lines += [
        "# [centre.sources.radar1]                  # any key of source_defaults for one source",
        "# override = true",
        "# [limits.sources.radar1]                  # any key of limits for one source",
    ]
    return "\n".join(lines) + "\n"
