"""Whoever changes, takes away or adds something is told of; what is untouched passes; a kill is no alarm."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pytest
import rerun as rr
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from cryptography.x509.oid import NameOID

from fusion_service.bus import open_bus, read_security
from fusion_service.cli import main
from fusion_service.errors import ReviewError, UsageError
from fusion_service.recording import Recorder, Rotation, parts, read
from fusion_service.recording.chain import Chain, Link, Seal, Statement
from fusion_service.recording.columns import raw
from fusion_service.recording.finding import Finding
from fusion_service.recording.program import find_program, quiet
from fusion_service.recording.reader import RawMessage, stored
from fusion_service.recording.repair import mend
from fusion_service.recording.sealing import CHAIN, SIGNER, seals_of, signers_of
from fusion_service.recording.signing import Authority, Signer, load_signer, read_authority
from fusion_service.recording.verifying import verify
from schemas import local_key
from tests.helpers.damage import spans
from tests.helpers.processes import Hub, Program, eventually, free_endpoint
from tests.recording.mission import START, mission

TICK = 20
COUNT = 100
KEYS = [f"fusion/v1/local/radar{k}/tracks" for k in range(3)]


class Held(NamedTuple):
    """A recording taken out of its file."""

    messages: list[RawMessage]
    seals: list[Seal]
    signers: list[str]


class Ca(NamedTuple):
    """An authority of the test's own, and its file."""

    file: Path
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def said(k: int) -> tuple[str, bytes, int]:
    return KEYS[k % 3], b"\xc1" + k.to_bytes(4, "little") * 30, START + k * 10**8


def fill(recorder: Recorder, begin: int = 0, end: int = COUNT) -> None:
    for k in range(begin, end):
        recorder.handle(*said(k))
        if k % TICK == TICK - 1:
            recorder.tick()


def record(path: Path, signer: Signer | None = None, **how: Any) -> Path:
    with Recorder(path, draw=False, signer=signer, **how) as recorder:
        fill(recorder)
    return path


def count(path: Path) -> int:
    """Messages in what may have just begun."""
    try:
        return sum(1 for _ in read(path))
    except (ReviewError, FileNotFoundError):
        return 0


def take(path: Path) -> Held:
    return Held(
        list(read(path)),
        sorted(
            (seal for chunk in stored(path, [CHAIN]) for seal in seals_of(chunk) if seal),
            key=lambda seal: seal.statement.number,
        ),
        [pem for chunk in stored(path, [SIGNER]) for pem in signers_of(chunk)],
    )


def put(path: Path, held: Held) -> Path:
    """A file as a forger writes it, without our recorder."""
    stream = rr.RecordingStream("forged", recording_id=held.seals[0].statement.recording if held.seals else "x")
    stream.set_sinks(rr.FileSink(str(path)))
    for pem in held.signers:
        stream.log(SIGNER, rr.DynamicArchetype(archetype="Signer", components={"identity": [pem]}), static=True)

    for message in held.messages:
        times = rr.TimeColumn("received", timestamp=pa.array([message.received], pa.int64()).to_numpy().view("M8[ns]"))
        stream.send_columns(
            "/raw/" + message.key.removeprefix("fusion/v1/"),
            [rr.TimeColumn("arrival", sequence=[message.arrival]), times],
            raw(rr, [(message.key, message.data)]),
        )
    for seal in held.seals:
        components = {
            "statement": pa.array([seal.text], pa.string()),
            "digests": pa.array([seal.digests], pa.binary()),
            "signature": pa.array([seal.signature], pa.binary()),
        }
        columns = [*rr.DynamicArchetype.columns(archetype="Seal", components=components)]
        stream.send_columns(CHAIN, [rr.TimeColumn("arrival", sequence=[0])], columns)
    stream.disconnect()
    return path


def resealed(held: Held, signer: Signer | None) -> Held:
    """Sealed anew over what is there now, as a forger would who knows how."""
    one, rest = held.seals[0].statement, list(held.messages)
    chain = Chain(one.recording, one.part, Link(), keeps=one.keeps, signer=signer.fingerprint if signer else "")
    seals: list[Seal] = []
    for seal in held.seals:
        count = seal.statement.count if not seal.statement.ends else len(rest)
        for message in rest[:count]:
            chain.add(message.received, message.key, message.data)
        del rest[:count]
        text, digests = chain.close(seal.statement.ends)
        seals.append(Seal.read(text, digests, signer.sign(text) if signer else b""))
    return Held(held.messages, seals, [signer.identity] if signer else [])


