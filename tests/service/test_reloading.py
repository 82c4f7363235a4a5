"""What a reload takes at once, what it leaves for a restart, and that it never harms what is there."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from fusion_service.bus.renewal import certificates_changed, fingerprint
from fusion_service.bus.security import read_security
from fusion_service.cli import main
from fusion_service.config import ServiceConfig, load_config
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.flow import Flow
from fusion_service.service.heartbeat import Heartbeat
from fusion_service.service.reloading import AT_ONCE, Reloads, Tuned, changed


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:], root.level = handlers, level


class Running:
    """A service, as far as a reload sees it."""

    def __init__(self, config: ServiceConfig) -> None:
        self.flow, self.told = Flow(config.limits), BoundedLog(config.service.log_refusals)
        self.heart = Heartbeat(config.service.status_period, lambda busy, alive: None)
        self.tuned = Tuned(self.flow, self.told, self.heart)


class Reloaded:
    """A service on a config file that is written anew."""

    def __init__(self, path: Path, verbose: bool = False) -> None:
        self.path = path
        path.write_text("")
        self.reloads = Reloads(load_config(path), lambda: load_config(path), verbose)
        self.running = Running(self.reloads.config)
        make = self.reloads.making(lambda config, bus, state, tenure: self.running)
        make(self.reloads.config, None, None, None)  # type: ignore[arg-type]

    def reload(self, text: str) -> None:
        self.path.write_text(text)
        self.reloads.reload()


def test_what_changes_no_result_is_taken_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    one = Reloaded(tmp_path / "centre.toml")
    assert one.running.flow.takes("r1", 10)
    one.reload(
        "[service]\nlog_level = 'debug'\nstatus_period = 0.5\nlog_refusals = 4.0\n[limits]\nmessages = 1\nburst = 1\n"
    )
    assert one.running.heart.period == 0.5
    assert logging.getLogger().level == logging.DEBUG
    assert 1 <= sum(one.running.flow.takes("r1", 10) for _ in range(1000)) < 100
    for key in (
        "service.log_level: info -> debug",
        "service.status_period: 1.0 -> 0.5",
        "limits.messages: 5000.0 -> 1.0",
    ):
        assert key in caplog.text
    assert "restart" not in caplog.text
    one.reload("[service]\nlog_level = 'warning'\n")
    assert one.running.heart.period == 1.0
    assert logging.getLogger().level == logging.WARNING


def test_verbose_goes_before_the_level(tmp_path: Path) -> None:
    Reloaded(tmp_path / "centre.toml", verbose=True).reload("[service]\nlog_level = 'error'\n")
    assert logging.getLogger().level == logging.DEBUG


def test_the_rest_waits_for_a_restart_and_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one = Reloaded(tmp_path / "centre.toml")
    before = one.reloads.config
    one.reload(
        "[centre]\nrule = 'ci'\n[centre.sources.r1]\nignore = true\n[bus]\nrealm = 'other'\n[service]\ntakeover = 2\n"
    )
    for key in ("centre.rule: auto -> ci", "centre.sources.r1", "bus.realm: fusion -> other", "service.takeover"):
        assert key in caplog.text
    assert "taken by a restart only" in caplog.text
    assert one.reloads.config == before


def test_a_bad_file_changes_nothing_and_every_error_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one = Reloaded(tmp_path / "centre.toml")
    before = one.reloads.config
    for text in ("[service]\nstatus_period = 'x'\nlog_levle = 1\n", "no toml", "\0"):
        caplog.clear()
        one.reload(text)
        assert "the old config goes on" in caplog.text
        assert str(one.path) in caplog.text
    one.path.unlink()
    one.reloads.reload()
    assert "cannot be read" in caplog.text
    assert one.reloads.config == before
    assert one.running.heart.period == 1.0


def test_every_key_is_one_or_the_other() -> None:
    """Whatever is added to the config later waits for a restart unless it is named."""
    config = ServiceConfig()
    for table in fields(config):
        inner = getattr(config, table.name)
        for one in fields(inner):
            new = dataclasses.replace(config, **{table.name: dataclasses.replace(inner, **{one.name: "new"})})
            taken, waiting = changed(config, new)
            at_once = table.name == "limits" or f"{table.name}.{one.name}" in AT_ONCE
            assert (len(taken), len(waiting)) == ((1, 0) if at_once else (0, 1)), one.name
    assert changed(config, config) == ([], [])


def test_renewed_certificates_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("cryptography")
    assert main(["keys", str(tmp_path / "keys"), "--centre", "centre"]) == 0
    logging.getLogger().addHandler(caplog.handler)  # which setting up the log has taken away
    folder = tmp_path / "keys" / "centre-centre"
    before = fingerprint(folder)
    assert len(before) == 4
    assert not certificates_changed(before, folder)
    path = read_security(folder).certificate
    path.write_bytes(path.read_bytes() + b"\n")
    assert certificates_changed(before, folder)
    assert f"taken by a restart only: {path}" in caplog.text
    (folder / "security.toml").unlink()
    assert certificates_changed(before, folder)
    assert "a restart would fail" in caplog.text
    assert not certificates_changed({}, None)
