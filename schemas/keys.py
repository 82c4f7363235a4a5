"""Key expressions: build and parse.

{realm}/v1/local/{source}/tracks|intensity|info|alive
{realm}/v1/global/{centre}/tracks|log|status|alive|picture|orders|state
{realm}/v1/global/{centre}/orders/{operator}
{realm}/v1/global/{centre}/holds|yields|standby/{name}
{realm}/v1/record/{recorder}/alive|state
{realm}/v1/truth/{scenario}
"""

from __future__ import annotations

import re
from dataclasses import dataclass

__all__ = [
    "REALM",
    "Key",
    "centre_source",
    "check_name",
    "check_realm",
    "check_source",
    "global_key",
    "local_key",
    "order_key",
    "parse_key",
    "record_key",
    "token_key",
    "truth_key",
]

REALM = "fusion"
VERSION = "v1"
LOCAL = ("tracks", "intensity", "info", "alive")
CENTRES = "global/"
GLOBAL = ("tracks", "log", "status", "alive", "picture", "orders", "state")
RECORD = ("alive", "state")
TOKENS = ("holds", "yields", "standby")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,63}\Z")


@dataclass(frozen=True, slots=True)
class Key:
    """A parsed key: scope `local`, `global` or `truth`; `what` is "" for truth."""

    realm: str
    scope: str
    name: str
    what: str

    @property
    def source(self) -> str:
        """The name of the source that it is a key of."""
        return centre_source(self.name) if self.scope == "global" else self.name


def check_name(name: str) -> str:
    """Return `name` if it can stand in a key: 1 to 64 letters, digits, `_.:-`, beginning with a letter or digit.
    Raises ValueError if not."""
    if not _NAME.match(name):
        raise ValueError(f"bad name {name!r}: use 1 to 64 letters, digits or _ . : - and begin with a letter or digit")
    return name


def centre_source(centre: str) -> str:
    """The name under which the picture of a centre is a source of another one: `global/{centre}`."""
    return f"{CENTRES}{centre}"


def check_source(name: str) -> str:
    """Return `name` if it can be that of a source: a name, or that of a centre as `centre_source` gives it. Raises
    ValueError if not."""
    check_name(name.removeprefix(CENTRES) if isinstance(name, str) else name)
    return name


def check_realm(realm: str) -> str:
    """Return `realm` if every chunk between its slashes is a name other than `v1`. Raises ValueError if not."""
    for chunk in realm.split("/"):
        check_name(chunk)
        if chunk == VERSION:
            raise ValueError(f"bad realm {realm!r}: {VERSION} stands for the version")
    return realm


def local_key(source: str, what: str, realm: str = REALM) -> str:
    """Key of a source; `what` is tracks, intensity, info or alive. `*` stands for any source.
    Raises ValueError for any other, and for what is no name or realm."""
    if what not in LOCAL:
        raise ValueError(f"no local key {what!r} (known: {' '.join(LOCAL)})")
    return f"{check_realm(realm)}/{VERSION}/local/{source if source == '*' else check_name(source)}/{what}"


def global_key(centre: str, what: str, realm: str = REALM) -> str:
    """Key of a centre; `what` is tracks, log, status, alive, picture, orders or state. `*` stands for any centre.
    Raises ValueError for any other, and for what is no name or realm."""
    if what not in GLOBAL:
        raise ValueError(f"no global key {what!r} (known: {' '.join(GLOBAL)})")
    return f"{check_realm(realm)}/{VERSION}/global/{centre if centre == '*' else check_name(centre)}/{what}"


def token_key(centre: str, what: str, name: str, realm: str = REALM) -> str:
    """Key of a liveliness token by which the processes of one centre know of each other; `what` is holds, yields or
    standby. `*` stands for any name. Raises ValueError for any other, and for what is no name or realm."""
    if what not in TOKENS:
        raise ValueError(f"no token {what!r} (known: {' '.join(TOKENS)})")
    name = name if name == "*" else check_name(name)
    return f"{check_realm(realm)}/{VERSION}/global/{check_name(centre)}/{what}/{name}"


def order_key(centre: str, operator: str, realm: str = REALM) -> str:
    """Key on which an operator gives orders: with certificates nobody else can. `*` stands for any operator. Raises
    ValueError for what is no name or realm."""
    return f"{global_key(centre, 'orders', realm)}/{operator if operator == '*' else check_name(operator)}"


def record_key(recorder: str, what: str, realm: str = REALM) -> str:
    """Key of a recorder; `what` is alive or state. `*` stands for any recorder. Raises ValueError for any other, and
    for what is no name or realm."""
    if what not in RECORD:
        raise ValueError(f"no key of a recorder {what!r} (known: {' '.join(RECORD)})")
    return f"{check_realm(realm)}/{VERSION}/record/{recorder if recorder == '*' else check_name(recorder)}/{what}"


def truth_key(scenario: str, realm: str = REALM) -> str:
    """Key of a scenario's truth. `*` stands for any scenario. Raises ValueError for what is no name or realm."""
    return f"{check_realm(realm)}/{VERSION}/truth/{scenario if scenario == '*' else check_name(scenario)}"


def parse_key(key: str) -> Key:
    """The parts of a key. Raises ValueError for anything that is not one of ours."""
    chunks = key.split("/")
    if len(chunks) >= 4 and chunks[-3:-1] == [VERSION, "truth"]:
        return Key(check_realm("/".join(chunks[:-3])), "truth", check_name(chunks[-1]), "")
    if len(chunks) >= 5 and chunks[-4] == VERSION:
        scope, name, what = chunks[-3:]
        if what in {"local": LOCAL, "global": GLOBAL}.get(scope, ()):
            return Key(check_realm("/".join(chunks[:-4])), scope, check_name(name), what)
    raise ValueError(f"not a key of this version: {key!r}")
