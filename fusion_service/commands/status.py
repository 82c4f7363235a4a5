"""`fusion-service status`: how a running centre and its sources are, from the bus alone."""

from __future__ import annotations

import argparse
import threading
from typing import Any

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.process import argument, positive

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "How a running centre and its sources are, and what is wrong: 0 all is well, 1 something is wrong, or no answer."
EXAMPLE = """fusion-service status
  fusion-service status --json | jq '.centres[].sources'
  fusion-service status --centre north --for 10 || echo "see to it"
  fusion-service status --security keys/display-wall"""
HUB = 5.0
"""Seconds in which the hub must be there."""
MOST_KEYS = 200


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("--centre", metavar="NAME", help="of this centre only (default: all of the realm)")
    parser.add_argument("--json", action="store_true", help="as JSON, for scripts")
    parser.add_argument(
        "--for",
        dest="seconds",
        type=argument(positive),
        default=2.5,
        metavar="S",
        help="how long it listens, s (default 2.5); whoever publishes less often on a wrong key is not heard",
    )
    parser.add_argument(
        "--connect", action="append", type=argument(check_endpoint), metavar="ENDPOINT", help="hub to join"
    )
    parser.add_argument("--security", metavar="FILE", help="a certificate that may listen (see `fusion-service keys`)")
    parser.add_argument("--realm", default="fusion", help="first part of every key (default fusion)")


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Listen, print, and raise `HealthError` where something is wrong. Raises `UsageError`, `BusError`,
    `SecurityError` besides."""
    import json
    import time

    from fusion_service.bus import open_bus
    from fusion_service.bus.security import maybe_security
    from fusion_service.errors import HealthError, UsageError
    from fusion_service.hints.health import health_of
    from schemas import global_key

    try:
        names = [global_key(args.centre or "*", what, args.realm) for what in ("status", "tracks")]
    except ValueError as error:
        raise UsageError(str(error)) from None
    ear = _Ear()
    security = maybe_security(args.security)
    with open_bus(args.connect or [DEFAULT_ENDPOINT], wait=HUB, stop=stop, security=security) as bus:
        for key in names:
            bus.subscribe(key, ear.take)
        everywhere = ear.overhear(bus)
        begin = time.monotonic()
        while not stop.is_set() and time.monotonic() - begin < args.seconds + HUB:
            stop.wait(0.05)
            if ear.statuses and time.monotonic() - begin >= args.seconds:
                break
    now = time.time_ns()
    healths = [health_of(status, ear.pictures.get(name), now) for name, status in sorted(ear.statuses.items())]
    beside = ear.beside(args.realm)
    wrong = [*ear.twice(), *(line for health in healths for line in health.wrong), *beside]
    if not healths:
        who = f"no centre named {args.centre}" if args.centre else f"no centre of the realm {args.realm}"
        wrong.insert(0, f"{who} answers: is `fusion-service run` there, under this name?")
    if args.json:
        said = {"well": not wrong, "wrong": wrong, "beside": beside, "centres": [health.data for health in healths]}
        print(json.dumps(said, indent=1, default=_plain))
    else:
        for health in healths:
            print("\n".join(health.lines))
        for line in ear.twice():
            print(line)
        for line in beside:
            print(f"beside: {line}")
        if not everywhere:
            print("only this realm was heard: the certificate lets in no more")
    if wrong:
        raise HealthError(wrong[0] if len(wrong) == 1 else f"{len(wrong)} things are wrong; the first: {wrong[0]}")


class _Ear:
    """Keeps the newest statuses and pictures by centre, and the keys that anybody publishes on."""

    def __init__(self) -> None:
        self.statuses: dict[str, Any] = {}
        self.pictures: dict[str, Any] = {}
        self._runs: dict[str, dict[int, int]] = {}
        self._keys: dict[str, None] = {}

    def take(self, key: str, data: bytes) -> None:
        """A message of a centre, on a thread of the bus."""
        from schemas import GlobalTracks, MessageError, Status, decode

        try:
            message = decode(data)
        except MessageError:
            return
        if isinstance(message, Status):
            self.statuses[message.source] = message
            runs = self._runs.setdefault(message.source, {})
            runs[message.epoch] = runs.get(message.epoch, 0) + 1
        elif isinstance(message, GlobalTracks) and not message.delta:
            self.pictures[message.source] = message

    def twice(self) -> list[str]:
        """Centres of which two processes publish at once."""
        return [
            f"{len(runs)} processes publish as centre {name}: end one of them, or let it stand by (run --standby)"
            for name, runs in sorted(self._runs.items())
            if sum(count > 1 for count in runs.values()) > 1
        ]

    def overhear(self, bus: Any) -> bool:
        """Hear on which keys anybody publishes; whether that is allowed."""
        from fusion_service.bus import BusError

        try:
            bus.subscribe("**", self._overheard, history=0)
            bus.watch("**/v1/local/*/alive", lambda key, alive: self._overheard(key, b""))
        except BusError:
            return False
        return True

    def _overheard(self, key: str, data: bytes) -> None:
        if len(self._keys) < MOST_KEYS:
            self._keys[key] = None

    def beside(self, realm: str) -> list[str]:
        """What is published where no centre of `realm` listens."""
        from fusion_service.hints import key_finding

        found = []
        for key in sorted(self._keys):
            odd = key_finding(key, realm)
            if odd is not None:
                found.append(odd.said if odd.reason == "key" else f"{key}: {odd.said}")
        return found


def _plain(value: Any) -> Any:
    """What JSON has no form for."""
    return value.hex() if isinstance(value, bytes) else str(value)
