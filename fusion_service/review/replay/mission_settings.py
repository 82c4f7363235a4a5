"""The settings that a replay begins from: those of the mission's own log, or of a config file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fusion_service import __version__
from fusion_service.centre import is_picture_of
from fusion_service.config import BEFORE, CentreConfig, ConfigError, centre_config, config_hash
from fusion_service.config.own_rule import is_loaded, told_rule
from fusion_service.config.settings import nested, plain_settings
from fusion_service.errors import ReviewError
from fusion_service.recording.survey import RecordedCentre, Survey
from fusion_service.review.replay.recorded_rule import missing_rule
from fusion_service.review.replay.variants import Variant

__all__ = ["MissionSettings", "RunSettings"]


class RunSettings(NamedTuple):
    """The settings of one run: tables of a config; doubt: why they may not be its, empty where they are; own: whether
    they are known to be the mission's."""

    tables: Mapping[str, Any]
    doubt: str = ""
    own: bool = True


class MissionSettings:
    """The settings of each run of the centre that is followed. given: of a config file, above what is recorded.

    foreign: the hash of `given` where no run had these settings. first: those of the first run. told: in words.
    ruled: every variant has a rule of its own.
    Raises `ReviewError` where the settings are not in the recording, or cannot be used.
    """

    def __init__(
        self,
        found: Survey,
        followed: RecordedCentre | None,
        given: CentreConfig | None,
        *,
        by_clock: bool,
        ruled: bool = False,
    ) -> None:
        self.remarks: list[str] = []
        self.foreign = ""
        self._given = None if given is None else nested(plain_settings(given))
        self._recorded = {} if followed is None else {code: BEFORE | one for code, one in followed.settings.items()}
        self._doubts: dict[str, str] = {}
        self.told = "the config given" if given is not None else "its own settings"
        if followed is None or (by_clock and not self._recorded and given is None):
            self.first = self._given or {}
            self.told = self.told if given is not None else "default settings"
            return
        if given is not None:
            assert self._given is not None
            if config_hash(given) not in followed.hashes:
                self.foreign = config_hash(given)
        elif not self._recorded:
            raise ReviewError(
                f"{found.path} does not say how its centre was set (version {', '.join(followed.versions)}): "
                f"give the config of the mission with --config"
            )
        else:
            self._look(found, followed, ruled)
        self.first = self._given or next(iter(self._recorded.values()))
        others = [version for version in followed.versions if version != __version__]
        if others:
            self.remarks.append(f"recorded by version {', '.join(others)}, this is {__version__}: they may differ")

    @property
    def centres(self) -> set[str]:
        """The sources, of all runs, that are other centres."""
        runs = [self.first, *self._recorded.values()]
        return {name for tables in runs for name in tables.get("sources", {}) if is_picture_of(name)}

    def _look(self, found: Survey, followed: RecordedCentre, ruled: bool) -> None:
        """Check the recorded settings: they must be usable, and those of their hash."""
        if followed.unknown:
            self.remarks.append(f"settings that this version does not know: {', '.join(sorted(followed.unknown))}")
        for code, tables in self._recorded.items():
            rule = str(tables.get("rule", ""))
            if why := missing_rule(rule, ruled):
                raise ReviewError(f"{found.path} {why}")
            if told_rule(rule) and not is_loaded(rule):
                continue
            try:
                config = centre_config(tables)
            except ConfigError as error:
                raise ReviewError(
                    f"{found.path}: its settings cannot be used by version {__version__} "
                    f"({'; '.join(error.problems)}): give a config with --config"
                ) from None
            if config_hash(config) != code and followed.versions == [__version__]:
                self._doubts[code] = f"the settings in the log have hash {config_hash(config)}, the log says {code}"

    def check(self, variants: Sequence[Variant]) -> None:
        """Let every variant be made of the settings of every run. `ConfigError` says what cannot be."""
        for variant in variants:
            for tables in [self.first, *(() if self._given else self._recorded.values())]:
                variant.config(tables)

    def of(self, code: str) -> RunSettings:
        """The settings of a run whose log has this hash."""
        if self._given is not None:
            return RunSettings(self._given, own=not self.foreign)
        if code in self._recorded:
            doubt = self._doubts.get(code, "")
            return RunSettings(self._recorded[code], doubt, not doubt)
        return RunSettings(self.first, "the settings of the run are not in the recording", False)
