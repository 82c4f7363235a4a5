"""Who we are on the bus, and whom we believe: the table [security] of a TOML file, and what Zenoh is told for it.

    [security]                      # the file of a source, centre, recorder, operator, viewer, gateway, or scenario
    role = "source"
    name = "radar-1"
    ca = "ca.pem"                   # the authority whose certificates are believed; paths begin at the file's folder
    certificate = "radar-1.pem"
    key = "radar-1.key"             # readable by its owner alone

    [security]                      # the file of the hub
    role = "hub"
    ...
    roles.source = ["radar-1", {name = "radar-2", certificate = "radar-2.example.org"}]
    roles.centre = ["centre"]       # who may come, and as what; who is not listed is not heard

`fusion-service keys` writes them. No file is opened by Zenoh that was not looked at here; the key's text is never read
but by the TLS libraries.
"""

from __future__ import annotations

import os
import stat
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from fusion_service.bus.roles import ROLES, Party, access_control, common_name
from fusion_service.errors import FusionError
from schemas import REALM, check_name, check_realm

__all__ = [
    "ACCEPT_PENDING",
    "ACCEPT_TIMEOUT",
    "FILE",
    "HUB",
    "Security",
    "SecurityError",
    "check_party",
    "check_private",
    "hub_security",
    "link_settings",
    "maybe_security",
    "read_security",
    "secured",
    "zenohd_settings",
]

HUB = "hub"
FILE = "security.toml"
"""Name of the file in the folder of a party."""
ACCEPT_PENDING, ACCEPT_TIMEOUT = 4096, 3000
"""Connections that may be in their opening at a time, and ms that one may take: idle ones hold up nobody's joining."""
_KNOWN = ("role", "name", "ca", "certificate", "key", "realm", "roles", "hub")


class SecurityError(FusionError):
    """A security file, certificate or key that cannot be used; the message says which, and how to mend it."""

    exit_code: ClassVar[int] = 2


@dataclass(frozen=True)
class Security:
    """A party's, or the hub's, certificates. parties: whom a hub lets in, by the common name of their certificates.
    hub: the security file of the hub that a centre holds itself (`run --hub`)."""

    path: Path
    role: str
    name: str
    ca: Path
    certificate: Path
    key: Path
    realm: str = REALM
    hub: Path | None = None
    parties: Mapping[str, Party] = field(default_factory=dict)

    @property
    def common_name(self) -> str:
        """What the certificate says, unless it was made elsewhere."""
        return common_name(self.role, self.name)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"


def read_security(path: str | Path) -> Security:
    """Read the table [security] of a TOML file, or of the `security.toml` in a folder, and look at the files that it
    names. Raises `SecurityError`."""
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    try:
        raw = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise SecurityError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise SecurityError(f"{path}: not TOML: {error}") from None
    table = raw.get("security")
    if not isinstance(table, dict):
        raise SecurityError(f"{path}: there is no table [security] in it: `fusion-service keys` writes such a file")
    try:
        return _read(path, table)
    except ValueError as error:
        raise SecurityError(f"{path}: [security] {error}") from None


def maybe_security(path: str | Path | None) -> Security | None:
    """`read_security`, where a file is given."""
    return None if path is None else read_security(path)


def hub_security(path: str | Path | None) -> Security | None:
    """The file of the hub that the centre of this file holds itself, which it names under `hub`."""
    centre = maybe_security(path)
    if centre is None:
        return None
    if centre.hub is None:
        raise SecurityError(f'{centre.path}: --hub needs the hub\'s certificate too: hub = "../hub"')
    return read_security(centre.hub)


def check_party(security: Security, roles: tuple[str, ...], name: str = "") -> None:
    """Raises `SecurityError` if a certificate is not for one of these roles, or for another name."""
    if security.role not in roles:
        raise SecurityError(f"{security.path}: it is that of {security}, and no good for a {' or a '.join(roles)}")
    if name and security.name != name:
        raise SecurityError(f"{security.path}: it is that of {security}, and no good for {name}")


