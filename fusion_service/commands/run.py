"""`fusion-service run`: the service."""

from __future__ import annotations

import argparse
import dataclasses
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING

from fusion_service.bus.endpoint import check_endpoint
from fusion_service.commands.observed import add_metrics, observed
from fusion_service.hangup import on_hangup
from fusion_service.process import argument, loading

if TYPE_CHECKING:
    from fusion_service.config import ServiceConfig

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "The fusion service."
EXAMPLE = """fusion-service run --config centre.toml
  fusion-service run --config centre.toml --standby           a second one, which takes over when the first is gone
  fusion-service run --config centre.toml --security keys/centre-centre
  fusion-service run --config centre.toml --metrics            http://127.0.0.1:9464/metrics, /healthz, /readyz
SIGHUP reads the config again, takes what changes no result, and says what needs a restart."""


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
    add_metrics(parser, "service")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Run the service until `stop` is set. Raises `ConfigError`, `BusError`, `SecurityError`,
    `StateError`, OSError, ImportError."""
    with loading():
        from fusion_service.bus.hub import open_hub
        from fusion_service.bus.security import hub_security
        from fusion_service.monitoring import Pulse
        from fusion_service.service.daemon import run_service
        from fusion_service.service.notify import listening
        from fusion_service.service.reloading import Reloads, set_level

    if stop.is_set():
        return
    config = _config(args)
    set_level(config, args.verbose)
    reloads = Reloads(config, lambda: _config(args), args.verbose)
    pulse = Pulse(reloads.joined)
    with ExitStack() as stack:
        stack.enter_context(on_hangup(reloads.reload))
        stack.enter_context(listening(pulse.told))
        stack.enter_context(observed(args.metrics, "service", pulse.samples, pulse.alive, pulse.ready))
        if args.hub:
            stack.enter_context(open_hub(config.bus.connect, hub_security(config.bus.security)))
        run_service(config, stop, args.standby, reloads)


def _config(args: argparse.Namespace) -> ServiceConfig:
    """As the file and the arguments say."""
    from fusion_service.config import ServiceConfig, load_config

    config = load_config(args.config) if args.config else ServiceConfig()
    if args.connect:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, connect=tuple(args.connect)))
    if args.security:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, security=args.security))
    return config
