"""What is attacked: a hub, open or secured, a service, an honest radar, those who listen, real certificates."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh

import schemas
from fusion_service.bus import Bus, open_bus
from fusion_service.bus.certificates import make_authority, open_authority
from fusion_service.bus.joining import session_config
from fusion_service.bus.keyring import Keyring
from fusion_service.bus.security import Security, read_security, secured
from sensor_clients.publisher import TrackPublisher
from tests.helpers.processes import eventually, free_endpoint

__all__ = ["SITE", "Check", "Lab", "bad_certificates", "keys", "lab", "scan"]

SITE = schemas.Enu(lat=59.0, lon=10.0)
Check = Callable[[], bool]
"""Whether an attack that has begun has worked."""
REFUSALS = "zenoh_link_tls=warn,zenoh::net::routing::interceptor::access_control=trace"
CONFIG = """[centre]
name = "main"
period = 0.2
delay = 0.05
lateness = 1.0
confirm_hits = 1
confirm_within = 1
[service]
compiled = "off"
[bus]
connect = ["{endpoint}"]
"""
PARTIES = [
    *(("source", name) for name in ("r1", "evil", "late")),
    *(("centre", name) for name in ("main", "other")),
    *(("recorder", "rec"), ("operator", "alice"), ("operator", "bob"), ("viewer", "wall"), ("gateway", "gate")),
]


def keys(folder: Path) -> Path:
    """The certificates of all, and of one that is removed again; the hub's at this machine."""
    list(Keyring(folder).change([*PARTIES, ("source", "gone")]))
    kept = folder.parent / "gone"
    os.rename(folder / "source-gone", kept)
    list(Keyring(folder).change(remove=["source:gone"]))
    return folder


def bad_certificates(folder: Path, keys: Path) -> dict[str, Security]:
    """Certificates that nobody should take, of the name of an honest radar, or of the centre."""
    own = open_authority(keys / "authority/ca.pem", keys / "authority/ca.key")
    honest = read_security(keys / "source-r1")
    evil = read_security(keys / "source-evil")
    folder.mkdir()
    made: dict[str, Security] = {"removed": read_security(keys.parent / "gone")}

    def one(name: str, of: Security = honest) -> Security:
        made[name] = replace(of, certificate=folder / f"{name}.pem", key=folder / f"{name}.key", path=folder / name)
        return made[name]

    foreign = make_authority(folder / "foreign-ca.pem", folder / "foreign-ca.key", "track fusion keys")
    now = datetime.now(UTC)
    expired, early, stranger, forged = one("expired"), one("early"), one("foreign"), one("forged")
    own.issue(expired.certificate, expired.key, "source:r1", days=1, now=now - timedelta(days=2))
    own.issue(early.certificate, early.key, "source:r1", days=3, now=now + timedelta(days=2))
    foreign.issue(stranger.certificate, stranger.key, "source:r1")
    self_signed = one("self-signed")
    make_authority(self_signed.certificate, self_signed.key, "source:r1")
    # signed by a radar, whose certificate is no authority's, with the radar's beside it
    open_authority(evil.certificate, evil.key).issue(forged.certificate, forged.key, "centre:main")
    forged.certificate.write_bytes(forged.certificate.read_bytes() + evil.certificate.read_bytes())
    made["anothers-key"] = replace(honest, key=evil.key)
    for name, authority, days, host in (
        ("hub-foreign", foreign, 1.0, "127.0.0.1"),
        ("hub-expired", own, 1.0, "127.0.0.1"),
        ("hub-elsewhere", own, 1.0, "hub.example.org"),
    ):
        hub = one(name, read_security(keys / "hub"))
        when = now - timedelta(days=2) if name == "hub-expired" else now
        authority.issue(hub.certificate, hub.key, "hub", hosts=[host], days=days, now=when)
    return made


