"""Consensus at every node over real peers (Dubey IV: "fusion was performed at each node, and a single-step fusion was
sufficient to achieve consensus, resulting in identical track densities across all trackers").

Four processes on the loopback, each a tracker of the first scenario of `dubey-sonobuoys-cv`. Each publishes its own
track on the bus and runs a fusion service of its own on all four (`clock = "message"`, a step every 15 s of the
mission's time, `hmd-ga` with det weights). The study itself holds the hub, through which messages go. Nobody is the
master: no service hears another.

* **alone**: the trackers filter by themselves, and what the services fuse goes nowhere.
* **fed back**: a tracker waits for the fused density of its own service, and its filter goes on from that.

In a round each node publishes one message; each service receives four, makes one step, and publishes. Missions follow
each other ten minutes apart in their own time. Every node simulates the whole world from the same seed, but publishes
its own track only, and of the others it knows what its own service says. The messages tell no lineage, though a track
that was fed back contains the data of all: a service that knew would fuse by covariance intersection, and the study is
of what the rule makes of them.

The batch is the same missions from the same seeds in one process without a bus: `fuse_last` on the tracks that run
alone, and `studies.sonobuoys.fly` with consensus for those that are fed back.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import socket
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from queue import Empty, Queue
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fusion_service.bus import open_bus
from fusion_service.config import BusConfig, DaemonConfig, ServiceConfig, centre_config
from fusion_service.rules import Fused
from fusion_service.service.daemon import run_service
from schemas import GlobalTracks, Local, Motion, Status, decode, global_key
from sensor_clients.publisher import TrackPublisher
from studies import sonobuoys
from studies.rules import fuser
from studies.sonobuoys import CV, Q1, STEPS, TRACKERS, T
from studies.study import Floats, Result, Row, Run, Study

RULE = "hmd-ga"
SOURCES = tuple(f"tracker-{j + 1}" for j in range(TRACKERS))
FRAME = Local("sonobuoys")
SPACE = ("x", "y", "vx", "vy")
MODES = ("alone", "fed back")
BEGIN = 1_700_000_100
"""Time of the first scan, s; any multiple of the period in the past."""
PAUSE = 600.0
"""Between one mission and the next, s of their own time."""
SHORT = 12
"""Scans of the one short mission in CI."""
PATIENCE = 60.0
"""Seconds of waiting after which a node gives up."""
SETTINGS = {
    "clock": "message",
    "period": T,
    "lateness": 1000.0,  # a step is made once all four have said their track, however late one is
    "rule": RULE,
    "frame": FRAME,
    "motion": Motion("cv", Q1),
    "gate": 1 - 1e-9,
    "keep_gate": 1 - 1e-12,
    "coast": T,
}


@dataclass(frozen=True, slots=True)
class Missions:
    """`count` missions of so many scans after the first; then as many that are fed back."""

    seed: int
    count: int
    scans: int

    def fly(self, number: int, consensus: Callable[[Floats, Floats], Fused] | None) -> sonobuoys.Tracks:
        rng = np.random.default_rng([self.seed, number])
        return sonobuoys.fly(CV, rng, sonobuoys.field(rng, 1), consensus=consensus, steps=self.scans)[1]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a node has seen: fused means (modes, count, K, 4) and covariances (modes, count, K, 4, 4), of how many
    tracks each was made and how long the round took, s (modes, count, K); messages refused."""

    means: Floats
    covariances: Floats
    contributors: Floats
    seconds: Floats
    refused: int


def node(number: int, endpoint: str, missions: Missions, pipe: Any) -> None:
    """A process: one tracker with its own service. Sends an `Answer` through the pipe, or a text that says what failed;
    ends when the other end is closed."""
    stop = _stop_with(pipe)
    try:
        config = centre_config({**SETTINGS, "name": f"node-{number + 1}"})
        whole = ServiceConfig(config, BusConfig(connect=(endpoint,)), DaemonConfig(status_period=0.2))
        service = threading.Thread(target=run_service, args=(whole, stop))
        service.start()
        try:
            pipe.send(_track(number, endpoint, missions, config.name, stop))
            stop.wait()
        finally:
            stop.set()
            service.join()
    except Exception:
        with suppress(OSError):
            pipe.send(traceback.format_exc())


