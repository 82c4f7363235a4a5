"""Security files, certificates that `fusion-service keys` makes, the rules of the roles, and what is said of each."""

from __future__ import annotations

import json
import logging
import os
import re
import stat
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import fusion_service.cli
from fusion_service.bus import BusError, SecurityError, open_bus, read_security
from fusion_service.bus.certificates import open_authority
from fusion_service.bus.hub import open_hub, run_hub
from fusion_service.bus.keyring import Keyring
from fusion_service.bus.refusal import own_certificate
from fusion_service.bus.roles import ROLES, Party, access_control, allowed, rights
from fusion_service.bus.security import check_party, hub_security, link_settings, secured
from fusion_service.config import load_config
from schemas import order_key
from sensor_clients.publisher import TrackPublisher, TruthPublisher
from tests.helpers.processes import eventually, free_endpoint, slowness


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("security") / "keys"
    list(Keyring(folder).change([(role, "one") for role in ROLES] + [("source", "two")]))
    return folder


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def command(*words: str | Path) -> int:
    return fusion_service.cli.main([str(word) for word in words])


def test_one_command_makes_a_laboratory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lab" / "keys"
    parties = ["--source", "r1", "--source", "r2", "--centre", "main", "--recorder", "rec", "--operator", "alice"]
    before = os.umask(0)
    try:
        assert command("keys", folder, *parties) == 0
    finally:
        os.umask(before)
    said = capsys.readouterr().out
    assert "authority on a computer that is on no network" in said
    assert "source:r2" in said
    assert re.search(r"operator alice .* 36[45] days left", said)
    hub = read_security(folder / "hub")
    assert set(hub.parties) == {"source:r1", "source:r2", "centre:main", "recorder:rec", "operator:alice"}
    for place in [folder, *folder.iterdir()]:
        assert mode(place) == 0o700
    for key in folder.glob("*/*key*"):
        assert mode(key) == 0o600
    for party in folder.glob("*-*"):
        assert own_certificate(read_security(party)).common_name == party.name.replace("-", ":")
    assert own_certificate(hub).common_name == "hub"


def test_parties_are_added_renewed_and_removed_later(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert command("keys", folder, "--source", "r1") == 0
    first = {path: path.read_bytes() for path in folder.glob("*/*.pem")}
    assert command("keys", folder, "--source", "r2", "--source", "r1") == 0
    assert all(path.read_bytes() == data for path, data in first.items())
    assert "start the hub again" in capsys.readouterr().out
    assert set(read_security(folder / "hub").parties) == {"source:r1", "source:r2"}
    assert command("keys", folder, "--renew", "source:r1", "--at", "hub.example.org", "--days", "7") == 0
    changed = {path.parent.name for path, data in first.items() if path.read_bytes() != data}
    assert changed == {"source-r1", "hub"}
    assert re.search(r"source r1 .* 7 days left", capsys.readouterr().out)
    assert command("keys", folder, "--remove", "source:r2") == 0
    assert set(read_security(folder / "hub").parties) == {"source:r1"}
    assert not (folder / "source-r2").exists()
    capsys.readouterr()
    for wrong, why in (
        (["--remove", "source:r9"], "source:r9: no such party"),
        (["--renew", "r1"], "r1: no such party"),
        (["--source", "x" * 60], "too long"),
    ):
        assert command("keys", folder, *wrong) == 2
        assert why in capsys.readouterr().err
    with pytest.raises(SystemExit):
        command("keys", tmp_path / "nothing", "--source", "r1", "--days", "1e9")
    assert "for which the authority itself holds" in capsys.readouterr().err
    assert command("keys", tmp_path / "nothing") == 2
    assert "no keys there" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()


def test_an_authority_that_is_kept_elsewhere_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    assert command("keys", folder, "--source", "r1") == 0
    (folder / "authority" / "ca.key").unlink()
    kept = {path: path.read_bytes() for path in folder.glob("*/*")}
    capsys.readouterr()
    for more in (["--source", "r3"], ["--renew", "source:r1"], ["--remove", "source:r1"], ["--at", "10.0.0.1"]):
        assert command("keys", folder, *more) == 2
        assert "but no authority/ca.key, which alone can add" in capsys.readouterr().err
    assert command("keys", folder) == 0
    assert "source r1" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in folder.glob("*/*")} == kept


