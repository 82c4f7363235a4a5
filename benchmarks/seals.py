"""What seals cost: of a message, of a recorder, of a file, and of who checks them.

python -m benchmarks.seals                          a minute

CPU time of one thread; the least of three runs, for a busy machine only adds.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from benchmarks.recording import SECOND, Scans
from fusion_service.recording import Recorder, read
from fusion_service.recording.chain import digest
from fusion_service.recording.sealing import Sealer
from fusion_service.recording.signing import Signer, load_signer
from fusion_service.recording.verifying import verify
from schemas import encode, local_key

SOURCES, TRACKS, SCANS = 50, 20, 200
"""A second of it is 1,000 tracks; the recorder takes 200 of them, which are 10,000 messages and 200,000 tracks."""


def least(work: Callable[[], Any], runs: int = 3) -> float:
    """CPU seconds."""
    found = []
    for _ in range(runs):
        began = time.thread_time()
        work()
        found.append(time.thread_time() - began)
    return min(found)


def of_a_message() -> None:
    """The digest alone."""
    print("bytes of a message   us     MB/s")
    for size in (200, 2_800, 28_000):
        data = os.urandom(size)

        def work(data: bytes = data) -> None:
            for _ in range(5000):
                digest(1, "fusion/v1/local/radar01/tracks", data)

        each = least(work) / 5000
        print(f"{size:16,} {each * 1e6:6.2f} {size / each / 1e6:8.0f}")


def signer(folder: Path) -> Signer:
    """A key like that of a certificate."""
    path = folder / "key.pem"
    path.touch(0o600)
    key = ec.generate_private_key(ec.SECP256R1())
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return load_signer(path)


@contextmanager
def unsealed(really: bool) -> Iterator[None]:
    """A recorder seals nothing meanwhile."""
    before = Sealer.begin, Sealer.add, Sealer.seal
    if really:
        for name in ("begin", "add", "seal"):
            setattr(Sealer, name, lambda self, *args, **kwargs: None)
    try:
        yield
    finally:
        Sealer.begin, Sealer.add, Sealer.seal = before  # type: ignore[method-assign]


def of_a_recorder(folder: Path) -> None:
    """200,000 tracks a second through `Recorder`, for the messages alone, without seals, with them, signed."""
    scans, made = Scans(SOURCES, TRACKS), []
    for second in range(SCANS):
        for k, name in enumerate(scans.names):
            made.append((local_key(name, "tracks"), encode(scans.scan(k, 1, second, second * SECOND, float(second)))))
    size = sum(len(data) for _, data in made)
    print(f"\n{len(made):,} messages of {SOURCES} sources of {TRACKS} tracks, {size / len(made):,.0f} bytes")
    print("recorder      us a message   file, MB")

    def record(path: Path, by: Signer | None) -> None:
        path.unlink(missing_ok=True)
        with Recorder(path, draw=False, signer=by) as recorder:
            for k, (key, data) in enumerate(made):
                recorder.handle(key, data, 10**18 + k * 10**5)
                if k % 10_000 == 9_999:
                    recorder.tick()

    by = signer(folder)
    for name, key in (("without seals", None), ("sealed", None), ("signed", by)):
        path = folder / f"{name}.rrd"
        with unsealed(name == "without seals"):
            took = least(partial(record, path, key))
        print(f"{name:14} {took / len(made) * 1e6:11.1f} {path.stat().st_size / 1e6:10.2f}")
    path = folder / "signed.rrd"
    reading, checking = least(lambda: list(map(len, read(path)))), least(lambda: verify(path))
    print(f"\nread: {reading / len(made) * 1e6:.1f} us a message; read and compared with its seals: "
          f"{checking / len(made) * 1e6:.1f}; {verify(path)}")  # fmt: skip


def main() -> None:
    """Print all."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.1f}")
    of_a_message()
    with tempfile.TemporaryDirectory() as folder:
        of_a_recorder(Path(folder))


if __name__ == "__main__":
    main()