def _stop_with(pipe: Any) -> threading.Event:
    """An event that is set when the parent closes its end of the pipe, or dies."""
    stop = threading.Event()

    def watch() -> None:
        try:
            pipe.recv()
        except (EOFError, OSError):
            stop.set()

    threading.Thread(target=watch, daemon=True).start()
    return stop


def _track(number: int, endpoint: str, missions: Missions, name: str, stop: threading.Event) -> Answer:
    pictures: Queue[GlobalTracks] = Queue()
    ready: set[str] = set()
    refused: dict[str, int] = {}
    begin = threading.Event()

    def on_picture(key: str, data: bytes) -> None:
        message = decode(data)
        assert isinstance(message, GlobalTracks)
        pictures.put(message)

    def on_status(key: str, data: bytes) -> None:
        message = decode(data)
        assert isinstance(message, Status)
        if message.source == name:
            refused.update(message.refused)
        if all(message.sources.get(one, {}).get("alive") for one in SOURCES):
            ready.add(message.source)
        if len(ready) == TRACKERS:
            begin.set()

    with ExitStack() as stack:
        bus = stack.enter_context(open_bus([endpoint], wait=PATIENCE, stop=stop))
        bus.subscribe(global_key(name, "tracks"), on_picture, history=0)
        bus.subscribe(global_key("*", "status"), on_status)
        publisher = TrackPublisher(SOURCES[number], connect=endpoint, origin="simulated", stop=stop)
        stack.enter_context(publisher)
        publisher.info(frame=FRAME, position=(0.0, 0.0, 0.0), period=T, motion=Motion("cv", Q1))
        if not begin.wait(PATIENCE):
            raise TimeoutError(f"only {sorted(ready)} know all four trackers")
        shape = (len(MODES), missions.count, missions.scans + 1)
        answer = Answer(np.empty((*shape, 4)), np.empty((*shape, 4, 4)), np.empty(shape), np.empty(shape), 0)
        for mode, m in np.ndindex(shape[:2]):
            scan = iter(range(shape[2]))

            def exchange(means: Floats, covariances: Floats, mode: int = mode, m: int = m, scan: Any = scan) -> Fused:
                """One round: our own track out, the fused one of our own service back."""
                which = mode, m, next(scan)
                flight = mode * missions.count + m
                at = round((BEGIN + (PAUSE + T * missions.scans) * flight + T * which[2]) * 1e9)
                begun = time.perf_counter()
                publisher.tracks(
                    time=at,
                    space=SPACE,
                    frame=FRAME,
                    ids=[flight + 1],
                    means=means[None, number, :, 0],
                    covariances=covariances[None, number, ..., 0],
                )
                picture = _wait(pictures, at)
                answer.seconds[which] = time.perf_counter() - begun
                answer.means[which], answer.covariances[which] = picture.means[0], picture.covariances[0]
                answer.contributors[which] = picture.contributor_counts[0]
                mean, covariance = picture.means[0][:, None], picture.covariances[0][..., None]
                return Fused(mean, covariance, np.full((TRACKERS, 1), np.nan), None)

            if MODES[mode] == "fed back":
                missions.fly(m, exchange)
            else:
                tracks = missions.fly(m, None)
                for means, covariances in zip(tracks.means, tracks.covariances, strict=True):
                    exchange(means, covariances)
        time.sleep(0.3)  # one more status
        return replace(answer, refused=sum(refused.values()))


def _wait(pictures: Queue[GlobalTracks], at: int) -> GlobalTracks:
    """The picture of `at`, ns; those of steps in the pause before it are dropped."""
    while True:
        try:
            picture = pictures.get(timeout=PATIENCE)
        except Empty:
            raise TimeoutError(f"no fused track for {at} within {PATIENCE:g} s") from None
        if picture.time == at and len(picture.ids) == 1:
            return picture
        if picture.time >= at:
            raise RuntimeError(f"a picture of {len(picture.ids)} tracks at {picture.time}, where one at {at} belongs")


