"""`sensor-client check`: all that is wrong with what a source sends, and what the centre does with it."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack

from fusion_service.bus import Bus, BusError, Inbox
from fusion_service.bus.options import joined
from fusion_service.errors import HealthError, UsageError
from fusion_service.hints import Listened
from fusion_service.hints.inspecting import inspect
from fusion_service.hints.payload import raw_map
from fusion_service.hints.showing import shown
from schemas import MessageError, SensorInfo, Status, decode, global_key, local_key

__all__ = ["check_file", "check_source"]

LARGEST = 2**28
"""Bytes of a file that is read."""
WAITING = 4096
MOST_SAID = 500
RECENT = 60.0
"""Seconds for which a refusal counts as one of now."""


def check_file(path: Path) -> None:
    """Print what is wrong with the messages in a file, one after another. Raises `HealthError` where something is,
    `UsageError` where it cannot be read."""
    try:
        if path.stat().st_size > LARGEST:
            raise UsageError(f"{path} is larger than {LARGEST} bytes: give messages, not a recording")
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from None
    now, wrong, heard = time.time_ns(), 0, Listened()
    messages = _split(data)
    for number, one in enumerate(messages, 1):
        found = inspect(one, now, live=False)
        wrong += len(found.findings)
        for line in shown(f"message {number}", one, found, now, 1):
            print(line)
        if found.message is not None:
            heard.heard(found.message, found.message.sent)
    for doubt in heard.doubts(now) if len(messages) > 1 else []:
        wrong += 1
        print(f"    DOUBTFUL {doubt}")
    if wrong:
        raise HealthError(f"{wrong} things are wrong in {path}")
    print(f"{len(messages)} messages, nothing wrong with any")


def _split(data: bytes) -> list[bytes]:
    """The maps that stand one after another in a file; all of it where it is none."""
    unpacker, parts, start = msgpack.Unpacker(max_buffer_size=max(len(data), 1)), [], 0
    unpacker.feed(data)
    try:
        while start < len(data):
            unpacker.read_map_header()
            unpacker = msgpack.Unpacker(max_buffer_size=max(len(data), 1))
            unpacker.feed(data[start:])
            unpacker.skip()
            end = start + unpacker.tell()
            parts.append(data[start:end])
            start = end
    except (ValueError, TypeError, msgpack.exceptions.UnpackException, RecursionError):
        return [*parts, data[start:]]
    return parts or [data]


class _Check:
    """What was heard of one source. said: every different thing that is wrong, once."""

    def __init__(self, name: str, realm: str) -> None:
        self.name, self.realm = name, realm
        self.said: dict[str, int] = {}
        self.listened = Listened()
        self.infos = self.tracks = self.unread = 0
        self.centres: dict[str, dict[str, Any]] = {}

    def take(self, key: str, data: bytes, received: int) -> None:
        """A message on the bus, of whoever."""
        if "/v1/global/" in key and key.endswith("/status"):
            self._centre(data)
            return
        chunks = key.split("/")
        ours = self.name in chunks
        if "global" in chunks or not (ours or (key and raw_map(data).get("source") == self.name)):
            return
        found = inspect(data, received, key, self.realm)
        for one in found.findings:
            self.say(f"WRONG ({one.reason}) {one.said}", (one.reason, one.field))
        if found.message is None:
            self.unread += 1
            return
        self.infos += isinstance(found.message, SensorInfo)
        self.tracks += not isinstance(found.message, SensorInfo)
        self.listened.heard(found.message, received)

    def _centre(self, data: bytes) -> None:
        try:
            message = decode(data)
        except MessageError:
            return
        if isinstance(message, Status):
            self.centres[message.source] = message.sources.get(self.name, {})

    def doubt(self) -> None:
        """Say what is doubtful now, if it was not said."""
        for one in self.listened.doubts(time.time_ns()):
            self.say(f"DOUBTFUL {one}", one[:30])

    def say(self, line: str, about: object) -> None:
        """Print a line, once for whatever it is about."""
        known = str(about)
        self.said[known] = self.said.get(known, 0) + 1
        if self.said[known] == 1 and len(self.said) < MOST_SAID:
            print(line, flush=True)

    def refusing(self) -> list[str]:
        """The centres that refuse it now."""
        return [
            name
            for name, said in self.centres.items()
            if isinstance(last := said.get("last_refusal"), dict)
            and last.get("reason") not in ("repeat", "muted")
            and isinstance(last.get("time"), int)
            and (time.time_ns() - last["time"]) / 1e9 < RECENT
        ]

    def is_there(self, alive: dict[str, bool]) -> bool:
        """Whether its token stands, by all that do."""
        return any(held for key, held in alive.items() if self.name in key.split("/"))

    def summary(self, alive: dict[str, bool], itself: bool) -> list[str]:
        """What was heard, and what the centres do with it. itself: whether the source could be heard."""
        rate = self.listened.rate
        heard = (
            f"heard: {self.tracks} messages with tracks, {self.infos} sensor_info, {self.unread} that cannot be read"
        )
        told = heard + (f"; {rate:.3g} a second" if rate else "")
        lines = [told + ("" if self.is_there(alive) else "; no liveliness token")] if itself else []
        for centre, said in sorted(self.centres.items()):
            if not said:
                lines.append(f"centre {centre}: has heard nothing of it")
                continue
            lines.append(
                f"centre {centre}: has taken {said.get('messages', 0)} messages, {said.get('tracks', 0)} tracks now"
            )
            last = said.get("last_refusal")
            if isinstance(last, dict):
                lines.append(f"    refused ({last.get('reason')}, {last.get('count')} times): {last.get('said')}")
            doubts = said.get("doubts")
            lines += [f"    DOUBTFUL {one}" for one in doubts] if isinstance(doubts, list) and not itself else []
            lines += [f"    {said['note']}"] if said.get("note") else []
        return lines or ["no centre is there"]


def _hear(bus: Bus, name: str, realm: str, take: Callable[[str, bytes], None], alive: dict[str, bool]) -> bool:
    """Hear all of the bus; where a certificate does not let us, the source and the centres in `realm` alone; whether at
    least the source is heard. Raises `BusError` where not even the centres are."""
    try:
        bus.subscribe("**", take)
        bus.watch("**/v1/local/*/alive", alive.__setitem__)
        return True
    except BusError:
        pass
    try:
        keys = [local_key(name, what, realm) for what in ("tracks", "intensity", "info")]
        token, status = local_key(name, "alive", realm), global_key("*", "status", realm)
    except ValueError as error:
        raise UsageError(str(error)) from None
    heard = True
    try:
        for key in keys:
            bus.subscribe(key, take)
        bus.watch(token, alive.__setitem__)
    except BusError:
        heard = False
    if heard:
        with suppress(BusError):
            bus.subscribe(status, take)
    else:
        bus.subscribe(status, take)
    return heard


def check_source(name: str, args: argparse.Namespace, stop: threading.Event) -> None:
    """Listen to a source for `args.seconds` on the bus that `args` say (see `bus_options`), and print what is wrong as
    it is heard, then a summary. Raises `HealthError` where something is wrong, or nothing came."""
    inbox: Inbox[tuple[str, bytes, int]] = Inbox(WAITING)
    check = _Check(name, args.realm)
    alive: dict[str, bool] = {}
    with joined(args, stop) as bus:
        heard = _hear(
            bus, name, args.realm, lambda key, data: inbox.put(key, (key, data, time.time_ns()), len(data)), alive
        )
        if not heard:
            print("this certificate may not hear sources: what centres say of it is all that is told", flush=True)
        begin = time.monotonic()
        while not stop.is_set() and time.monotonic() - begin < args.seconds:
            for _, (key, data, received) in inbox.take(0.1):
                check.take(key, data, received)
            check.doubt()
    if heard:
        _token(check, alive, args)
    print("\n".join(check.summary(alive, heard)))
    for centre in check.refusing():
        check.said.setdefault(f"refused by {centre}", 1)
    for centre, said in check.centres.items() if not heard else ():
        check.said |= {f"{centre} doubts {one}": 1 for one in said.get("doubts") or ()}
    if check.said:
        raise HealthError(f"{len(check.said)} things are wrong with {name}")
    print(f"nothing is wrong with {name}")


def _token(check: _Check, alive: dict[str, bool], args: argparse.Namespace) -> None:
    """Say whether its token is there. Raises `HealthError` where nothing came of it."""
    name = check.name
    there = check.is_there(alive)
    if not check.tracks + check.infos + check.unread:
        near = f" (its token is there: {next(iter(alive))})" if there else ""
        raise HealthError(
            f"nothing came of {name} in {args.seconds:g} s, in any realm{near}: does it publish, at this hub?"
        )
    if not there and any(name in key.split("/") for key in alive):
        print("it went while it was listened to: its liveliness token is no more")
    elif not there:
        check.say(
            f"DOUBTFUL it holds no liveliness token: declare one on {args.realm}/v1/local/{name}/alive", "no token"
        )