def with_message(held: Held, number: int, **change: Any) -> Held:
    messages = [one._replace(**change) if one.arrival == number else one for one in held.messages]
    return held._replace(messages=messages)


def private(path: Path, key: Any) -> Path:
    path.touch(0o600)
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return path


def certificate(subject: str, issuer: str, public: Any, by: Any, *, ca: bool, days: float = 365.0) -> x509.Certificate:
    begin = datetime.fromtimestamp(START / 1e9, UTC) - timedelta(days=30)
    return (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, subject)]))
        .issuer_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, issuer)]))
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(begin + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .sign(by, hashes.SHA256())
    )


def make_ca(folder: Path, name: str) -> Ca:
    key = ec.generate_private_key(ec.SECP256R1())
    made = certificate("ca", "ca", key.public_key(), key, ca=True)
    (folder / f"{name}.pem").write_bytes(made.public_bytes(Encoding.PEM))
    return Ca(folder / f"{name}.pem", made, key)


def make_signer(folder: Path, ca: Ca, name: str = "recorder:rec", days: float = 365.0) -> Signer:
    key = ec.generate_private_key(ec.SECP256R1())
    made = certificate(name, "ca", key.public_key(), ca.key, ca=False, days=days)
    stem = f"{ca.file.stem}-{name}-{days}"
    (folder / f"{stem}.pem").write_bytes(made.public_bytes(Encoding.PEM))
    return load_signer(private(folder / f"{stem}.key", key), folder / f"{stem}.pem")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys")


@pytest.fixture(scope="module")
def ca(keys: Path) -> Ca:
    return make_ca(keys, "ours")


@pytest.fixture(scope="module")
def authority(ca: Ca) -> Authority:
    return read_authority(ca.file)


@pytest.fixture(scope="module")
def signer(keys: Path, ca: Ca) -> Signer:
    return make_signer(keys, ca)


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory, signer: Signer) -> Path:
    return record(tmp_path_factory.mktemp("signed") / "mission.rrd", signer)


def test_what_is_untouched_is_whole(signed: Path, authority: Authority, tmp_path: Path) -> None:
    found = verify(signed, authority)
    assert found == Finding("whole", COUNT, COUNT, 0, 0, 0, (), ("recorder:rec",), "", ())
    assert str(found) == "signed by recorder:rec, whole: 100 messages"
    assert str(verify(signed)) == f"{found}; not compared with an authority (--ca FILE)"
    plain = verify(record(tmp_path / "plain.rrd"))
    assert (plain.state, str(plain)) == ("whole", "no signature, whole: 100 messages")
    assert verify(put(tmp_path / "copied.rrd", take(signed)), authority) == found


def test_the_same_messages_have_the_same_chain() -> None:
    ends = []
    for _ in range(2):
        chain = Chain("mission", 0, Link())
        for k in range(10):
            key, data, received = said(k)
            chain.add(received, key, data)
        ends.append(chain.close("recording"))
    assert ends[0] == ends[1]
    one, other = Chain("mission", 0, Link()), Chain("mission", 0, Link())
    one.add(1, "ab", b"c")
    other.add(1, "a", b"bc")
    assert one.close() != other.close()


def byte(held: Held) -> Held:
    return with_message(held, 37, data=held.messages[37].data[:-1] + b"!")


def time(held: Held) -> Held:
    return with_message(held, 37, received=held.messages[37].received + 1)


def key(held: Held) -> Held:
    return with_message(held, 37, key=KEYS[37 % 3 - 1])


def swapped(held: Held) -> Held:
    messages = list(held.messages)
    messages[37], messages[39] = messages[39]._replace(arrival=37), messages[37]._replace(arrival=39)
    return held._replace(messages=messages)


def one_deleted(held: Held) -> Held:
    return held._replace(messages=[one for one in held.messages if one.arrival != 37])


def deleted_and_renumbered(held: Held) -> Held:
    rest = [one for one in held.messages if one.arrival != 37]
    return held._replace(messages=[one._replace(arrival=k) for k, one in enumerate(rest)])


def tail_deleted(held: Held) -> Held:
    return held._replace(messages=held.messages[:37])


def one_added(held: Held) -> Held:
    return held._replace(messages=[*held.messages, held.messages[-1]._replace(arrival=COUNT)])


