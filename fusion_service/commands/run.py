"""`fusion-service run`: the service."""

from __future__ import annotations

import argparse
import dataclasses
import threading

from fusion_service.bus.endpoint import check_endpoint
from fusion_service.process import argument, loading

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The fusion service."
EXAMPLE = """fusion-service run --config centre.toml
  fusion-service run --config centre.toml --standby           a second one, which takes over when the first is gone
  fusion-service run --config centre.toml --security keys/centre-centre"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("--config", metavar="FILE", help="TOML file (default: all defaults; `check` shows them)")
    parser.add_argument(
        "--connect",
        action="append",
        type=argument(check_endpoint),
        metavar="ENDPOINT",
        help="hub to join, instead of the config's",
    )
    parser.add_argument(
        "--standby",
        action="store_true",
        help="follow the centre of this name that runs, and take over when it is gone (same config, own state folder)",
    )
    parser.add_argument("--hub", action="store_true", help="hold a hub in this process too (the smallest installation)")
    parser.add_argument("--security", metavar="FILE", help="certificates, instead of the config's (see `keys`)")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Run the service until `stop` is set. Raises `ConfigError`, `BusError`, `SecurityError`,
    `StateError`."""
    with loading():
        from fusion_service.bus.hub import open_hub
        from fusion_service.bus.security import hub_security
        from fusion_service.config import ServiceConfig, load_config
        from fusion_service.service.daemon import run_service

    if stop.is_set():
        return
    config = load_config(args.config) if args.config else ServiceConfig()
    if args.connect:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, connect=tuple(args.connect)))
    if args.security:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, security=args.security))
    if args.hub:
        with open_hub(config.bus.connect, hub_security(config.bus.security)):
            run_service(config, stop, args.standby)
    else:
        run_service(config, stop, args.standby)
