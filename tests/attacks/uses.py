"""What is allowed, and must work whatever is attacked: every role's own work."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import msgpack

import schemas
from fusion_service.bus import open_bus
from tests.attacks.lab import Lab

__all__ = ["USES"]

V1 = "fusion/v1"


def source(lab: Lab) -> bool:
    """A radar's tracks reach the centre: they are in its picture."""
    lab.recorded.clear()
    return lab.wait(lambda: lab.report() and lab.heard(f"{V1}/global/main/tracks", b"r1"), 20.0)


def late_recorder(lab: Lab) -> bool:
    """Who joins later gets the last info of a radar that says nothing any more, and hears of its token."""
    heard: list[str] = []
    tokens: list[str] = []
    with open_bus([lab.endpoint], wait=60.0, security=lab.security("recorder-rec")) as bus:
        bus.subscribe(f"{V1}/**", lambda key, data: heard.append(key))
        bus.watch(f"{V1}/*/*/alive", lambda key, up: tokens.append(key))
        alive = {f"{V1}/local/r1/alive", f"{V1}/global/main/alive"}
        return lab.wait(lambda: f"{V1}/local/r1/info" in heard and alive <= set(tokens), 20.0)


def viewer(lab: Lab) -> bool:
    """A viewer hears the picture, and asks for it."""
    heard: list[bytes] = []
    with open_bus([lab.endpoint], wait=60.0, security=lab.security("viewer-wall")) as bus:
        bus.subscribe(f"{V1}/global/*/tracks", lambda key, data: heard.append(data), history=0)
        asked = [found for who in ("main", "*") for found in bus.ask(f"{V1}/global/{who}/picture", timeout=20.0)]
        pictures = [schemas.decode(data) for _, data in asked]
        whole = len(pictures) == 2 and all(isinstance(one, schemas.GlobalTracks) for one in pictures)
        return whole and lab.wait(lambda: bool(heard), 20.0)


def _note(keys: list[str], key: str, data: bytes) -> None:
    keys.append(key)


def sensors_seen(lab: Lab) -> bool:
    """A viewer and an operator that join late hear what a radar has said of itself, and nothing else of it."""
    heard: dict[str, list[str]] = {"viewer-wall": [], "operator-bob": []}
    with ExitStack() as stack:
        for party, keys in heard.items():
            bus = stack.enter_context(open_bus([lab.endpoint], wait=10.0, security=lab.security(party)))
            bus.subscribe(f"{V1}/local/*/info", partial(_note, keys))
        return lab.wait(
            lambda: lab.report() and all(set(keys) == {f"{V1}/local/r1/info"} for keys in heard.values()), 3
        )


def recorder_seen(lab: Lab) -> bool:
    """A viewer sees that a recorder is there, and asks what it keeps."""
    tokens: list[str] = []
    with (
        open_bus([lab.endpoint], wait=60.0, security=lab.security("recorder-rec")) as recorder,
        open_bus([lab.endpoint], wait=60.0, security=lab.security("viewer-wall")) as bus,
    ):
        recorder.announce(f"{V1}/record/rec/alive")
        recorder.answer(f"{V1}/record/rec/state", lambda _: b"kept")
        bus.watch(f"{V1}/record/*/alive", lambda key, up: tokens.append(key))
        return lab.wait(
            lambda: bool(tokens) and [(f"{V1}/record/rec/state", b"kept")] == bus.ask(f"{V1}/record/*/state"), 20.0
        )


def operator(lab: Lab) -> bool:
    """An operator's order, by the command, is obeyed, and stands in the operator's name; `list` tells it."""
    security = [] if lab.keys is None else ["--security", str(lab.keys / "operator-alice")]
    command = [
        sys.executable,
        "-m",
        "fusion_service",
        "order",
        "--centre",
        "main",
        "--connect",
        lab.endpoint,
        *security,
    ]
    done = subprocess.run([*command, "quarantine", "--source", "r1"], capture_output=True, text=True, timeout=120)
    key = schemas.order_key("main", "alice")
    with open_bus([lab.endpoint], wait=60.0, security=lab.security("operator-alice")) as bus:

        def stands() -> bool:
            (answer,) = bus.ask(key, msgpack.packb({"what": "list"}), 20.0)
            orders = msgpack.unpackb(answer[1])["orders"]
            return any(one["what"] == "quarantine" and (lab.keys is None or one["who"] == "alice") for one in orders)

        return done.returncode == 0 and lab.wait(stands, 20.0)


def gateway(lab: Lab) -> bool:
    """A gateway publishes as a source, and reads the picture."""
    heard: list[bytes] = []
    with open_bus([lab.endpoint], wait=60.0, security=lab.security("gateway-gate")) as bus:
        bus.subscribe(f"{V1}/global/main/tracks", lambda key, data: heard.append(data))
        publisher = bus.publisher(f"{V1}/local/gate/tracks")

        def both() -> bool:
            publisher.put(b"gate")
            return bool(heard) and lab.heard(f"{V1}/local/gate/tracks", b"gate")

        return lab.wait(both, 20.0)


def service_again(lab: Lab) -> bool:
    """The service is killed, and a new one fuses: it gets the radars' info from their caches."""
    lab.service.send_signal(signal.SIGKILL)
    lab.service.wait()
    if not lab.wait(lambda: (f"{V1}/global/main/alive", False) in lab.tokens, 20.0):
        return False
    lab.start_service()
    lab.recorded.clear()
    return lab.wait(lambda: lab.report() and lab.heard(f"{V1}/global/main/tracks", b"r1"), 60.0)


USES: dict[str, Callable[[Lab], bool]] = {
    "a source is fused": source,
    "a late recorder gets what is cached": late_recorder,
    "a viewer reads the picture": viewer,
    "viewers see where sensors stand": sensors_seen,
    "a viewer sees the recorder": recorder_seen,
    "an operator's order": operator,
    "a gateway publishes and reads": gateway,
    "the service comes back": service_again,
}