def one_doubled(held: Held) -> Held:
    return held._replace(messages=[*held.messages, held.messages[37]._replace(data=b"~")])


def seal_deleted(held: Held) -> Held:
    return held._replace(seals=[seal for seal in held.seals if seal.statement.number != 2])


def first_block_deleted(held: Held) -> Held:
    seals = [seal for seal in held.seals if seal.statement.number > 1]
    return held._replace(messages=held.messages[TICK:], seals=seals)


def digests_changed(held: Held) -> Held:
    """With a message that fits them."""
    other = with_message(held, 37, data=b"forged")
    seal = held.seals[2]
    digests = resealed(other, None).seals[2].digests
    seals = [one if one.statement.number != 2 else seal._replace(digests=digests) for one in held.seals]
    return other._replace(seals=seals)


def statement_changed(held: Held) -> Held:
    """With digests and a message that fit it, but not the next seal, nor the signature."""
    other = with_message(held, 37, data=b"forged")
    forged = resealed(other, None).seals[2]
    text = json.dumps(
        dataclasses.asdict(forged.statement)
        | {"signer": held.seals[2].statement.signer, "previous": held.seals[2].statement.previous}
    )
    seal = Seal.read(text, forged.digests, held.seals[2].signature)
    return other._replace(seals=[one if one.statement.number != 2 else seal for one in held.seals])


def signature_taken(held: Held) -> Held:
    return held._replace(seals=[one._replace(signature=b"") for one in held.seals])


def signer_taken(held: Held) -> Held:
    return held._replace(signers=[])


TOLD: dict[Callable[[Held], Held], str] = {
    byte: "chain broken at message 37, {}: it is not what was sealed",
    time: "chain broken at message 37, {}: it is not what was sealed",
    key: "chain broken at message 37, {}: it is not what was sealed",
    swapped: "chain broken at message 37, {}: there stands what was message 39; 1 more faults",
    one_deleted: "1 messages missing: 37, {}",
    deleted_and_renumbered: "chain broken at message 37, {}: there stands what was message 38",
    tail_deleted: "3 messages missing: 37 to 39, {}; 3 more faults, 63 messages missing in all",
    one_added: "1 messages stand after its end: 100",
    one_doubled: "message 37 is there twice",
    seal_deleted: "chain broken at message 40, {}: 1 seals before it are missing; 1 more faults",
    first_block_deleted: "chain broken at message 20, {}: 2 seals before it are missing",
    digests_changed: "chain broken at message 20, {}: the digests are not those that were sealed",
    statement_changed: "chain broken at message 20, {}: the signature of its seal is not by recorder:rec",
    signature_taken: "chain broken at message 0, {}: the signature of its seal is not by recorder:rec",
    signer_taken: "chain broken at message 0, {}: the certificate that its seal names is not there",
}


@pytest.mark.parametrize("change", TOLD, ids=lambda change: change.__name__)
def test_each_change_is_told_and_named(
    change: Callable[[Held], Held], signed: Path, authority: Authority, tmp_path: Path
) -> None:
    found = verify(put(tmp_path / "changed.rrd", change(take(signed))), authority)
    assert found.state == "broken"
    text = str(found)
    for number in range(0, COUNT, TICK):
        last = START + (number + TICK - 1) * 10**8
        text = text.replace(f"{datetime.fromtimestamp(last / 1e9, UTC):%H:%M:%S} UTC", "{}")
    assert text.replace("00:00:00 UTC", "{}").startswith(TOLD[change]), text
    assert main(["verify", str(tmp_path / "changed.rrd")]) == 1


