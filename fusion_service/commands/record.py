"""`fusion-service record`: the recorder."""

from __future__ import annotations

import argparse
import logging
import os
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT
from fusion_service.bus.options import bus_options
from fusion_service.commands.arguments import duration, port, size
from fusion_service.commands.observed import add_metrics, observed
from fusion_service.hangup import on_hangup
from fusion_service.process import argument, positive

if TYPE_CHECKING:
    from fusion_service.bus.security import Security
    from fusion_service.recording import Recorder, Rotation
    from fusion_service.recording.signing import Signer

__all__ = ["EXAMPLE", "HELP", "add", "run"]

log = logging.getLogger(__name__)

HELP = "Record everything on the bus."
EXAMPLE = """fusion-service record --out mission.rrd
  fusion-service record --out mission/ --rotate-every 1h --keep-for 7d     parts 0001.rrd, 0002.rrd, ...
  fusion-service record --out mission.rrd --sign rec.key                   signed: `verify` and others check it
  fusion-service record --live       look on with: rerun --connect rerun+http://127.0.0.1:9876/proxy
  fusion-service record --live-web   look on in a browser
SIGHUP begins the next part."""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument(
        "--out",
        metavar="PATH",
        help="recording, a new file; or a folder (a name that ends with /, or exists) of parts, which is gone on with "
        "(default runs/mission-<UTC time>.rrd)",
    )
    bus_options(parser, "the recorder's certificate, which signs the recording too")
    parser.add_argument(
        "--name",
        metavar="NAME",
        help="of this recorder, for `status` and `top` (default: its certificate's, or host's)",
    )
    parser.add_argument(
        "--cutoff",
        type=argument(positive),
        metavar="M",
        help="largest error that still counts as followed, m: of the picture, and kept for `evaluate`",
    )
    parser.add_argument(
        "--every", type=argument(positive), metavar="S", help="how often `evaluate` is to score, s: kept for it"
    )
    parser.add_argument(
        "--flush",
        type=argument(duration),
        default=1.0,
        metavar="TIME",
        help="what a kill may cost at most (default 1s)",
    )
    parser.add_argument(
        "--sign", metavar="KEY", help="sign the recording by this private key, PEM, without a certificate"
    )
    parser.add_argument("--no-draw", action="store_true", help="record the messages alone, without the picture")
    add_metrics(parser, "recorder")
    _add_weeks(parser)
    _add_live(parser)


def _add_weeks(parser: argparse.ArgumentParser) -> None:
    weeks = parser.add_argument_group("for weeks", "any of these makes the recording a folder of parts")
    for name, kind, metavar, text in (
        ("--rotate-size", size, "SIZE", "of a part (default 500MB)"),
        ("--rotate-every", duration, "TIME", "time of a part, as in 1h"),
        ("--keep-size", size, "SIZE", "delete the oldest parts beyond 20GB, say"),
        ("--keep-for", duration, "TIME", "delete parts older than 7d, say"),
    ):
        weeks.add_argument(name, type=argument(kind), metavar=metavar, help=text)


def _add_live(parser: argparse.ArgumentParser) -> None:
    live = parser.add_argument_group("live")
    live.add_argument(
        "--live",
        nargs="?",
        const="127.0.0.1:9876",
        type=argument(_address),
        metavar="HOST:PORT",
        help="serve the picture to open viewers (default 127.0.0.1:9876; any other host opens it to the network)",
    )
    live.add_argument(
        "--live-web",
        nargs="?",
        const=9090,
        type=argument(port),
        metavar="PORT",
        help="and the viewer as a page, on the host of --live (default port 9090)",
    )


def _address(text: str) -> tuple[str, int]:
    from fusion_service.recording.live import address

    return address(text)


def _signer(key: str | None, security: Security | None) -> Signer | None:
    """By a key alone, or by the recorder's certificate; where that cannot sign, a recording without a signature is
    better than none."""
    from fusion_service.errors import UsageError
    from fusion_service.recording.signing import load_signer

    if key is not None:
        return load_signer(Path(key))
    try:
        return load_signer(security.key, security.certificate) if security else None
    except (ImportError, UsageError) as error:
        log.warning("the recording is not signed: %s", error)
        return None


