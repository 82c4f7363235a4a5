"""`sensor-client`: simulated and recorded sensors, each a process of its own on the bus."""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusion_service import __version__
from fusion_service.bus import DEFAULT_ENDPOINT
from fusion_service.bus.options import bus_options
from fusion_service.errors import UsageError
from fusion_service.process import Parser, argument, data_folder, exit_code, positive, stop_on_signals, whole
from schemas import check_realm
from sensor_clients.events import Event, Scenario
from sensor_clients.faults import faulty, read_fault
from sensor_clients.playback import autoferry, mrclam, radar_v2x, table
from sensor_clients.publisher import TrackPublisher, TruthPublisher
from sensor_clients.runner import pace
from sensor_clients.scenarios.three_radars import TRACKERS, three_radars

__all__ = ["main"]

EXAMPLES = """examples:
  sensor-client list
  sensor-client simulate three-radars --sensor radar1
  sensor-client simulate three-radars --sensor radar2 --tracker imm
  sensor-client simulate three-radars --sensor radar2 --fault clock=0.5,x=200,heading=0.3
  sensor-client simulate three-radars --sensor truth --speed 10 --start-at 1767225600
  sensor-client playback autoferry:2 --sensor lidar --data /data/autoferry --connect tcp/192.0.2.1:7447
  sensor-client simulate three-radars --sensor radar1 --security keys/source-radar1
  sensor-client playback autoferry:2 --sensor ir --data /data/autoferry
  sensor-client playback radar-v2x --sensor radar --data /data
  sensor-client playback mrclam:6 --sensor robot1 --data /data
  sensor-client check radar1                               what is wrong with it, and what the centre does with it
  sensor-client check message.msgpack
  sensor-client playback tracks.csv --sensor radar1        what `fusion-service export` has written
"""


class _Recorded(NamedTuple):
    """Recordings with a number: which there are, how one is read, and what its files are called."""

    numbers: tuple[int, ...]
    load: Callable[[Path, int], Scenario]
    files: str