def test_a_forger_needs_the_key(signed: Path, authority: Authority, keys: Path, tmp_path: Path) -> None:
    """Who seals all anew makes it whole, and is told of by name."""
    forged = with_message(take(signed), 37, data=b"forged")
    other = make_ca(keys, "other")
    foreign = make_signer(keys, other)
    path = put(tmp_path / "foreign.rrd", resealed(forged, foreign))
    assert str(verify(path)).startswith("signed by recorder:rec, whole"), "of the same name: only --ca tells"
    doubt = "signed by a certificate that is not of the authority given (--ca FILE)"
    assert (verify(path, authority).state, verify(path, authority).doubts) == ("doubtful", doubt)
    assert verify(path, read_authority(other.file)).state == "whole"
    bare = load_signer(private(tmp_path / "bare.key", ed25519.Ed25519PrivateKey.generate()))
    path = put(tmp_path / "bare.rrd", resealed(forged, bare))
    assert verify(path, authority).doubts == "signed by a key that is not the one given (--ca FILE)"
    path = put(tmp_path / "unsigned.rrd", resealed(forged, None))
    assert str(verify(path)) == "no signature, whole: 100 messages"
    assert verify(path, authority).doubts == "not signed by anybody of the authority given"
    # one's own signature with the other's certificate, and a certificate that one's own has issued
    one, mine = (
        take(signed).signers[0],
        resealed(forged, dataclasses.replace(foreign, identity=take(signed).signers[0])),
    )
    assert "the signature of its seal is not by recorder:rec" in str(verify(put(tmp_path / "worn.rrd", mine)))
    key = ec.generate_private_key(ec.SECP256R1())
    issued = certificate("recorder:rec", "recorder:rec", key.public_key(), key, ca=False)
    pair = issued.public_bytes(Encoding.PEM).decode() + one
    (tmp_path / "pair.pem").write_text(pair)
    below = load_signer(private(tmp_path / "pair.key", key), tmp_path / "pair.pem")
    assert verify(put(tmp_path / "pair.rrd", resealed(forged, below)), authority).doubts == doubt


def test_whose_certificate_signs(ca: Ca, authority: Authority, keys: Path, tmp_path: Path) -> None:
    """A source's, of the same authority, is no good; nor one that had ended. One through an authority between is."""
    found = verify(record(tmp_path / "source.rrd", make_signer(keys, ca, "source:radar1")), authority)
    assert str(found).startswith(
        "signed by the certificate of a source, and not of a recorder; signed by source:radar1"
    )
    found = verify(record(tmp_path / "old.rrd", make_signer(keys, ca, days=10.0)), authority)
    assert found.doubts.startswith("signed by a certificate that did not hold at 2026-09-21")
    between, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    middle = certificate("between", "ca", between.public_key(), ca.key, ca=True)
    leaf = certificate("recorder:far", "between", key.public_key(), between, ca=False)
    text = "".join(one.public_bytes(Encoding.PEM).decode() for one in (leaf, middle))
    (tmp_path / "far.pem").write_text(text)
    far = load_signer(private(tmp_path / "far.key", key), tmp_path / "far.pem")
    assert verify(record(tmp_path / "far.rrd", far), authority).state == "whole"


def test_by_a_key_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = ed25519.Ed25519PrivateKey.generate()
    path = record(tmp_path / "a.rrd", load_signer(private(tmp_path / "a.key", key)))
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    (tmp_path / "a.pub").write_bytes(public)
    assert main(["verify", str(path), "--ca", str(tmp_path / "a.pub"), "--ended"]) == 0
    assert "signed by key " in capsys.readouterr().out
    os.chmod(tmp_path / "a.key", 0o644)
    with pytest.raises(UsageError, match=r"others may read the private key .* chmod 600"):
        load_signer(tmp_path / "a.key")
    (tmp_path / "b.key").touch(0o600)
    with pytest.raises(UsageError, match="not a private key without password"):
        load_signer(tmp_path / "b.key")


def test_two_recordings_grafted(signed: Path, signer: Signer, authority: Authority, tmp_path: Path) -> None:
    """The first half of one, the second of another by the same recorder."""
    first, second = take(signed), take(record(tmp_path / "second.rrd", signer))
    for seals, told in (
        (first.seals[:3] + second.seals[3:], "from there on it is of another recording"),
        (first.seals, "it is not what was sealed"),
    ):
        messages = first.messages[:40] + [one._replace(received=one.received + 5) for one in second.messages[40:]]
        path = tmp_path / f"{len(told)}.rrd"
        found = verify(put(path, Held(messages, seals, first.signers)), authority)
        assert "chain broken at message 40, " in found.faults[0]
        assert found.faults[0].endswith(told)


