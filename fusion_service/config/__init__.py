"""One TOML file -> frozen dataclasses."""

from fusion_service.config.config import (
    BEFORE,
    BusConfig,
    CentreConfig,
    ConfigError,
    DaemonConfig,
    FlowConfig,
    LimitsConfig,
    ServiceConfig,
    SourceConfig,
    config_hash,
)
from fusion_service.config.example import example_toml
from fusion_service.config.loading import centre_config, load_config

__all__ = [
    "BEFORE",
    "BusConfig",
    "CentreConfig",
    "ConfigError",
    "DaemonConfig",
    "FlowConfig",
    "LimitsConfig",
    "ServiceConfig",
    "SourceConfig",
    "centre_config",
    "config_hash",
    "example_toml",
    "load_config",
]