def test_a_file_that_is_no_good_is_refused_in_one_line(keys: Path, tmp_path: Path) -> None:
    good = (keys / "source-one" / "security.toml").read_text()
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        (tmp_path / name).write_bytes((keys / "source-one" / name).read_bytes())
    (tmp_path / "key.pem").chmod(0o600)
    file = tmp_path / "security.toml"

    def refused(text: str) -> str:
        file.write_text(text)
        with pytest.raises(SecurityError) as caught:
            read_security(file)
        assert "\n" not in str(caught.value)
        assert str(file) in str(caught.value)
        return str(caught.value)

    file.write_text(good)
    assert read_security(tmp_path).role == "source"
    assert "no table [security]" in refused("[centre]\n")
    assert "not TOML" in refused("[security")
    assert "name is missing" in refused(good.replace('name = "one"', ""))
    assert "must be one of" in refused(good.replace('"source"', '"boss"'))
    assert "unknown key" in refused(good + 'colour = "red"\n')
    assert "cannot be read" in refused(good.replace("key.pem", "no.pem"))
    assert "bad name" in refused(good.replace('"one"', '"a/b"'))
    hub = good.replace('"source"', '"hub"')
    for roles in ("3", '{boss = ["x"]}', '{source = "x"}', "{source = [3]}", '{source = [{name = "a", other = "b"}]}'):
        assert "roles" in refused(hub + f"roles = {roles}\n")
    file.write_text(hub + 'roles.source = ["r1", {name = "r2", certificate = "radar.example.org"}]\n')
    assert read_security(file).parties == {
        "source:r1": Party("source", "r1", "source:r1"),
        "radar.example.org": Party("source", "r2", "radar.example.org"),
    }
    with pytest.raises(SecurityError, match="cannot be read"):
        read_security(tmp_path / "nothing.toml")


def test_a_key_that_others_may_read_is_refused(keys: Path, tmp_path: Path) -> None:
    for path in (keys / "source-one").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for wrong in (0o640, 0o604, 0o620):
        (tmp_path / "key.pem").chmod(wrong)
        with pytest.raises(SecurityError, match=r"chmod 600 \S+key.pem"):
            read_security(tmp_path)
    (tmp_path / "key.pem").chmod(0o400)
    assert read_security(tmp_path)


def test_a_certificate_is_for_a_role_and_a_name(keys: Path) -> None:
    source = read_security(keys / "source-one")
    check_party(source, ("source",), "one")
    with pytest.raises(SecurityError, match="source one, and no good for radar-9"):
        check_party(source, ("source",), "radar-9")
    with pytest.raises(SecurityError, match="source one, and no good for a centre"):
        check_party(source, ("centre",))
    with pytest.raises(SecurityError, match="no good for two"):
        TrackPublisher("two", security=keys / "source-one")
    with pytest.raises(SecurityError, match="no good for a scenario"):
        TruthPublisher("one", security=keys / "source-one")
    with pytest.raises(SecurityError, match='role = "hub"'):
        run_hub([free_endpoint()], threading.Event(), source)
    assert hub_security(keys / "centre-one") == read_security(keys / "hub")
    assert hub_security(None) is None
    with pytest.raises(SecurityError, match="hub = "):
        hub_security(keys / "source-one")


def test_endpoints_are_tls_with_certificates() -> None:
    assert secured(["tcp/127.0.0.1:7447", "tls/hub:1"]) == ("tls/127.0.0.1:7447", "tls/hub:1")
    for wrong in ("quic/hub:1", "unixsock-stream/tmp/x"):
        with pytest.raises(SecurityError, match="tls/host:port"):
            secured([wrong])


def test_a_certificate_that_ends_soon_is_told(keys: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    authority = open_authority(keys / "authority/ca.pem", keys / "authority/ca.key")
    source = read_security(keys / "source-one")
    for path in (keys / "source-one").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "key.pem").chmod(0o600)
    here = read_security(tmp_path)
    authority.issue(here.certificate, here.key, source.common_name, days=10)
    with caplog.at_level(logging.WARNING):
        assert own_certificate(here).end == pytest.approx(time.time() + 10 * 86400, abs=60)
    assert "ends in 10 days" in caplog.text
    authority.issue(here.certificate, here.key, source.common_name, days=1, now=datetime.now(UTC) - timedelta(days=3))
    with pytest.raises(SecurityError, match="has expired"):
        own_certificate(here)
    with pytest.raises(SecurityError, match="has expired"), open_bus(["tcp/127.0.0.1:1"], wait=False, security=here):
        pass


