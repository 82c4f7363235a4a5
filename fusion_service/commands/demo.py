"""`fusion-service demo`."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

from fusion_service.process import argument, positive, whole

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "A whole mission: hub, service, clients and recorder as processes, then a table, a map and a recording."
EXAMPLE = """fusion-service demo
  fusion-service demo --live
  fusion-service demo --rule hmd-ga --json result.json
  fusion-service demo --memory tracklet
  fusion-service demo --fault radar2:clock=0.5,heading=0.3 --set registration=correct
  fusion-service demo --scenario autoferry:2 --data DIR --speed 10
  fusion-service demo --scenario mrclam:6 --data DIR
  fusion-service demo --rule bci --set rule_options.max_correlation=0.5 --set gate=0.99"""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("--scenario", default="three-radars", help="three-radars (default), autoferry:N, or mrclam:6")
    parser.add_argument(
        "--data",
        metavar="DIR",
        help="folder of the recordings, or that holds autoferry/, mrclam/ (default: $FUSION_DATA)",
    )
    parser.add_argument(
        "--rule",
        default="auto",
        help="fusion rule (default auto; `fusion-service rules` lists them), or FILE.py:FUNCTION",
    )
    parser.add_argument("--criterion", help="of the rule's weights: det or trace")
    parser.add_argument(
        "--memory",
        default="auto",
        choices=("auto", "restart", "recursive", "tracklet"),
        help="what is fused beside the newest local tracks (default auto: tracklets with rule auto, else nothing)",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the centre, above all others"
    )
    parser.add_argument(
        "--speed", type=argument(positive), default=None, help="times faster than real time (default 10, mrclam 5)"
    )
    parser.add_argument("--seed", type=argument(whole), default=1, help="of the simulated sensors (default 1)")
    parser.add_argument(
        "--tracker",
        default="ckf",
        choices=("ckf", "imm", "gm-phd"),
        help="of the three radars: Gaussians (default), mixtures, or intensities, which an IntensityCentre fuses",
    )
    parser.add_argument("--cameras", action="store_true", help="autoferry: the bearing-only cameras too")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="SOURCE:NAME=NUMBER,...",
        help="make a source wrong on purpose, as `sensor-client simulate --fault` does; several times",
    )
    parser.add_argument(
        "--out", metavar="DIR", help="folder of the results (default runs/<scenario>-<rule>-<UTC time>)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the scores here")
    parser.add_argument(
        "--live", action="store_true", help="open the Rerun viewer while it flies; without a screen, say how to look on"
    )


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Fly the mission and print its scores. Raises what `run_demo` does."""
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
        faults=args.fault,
        out=Path(args.out) if args.out else None,
        json_path=Path(args.json) if args.json else None,
        stop=stop,
        live=args.live,
    )
