"""One TOML file -> frozen dataclasses."""

from fusion_service.config.config import (
    BusConfig,
    CentreConfig,
    ConfigError,
    DaemonConfig,
    ServiceConfig,
    SourceConfig,
    centre_config,
    config_hash,
    example_toml,
    load_config,
)

__all__ = [
    "BusConfig",
    "CentreConfig",
    "ConfigError",
    "DaemonConfig",
    "ServiceConfig",
    "SourceConfig",
    "centre_config",
    "config_hash",
    "example_toml",
    "load_config",
]