def test_no_party_owns_what_another_owns_and_none_reads_orders_of_others() -> None:
    owned: list[str] = []
    for role in ROLES:
        for name in ("a", "b"):
            own = rights(Party(role, name)).own
            assert all(f"/{name}" in key for key in own)
            owned += own if role != "gateway" else []  # a gateway is a source of its name
    assert len(set(owned)) == len(owned)
    for role in ROLES:
        orders = [key for key in rights(Party(role, "a")).ask if "orders" in key]
        assert orders == (["global/*/orders/a"] if role == "operator" else [])
    assert rights(Party("source", "a")).read == ()


def test_the_rules_are_whole(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hub = read_security(keys / "hub")
    control = access_control(hub.parties, "sea/north")["access_control"]
    assert control["enabled"]
    assert control["default_permission"] == "deny"
    known = {rule["id"] for rule in control["rules"]}
    assert len(known) == len(control["rules"])
    assert {rule for policy in control["policies"] for rule in policy["rules"]} == known
    assert all(rule["permission"] == "allow" for rule in control["rules"])
    named = [subject["cert_common_names"] for subject in control["subjects"] if "cert_common_names" in subject]
    assert sorted(name for (name,) in named) == sorted(hub.parties)
    keys_of = [key for rule in control["rules"] for key in rule["key_exprs"]]
    assert all(key.startswith(("sea/north/v1/", "@hub/v1/")) for key in keys_of)
    assert allowed(Party("source", "a"), "r")["publish"] == ["r/v1/local/a/**"]
    assert command("keys", keys, "--zenohd") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["access_control"] == link_settings(hub)["access_control"]
    assert printed["transport"]["link"]["tls"]["enable_mtls"] is True
    assert printed["listen"]["endpoints"] == ["tls/[::]:7447"]


def test_a_config_may_hold_the_security_table_or_name_its_file(tmp_path: Path) -> None:
    file = tmp_path / "centre.toml"
    file.write_text('[centre]\nname = "main"\n[security]\nrole = "centre"\n')
    assert load_config(file).bus.security == str(file)
    file.write_text('[bus]\nsecurity = "keys/centre-main"\n')
    assert load_config(file).bus.security == "keys/centre-main"
    file.write_text("[bus]\n")
    assert load_config(file).bus.security is None


def test_a_client_is_told_what_it_may_not_do(keys: Path) -> None:
    endpoint = free_endpoint()
    with (
        open_hub([endpoint], read_security(keys / "hub")),
        open_bus([endpoint], wait=60.0, security=read_security(keys / "source-one")) as source,
        open_bus([endpoint], wait=60.0, security=read_security(keys / "operator-one")) as operator,
        open_bus([endpoint], wait=60.0, security=read_security(keys / "centre-one")) as centre,
        TrackPublisher("two", connect=endpoint, wait=60.0, security=keys / "source-two"),
    ):
        seen: list[str] = []
        centre.watch("fusion/v1/local/*/alive", lambda key, up: seen.append(key))
        eventually(lambda: seen == ["fusion/v1/local/two/alive"])
        asked: list[str] = []

        def obey(key: str, payload: bytes | None) -> bytes:
            asked.append(key)
            return b"done"

        centre.answer_each(order_key("one", "*"), obey)
        eventually(lambda: operator.ask(order_key("one", "one")) == [(order_key("one", "one"), b"done")])
        assert set(asked) == {order_key("one", "one")}
        for wrong in (
            lambda: source.publisher("fusion/v1/local/two/tracks"),
            lambda: source.announce("fusion/v1/local/two/alive"),
            lambda: source.subscribe("fusion/v1/**", lambda key, data: None),
            lambda: source.watch("fusion/v1/*/*/alive", lambda key, up: None),
            lambda: source.answer("fusion/v1/global/one/picture", lambda payload: b""),
            lambda: source.ask("fusion/v1/global/one/picture"),
        ):
            with pytest.raises(BusError, match=r"source one may not (publish|subscribe|ask) there, only on: "):
                wrong()
        with pytest.raises(BusError, match="operator one may not ask there"):
            operator.ask(order_key("one", "two"))


def test_idle_connections_hold_up_nobody(keys: Path) -> None:
    import socket

    for security in (None, read_security(keys / "hub")):
        endpoint = free_endpoint()
        with open_hub([endpoint], security):
            host, port = endpoint.removeprefix("tcp/").split(":")
            idle = [socket.create_connection((host, int(port))) for _ in range(300)]
            begin = time.monotonic()
            party = None if security is None else read_security(keys / "source-one")
            with open_bus([endpoint], wait=60.0, security=party):
                assert time.monotonic() - begin < 4.0 * slowness(), "ten where they do"
            for one in idle:
                one.close()
