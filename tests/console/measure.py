"""What the console costs: `python -m tests.console.measure`; a minute and a half.

1. A service with 3 sensors of 300 tracks, one scan a second each: its CPU without and with a console that a browser
   looks at, in turns. The console is a client of the hub like any display: the service sends one copy to the hub.
2. A page with 5,000 tracks a second: times between frames of headless Chromium, which draws in software, at rest and
   while the map is dragged; bytes a second; CPU of the console.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from fusion_service.bus import open_bus
from tests.helpers.browser import Browser, Page
from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import COMMAND, Observer

TURNS, SPELL = 3, 8.0
SENSOR = """
import sys, time
import numpy as np
from schemas import Enu, Motion
from sensor_clients.publisher import TrackPublisher
endpoint, name, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
rng = np.random.default_rng(1)
places, noise = rng.uniform(-30000, 30000, (count, 4)) * [1, 1, 0, 0], np.random.default_rng(len(name))
with TrackPublisher(name, connect=endpoint) as publisher:
    publisher.info(frame=Enu(59.0, 10.5), position=(0, 0, 0), period=1.0, motion=Motion("cv", 1.0))
    while True:
        publisher.tracks(time=time.time_ns(), space=("x", "y", "vx", "vy"), frame=Enu(59.0, 10.5),
                         ids=range(1, count + 1), means=places + noise.normal(size=(count, 4)),
                         covariances=np.tile(np.diag([25.0, 25.0, 4.0, 4.0]), (count, 1, 1)))
        time.sleep(1.0)
"""
CENTRE = """
import sys, time
import numpy as np
import schemas
from dataclasses import replace
from fusion_service.bus import open_bus
from tests.console.scenes import picture, status
count, now = 5000, time.time_ns()
rng = np.random.default_rng(1)
means = np.concatenate([rng.uniform(-30000, 30000, (count, 2)), rng.uniform(-15, 15, (count, 2))], axis=1)
shape = rng.normal(size=(count, 2, 2)) * 120
P = np.tile(np.eye(4) * 4, (count, 1, 1))
P[:, :2, :2] = shape @ shape.transpose(0, 2, 1) + 400 * np.eye(2)
with open_bus([sys.argv[1]], wait=20) as bus:
    tracks, told = (bus.publisher(schemas.global_key("centre", what)) for what in ("tracks", "status"))
    bus.announce(schemas.global_key("centre", "alive"))
    for step in range(1, 10**6):
        now = time.time_ns()
        means[:, :2] += means[:, 2:]
        whole = picture(count, step, means=means, covariances=P, identity=("mmsi:257000000", None) * (count // 2))
        tracks.put(schemas.encode(replace(whole, epoch=now if step == 1 else 1, time=now, sent=now)))
        told.put(schemas.encode(status(now)))
        time.sleep(max(0.0, 1.0 - (time.time_ns() - now) / 1e9))
"""
GAPS = """
new Promise((done) => {
  const gaps = [];
  let last = performance.now();
  const begin = last;
  const bytes = fusionConsole.figures().bytes;
  const frame = (now) => {
    gaps.push(now - last);
    last = now;
    if (now - begin < %d) requestAnimationFrame(frame);
    else {
      const sorted = gaps.slice(1).sort((one, other) => one - other);
      const at = (share) => sorted[Math.floor(share * (sorted.length - 1))].toFixed(1);
      const rate = ((fusionConsole.figures().bytes - bytes) / (now - begin)).toFixed(0);
      const took = fusionConsole.figures().took.map((one) => one.toFixed(0)).join(', ');
      done(`p50 ${at(0.5)} ms, p95 ${at(0.95)} ms, p99 ${at(0.99)} ms, most ${at(1)} ms of ${sorted.length} frames; ` +
           `${rate} kB/s; base, tracks, chosen drawn in ${took} ms`);
    }
  };
  requestAnimationFrame(frame);
})"""


def cpu(program: Program) -> float:
    """Seconds of CPU that a process has had."""
    fields = Path(f"/proc/{program._process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def share(program: Program, seconds: float) -> float:
    """Of one core, in per cent, for so many seconds."""
    before, begin = cpu(program), time.monotonic()
    time.sleep(seconds)
    return 100 * (cpu(program) - before) / (time.monotonic() - begin)


def console(start: Callable[..., Program], endpoint: str) -> tuple[Program, str]:
    program = start(COMMAND, "console", "--connect", endpoint, "--listen", "127.0.0.1:0")
    return program, program.line(60).removeprefix("console: ")


def service_with_and_without(stack: ExitStack) -> None:
    hub = Hub().start()
    stack.callback(hub.kill)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    (folder / "centre.toml").write_text(f'[bus]\nconnect = ["{hub.endpoint}"]\n[service]\nstate = "{folder}/state"\n')

    def start(*command: str) -> Program:
        return stack.enter_context(Program(*command))

    service = start(COMMAND, "run", "--config", str(folder / "centre.toml"))
    for name in ("a", "bb", "ccc"):
        start(SENSOR, hub.endpoint, name, "300")
    with open_bus([hub.endpoint], wait=20.0) as bus:
        seen = Observer(bus)
        eventually(lambda: seen.pictures and (seen.pictures[-1].status == 1).sum() > 250, 60)
    browser = stack.enter_context(Browser())
    shares: dict[str, list[float]] = {"without": [], "with": []}
    for _ in range(TURNS):
        shares["without"].append(share(service, SPELL))
        with Program(COMMAND, "console", "--connect", hub.endpoint, "--listen", "127.0.0.1:0") as one:
            page = browser.page(one.line(60).removeprefix("console: "))
            page.until("document.querySelector('#map').dataset.tracks > 250", 60)
            shares["with"].append(share(service, SPELL))
            page.call("Page.navigate", url="about:blank")
    for name, values in shares.items():
        print(f"service {name} a console: {', '.join(f'{one:.1f}' for one in values)} % of a core")


def drag(page: Page, seconds: float) -> None:
    """Drag the map to and fro."""
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=400, y=400, button="left", clickCount=1)
    begin, k = time.monotonic(), 0
    while time.monotonic() - begin < seconds:
        k += 1
        x = 400 + 150 * ((k % 40) / 20 - 1 if k % 80 < 40 else 1 - (k % 40) / 20)
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=400 + k % 30, button="left", buttons=1)
        time.sleep(0.02)
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=400, y=400, button="left", clickCount=1)


def page_with_many(stack: ExitStack) -> None:
    hub = Hub().start()
    stack.callback(hub.kill)

    def start(*command: str) -> Program:
        return stack.enter_context(Program(*command))

    start(CENTRE, hub.endpoint)
    program, address = console(start, hub.endpoint)
    page = stack.enter_context(Browser()).page(address)
    page.until("document.querySelector('#map').dataset.tracks >= 5000", 60)
    time.sleep(5.0)
    before, begin = cpu(program), time.monotonic()
    print(f"5,000 tracks a second, at rest: {page.js(GAPS % 15000)}")
    print(f"console: {100 * (cpu(program) - before) / (time.monotonic() - begin):.1f} % of a core")
    page.js(f"globalThis.gaps = {GAPS % 8000}; 0")
    drag(page, 8.5)
    print(f"while it is dragged: {page.js('globalThis.gaps')}")


def main() -> None:
    parts = {"service": service_with_and_without, "page": page_with_many}
    for name in sys.argv[1:] or parts:
        with ExitStack() as stack:
            parts[name](stack)
    print(f"load of the machine: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