def test_older_recordings_are_not_sealed(ca: Ca, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (Path(__file__).parents[1] / "recordings" / "0.1.0").glob("*.rrd"):
        found = verify(path)
        assert (found.state, found.bad, found.messages) == ("not sealed", False, len(list(read(path))))
    assert main(["verify", str(path)]) == 0
    assert "not sealed" in capsys.readouterr().out
    assert main(["verify", str(path), "--ended"]) == 1
    assert main(["verify", str(path), "--ca", str(ca.file)]) == 1
    assert "not sealed" in (told := capsys.readouterr().err)
    assert "not signed by anybody of the authority given" in told
    assert main(["verify", str(tmp_path / "none.rrd")]) == 1


def test_a_recording_that_was_repaired_or_compacted_is_whole(
    signed: Path, authority: Authority, tmp_path: Path
) -> None:
    program = find_program()
    assert program is not None
    for how in ("merge", "optimize"):
        out = tmp_path / f"{how}.rrd"
        subprocess.run([program, "rrd", how, signed, "-o", out], env=quiet(tmp_path), check=True, capture_output=True)
        assert verify(out, authority) == verify(signed, authority)


def test_seals_that_come_after_all_messages(
    signed: Path, authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_service.recording.verifying.PATIENCE", 10)
    late = tmp_path / "late.rrd"
    data, head = signed.read_bytes(), 12
    records = spans(data)
    raws = [data[a:b] for a, b in records if b"RawMessage" in data[a:b]]
    others = [data[a:b] for a, b in records[1:] if b"RawMessage" not in data[a:b]]
    late.write_bytes(data[:head] + data[records[0][0] : records[0][1]] + b"".join(raws + others))
    found = verify(late, authority)
    assert (found.state, found.whole) == ("whole", COUNT)


def test_damage_within_is_told_by_the_messages_that_it_took(signed: Path, authority: Authority, tmp_path: Path) -> None:
    data = bytearray(signed.read_bytes())
    records = spans(data)
    begin, end = records[[k for k, (a, b) in enumerate(records) if b"RawMessage" in data[a:b]][4]]
    middle = (begin + end) // 2
    data[middle : middle + 40] = bytes(40)
    path = tmp_path / "damaged.rrd"
    path.write_bytes(data)
    lost = {one.arrival for one in read(signed)} - {one.arrival for one in read(path)}
    found = verify(path, authority)
    assert 0 < len(lost) <= TICK
    assert (found.state, found.missing, found.whole) == ("broken", len(lost), COUNT - len(lost))
    assert found.faults[0].startswith(f"{len(lost)} messages missing: some of {min(lost)} to {max(lost)}")
    assert mend(path).lost.bytes
    assert verify(path, authority) == found


def test_parts_are_one_chain(signer: Signer, authority: Authority, tmp_path: Path) -> None:
    folder = tmp_path / "m"
    with Recorder(folder, draw=False, signer=signer, rotation=Rotation(size=1)) as recorder:
        for sent in list(mission(3)):
            recorder.handle(sent.key, sent.data, sent.received)
        for k in range(0, COUNT, TICK):
            fill(recorder, k, k + TICK)
    with Recorder(folder, draw=False, signer=signer) as recorder:  # goes on
        fill(recorder)
    there = parts(folder)
    assert len(there) > 5
    found = verify(folder, authority)
    assert (found.state, found.notes) == ("whole", ())
    assert str(verify(there[2], authority)).split("; ")[1].startswith("begins with part 3")
    kept = verify(shutil.copytree(folder, tmp_path / "first") / "0001.rrd", authority)
    assert kept.state == "whole"
    (tmp_path / "first" / "0001.rrd").unlink()
    assert "its recorder deletes none" in verify(tmp_path / "first", authority).faults[0]
    between = shutil.copytree(folder, tmp_path / "between")
    count = sum(1 for _ in read(folder))
    (between / "0003.rrd").unlink()
    left = sum(1 for _ in read(between))
    found = verify(between, authority)
    assert (found.state, found.missing) == ("broken", count - left)
    assert found.faults[0].startswith(f"{count - left} messages missing before message 0 of part 4")
    last = shutil.copytree(folder, tmp_path / "last")
    parts(last)[-1].unlink()
    parts(last)[-1].unlink()
    assert verify(last, authority).state == "open"
    shutil.copy(folder / "0002.rrd", between / "0003.rrd")
    assert verify(between, authority).state == "broken"


def test_parts_that_the_recorder_deletes_are_no_alarm(tmp_path: Path, signer: Signer, authority: Authority) -> None:
    folder = tmp_path / "m"
    rotation = Rotation(size=10_000, keep_size=60_000)
    with Recorder(folder, draw=False, signer=signer, rotation=rotation) as recorder:
        for k in range(0, 10 * COUNT, TICK):
            fill(recorder, k, k + TICK)
    assert parts(folder)[0].name != "0001.rrd"
    found = verify(folder, authority)
    assert found.state == "whole"
    assert "are gone with parts that its recorder may delete" in str(found)


def test_a_killed_recorder(hub: Hub, keys: Path, ca: Ca, authority: Authority, tmp_path: Path) -> None:
    """Two real processes, the first one killed: what it had flushed is signed, and the second one goes on."""
    private(tmp_path / "rec.key", ed25519.Ed25519PrivateKey.generate())
    folder = tmp_path / "m"
    folder.mkdir()
    command = ["record", "--connect", hub.endpoint, "--out", str(folder), "--flush", "0.1s", "--no-draw"]
    command += ["--sign", str(tmp_path / "rec.key")]
    run = f"import sys; from fusion_service.cli import main; sys.exit(main({command!r}))"
    for k in range(2):
        with Program(run) as recorder, open_bus([hub.endpoint]) as bus:
            eventually(lambda k=k: len(parts(folder)) == k + 1, 20)  # type: ignore[misc]
            publisher = bus.publisher(KEYS[0], cache=200)
            for n in range(50):
                publisher.put(said(n)[1])
            eventually(lambda k=k: count(folder) >= 50 * (k + 1), 20)  # type: ignore[misc]
            # A kill between a flush and its seal leaves a message unsealed for good: a case of its own above.
            eventually(lambda k=k: verify(folder).whole >= 50 * (k + 1), 20)  # type: ignore[misc]
            if k == 0:
                recorder.signal(signal.SIGKILL)
            else:
                recorder.signal(signal.SIGINT)
            recorder.end(20)
        if k == 0:
            found = verify(folder)
            assert (found.state, found.messages, found.whole + found.unsealed) == ("open", 50, 50)
            assert "not ended by its recorder: it runs, was killed, or the end was cut off" in str(found)
            assert main(["verify", str(folder)]) == 0
            assert main(["verify", str(folder), "--ended"]) == 1
    found = verify(folder)
    assert (found.state, found.messages) == ("whole", 100)
    assert len(found.signers) == 1


@pytest.mark.parametrize("cut", [1, 300, 3000])
def test_a_file_that_is_cut_is_whole_as_far_as_it_is_sealed(
    cut: int, signer: Signer, authority: Authority, tmp_path: Path
) -> None:
    recorder = Recorder(tmp_path / "a.rrd", draw=False, signer=signer)
    fill(recorder)
    data = recorder.path.read_bytes()
    recorder.close()
    (tmp_path / "b.rrd").write_bytes(data[:-cut])
    found = verify(tmp_path / "b.rrd", authority)
    assert (found.state, found.count) == ("open", 0)
    assert found.whole < COUNT
    assert found.whole + found.unsealed == found.messages


def test_evaluate_tells_of_it(tmp_path: Path, signer: Signer, ca: Ca, capsys: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path / "m.rrd", draw=False, signer=signer) as recorder:
        for sent in mission(20):
            recorder.handle(sent.key, sent.data, sent.received)
    path, scores = str(tmp_path / "m.rrd"), tmp_path / "scores.json"
    assert main(["evaluate", path, "--json", str(scores), "--ca", str(ca.file)]) == 0
    seal = json.loads(scores.read_text())["recordings"][0]["seal"]
    assert (seal["state"], seal["signers"], seal["missing"]) == ("whole", ["recorder:rec"], 0)
    assert f"{path}: {seal['text']}\n" in capsys.readouterr().out
    for command in (["explain", path], ["export", path, "--out", str(tmp_path / "a.csv")]):
        assert main([*command, "--ca", str(ca.file)]) == 0
        assert f"{path}: {seal['text']}\n" in capsys.readouterr().out
    held = take(Path(path))
    changed = put(tmp_path / "changed.rrd", with_message(held, 7, received=held.messages[7].received + 1))
    assert main(["evaluate", str(changed)]) == 0
    assert f"WARNING {changed}: chain broken at message 7, " in capsys.readouterr().err


HOSTILE = ["", "{}", "[]", "1", "[" * 3000, '{"recording":1}', json.dumps({"a": "x" * 5000})]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_statement_is_a_line(text: str, signed: Path, tmp_path: Path) -> None:
    held = take(signed)
    seals = [held.seals[0], held.seals[1]._replace(text=text), *held.seals[2:]]
    found = verify(put(tmp_path / "a.rrd", held._replace(seals=seals)))
    assert found.state == "broken"
    assert "a seal cannot be read" in found.faults


@pytest.mark.parametrize("name", ["part", "number", "first", "count", "repeated", "total", "time"])
@pytest.mark.parametrize("value", [1, 7, 2**62])
def test_no_number_in_a_statement_makes_it_hang(name: str, value: int, signed: Path, tmp_path: Path) -> None:
    held = take(signed)
    plain = dataclasses.asdict(held.seals[2].statement)
    text = json.dumps(plain | {name: value})
    assert json.loads(text) != plain
    seals = [
        one if k != 2 else one._replace(text=text, statement=Statement(**json.loads(text)))
        for k, one in enumerate(held.seals)
    ]
    assert verify(put(tmp_path / "a.rrd", held._replace(seals=seals))).state == "broken"


def test_the_certificate_of_a_security_file_signs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`keys`, a secured hub, `record --security`, `verify --ca`, all real."""
    assert main(["keys", str(tmp_path / "keys"), "--recorder", "rec", "--source", "radar1", "--source", "radar2"]) == 0
    endpoint, keys, out = free_endpoint(), tmp_path / "keys", tmp_path / "m.rrd"

    def command(*words: str) -> str:
        return f"import sys; from fusion_service.cli import main; sys.exit(main({list(words)!r}))"

    listen = command("hub", "--listen", endpoint, "--security", str(keys / "hub"))
    connect = ["--connect", endpoint, "--security", str(keys / "recorder-rec")]
    with Program(listen), Program(command("record", *connect, "--out", str(out), "--flush", "0.1s")) as recorder:
        eventually(out.is_file, 30)  # then it has subscribed
        with open_bus([endpoint], security=read_security(keys / "source-radar1")) as bus:
            publisher = bus.publisher(local_key("radar1", "tracks"), cache=200)
            for k in range(50):
                publisher.put(said(k)[1])
            eventually(lambda: count(out) == 50, 30)
        recorder.signal(signal.SIGINT)
        assert recorder.end(20)[0] == 0
    capsys.readouterr()
    assert main(["verify", str(out), "--ca", str(keys / "authority" / "ca.pem"), "--ended"]) == 0
    assert capsys.readouterr().out == f"{out}: signed by recorder:rec, whole: 50 messages\n"
    assert main(["verify", str(out), "--ca", str(keys / "recorder-rec" / "certificate.pem")]) == 1
    assert "a certificate that is not of the authority given (--ca FILE)" in capsys.readouterr().err


def test_a_part_by_another_hand_is_told(signer: Signer, authority: Authority, keys: Path, tmp_path: Path) -> None:
    """Appended without a key, or by another key of the same name; or put before, without seals."""
    with Recorder(tmp_path / "m", draw=False, signer=signer, rotation=Rotation()) as recorder:
        fill(recorder)
    for name, other in (("none", None), ("other", make_signer(keys, make_ca(keys, "third")))):
        folder = shutil.copytree(tmp_path / "m", tmp_path / name)
        with Recorder(folder, draw=False, signer=other) as recorder:
            fill(recorder)
        found = verify(folder)
        if other is None:
            assert (found.state, found.doubts) == ("doubtful", "not all of it is signed")
        else:
            assert (found.state, found.notes[0]) == ("whole", "by 2 different keys")
            assert verify(folder, authority).state == "doubtful"
    before = tmp_path / "before"
    before.mkdir()
    shutil.copy(tmp_path / "m" / "0001.rrd", before / "0002.rrd")
    shutil.copy(Path(__file__).parents[1] / "recordings" / "0.1.0" / "memory.rrd", before / "0001.rrd")
    found = verify(before)
    assert (found.state, found.whole, found.messages - found.unsealed) == ("doubtful", COUNT, COUNT)


def test_what_is_added_to_a_killed_recording_is_not_sealed(
    signer: Signer, authority: Authority, tmp_path: Path
) -> None:
    recorder = Recorder(tmp_path / "a.rrd", draw=False, signer=signer)
    fill(recorder)
    shutil.copy(recorder.path, tmp_path / "b.rrd")
    recorder.close()
    held = take(tmp_path / "b.rrd")
    more = held._replace(messages=[*held.messages, *(held.messages[0]._replace(arrival=COUNT + k) for k in range(7))])
    found = verify(put(tmp_path / "c.rrd", more), authority)
    assert (found.state, found.whole, found.unsealed) == ("open", COUNT, 7)
    assert "7 messages are not sealed: 100 to 106" in str(found)
