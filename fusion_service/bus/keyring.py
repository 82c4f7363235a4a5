"""`Keyring`: the folder that `fusion-service keys` keeps.

DIR/authority/ca.pem, ca.key            whoever has ca.key can be anybody
DIR/hub/                                ca.pem, certificate.pem, key.pem, security.toml
DIR/source-radar-1/, DIR/centre-.../    the same: all that a party needs, to be copied to its computer
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from fusion_service.bus.roles import ROLES, Party, common_name
from fusion_service.bus.security import FILE, HUB, SecurityError, read_security
from fusion_service.extras import install_hint
from schemas import REALM

try:
    from fusion_service.bus import certificates
except ImportError as error:
    raise ImportError(f"making keys needs a package more: {install_hint('keys')} ({error})") from None

__all__ = ["Keyring"]

HERE = ("localhost", "127.0.0.1", "::1")
FIELD = """in the field:
  keep {0}/authority on a computer that is on no network: whoever has ca.key can be anybody
  copy to each computer its own folder and no other, by a way that nobody reads
  give the hub's certificate the names it is reached by: --at hub.example.org
  start the hub again after every change here: it lets in whom its file lists
in the laboratory: fusion-service hub --security {0}/hub, and each with its own folder"""


class Keyring:
    """An authority with its hub and parties. Raises `SecurityError` if the folder is not as it must be."""

    def __init__(self, folder: Path, days: float = 365.0, realm: str | None = None) -> None:
        self._folder = folder
        self._days = days
        self._hosts: list[str] = []
        self._parties: dict[str, Party] = {}
        self._realm = realm or REALM
        self._new_realm = False
        if (folder / HUB / FILE).exists():
            hub = read_security(folder / HUB)
            self._parties = dict(hub.parties)
            self._realm = realm or hub.realm
            self._new_realm = self._realm != hub.realm

    def change(
        self,
        parties: Iterable[tuple[str, str]] = (),
        *,
        hosts: Sequence[str] = (),
        renew: Iterable[str] = (),
        remove: Iterable[str] = (),
    ) -> Iterator[str]:
        """Make what there is not yet, and tell it line by line. hosts: by which names the hub is reached too."""
        asked, renewed = [Party(*party) for party in parties], set(renew)
        for common in [*(renewed - {HUB}), *(gone := set(remove))]:
            if common not in self._parties:
                raise SecurityError(f"{common}: no such party in {self._folder}: write role:name, as in source:radar-1")
        for party in asked:
            if len(party.common_name) > 64:
                raise SecurityError(f"{party.name}: too long for a certificate: at most {63 - len(party.role)} letters")
        first = not (self._folder / "authority" / "ca.key").exists()
        if first and (there := sorted(one.parent.name for one in self._folder.glob(f"*/{FILE}"))):
            if not (asked or hosts or renewed or gone):
                return  # who there is can be told without it
            raise SecurityError(
                f"{self._folder}: there are keys ({', '.join(there[:3])}), but no authority/ca.key, which alone can "
                "add to them or renew them: bring it back, or make all anew in another folder"
            )
        if first and not asked:
            raise SecurityError(
                f"{self._folder}: no keys there: name the parties, as in --source radar-1 --centre centre"
            )
        authority = self._authority(first)
        if first:
            yield f"{self._folder}/authority: a new authority"
        for common in gone:
            party = self._parties.pop(common)
            shutil.rmtree(self._place(party), ignore_errors=True)
            yield f"{common} is removed"
        for party in asked:
            self._parties.setdefault(party.common_name, party)
        made = {party.common_name for party in asked if not (self._place(party) / FILE).exists()}
        for common in sorted((made | renewed) & set(self._parties)):
            place = self._place(self._parties[common])
            authority.issue(*self._files(place), self._parties[common].common_name, days=self._days)
            self._tell(place, self._parties[common])
            yield f"{place}: the certificate of {common}"
        known = self._known_hosts()
        wanted = list(dict.fromkeys([*known, *HERE, socket.gethostname(), *hosts]))
        rehosted = HUB in renewed or not set(wanted) <= set(known)
        if first or rehosted:
            authority.issue(*self._files(self._folder / HUB), HUB, hosts=wanted, days=self._days)
            yield f"{self._folder / HUB}: the certificate of the hub, at {', '.join(wanted)}"
        if first or made or gone or rehosted or self._new_realm:
            self._tell(self._folder / HUB, None)
            if not first:
                yield "start the hub again with this file: until then it goes by the old one"
        if first:
            yield FIELD.format(self._folder)

    def listed(self) -> list[str]:
        """Who there is, and until when, a line each."""
        rows = [("authority", self._folder / "authority" / "ca.pem"), (HUB, self._folder / HUB / "certificate.pem")]
        rows += [(str(party), self._place(party) / "certificate.pem") for party in self._parties.values()]
        width = max(len(name) for name, _ in rows)
        return [f"{name:<{width}}  {_state(path)}" for name, path in rows]

    def _authority(self, first: bool) -> certificates.Authority:
        files = self._folder / "authority" / "ca.pem", self._folder / "authority" / "ca.key"
        if first:
            _private_folder(self._folder)
            _private_folder(files[0].parent)
            return certificates.make_authority(*files, f"track fusion {self._folder.name}"[:64])
        try:
            return certificates.open_authority(*files)
        except (ValueError, TypeError) as error:
            raise SecurityError(f"{files[1]}: {error}") from None

    def _place(self, party: Party) -> Path:
        return self._folder / f"{party.role}-{party.name}"

    def _files(self, place: Path) -> tuple[Path, Path]:
        _private_folder(place)
        shutil.copyfile(self._folder / "authority" / "ca.pem", place / "ca.pem")
        return place / "certificate.pem", place / "key.pem"

    def _known_hosts(self) -> list[str]:
        path = self._folder / HUB / "certificate.pem"
        return certificates.hosts_of(path) if path.exists() else []

    def _tell(self, place: Path, party: Party | None) -> None:
        """Write a security file. party: None for the hub."""
        role, name = (party.role, party.name) if party else (HUB, HUB)
        lines = ["[security]", f'role = "{role}"', f'name = "{name}"', 'ca = "ca.pem"']
        lines += ['certificate = "certificate.pem"', 'key = "key.pem"']
        if role == "centre":
            lines.append(f'hub = "../{HUB}"{" " * 15}# for run --hub')
        if party is None:
            lines += [f'realm = "{self._realm}"', "", "[security.roles]  # who is let in, and as what"]
            for one in ROLES:
                of = [_entry(given) for given in self._parties.values() if given.role == one]
                lines.append(f"{one} = [{', '.join(of)}]")
        new = place / f"{FILE}.new"
        new.write_text("\n".join(lines) + "\n", encoding="utf-8")
        os.replace(new, place / FILE)


def _entry(party: Party) -> str:
    if party.common_name == common_name(party.role, party.name):
        return f'"{party.name}"'
    return f'{{name = "{party.name}", certificate = "{party.certificate}"}}'


def _private_folder(path: Path) -> None:
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.chmod(0o700)


def _state(path: Path) -> str:
    try:
        common, end = certificates.expiry(path)
    except (OSError, ValueError):
        return "its certificate is elsewhere"
    days = (end - datetime.now(UTC)).total_seconds() / 86400
    left = f"{days:.0f} days left" if days > 0 else "EXPIRED: --renew it"
    return f"{common:<24}  until {end:%Y-%m-%d}  {left}"