class Lab:
    """An open or secured world. `recorded`: (key, data) of all that a recorder hears."""

    def __init__(self, folder: Path, keys: Path | None, stack: ExitStack) -> None:
        self.keys = keys
        self.name = "open" if keys is None else "secured"
        self.endpoint = free_endpoint()
        self.stack = stack
        self.log = folder / f"hub-{self.name}.log"
        self._folder = folder
        self.recorded: list[tuple[str, bytes]] = []
        self.tokens: list[tuple[str, bool]] = []
        self.orders: list[str] = []

    def start(self) -> None:
        """Hub and service as processes, the radar and a recorder."""
        self.process("hub", "--listen", self.endpoint, *self._option("hub"), log=self.log)
        self.start_service()
        self.recorder = self.bus("recorder-rec")
        self.recorder.subscribe("fusion/v1/**", lambda key, data: self.recorded.append((key, data)), history=1)
        self.recorder.watch("fusion/v1/*/*/alive", lambda key, up: self.tokens.append((key, up)))
        self.radar = self.publisher("r1")
        self.viewer = self.bus("viewer-wall")
        self.report()

    def start_service(self) -> None:
        """The centre, as a process."""
        config = self._folder / f"{self.name}.toml"
        config.write_text(CONFIG.format(endpoint=self.endpoint))
        command = ["run", "--config", str(config), *self._option("centre-main")]
        self.service = self.process(*command, log=self.log.with_suffix(".service"))

    def report(self) -> bool:
        """The honest radar's picture of the world, once."""
        self.radar.info(frame=SITE, position=(0, 0, 0), period=0.2, motion=schemas.Motion("cv", 1.0))
        self.radar.tracks(**scan([7]))
        return True

    def process(self, *command: str, log: Path) -> subprocess.Popen[bytes]:
        """A command as a process, ended with the lab."""
        with log.open("ab") as file:
            environment = {**os.environ, "RUST_LOG": REFUSALS, "PYTHONUNBUFFERED": "1"}
            line = [sys.executable, "-m", "fusion_service", *command]
            process = subprocess.Popen(line, stdout=file, stderr=file, env=environment)
        self.stack.callback(process.wait)
        self.stack.callback(process.kill)
        return process

    def security(self, party: str) -> Security | None:
        """A party's file."""
        return None if self.keys is None else read_security(self.keys / party)

    def _option(self, party: str) -> list[str]:
        return [] if self.keys is None else ["--security", str(self.keys / party)]

    def bus(self, party: str) -> Bus:
        """An honest session of a party."""
        return self.stack.enter_context(open_bus([self.endpoint], wait=60.0, security=self.security(party)))

    def publisher(self, name: str) -> TrackPublisher:
        """An honest radar."""
        security = None if self.keys is None else self.keys / f"source-{name}"
        return self.stack.enter_context(TrackPublisher(name, connect=self.endpoint, wait=60.0, security=security))

    def raw(self, party: str, mode: str = "client") -> zenoh.Session:
        """A session that knows no manners, with the certificate of a party."""
        security = self.security(party)
        endpoints = [self.endpoint] if security is None else secured([self.endpoint])
        session = zenoh.open(session_config(endpoints, (), mode, security))
        self.stack.callback(session.close)
        return session

    def heard(self, key: str, mark: bytes) -> bool:
        """Whether the recorder has heard something with `mark` in it on `key`."""
        return any(where == key and mark in data for where, data in list(self.recorded))

    def wait(self, check: Check, seconds: float = 1.0) -> bool:
        """Whether it comes true in time."""
        end = time.monotonic() + seconds
        while not (held := check()) and time.monotonic() < end:
            time.sleep(0.02)
        return held

    def refusals(self) -> list[str]:
        """What the hub's log says."""
        return self.log.read_text(errors="replace").splitlines()


@contextmanager
def lab(folder: Path, keys: Path | None) -> Iterator[Lab]:
    """A world that works: the radar's target is in the picture of the centre."""
    with ExitStack() as stack:
        one = Lab(folder, keys, stack)
        one.start()
        eventually(lambda: one.report() and one.heard("fusion/v1/global/main/tracks", b"r1"))
        yield one


def scan(ids: Sequence[int]) -> dict[str, Any]:
    """A scan of standing targets, now."""
    return {
        "time": time.time_ns(),
        "space": ("x", "y"),
        "frame": SITE,
        "ids": list(ids),
        "means": [[1000.0 * one, 0.0] for one in ids],
        "covariances": [[[25.0, 0.0], [0.0, 25.0]] for _ in ids],
    }
