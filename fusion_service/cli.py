"""`fusion-service`: hub, run, record, demo, check, rules, and what works on recordings.

Exit codes: 0 done, 1 failure, 2 bad usage or config.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.commands import COMMANDS, units
from fusion_service.process import set_up_logging, stop_on_signals

__all__ = ["main"]


def _endpoint(text: str) -> str:
    try:
        return check_endpoint(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.0 < speed < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return speed


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return int(text)


def _unit(kind: str) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value: float = getattr(units, kind)(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return value

    return read


def _address(text: str) -> tuple[str, int]:
    from fusion_service.recording.live import address

    try:
        return address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port")
    return int(text)


class _Help(argparse.RawDescriptionHelpFormatter):
    """Keeps the examples as they are written."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fusion-service",
        description="Associates and fuses the tracks of remote sensors into one picture.",
        epilog="Example: fusion-service demo\n`fusion-service COMMAND --help` shows an example for each command.",
        formatter_class=_Help,
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, text: str, example: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, epilog=f"Example:\n  {example}", formatter_class=_Help
        )
        sub.add_argument("-v", "--verbose", action="store_true", help="log more")
        return sub

    hub = command(
        "hub", "The bus: a Zenoh router that everything else joins.", f"fusion-service hub --listen {DEFAULT_ENDPOINT}"
    )
    hub.add_argument(
        "--listen",
        action="append",
        type=_endpoint,
        metavar="ENDPOINT",
        help=f"where to listen (default {DEFAULT_ENDPOINT})",
    )

    run = command("run", "The fusion service.", "fusion-service run --config centre.toml")
    run.add_argument("--config", metavar="FILE", help="TOML file (default: all defaults; `check` shows them)")
    run.add_argument(
        "--connect", action="append", type=_endpoint, metavar="ENDPOINT", help="hub to join, instead of the config's"
    )
    run.add_argument("--hub", action="store_true", help="hold a hub in this process too (the smallest installation)")

    record = command(
        "record",
        "Record everything on the bus.",
        "fusion-service record --out mission.rrd\n"
        "  fusion-service record --out mission/ --rotate-every 1h --keep-for 7d     parts 0001.rrd, 0002.rrd, ...\n"
        "  fusion-service record --live       look on with: rerun --connect rerun+http://127.0.0.1:9876/proxy\n"
        "  fusion-service record --live-web   look on in a browser",
    )
    record.add_argument(
        "--out",
        metavar="PATH",
        help="recording, a new file; or a folder (a name that ends with /, or exists) of parts, which is gone on with "
        "(default runs/mission-<UTC time>.rrd)",
    )
    record.add_argument(
        "--connect",
        action="append",
        type=_endpoint,
        metavar="ENDPOINT",
        help=f"hub to join (default {DEFAULT_ENDPOINT})",
    )
    record.add_argument("--cutoff", type=float, metavar="M", help="largest error that still counts as followed, m")
    record.add_argument("--realm", default="fusion", help="first part of every key (default fusion)")
    record.add_argument(
        "--flush", type=_unit("duration"), default=1.0, metavar="TIME", help="what a kill may cost at most (default 1s)"
    )
    record.add_argument("--no-draw", action="store_true", help="record the messages alone, without the picture")
    weeks = record.add_argument_group("for weeks", "any of these makes the recording a folder of parts")
    weeks.add_argument("--rotate-size", type=_unit("size"), metavar="SIZE", help="of a part (default 500MB)")
    weeks.add_argument("--rotate-every", type=_unit("duration"), metavar="TIME", help="time of a part, as in 1h")
    weeks.add_argument(
        "--keep-size", type=_unit("size"), metavar="SIZE", help="delete the oldest parts beyond 20GB, say"
    )
    weeks.add_argument("--keep-for", type=_unit("duration"), metavar="TIME", help="delete parts older than 7d, say")
    live = record.add_argument_group("live")
    live.add_argument(
        "--live",
        nargs="?",
        const="127.0.0.1:9876",
        type=_address,
        metavar="HOST:PORT",
        help="serve the picture to open viewers (default 127.0.0.1:9876; any other host opens it to the network)",
    )
    live.add_argument(
        "--live-web",
        nargs="?",
        const=9090,
        type=_port,
        metavar="PORT",
        help="and the viewer as a page, on the host of --live (default port 9090)",
    )

    demo = command(
        "demo",
        "A whole mission: hub, service, clients and recorder as processes, then a table, a map and a recording.",
        "fusion-service demo\n"
        "  fusion-service demo --rule hmd-ga --json result.json\n"
        "  fusion-service demo --scenario autoferry:2 --data DIR --speed 10\n"
        "  fusion-service demo --rule bci --set rule_options.max_correlation=0.5 --set gate=0.99",
    )
    demo.add_argument("--scenario", default="three-radars", help="three-radars (default), or autoferry:N")
    demo.add_argument("--data", metavar="DIR", help="folder of the Autoferry files (default: $FUSION_DATA)")
    demo.add_argument("--rule", default="ci", help="fusion rule (default ci; `fusion-service rules` lists them)")
    demo.add_argument("--criterion", help="of the rule's weights: det or trace")
    demo.add_argument("--memory", default="restart", choices=("restart", "recursive"), help="default restart")
    demo.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the centre, above all others"
    )
    demo.add_argument("--speed", type=_speed, default=None, help="times faster than real time (default 10)")
    demo.add_argument("--seed", type=_seed, default=1, help="of the simulated sensors (default 1)")
    demo.add_argument(
        "--tracker",
        default="ckf",
        choices=("ckf", "imm", "gm-phd"),
        help="of the three radars: Gaussians (default), mixtures, or intensities, which an IntensityCentre fuses",
    )
    demo.add_argument("--cameras", action="store_true", help="autoferry: the bearing-only cameras too")
    demo.add_argument("--out", metavar="DIR", help="folder of the results (default runs/<scenario>-<rule>-<UTC time>)")
    demo.add_argument("--json", metavar="FILE", help="write the scores here")

    check = command(
        "check", "Check a config; without a file, print one with every default.", "fusion-service check centre.toml"
    )
    check.add_argument("config", nargs="?", metavar="FILE", help="TOML file")

    command("rules", "The fusion rules and what each promises.", "fusion-service rules")

    for module in COMMANDS:
        sub = command(module.__name__.rpartition(".")[2].replace("_", "-"), module.HELP, module.EXAMPLE)
        module.add(sub)
        sub.set_defaults(call=module.run)
    return parser


