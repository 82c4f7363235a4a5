"""`fusion-service check`."""

from __future__ import annotations

import argparse
import sys
import threading

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "Check a config; without a file, print one with every default."
EXAMPLE = "fusion-service check centre.toml"


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("config", nargs="?", metavar="FILE", help="TOML file")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Say whether the config is good, or print an example. Raises `ConfigError`."""
    from fusion_service.config import config_hash, example_toml, load_config

    if args.config is None:
        sys.stdout.write(example_toml())
        return
    config = load_config(args.config)
    print(
        f"{args.config}: good ({config.centre.rule}, {config.centre.memory} memory, hash {config_hash(config.centre)})"
    )