def _rotation(args: argparse.Namespace) -> Rotation | None:
    """How a recording in parts goes on; None of one in a single file."""
    from fusion_service.errors import UsageError
    from fusion_service.recording import Rotation
    from fusion_service.recording.parts import is_folder

    limits = (args.rotate_size, args.rotate_every, args.keep_size, args.keep_for)
    if all(limit is None for limit in limits) and not (args.out and is_folder(args.out)):
        return None
    try:
        return Rotation(*limits)
    except ValueError as error:
        raise UsageError(str(error)) from None


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Record until `stop` is set. Raises `UsageError`, `SecurityError`, `BusError`, `ReviewError`,
    ImportError, OSError."""
    from fusion_service.bus import open_bus
    from fusion_service.bus.security import maybe_security
    from fusion_service.errors import UsageError
    from fusion_service.recording import default_path, run_recorder
    from fusion_service.recording.live import DEFAULT_ADDRESS, Live
    from fusion_service.recording.presence import Presence, host_name
    from fusion_service.service.notify import listening, notify
    from schemas import check_name

    rotation = _rotation(args)
    path = Path(args.out) if args.out else default_path(suffix=".rrd" if rotation is None else "")
    try:
        name = check_name(args.name or host_name())
    except ValueError as error:
        raise UsageError(f"--name: {error}") from None
    _check_place(path, folder=rotation is not None, make=not args.out)
    if (args.live or args.live_web) and args.no_draw:
        raise UsageError("--live shows what is drawn: leave out --no-draw")
    security = maybe_security(args.security)
    signer = _signer(args.sign, security)
    name = security.name if security is not None and not args.name else name
    with ExitStack() as stack:
        live = None
        if args.live or args.live_web:
            live = Live(*(args.live or DEFAULT_ADDRESS), web=args.live_web)
            stack.callback(live.close)
            print(f"live: rerun --connect {live.url}" + (f"\nlive: {live.page}" if live.page else ""), flush=True)
        attended = _Attended()
        stack.enter_context(on_hangup(attended.next_part))
        stack.enter_context(listening(attended.pulse.told))
        pulse, figures = attended.pulse, attended.figures
        stack.enter_context(observed(args.metrics, "recorder", figures.samples, pulse.alive, pulse.begun))
        bus = stack.enter_context(open_bus(args.connect or [DEFAULT_ENDPOINT], stop=stop, security=security))
        presence = Presence(bus, name, path, args.realm)

        def tick(recorder: Recorder) -> None:
            presence.note(recorder)
            attended.tick(recorder)

        run_recorder(
            bus,
            path,
            realm=args.realm,
            stop=stop,
            cutoff=args.cutoff,
            every=args.every,
            draw=not args.no_draw,
            rotation=rotation,
            signer=signer,
            live=live,
            interval=args.flush,
            on_tick=tick,
        )
        notify("STOPPING=1")


def _check_place(path: Path, *, folder: bool, make: bool) -> None:
    """Before a hub is waited for: that Rerun is there, and that `path`, a file or a `folder` of parts, can be written.
    make: the folder that it is in, if need be. Raises ImportError, OSError."""
    import tempfile
    from importlib.util import find_spec

    from fusion_service.recording.columns import import_rerun

    if path.exists() and (not folder or path.is_file()):
        raise FileExistsError(f"{path} exists already: name another file, or move it away")
    if make:
        path.parent.mkdir(parents=True, exist_ok=True)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} is no folder that exists: make it, or name another place with --out")
    place = path if path.is_dir() else path.parent
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        why = os.strerror(error.errno or 0)
        raise PermissionError(f"{place} cannot be written ({why}): name another place with --out, or mend it") from None
    if find_spec("rerun") is None:  # else it is loaded after the bus is heard, for that takes a second
        import_rerun()


class _Attended:
    """Tells those who look after the recorder how it is, and it that a part is to end."""

    def __init__(self) -> None:
        from fusion_service.monitoring import Pulse, Recorded

        self.pulse, self.figures = Pulse(), Recorded()
        self._recorder: Recorder | None = None

    def tick(self, recorder: Recorder) -> None:
        """On the recorder's thread."""
        from fusion_service.monitoring import recorder_samples
        from fusion_service.service.notify import notify

        words = f"STATUS={recorder.messages} messages, {recorder.bytes} bytes, in {recorder.path.name}"
        notify(f"{'' if self._recorder else 'READY=1'}\nWATCHDOG=1\n{words}".strip())
        self._recorder = recorder
        counts = recorder.messages, recorder.bytes, recorder.rows, dict(recorder.undecodable), dict(recorder.undrawn)
        self.figures.tick(recorder_samples(*counts), recorder.path)

    def next_part(self) -> None:
        """Of a recording in parts, at the next tick."""
        if self._recorder is None:
            log.info("nothing is recorded yet: there is no part to end")
        elif not self._recorder.next_part():
            log.warning("it goes on in one file: record into a folder (--out mission/) for parts that a signal ends")
