"""What each role may do on the bus, as the rules of a hub: the only place where that is said.

Nobody may do anything but what is allowed here. A certificate stands for one party, a role with a name, as its common
name says: `source:radar-1`. Each party owns the keys below its prefix: it alone publishes there, answers, keeps the
last samples (their keys have `@adv` in them, which no `*` matches, so they are named apart) and holds its liveliness
token. Who reads may subscribe, look for tokens, and ask publishers for samples it missed.

| role | owns | reads |
|---|---|---|
| source | `local/{name}/**` | nothing |
| centre | `global/{name}/**`, queryables `picture`, `orders`, `state` | `local/**`, `global/**`, its own `state` |
| recorder | `record/{name}/**` | everything but questions and answers |
| viewer | nothing | `global/**`, `record/**`, `local/*/info`; asks for `picture`, and recorders for `state` |
| operator | nothing | as a viewer; gives orders on `global/*/orders/{name}` alone |
| gateway | `local/{name}/**` | as a viewer, without `local/*/info` |
| scenario | `truth/{name}` | nothing: for simulations |

So a viewer sees where sensors stand and what they cover, but hears none of their tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

__all__ = [
    "ANYONE",
    "HELLO",
    "ROLES",
    "Party",
    "Rights",
    "access_control",
    "allowed",
    "common_name",
    "hello_key",
    "rights",
]

ROLES = ("source", "centre", "recorder", "operator", "viewer", "gateway", "scenario")
HELLO = "@hub/v1"
"""Below it each party asks the hub what it may do; no wildcard matches it."""
ANYONE = f"{HELLO}/anyone"
"""Where whoever is let in at all gets an answer, so that silence on its own key says that it is not listed."""
LARGEST_LOCAL = 4 * 2**20
"""Bytes of a message of a source; the hub drops longer ones."""


class Party(NamedTuple):
    """Whom a certificate stands for: its role, its name, and what the certificate says, if that is not `role:name`."""

    role: str
    name: str
    certificate: str = ""

    @property
    def common_name(self) -> str:
        """What its certificate says."""
        return self.certificate or common_name(self.role, self.name)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"


class Rights(NamedTuple):
    """Key expressions, without the realm: what a party owns, reads, asks, and is asked beside what it owns."""

    own: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    ask: tuple[str, ...] = ()
    asked: tuple[str, ...] = ()


def common_name(role: str, name: str) -> str:
    """What the certificate of a party says: `source:radar-1`."""
    return f"{role}:{name}"


def hello_key(common: str) -> str:
    """Where the party of this common name asks the hub what it may do."""
    return f"{HELLO}/party/{common}"


def rights(party: Party) -> Rights:
    """What a party may do."""
    role, name = party.role, party.name
    results = ("global/**", "record/**")
    looks = (*results, "local/*/info")
    asks = ("global/*/picture", "record/*/state")
    picture = asks[0]
    return {
        "source": Rights(own=(f"local/{name}/**",)),
        "centre": Rights(
            own=(f"global/{name}/**",),
            read=("local/**", "global/**"),
            ask=(picture, f"global/{name}/state"),
            asked=(picture,),
        ),
        "recorder": Rights(own=(f"record/{name}/**",), read=("**",), asked=asks[1:]),
        "viewer": Rights(read=looks, ask=asks),
        "operator": Rights(read=looks, ask=(*asks, f"global/*/orders/{name}")),
        "gateway": Rights(own=(f"local/{name}/**",), read=results, ask=asks),
        "scenario": Rights(own=(f"truth/{name}",)),
    }[role]


def allowed(party: Party, realm: str) -> dict[str, list[str]]:
    """What a party may do, as whole key expressions: publish, subscribe, ask; who: which party it is."""
    given = rights(party)
    return {
        "publish": _below(realm, given.own),
        "subscribe": _below(realm, given.read),
        "ask": _below(realm, given.ask),
        "who": [str(party)],
    }


def access_control(parties: Mapping[str, Party], realm: str) -> dict[str, Any]:
    """Zenoh's `access_control` and `low_pass_filter` for parties by common name, default deny."""
    rules = [*_rules(HELLO, [("asks", "ingress", ["query"], [ANYONE]), ("is told", "egress", ["reply"], [ANYONE])])]
    subjects: list[dict[str, Any]] = [{"id": HELLO, "link_protocols": ["tls"]}]
    policies = [_policy(HELLO, rules)]
    for common, party in sorted(parties.items()):
        held = _rules(common, _permissions(common, rights(party), realm))
        rules += held
        subjects.append({"id": common, "cert_common_names": [common]})
        policies.append(_policy(common, held))
    largest = {
        "id": "the largest message of a source",
        "flows": ["ingress"],
        "messages": ["put", "reply", "query"],
        "key_exprs": _with_caches(realm, ["local/**", "truth/**"]),
        "size_limit": LARGEST_LOCAL,
    }
    control = {"enabled": True, "default_permission": "deny"}
    return {
        "access_control": {**control, "rules": rules, "subjects": subjects, "policies": policies},
        "low_pass_filter": [largest],
    }


_Permission = tuple[str, str, list[str], list[str]]
"""What for, which way as the hub sees it, which of Zenoh's messages, on which keys."""


def _permissions(common: str, given: Rights, realm: str) -> Iterator[_Permission]:
    yield "asks the hub", "ingress", ["query"], [hello_key(common)]
    yield "is answered by the hub", "egress", ["reply"], [hello_key(common)]
    if given.own:
        keys = _with_caches(realm, given.own)
        yield "says", "ingress", ["put", "reply", "declare_queryable", "liveliness_token"], keys
        yield "knows who listens", "egress", ["declare_subscriber"], _with_caches(realm, ["**"])
        asked = [*_caches(realm, ["**"]), *keys, *_below(realm, given.asked)]
        yield "is asked", "egress", ["query"], asked
    if given.read:
        keys = _with_caches(realm, given.read)
        looks = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
        yield "listens", "ingress", looks, keys
        yield "asks again for what it missed", "ingress", ["query"], _caches(realm, given.read)
        yield "hears", "egress", ["put", "reply", "declare_queryable", "liveliness_token"], keys
    if given.ask:
        keys = _below(realm, given.ask)
        yield "asks", "ingress", ["query"], keys
        yield "is answered", "egress", ["reply", "declare_queryable"], keys


def _rules(who: str, permissions: Iterable[_Permission]) -> list[dict[str, Any]]:
    return [
        {"id": f"{who} {what}", "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
        for what, flow, messages, keys in permissions
    ]


def _policy(who: str, rules: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    return {"id": who, "rules": [rule["id"] for rule in rules], "subjects": [who]}


def _below(realm: str, keys: Iterable[str]) -> list[str]:
    return [f"{realm}/v1/{key}" for key in keys]


def _caches(realm: str, keys: Iterable[str]) -> list[str]:
    return [f"{key}/@adv/**" for key in _below(realm, keys)]


def _with_caches(realm: str, keys: Sequence[str]) -> list[str]:
    return _below(realm, keys) + _caches(realm, keys)