RECORDED = {
    "autoferry": _Recorded(autoferry.SCENARIOS, autoferry.load, "the Autoferry JSON files"),
    "mrclam": _Recorded(mrclam.SETS, mrclam.load, "the MR.CLAM sets, or one above it"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code, which is as that of `fusion-service`."""
    arguments = _parser().parse_args(argv)
    return exit_code("sensor-client", lambda: arguments.run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="sensor-client",
        description="Publish the tracks of one simulated or recorded sensor, or the truth.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    simulate = _command(commands, "simulate", "simulate a sensor and its local tracker", EXAMPLES)
    simulate.add_argument("scenario", help="three-radars")
    simulate.add_argument("--seed", type=argument(whole), default=0, help="seed of noise and clutter (default 0)")
    simulate.add_argument("--tracker", choices=TRACKERS, default="ckf", help="of the radars (default ckf); see list")
    simulate.set_defaults(run=_simulate)
    playback = _command(commands, "playback", "play recorded returns through a local tracker, or tracks", EXAMPLES)
    numbers = ", ".join(map(str, autoferry.SCENARIOS))
    playback.add_argument(
        "scenario", help=f"autoferry:N, N one of {numbers}; mrclam:6; radar-v2x; or a .csv or .parquet file of tracks"
    )
    playback.add_argument(
        "--data", type=Path, help="directory of the recording, or that holds it by its name (default: $FUSION_DATA)"
    )
    playback.set_defaults(run=_playback)
    for command in (simulate, playback):
        command.add_argument("--sensor", required=True, help="which of the scenario's sensors, or truth")
        bus_options(command, "certificates of this sensor")
        command.add_argument(
            "--fault",
            type=argument(read_fault),
            metavar="NAME=NUMBER,...",
            help="make the source wrong on purpose: clock and delay (s), x and y (m), heading (degrees), range (m), "
            "scale, sigma (factor), loss (share), stuck (s)",
        )
        command.add_argument(
            "--speed", type=argument(positive), default=1.0, help="scenario seconds per second (default 1)"
        )
        command.add_argument(
            "--start-at", type=float, metavar="UNIX_SECONDS", help="when the scenario starts (default: now)"
        )
        command.add_argument(
            "--duration", type=argument(positive), metavar="S", help="stop after S seconds of the scenario"
        )
    _add_check(commands)
    listing = _command(commands, "list", "scenarios, their sensors and parameters with their sources", EXAMPLES)
    listing.set_defaults(run=_list)
    return parser


def _add_check(commands: Any) -> None:
    checking = _command(commands, "check", "say all that is wrong with what a source sends, or with a file", EXAMPLES)
    checking.add_argument("what", metavar="SOURCE|FILE", help="name of a source on the bus, or a file of messages")
    checking.add_argument(
        "--for",
        dest="seconds",
        type=argument(positive),
        default=10.0,
        metavar="S",
        help="listen so long (default 10 s)",
    )
    bus_options(checking, "a certificate that may listen: a recorder's, or a viewer's for what centres say of it")
    checking.set_defaults(run=_check)


def _check(arguments: argparse.Namespace) -> None:
    from sensor_clients.checking import check_file, check_source

    path = Path(arguments.what)
    if path.is_file() or len(path.parts) > 1 or path.suffix in (".msgpack", ".bin", ".json"):
        check_file(path)
        return
    with stop_on_signals() as stop:
        check_source(arguments.what, arguments, stop)


def _command(commands: Any, name: str, text: str, epilog: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=text, description=text, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    return parser


def _list(_: argparse.Namespace) -> None:
    print(_describe(three_radars(), "simulate three-radars"))
    print("  trackers: " + "; ".join(f"{name}, {what}" for name, what in TRACKERS.items()))
    print()
    print(f"playback autoferry:N  N in {', '.join(map(str, autoferry.SCENARIOS))}: {autoferry.SUMMARY}")
    print(f"  sensors: {', '.join(autoferry.SENSORS)}, truth; needs --data or FUSION_DATA")
    print(_table(autoferry.PARAMETERS))
    print()
    print(f"playback radar-v2x  {radar_v2x.SUMMARY}")
    print(f"  sensors: {', '.join(radar_v2x.SENSORS)}; needs --data or FUSION_DATA")
    print(_table(radar_v2x.PARAMETERS))
    print()
    print(f"playback mrclam:N  N in {', '.join(map(str, mrclam.SETS))}: {mrclam.SUMMARY}")
    print(f"  sensors: {', '.join(mrclam.SENSORS)}, truth; needs --data or FUSION_DATA")
    print(_table(mrclam.PARAMETERS))


def _describe(scenario: Scenario, command: str) -> str:
    head = f"{command}  {scenario.summary}\n  sensors: {', '.join(scenario.sensors)}, truth"
    return f"{head}\n{_table(scenario.parameters)}"


def _table(parameters: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[column]) for row in parameters) for column in range(2)]
    return "\n".join(f"    {name:{widths[0]}}  {value:{widths[1]}}  {source}" for name, value, source in parameters)


def _simulate(arguments: argparse.Namespace) -> None:
    if arguments.scenario != "three-radars":
        raise UsageError(f"no simulated scenario {arguments.scenario!r}; known: three-radars")
    _publish(three_radars(arguments.tracker), arguments, arguments.seed)


def _playback(arguments: argparse.Namespace) -> None:
    path = Path(arguments.scenario)
    if path.suffix in table.SUFFIXES:
        _publish(table.load(path), arguments, 0, table.lineage(path, arguments.sensor))
        return
    if arguments.scenario == "radar-v2x":
        folder = data_folder("radar-v2x", arguments.data)
        if folder is None:
            raise UsageError(
                "no data: say --data DIR or set FUSION_DATA to the directory of radar.csv, or one above it"
            )
        _publish(radar_v2x.load(radar_v2x.find(folder)), arguments, 0)
        return
    name, _, number = arguments.scenario.partition(":")
    kind = RECORDED.get(name)
    if kind is None or number not in map(str, kind.numbers):
        known = ", ".join(f"{name}:{n}" for name, kind in RECORDED.items() for n in kind.numbers)
        raise UsageError(
            f"no recorded scenario {arguments.scenario!r}; known: {known}, radar-v2x, or a .csv or .parquet file"
        )
    data = data_folder(name, arguments.data)
    if data is None:
        raise UsageError(f"no data: say --data DIR or set FUSION_DATA to the directory of {kind.files}")
    _publish(kind.load(data, int(number)), arguments, 0)


def _publish(
    scenario: Scenario, arguments: argparse.Namespace, seed: int, lineage: Sequence[str] | None = None
) -> None:
    sensor = arguments.sensor
    if sensor != "truth" and sensor not in scenario.sensors:
        raise UsageError(
            f"no sensor {sensor!r} in {scenario.name}; known: {', '.join([*filter(None, scenario.sensors), 'truth'])}"
        )
    events: Iterator[Event]
    kind: type[TrackPublisher] | type[TruthPublisher]
    if sensor == "truth":
        events, name, kind = scenario.truth(), scenario.name, TruthPublisher
    else:
        events, name, kind = scenario.sensors[sensor](seed), sensor, TrackPublisher
        if arguments.fault is not None:
            events = faulty(events, arguments.fault, seed)
    if arguments.duration is not None:
        end = scenario.start + round(arguments.duration * 1e9)
        events = itertools.takewhile(lambda event: event.time <= end, events)
    where = {"connect": arguments.connect or DEFAULT_ENDPOINT, "realm": arguments.realm, "origin": scenario.origin}
    where["security"] = arguments.security
    if kind is TrackPublisher:
        where["lineage"] = lineage
    with stop_on_signals() as stop:
        try:
            check_realm(arguments.realm)
            opening = kind(name, stop=stop, **where)
        except ValueError as error:
            raise UsageError(str(error)) from None
        with opening as publisher:
            start_at = time.time() if arguments.start_at is None else arguments.start_at
            pace(events, publisher, start=scenario.start, start_at=start_at, speed=arguments.speed, stop=stop)
