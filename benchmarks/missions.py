"""The tables of docs/measurements.md: whole missions by `fusion-service demo`, one after the other.

python -m benchmarks.missions                      three radars under each rule
python -m benchmarks.missions --data DIR           Autoferry 2, 3, 5, 13, 16 as well, without and with cameras
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

RULES = (("auto", None), ("naive", None), ("ci", "det"), ("ci", "trace"), ("hmd-ga", "det"))
SCENARIOS = (2, 3, 5, 13, 16)
TO_BEAT = {"2": 8.8, "3": 21.6, "5": 16.8, "13": 15.0, "16": 16.8, "mean": 15.8}
"""A centralised JPDA tracker on the same returns, tuned on these five (Stone Soup)."""


def demo(*arguments: str, speed: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        scores = Path(folder) / "scores.json"
        command = [sys.executable, "-m", "fusion_service", "demo", "--speed", str(speed), "--out", f"{folder}/out"]
        done = subprocess.run([*command, "--json", str(scores), *arguments], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(arguments)} failed: {done.stderr.strip().splitlines()[-1:]}")
        result: dict[str, Any] = json.loads(scores.read_text())
        return result


def cells(name: str, one: dict[str, float]) -> str:
    parts = " | ".join(f"{one[key]:.3g}" for key in ("gospa_localisation", "gospa_missed", "gospa_false"))
    return f"| {name} | {one['gospa']:.4g} | {parts} | {one['rmse_position']:.3g} | {one['anees']:.2f} |"


def three_radars(speed: float) -> None:
    print("| | GOSPA, m | localisation, m2 | missed, m2 | false, m2 | RMSE, m | ANEES |\n|---|---|---|---|---|---|---|")
    shared: list[tuple[str, dict[str, Any]]] = []
    for rule, criterion in RULES:
        options = ["--rule", rule, *(["--criterion", criterion] if criterion else [])]
        result = demo(*options, speed=speed)
        label = f"{rule} {criterion or ''}".strip()
        if not shared:
            for name, one in result["sources"].items():
                print(cells(name, one), flush=True)
        print(cells(f"fused, `{label}`", result["fused"]), flush=True)
        shared.append((label, result["shared"]))
    print("\n| targets tracked by | rule | RMSE fused, m | best single radar, m | ANEES fused | best single |")
    print("|---|---|---|---|---|---|")
    for key, words in (("seen_by_2", "two radars"), ("seen_by_3", "three radars")):
        for label, both in shared:
            one = both[key]
            print(
                f"| {words} | `{label}` | {one['fused_rmse']:.1f} | {one['best_rmse']:.1f} "
                f"| {one['fused_anees']:.2f} | {one['best_anees']:.2f} |"
            )


def autoferry(data: str, speed: float) -> None:
    print("\n| scenario | lidar | radar | fused | localisation | missed | false | RMSE, m | ANEES | to beat |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    keys = ("gospa", "gospa_localisation", "gospa_missed", "gospa_false", "rmse_position", "anees")
    rows = []
    for number in SCENARIOS:
        result = demo("--scenario", f"autoferry:{number}", "--data", data, speed=speed)
        sources = [result["sources"][name]["gospa"] for name in ("lidar", "radar")]
        rows.append([*sources, *(result["fused"][key] for key in keys)])
        print(f"| {number} | {' | '.join(f'{value:.4g}' for value in rows[-1])} | {TO_BEAT[str(number)]} |", flush=True)
    means = [sum(column) / len(rows) for column in zip(*rows, strict=True)]
    print(f"| mean | {' | '.join(f'{value:.4g}' for value in means)} | {TO_BEAT['mean']} |")


def cameras(data: str, speed: float) -> None:
    print("\n| scenario | cameras | GOSPA, m | localisation | missed | false | ANEES | identity switches |")
    print("|---|---|---|---|---|---|---|---|")
    keys = ("gospa", "gospa_localisation", "gospa_missed", "gospa_false", "anees", "identity_switches")
    for label, options in (("without", []), ("with", ["--cameras"])):
        rows = []
        for number in SCENARIOS:
            arguments = ["--scenario", f"autoferry:{number}", "--data", data, "--rule", "hmd-ga", *options]
            fused = demo(*arguments, speed=speed)["fused"]
            rows.append([fused[key] for key in keys])
            print(f"| {number} | {label} | {' | '.join(f'{value:.4g}' for value in rows[-1])} |", flush=True)
        means = [sum(column) / len(rows) for column in zip(*rows, strict=True)]
        print(f"| mean | {label} | {' | '.join(f'{value:.4g}' for value in means)} |", flush=True)


def trackers(speed: float) -> None:
    print("\n| radars publish | fused by | GOSPA, m | localisation, m2 | missed, m2 | false, m2 | RMSE, m | ANEES |")
    print("|---|---|---|---|---|---|---|---|")
    cases = (
        ("Gaussians", "`ci`", ["--rule", "ci"]),
        ("IMM mixtures", "`gm-ga`", ["--tracker", "imm", "--set", "mixture_rule=gm-ga"]),
        ("IMM mixtures", "`auto` on moments", ["--tracker", "imm"]),
        ("intensities", "`hybrid`", ["--tracker", "gm-phd"]),
        ("intensities", "`aa`", ["--tracker", "gm-phd", "--set", "intensity_rule=aa"]),
        ("intensities", "`ga`", ["--tracker", "gm-phd", "--set", "intensity_rule=ga"]),
    )
    for what, how, options in cases:
        row = cells(how, demo(*options, speed=speed)["fused"])
        print(f"| {what} {row}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="folder of the Autoferry recordings")
    parser.add_argument("--speed", type=float, default=20.0, help="times real time (default 20)")
    parser.add_argument("--only-autoferry", action="store_true")
    args = parser.parse_args()
    if not args.only_autoferry:
        three_radars(args.speed)
        trackers(args.speed)
    if args.data:
        autoferry(args.data, args.speed)
        cameras(args.data, args.speed)


if __name__ == "__main__":
    main()
