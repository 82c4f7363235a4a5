"""What a recording holds of its centres: a first look, before it is read for good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Event
from typing import Any

from fusion_service.config import CentreConfig, config_hash
from fusion_service.config.settings import known_settings, nested
from fusion_service.errors import ReviewError
from fusion_service.recording import read
from fusion_service.recording.columns import import_rerun
from schemas import REALM, Key, MessageError, StepLog, decode, parse_key

__all__ = ["RecordedCentre", "Survey", "key_of", "survey"]


@dataclass
class RecordedCentre:
    """What is there of one centre. settings: tables of a config by its hash, of the runs whose start is recorded;
    hashes: of the first log of each run, and of all starts; unknown: settings that this version does not know."""

    name: str
    realm: str
    logs: int = 0
    pictures: int = 0
    replayed: bool = False
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    hashes: list[str] = field(default_factory=list)
    versions: list[str] = field(default_factory=list)
    unknown: set[str] = field(default_factory=set)

    def _note(self, log: StepLog) -> None:
        self.replayed = log.origin == "replay"
        if log.config_hash not in self.hashes:
            self.hashes.append(log.config_hash)
        if log.version not in self.versions:
            self.versions.append(log.version)
        for event in log.events:
            if event.get("kind") == "start" and isinstance(event.get("config"), Mapping):
                try:
                    tables, unknown = known_settings(nested(event["config"]))
                except ValueError:
                    continue
                self.settings[log.config_hash] = tables
                self.unknown |= set(unknown)
        if config_hash(CentreConfig(name=self.name)) == log.config_hash:
            self.settings.setdefault(log.config_hash, {"name": self.name})


@dataclass
class Survey:
    """messages: how many there are; inputs: those of sources; sources: names under local keys; realm: of the first
    key that has one."""

    path: Path
    realm: str = ""
    messages: int = 0
    inputs: int = 0
    undecodable: int = 0
    sources: set[str] = field(default_factory=set)
    centres: dict[str, RecordedCentre] = field(default_factory=dict)

    def chosen(self, name: str | None) -> RecordedCentre | None:
        """The centre `name`, else the only one with step logs, or the only one of these that is no replay; None where
        there is none with step logs. `ReviewError` if it cannot be told."""
        if name is not None:
            one = self._named(name)
            return one if one.logs else None
        return self._only([one for one in self.centres.values() if one.logs])

    def shown(self, name: str | None) -> RecordedCentre:
        """The same, be it with step logs or without. `ReviewError` if it cannot be told, or there is none."""
        if name is not None:
            return self._named(name)
        one = self._only([one for one in self.centres.values() if one.logs]) or self._only(list(self.centres.values()))
        if one is None:
            raise ReviewError(f"{self.path} holds no tracks of a centre: fuse it with fusion-service replay first")
        return one

    def _named(self, name: str) -> RecordedCentre:
        if name not in self.centres:
            raise ReviewError(f"{self.path} holds no centre {name!r}: name one of its centres ({self._known})")
        return self.centres[name]

    def _only(self, some: list[RecordedCentre]) -> RecordedCentre | None:
        first_hand = [one for one in some if not one.replayed] or some
        if len(first_hand) > 1:
            raise ReviewError(f"{self.path} holds several centres: choose one with --centre ({self._known})")
        return first_hand[0] if first_hand else None

    @property
    def _known(self) -> str:
        return ", ".join(sorted(self.centres)) or "none"


@lru_cache(maxsize=4096)
def key_of(text: str) -> Key | None:
    """The parts of a key; None for one that is not of this wire format."""
    try:
        return parse_key(text)
    except ValueError:
        return None


def survey(path: str | Path, stop: Event | None = None) -> Survey:
    """Look through a recording once. `ReviewError`, or `FileNotFoundError`, for what is none, and `ReviewError` where
    recordings cannot be read here."""
    found = Survey(Path(path))
    try:
        import_rerun()
    except ImportError as error:
        raise ReviewError(str(error)) from None
    for raw in read(path):
        if stop is not None and stop.is_set():
            break
        found.messages += 1
        key = key_of(raw.key)
        if key is None:
            continue
        found.realm = found.realm or key.realm
        if key.scope == "local":
            found.sources.add(key.name)
            found.inputs += key.what in ("info", "tracks", "intensity")
        if key.scope != "global" or key.what not in ("log", "tracks"):
            continue
        centre = found.centres.setdefault(key.name, RecordedCentre(key.name, key.realm))
        centre.pictures += key.what == "tracks"
        if key.what == "tracks" or (centre.logs and b"start" not in raw.data):
            centre.logs += key.what == "log"
            continue
        try:
            message = decode(raw.data)
        except MessageError:
            found.undecodable += 1
            continue
        if isinstance(message, StepLog):
            centre.logs += 1
            centre._note(message)
    found.realm = found.realm or REALM
    if not found.messages and not (stop is not None and stop.is_set()):
        raise ReviewError(f"{path} holds no messages: record a mission with fusion-service record")
    return found
