"""Attacks by who must not come in at all, or who waits for others to come in to him: wrong certificates and none, plain
TCP, rogue hubs. Each opens a link past all manners, and says why it was refused, as the product's own client would."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import zenoh

from fusion_service.bus import BusError, SecurityError, open_bus
from fusion_service.bus.joining import session_config
from fusion_service.bus.refusal import refused
from fusion_service.bus.security import Security, link_settings, read_security, secured
from tests.attacks.lab import Lab
from tests.helpers.processes import free_endpoint

__all__ = ["LINKS", "LinkAttack", "Outcome", "at_own_hub", "bare_link", "rogue_hubs", "told"]


class LinkAttack(NamedTuple):
    """What is shown to the hub, what the client is told, and what the hub's log says (Zenoh's words)."""

    name: str
    shown: str
    told: str
    logged: str


class Outcome(NamedTuple):
    """Whether a link was made, or an honest party taken in; what was told on our side."""

    worked: bool
    told: str


LINKS = (
    LinkAttack("no certificate", "none", "", "sent no certificates"),
    LinkAttack("plain TCP", "plain", "asks for certificates", "corrupt message"),
    LinkAttack("an expired certificate", "expired", "has expired", "certificate expired"),
    LinkAttack("a certificate of tomorrow", "early", "does not hold yet", "not valid yet"),
    LinkAttack("a foreign certificate", "foreign", "foreign", "UnknownIssuer|BadSignature"),
    LinkAttack("a self-signed certificate", "self-signed", "foreign", "CaUsedAsEndEntity"),
    LinkAttack("signed by a radar", "forged", "foreign", "EndEntityUsedAsCa"),
    LinkAttack("a stolen certificate without its key", "anothers-key", "no certificate and its key", ""),
    LinkAttack("a certificate that was removed", "removed", "not in its file", "may say and hear nothing"),
)


def bare_link(lab: Lab, shown: Security | None, *, certificate: bool = True) -> Outcome:
    """A link by Zenoh alone, and a message as the radar's on it: worked if the recorder hears it."""
    endpoints = [lab.endpoint] if shown is None else secured([lab.endpoint])
    config = session_config(endpoints, (), "client", None)
    for name, value in (link_settings(shown) if shown is not None else {}).items():
        if certificate or name.split("_")[-1] not in ("certificate", "key", "mtls") or "root" in name:
            config.insert_json5(name, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        return Outcome(False, str(error))
    lab.stack.callback(session.close)
    mark = f"link {id(session)}".encode()
    session.put("fusion/v1/local/r1/tracks", mark)
    return Outcome(lab.wait(lambda: lab.heard("fusion/v1/local/r1/tracks", mark)), "")


def told(lab: Lab, shown: Security | None) -> str:
    """What the product's own client says, and where that looks at its own files first, what the hub answers."""
    try:
        with open_bus([lab.endpoint], wait=False, security=shown):
            return ""
    except BusError as error:
        return str(error)
    except SecurityError as error:
        try:
            return f"{error}; {refused(secured([lab.endpoint]), shown)}"
        except SecurityError as again:
            return str(again)


def at_own_hub(listening: Security | None, victim: Security | None, host: str = "127.0.0.1") -> Outcome:
    """Listen as a hub with a certificate that is no hub's: worked if an honest party comes in."""
    endpoint = free_endpoint()
    there = endpoint.replace("127.0.0.1", host)
    with ExitStack() as stack:
        config = session_config((), [endpoint], "router", None)
        if listening is not None:
            config = session_config((), secured([endpoint]), "router", replace(listening, role="hub"))
        stack.callback(zenoh.open(config).close)
        try:
            with open_bus([there], wait=False, security=victim):
                return Outcome(True, "")
        except BusError as error:
            return Outcome(False, str(error))


def rogue_hubs(keys: Path, bad: dict[str, Security]) -> dict[str, tuple[Callable[[], Outcome], str]]:
    """Who waits for an honest radar, and what that radar is told."""
    radar = read_security(keys / "source-r1")
    other_name = replace(radar, role="hub", certificate=bad["hub-elsewhere"].certificate, key=bad["hub-elsewhere"].key)
    return {
        "a hub with a radar's certificate": (
            lambda: at_own_hub(read_security(keys / "source-evil"), radar),
            "another purpose|not for the name",
        ),
        "a hub with a foreign certificate": (lambda: at_own_hub(bad["hub-foreign"], radar), "foreign"),
        "a hub of another name": (lambda: at_own_hub(other_name, radar), "not for the name"),
        "a hub whose certificate has expired": (lambda: at_own_hub(bad["hub-expired"], radar), "has expired"),
        "a hub that is open": (lambda: at_own_hub(None, radar), "not by TLS"),
    }
