"""Which attacks work, and whether those that do not are refused for a reason that is seen."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import zenoh

from fusion_service.bus.security import Security
from tests.attacks.lab import Check, Lab
from tests.attacks.onkeys import KeyAttack
from tests.attacks.onlinks import LINKS, bare_link, rogue_hubs, told

__all__ = ["Verdict", "on_keys", "on_links", "with_own_hubs"]


class Verdict(NamedTuple):
    """Whether an attack worked; what the attacker's side and the hub's log say of it; missing: which of them does not
    say what it should."""

    name: str
    worked: bool
    client: str = ""
    hub: str = ""
    missing: str = ""


def on_keys(lab: Lab, attacks: Sequence[KeyAttack], seconds: float) -> list[Verdict]:
    """All at once, each in a session of its own; `seconds` are waited for those that do not work."""
    sessions: list[zenoh.Session] = []
    checks: list[tuple[KeyAttack, Check]] = []
    for attack in attacks:
        sessions.append(lab.raw(attack.party, attack.mode))
        checks.append((attack, attack.begin(lab, sessions[-1], attack.name)))
    worked: set[str] = set()
    end = time.monotonic() + seconds
    while len(worked) < len(checks):
        worked |= {attack.name for attack, check in checks if attack.name not in worked and check()}
        if time.monotonic() >= end:
            break
    if lab.keys is not None:  # the hub says a few a second
        lab.wait(lambda: all(refusal_of(lab.refusals(), one) for one, _ in checks if one.refused), 20.0)
    log = lab.refusals()
    found = []
    for attack, _ in checks:
        reason = refusal_of(log, attack)
        missing = "hub" if lab.keys is not None and attack.refused and not reason else ""
        found.append(Verdict(attack.name, attack.name in worked, hub=reason, missing=missing))
    return found


def refusal_of(log: Sequence[str], attack: KeyAttack) -> str:
    """What the hub refused this party on this key: said to be unauthorized, and by no rule authorized."""
    if not attack.refused:
        return ""
    common = attack.party.replace("-", ":", 1)
    what = re.compile(rf"CertCommonName\({re.escape(common)}\)\S* is (un)?authorized to ([^(]*) \(ingress\) on (.*)$")
    act, _, key = attack.refused.rpartition(" ")
    said: dict[str, bool] = {}
    for line in log:
        if (match := what.search(line)) and key in match[3]:
            done = match[2].replace("Declare/Undeclare", "Declare")
            if done.endswith(act):
                about = f"{done} on {match[3]}"
                said[about] = said.get(about, True) and bool(match[1])
    return next((text for text, refused in said.items() if refused), "")


def on_links(lab: Lab, bad: dict[str, Security]) -> list[Verdict]:
    """One after the other, for the hub's log does not say from whom a link was."""
    found = []
    for attack in LINKS:
        known = len(lab.refusals())
        honest = lab.security("source-r1")
        shown = None if attack.shown == "plain" else honest if attack.shown == "none" else bad[attack.shown]
        outcome = bare_link(lab, shown, certificate=attack.shown != "none")
        client = told(lab, shown) if attack.told else ""
        hub = [line for line in lab.refusals()[known:] if re.search(attack.logged or "-nothing-", line)]
        missing = "client" * (not re.search(attack.told, client)) + "hub" * bool(attack.logged and not hub)
        found.append(Verdict(attack.name, outcome.worked, client, hub[0] if hub else "", missing))
    return found


def with_own_hubs(keys: Path, bad: dict[str, Security], *, most: int | None = None) -> list[Verdict]:
    """Hubs that wait for an honest radar; the radar's side must say why it does not join. most: how many."""
    found = []
    for name, (attack, expected) in [*rogue_hubs(keys, bad).items()][:most]:
        outcome = attack()
        missing = "" if re.search(expected, outcome.told) else "client"
        found.append(Verdict(name, outcome.worked, outcome.told, missing=missing))
    return found