class Crew:
    """Processes, each at the end of a pipe. Leaving the context closes the pipes, on which they end, and kills what is
    left after 20 s."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._crew: list[tuple[Any, Any]] = []

    def start(self, target: Callable[..., None], *arguments: Any) -> Any:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=target, args=(*arguments, theirs), daemon=True)
        process.start()
        theirs.close()
        self._crew.append((process, ours))
        return ours

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for _, pipe in self._crew:
            pipe.close()
        deadline = time.monotonic() + 20.0
        for process, _ in self._crew:
            process.join(max(0.1, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()


def over_the_bus(missions: Missions) -> list[Answer]:
    """The four nodes' answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    found: dict[int, Answer] = {}
    with open_bus(listen=[endpoint], mode="router"), Crew() as crew:
        waiting = {crew.start(node, number, endpoint, missions): number for number in range(TRACKERS)}
        while waiting:
            for pipe in multiprocessing.connection.wait(list(waiting)):
                number = waiting.pop(pipe)
                found[number] = _answer(number, pipe)
    return [found[number] for number in range(TRACKERS)]


def _answer(number: int, pipe: Any) -> Answer:
    try:
        answer = pipe.recv()
    except EOFError:
        answer = "it ended without a word"
    if isinstance(answer, Answer):
        return answer
    raise RuntimeError(f"node {number + 1}: {answer}")


def in_one_batch(missions: Missions) -> tuple[Floats, Floats]:
    """Means (modes, count, K, 4) and covariances (modes, count, K, 4, 4) of the same missions without a bus."""
    rule = fuser(RULE)
    means, covariances = [], []
    for mode in MODES:
        for m in range(missions.count):
            tracks = missions.fly(m, rule if mode == "fed back" else None)
            x, P = tracks.means[..., 0], tracks.covariances[..., 0]
            if mode == "alone":
                fused = rule(np.moveaxis(x, 0, -1), np.moveaxis(P, 0, -1))
                means.append(fused.mean.T)
                covariances.append(np.moveaxis(fused.covariance, -1, 0))
            else:
                means.append(x[:, 0])
                covariances.append(P[:, 0])
    shape = (len(MODES), missions.count, missions.scans + 1)
    return np.reshape(means, (*shape, 4)), np.reshape(covariances, (*shape, 4, 4))


def _same(a: tuple[Floats, Floats], b: tuple[Floats, Floats]) -> NDArray[np.bool_]:
    """Where means and covariances have the same bits, (modes, count, K)."""
    return np.asarray((a[0] == b[0]).all(-1) & (a[1] == b[1]).all((-1, -2)))


def run(run: Run) -> Result:
    missions = Missions(run.seed, run.runs, STEPS if run.runs > 1 else SHORT)
    answers = over_the_bus(missions)
    batch = in_one_batch(missions)
    fused = [(one.means, one.covariances) for one in answers]
    agreed = np.all([_same(one, fused[0]) for one in fused], axis=0)
    equal = _same(fused[0], batch)
    off = np.abs(fused[0][0] - batch[0]) / np.sqrt(np.diagonal(batch[1], axis1=-2, axis2=-1))
    fewest = np.min([one.contributors for one in answers], axis=0)
    rows = []
    for mode, name in enumerate(MODES):
        values = {
            "rounds of every node": float(agreed[mode].size),
            "all four nodes have the same bits, % of rounds": 100 * float(agreed[mode].mean()),
            "and those of the batch, % of rounds": 100 * float(equal[mode].mean()),
            "largest difference from the batch, sigma": float(off[mode].max()),
            "local tracks in a fused one, fewest": float(fewest[mode].min()),
        }
        rows += [Row(name, quantity, None, value) for quantity, value in values.items()]
    rows.append(Row("both", "messages refused", None, float(sum(one.refused for one in answers))))
    paces = 1000 * np.mean([one.seconds for one in answers], axis=(0, 2, 3))
    run.progress(1.0, ", ".join(f"{name} {pace:.1f} ms a round" for name, pace in zip(MODES, paces, strict=True)))
    notes = (
        "One round is enough: 4 messages published, each delivered to 4 services, which make one step each. How long a "
        "round takes is shown while the study runs; it depends on the machine.",
    )
    return Result(tuple(rows), notes)


STUDIES = (
    Study(
        name="dubey-consensus",
        title="Consensus at every node, by four processes on a real bus",
        source="Dubey IV",
        about=__doc__ or "",
        run=run,
        runs=5,
        quick=1,
        seconds=110.0,
    ),
)