def _hub(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.bus.hub import run_hub

    run_hub(args.listen or [DEFAULT_ENDPOINT], stop)


def _run(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.bus import open_bus
    from fusion_service.config import ServiceConfig, load_config
    from fusion_service.service.daemon import run_service

    config = load_config(args.config) if args.config else ServiceConfig()
    if args.connect:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, connect=tuple(args.connect)))
    if args.hub:
        with open_bus(listen=config.bus.connect, mode="router"):
            run_service(config, stop)
    else:
        run_service(config, stop)


def _record(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.bus import open_bus
    from fusion_service.config import ConfigError
    from fusion_service.recording import Rotation, default_path, run_recorder
    from fusion_service.recording.live import DEFAULT_ADDRESS, Live
    from fusion_service.recording.parts import is_folder

    limits = (args.rotate_size, args.rotate_every, args.keep_size, args.keep_for)
    rotation = None
    if any(limit is not None for limit in limits) or (args.out and is_folder(args.out)):
        try:
            rotation = Rotation(*limits)
        except ValueError as error:
            raise ConfigError([f"fusion-service record: {error}"]) from None
    path = Path(args.out) if args.out else default_path(suffix=".rrd" if rotation is None else "")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and (rotation is None or path.is_file()):
        raise FileExistsError(f"{path} exists already: name another file, or move it away")
    if (args.live or args.live_web) and args.no_draw:
        raise ConfigError(["fusion-service record: --live shows what is drawn: leave out --no-draw"])
    with ExitStack() as stack:
        live = None
        if args.live or args.live_web:
            live = Live(*(args.live or DEFAULT_ADDRESS), web=args.live_web)
            stack.callback(live.close)
            print(f"live: rerun --connect {live.url}" + (f"\nlive: {live.page}" if live.page else ""), flush=True)
        bus = stack.enter_context(open_bus(args.connect or [DEFAULT_ENDPOINT], stop=stop))
        run_recorder(
            bus,
            path,
            realm=args.realm,
            stop=stop,
            cutoff=args.cutoff,
            draw=not args.no_draw,
            rotation=rotation,
            live=live,
            interval=args.flush,
        )


def _demo(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.demo import run_demo

    run_demo(
        scenario=args.scenario,
        rule=args.rule,
        criterion=args.criterion,
        memory=args.memory,
        changes=args.set,
        data=args.data,
        speed=args.speed,
        seed=args.seed,
        tracker=args.tracker,
        cameras=args.cameras,
        out=Path(args.out) if args.out else None,
        json_path=Path(args.json) if args.json else None,
        stop=stop,
    )


def _check(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.config import config_hash, example_toml, load_config

    if args.config is None:
        sys.stdout.write(example_toml())
        return
    config = load_config(args.config)
    print(
        f"{args.config}: good ({config.centre.rule}, {config.centre.memory} memory, hash {config_hash(config.centre)})"
    )


def _rules(args: argparse.Namespace, stop: threading.Event) -> None:
    from fusion_service.rules import RULES

    for rule in RULES.values():
        options = ", ".join(f"{name}={value!r}" for name, value in rule.options.items()) or "none"
        print(f"{rule.name:<18}{'N-way   ' if rule.n_way else 'pairwise'}  {rule.promise}")
        print(f"{'':<18}options: {options}; source: {rule.source}")


HERE = {"hub": _hub, "run": _run, "record": _record, "demo": _demo, "check": _check, "rules": _rules}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    try:
        args = _parser().parse_args(argv)
        with stop_on_signals() as stop:
            return _call(args, stop)
    except KeyboardInterrupt:  # before the handlers were there
        return 130


def _call(args: argparse.Namespace, stop: threading.Event) -> int:
    set_up_logging(args.verbose)
    from fusion_service.bus import BusError, BusStopped  # slow to import: only now is a signal heard
    from fusion_service.config import ConfigError
    from fusion_service.demo import DemoError
    from fusion_service.errors import ReviewError
    from fusion_service.service.state import StateError

    try:
        (HERE.get(args.command) or args.call)(args, stop)
    except BusStopped:
        return 0
    except ConfigError as error:
        print("\n".join(error.problems), file=sys.stderr)
        return 2
    except (BusError, DemoError, ImportError, ReviewError, StateError, OSError) as error:
        print(f"fusion-service {args.command}: {error}", file=sys.stderr)
        return 1
    return 0
