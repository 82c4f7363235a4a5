"""How soon `top` shows a client that is wrong, and what it costs: `python -m tests.lookout` (about a minute)."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import msgpack

from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import Scene, opened
from tests.helpers.terminal import Terminal
from tests.service.test_wrong_clients import SETTINGS, WRONG

SHOWN = {
    "seconds": "is `time` in seconds",
    "states": 'did you mean "x"',
    "json": "payload is JSON",
    "silent": "no sensor_info came",
    "narrow": "is radius in m",
}
"""Client that is wrong -> words by which it is known."""
SPAN = 15.0
PATIENCE = 30.0


def shown_after(scene: Scene, top: Terminal, name: str, words: str) -> float:
    """Seconds from the first message of a wrong client to its fault on the screen."""
    out = {what: scene.bus.publisher(f"fusion/v1/local/{name}/{what}") for what in ("tracks", "info")}
    scene.bus.announce(f"fusion/v1/local/{name}/alive")
    k, begin = 0, time.monotonic()
    while not top.shows(words) and time.monotonic() - begin < PATIENCE:
        now = time.time_ns()
        for what, make in (("tracks", WRONG[name].tracks), ("info", WRONG[name].info)):
            if make is not None and (what == "tracks" or k % 5 == 0):
                said = make(name, k, now)
                out[what].put(said if isinstance(said, bytes) else msgpack.packb(said))
        k += 1
        time.sleep(0.1)
    return time.monotonic() - begin


def processor(process: int, seconds: float) -> float:
    """Seconds of processor time that a process takes in so many."""

    def ticks() -> int:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])

    before = ticks()
    time.sleep(seconds)
    return (ticks() - before) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Print both."""
    with tempfile.TemporaryDirectory() as folder:
        hub = Hub().start()
        try:
            with opened(hub, Path(folder)) as scene:
                measure(scene, scene.service(SETTINGS))
        finally:
            hub.kill()


def measure(scene: Scene, service: Program) -> None:
    """With a service that has just begun."""
    for name in ("r1", "r2", "r3"):
        scene.sensor(name, *range(20))
    eventually(lambda: scene.said_of("r3", "rate"), PATIENCE)
    without = processor(service.pid, SPAN)
    with Terminal("top", "--connect", scene.endpoint, width=110, height=60) as top:
        eventually(lambda: top.shows("centre centre: up", "r3"), PATIENCE)
        beside = processor(service.pid, SPAN)
        own = processor(top.process.pid, SPAN)
        print(
            f"three sources of 20 tracks, processor time in {SPAN:g} s: service without top {without:.2f} s, ", end=""
        )
        print(f"with it {beside:.2f} s; top {own:.2f} s; load {os.getloadavg()[0]:.1f}")
        for name, words in SHOWN.items():
            print(f"{name:<10} shown after {shown_after(scene, top, name, words):.1f} s", flush=True)
        wrong, begin = scene.bus.publisher("fusoin/v1/local/m02/tracks"), time.monotonic()
        while not top.shows("did you mean 'fusion'") and time.monotonic() - begin < PATIENCE:
            wrong.put(b"?")
            time.sleep(0.1)
        print(f"{'realm':<10} shown after {time.monotonic() - begin:.1f} s")


if __name__ == "__main__":
    main()