def _read(path: Path, table: dict[str, Any]) -> Security:
    for name in table:
        if name not in _KNOWN:
            raise ValueError(f"{name}: unknown key (known: {', '.join(_KNOWN)})")
    text = {name: _text(table, name) for name in ("role", "name", "ca", "certificate", "key")}
    role = text["role"]
    if role not in (*ROLES, HUB):
        raise ValueError(f"role: is {role!r}, must be one of: {', '.join((*ROLES, HUB))}")
    here = path.parent.absolute()
    files = {name: here / text[name] for name in ("ca", "certificate", "key")}
    for name, file in files.items():
        if not os.access(file, os.R_OK) or not file.is_file():
            raise ValueError(f"{name}: {file} cannot be read: is it there, and yours?")
    check_private(files["key"])
    parties = {party.common_name: party for party in _parties(table.get("roles", {}))} if role == HUB else {}
    hub = Path(os.path.normpath(here / _text(table, "hub"))) if "hub" in table else None
    realm = check_realm(_text(table, "realm")) if "realm" in table else REALM
    return Security(path, role, check_name(text["name"]), **files, realm=realm, hub=hub, parties=parties)


def _text(table: dict[str, Any], name: str) -> str:
    if name not in table:
        raise ValueError(f"{name} is missing")
    if not isinstance(table[name], str) or not table[name]:
        raise ValueError(f"{name}: is {table[name]!r}, must be a text")
    return str(table[name])


def _parties(table: Any) -> Iterator[Party]:
    if not isinstance(table, dict):
        raise ValueError(f"roles: is {table!r}, must be a table of lists of names")
    for role, names in table.items():
        if role not in ROLES or not isinstance(names, list):
            raise ValueError(f"roles.{role}: must be a list of names under one of: {', '.join(ROLES)}")
        for one in names:
            given = {"name": one} if isinstance(one, str) else one
            if not isinstance(given, dict) or not {"name"} <= set(given) <= {"name", "certificate"}:
                raise ValueError(f"roles.{role}: {one!r} is no name, nor {{name = ..., certificate = COMMON NAME}}")
            try:
                name = check_name(given["name"])
                yield Party(role, name, check_name(given.get("certificate", common_name(role, name)[:64])))
            except (TypeError, ValueError) as error:
                raise ValueError(f"roles.{role}: {error}") from None


def check_private(key: Path) -> None:
    """Raises ValueError if others than its owner may read or write a private key."""
    if stat.S_IMODE(key.stat().st_mode) & 0o077:
        raise ValueError(f"key: others may read the private key {key}: chmod 600 {key}")


def secured(endpoints: Iterable[str]) -> tuple[str, ...]:
    """The same places by TLS: `tcp/` is read as `tls/`. Raises `SecurityError` for what cannot be."""
    found = tuple(f"tls/{one.removeprefix('tcp/').removeprefix('tls/')}" for one in endpoints)
    for one in found:
        if one.count("/") != 1:
            raise SecurityError(f"{one.removeprefix('tls/')}: with a security file the bus is TLS: write tls/host:port")
    return found


def link_settings(security: Security) -> dict[str, Any]:
    """What Zenoh is told of the links of a hub or of a client: TLS alone, both ends shown by certificates."""
    certificate, key = str(security.certificate), str(security.key)
    ends = ("listen", "connect") if security.role == HUB else ("connect",)
    tls = {
        "root_ca_certificate": str(security.ca),
        **{f"{end}_certificate": certificate for end in ends},
        **{f"{end}_private_key": key for end in ends},
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    return {
        "transport/link/protocols": ["tls"],
        **{f"transport/link/tls/{name}": value for name, value in tls.items()},
        "scouting/gossip/enabled": False,
        "adminspace/enabled": False,
        **(access_control(security.parties, security.realm) if security.role == HUB else {}),
    }


def zenohd_settings(security: Security, listen: Iterable[str]) -> dict[str, Any]:
    """The same as the config file of a real zenohd, nested."""
    plain: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": list(secured(listen)),
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": ACCEPT_TIMEOUT,
        **link_settings(security),
    }
    nested: dict[str, Any] = {}
    for name, value in plain.items():
        *tables, last = name.split("/")
        inner = nested
        for table in tables:
            inner = inner.setdefault(table, {})
        inner[last] = value
    return nested
