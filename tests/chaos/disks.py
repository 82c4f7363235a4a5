"""Disks that are full: under the state of the service, while it runs and when it starts; under a recording.

Small file systems are mounted for it, which takes the right to; without it nothing is tried, and that is said.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fusion_service.recording import read
from tests.chaos.report import Report
from tests.chaos.scene import TARGETS, Product, Watch, product
from tests.helpers.processes import eventually

__all__ = ["fill_disks"]

SILENCE = 1.5
STATE, RECORDED = "1m", "160m"


@contextmanager
def _mounted(place: Path, size: str) -> Iterator[None]:
    """A file system of that size. Raises OSError where it may not be mounted."""
    place.mkdir(exist_ok=True)
    try:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], capture_output=True, text=True
        )
    except FileNotFoundError as error:
        raise OSError(f"no program mounts: {error}") from None
    if done.returncode:
        raise OSError(done.stderr.strip())
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=False)


def _fill(place: Path) -> Path:
    """A file that takes all the room there is."""
    path = place / "filler"
    with suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return path


def fill_disks() -> Report:
    """The state, then the recording."""
    report = Report("disk")
    for part in (_state, _recording):
        with product() as (all_of, watch):
            try:
                part(all_of, watch, report)
            except PermissionError as error:
                report.escaped(str(error))
            except OSError as error:
                report.say(f"not tried: {error}")
    return report


def _up(all_of: Product, watch: Watch, *names: str) -> dict[int, int]:
    since = time.monotonic()
    all_of.start(*names)
    eventually(lambda: watch.whole(since), 90)
    return watch.confirmed()


def _unsaved(watch: Watch) -> float:
    return watch.status.step_time.get("unsaved", 0) if watch.status is not None else 0


def _state(all_of: Product, watch: Watch, report: Report) -> None:
    place = all_of.folder / "state"
    with _mounted(place, STATE):
        before = _up(all_of, watch, "r1", "r2", "service")
        report.tried += 1
        filler, begin = _fill(place), time.monotonic()
        eventually(lambda: _unsaved(watch) > 0, 60)
        time.sleep(3.0)
        silence, whole = watch.silence(begin), watch.whole()
        report.say(f"state full while it runs: picture {'whole' if whole else 'NOT WHOLE'}, silence {silence:.2f} s")
        if not whole or watch.confirmed() != before:
            report.escaped(f"state full while it runs: {before} became {watch.confirmed()}")
        report.tried += 1
        service = all_of["service"]
        service.kill()
        begin = time.monotonic()
        service.start()
        while not watch.whole(begin) and service.running() and time.monotonic() - begin < 90:
            time.sleep(0.05)
        if watch.whole(begin):
            kept = sum(watch.confirmed().get(one) == before[one] for one in TARGETS)
            report.say(f"killed and started on a full disk: first status after {watch.first(begin):.1f} s, ids {kept}")
        else:
            said = service.log.read_text(errors="replace").splitlines()[-1:]
            report.escaped(f"it does not start on a full disk: {said}")
        filler.unlink()
        if not service.running():
            service.kill()
            service.start()
        begin = time.monotonic()
        eventually(lambda: watch.whole(begin), 90)
        time.sleep(3.0)
        unsaved = _unsaved(watch)
        time.sleep(3.0)
        if _unsaved(watch) > unsaved or watch.returned or any(len(one) > 1 for one in watch.targets_of.values()):
            report.escaped(f"room again: unsaved {_unsaved(watch)}, ended and back {watch.returned}")
        code, _ = service.end()
        report.say(f"room again: saved again, exit code {code}")


def _recording(all_of: Product, watch: Watch, report: Report) -> None:
    place = all_of.folder / "recorded"
    with _mounted(place, RECORDED):
        _up(all_of, watch, "r1", "r2", "service", "recorder")

        def parts() -> list[Path]:
            return sorted(place.glob("*.rrd"))

        def written(more: int) -> bool:
            return len(parts()) > more and parts()[-1].stat().st_size > 20_000

        eventually(lambda: written(0), 60)
        time.sleep(5.0)
        before = sum(1 for part in parts() for _ in read(part))
        recorder, begin = all_of["recorder"], time.monotonic()
        report.tried += 1
        filler = _fill(place)
        eventually(lambda: not recorder.running(), 60)
        code, _ = recorder.end()
        said = recorder.log.read_text(errors="replace")
        last = said.strip().splitlines()[-1:]
        if code != 1 or "Traceback" in said:
            report.escaped(f"recording on a full disk: exit code {code}: {said[-1000:]}")
        filler.unlink()
        messages = sum(1 for part in parts() for _ in read(part))
        report.say(f"recording on a full disk: exit code {code}, {last}; {messages} messages are read")
        report.say(f"the service meanwhile: silence {watch.silence(begin):.2f} s")
        if not messages >= before > 0 or not watch.whole():
            report.escaped(f"recording on a full disk: {before} messages were there, or the picture suffers")
        report.tried += 1
        count = len(parts())
        recorder.start()
        eventually(lambda: written(count), 60)
        code, _ = recorder.end()
        report.say(f"room again: another part, exit code {code}")
        if code:
            report.escaped(f"room again: the recorder ends with {code}")
