"""A hard mission and its review: `python -m benchmarks.review_mission [--out runs/review] [--speed 20]`.

Three radars on a bus of their own, recorded into a folder. Under way the service, radar 2 and the recorder are killed
(SIGKILL), one after the other, and started again. Then, with the commands of the analyst: the recording is verified
by its logs, fused again under five rules, and all of them compared on one page. docs/review.md shows what comes out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from fusion_service.demo import (
    START,
    Crew,
    client_arguments,
    free_endpoint,
    plan_mission,
    record_arguments,
    write_config,
)

RULES = ("naive", "ci", "bci:max_correlation=0.5", "ici", "hmd-ga")
KILLS = ((100.0, "service"), (150.0, "radar2"), (200.0, "record"))
"""When, seconds of mission, which process is killed; it is started again at once."""


def fly(folder: Path, speed: float) -> Path:
    """Fly the mission; returns the recording, a folder."""
    plan = plan_mission("three-radars")
    endpoint = free_endpoint()
    config = write_config(folder, {"clock": "message", "rule": "ci", **plan.settings(speed)}, endpoint)
    recording = folder / "mission"
    with Crew(folder) as crew:
        commands = {
            "hub": ["fusion_service", "hub", "--listen", endpoint],
            "service": ["fusion_service", "run", "--config", str(config)],
            "record": record_arguments(f"{recording}/", endpoint, plan.cutoff),
        }
        for name in ("hub", "record", "service"):
            crew.start(name, commands[name])
            time.sleep(3.0)
        begin = time.time() + START
        for name, command in plan.clients.items():
            commands[name] = client_arguments(command, endpoint, speed, begin)
            crew.start(name, commands[name])
        for at, name in KILLS:
            time.sleep(max(0.0, begin + at / speed - time.time()))
            crew.kill(name)
            crew.start(name, commands[name])
            print(f"{at:5.0f} s  {name} killed and started again", flush=True)
        while crew.running(*plan.clients):
            time.sleep(0.2)
        time.sleep(3.0)
        crew.stop("service")
        crew.stop("record")
    return recording


def run(*arguments: str) -> None:
    """One of the analyst's commands, as typed."""
    print(f"\n$ fusion-service {' '.join(arguments)}", flush=True)
    done = subprocess.run([sys.executable, "-m", "fusion_service", *arguments])
    if done.returncode:
        raise SystemExit(done.returncode)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs") / "review")
    parser.add_argument("--speed", type=float, default=10.0)
    args = parser.parse_args()
    args.out.mkdir(parents=True)
    recording = fly(args.out, args.speed)
    rules = args.out / "rules.rrd"
    run("replay", str(recording), "--verify")
    run("replay", str(recording), *(part for rule in RULES for part in ("--rule", rule)), "--out", str(rules))
    run("evaluate", str(rules), "--cutoff", "5000", "--html", str(args.out / "rules.html"))
    run("explain", str(recording))


if __name__ == "__main__":
    main()
