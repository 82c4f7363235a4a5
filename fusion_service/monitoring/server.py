"""A small HTTP server for monitoring systems: /metrics, /healthz and /readyz, on a thread of its own.

It answers `MOST` at a time, each within `PATIENCE` seconds, and turns others away: who asks slowly holds up nobody but
those who ask. There are no passwords: it listens on loopback unless it is told otherwise, and says nothing but figures
and names of sources.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from fusion_service import __version__
from fusion_service.monitoring.figures import METRICS, Sample

__all__ = ["DEFAULT_HOST", "Serving", "process_samples", "served"]

DEFAULT_HOST = "127.0.0.1"
MOST = 8
"""Requests at a time."""
PATIENCE = 10.0
"""Seconds that a request may take."""
LOOK = 0.2
"""Seconds between looks at those that take longer, and at whether to end."""

log = logging.getLogger(__name__)


def process_samples(process: str, ready: str) -> Iterator[Sample]:
    """What every process says of itself."""
    yield Sample("fusion_build_info", (__version__, process), 1.0)
    yield Sample("fusion_ready", (), float(not ready))


class Serving:
    """What is served. samples: of now; alive, ready: "", or why not. All are called on threads of the server."""

    def __init__(
        self,
        samples: Callable[[], Iterable[Sample]],
        alive: Callable[[], str] = lambda: "",
        ready: Callable[[], str] = lambda: "",
    ) -> None:
        self.alive, self.ready = alive, ready
        self._samples = samples
        prometheus = _import()
        self._registry = prometheus.CollectorRegistry(auto_describe=False)
        prometheus.ProcessCollector(registry=self._registry)
        self._registry.register(self)

    def describe(self) -> list[Any]:
        """Nothing, so that nothing is collected before it is asked for."""
        return []

    def collect(self) -> Iterator[Any]:
        """Families of Prometheus' client library."""
        core = _import().core
        kinds = {"counter": core.CounterMetricFamily, "gauge": core.GaugeMetricFamily}
        families: dict[str, Any] = {}
        for name, labels, value in self._samples():
            family = families.get(name)
            if family is None:
                metric = METRICS[name]
                family = families[name] = kinds[metric.kind](name, f"{metric.help}", labels=metric.labels)
            family.add_metric(labels, value)
        yield from families.values()

    def text(self, accept: str) -> tuple[bytes, str]:
        """The metrics, and their type, in the newest format that is accepted."""
        encode, kind = _import().exposition.choose_encoder(accept)
        return encode(self._registry), kind


def _import() -> Any:
    try:
        import prometheus_client
        import prometheus_client.core
    except ImportError as error:
        raise ImportError(
            f"metrics need prometheus-client ({error}): pip install 'track-fusion-centre[metrics]'"
        ) from error
    return prometheus_client


class _Handler(BaseHTTPRequestHandler):
    timeout = PATIENCE
    server_version = "fusion-service"
    sys_version = ""
    server: _Server

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        serving = self.server.serving
        if path == "/metrics":
            try:
                body, kind = serving.text(self.headers.get("Accept") or "")
            except Exception:
                log.exception("the metrics could not be told")
                self._answer(500, b"a fault of the process: see its log\n")
                return
            self._answer(200, body, kind)
        elif path in ("/healthz", "/readyz"):
            fault = serving.alive() if path == "/healthz" else serving.ready()
            self._answer(503 if fault else 200, f"{fault or 'ok'}\n".encode("utf-8", "replace"))
        else:
            self._answer(404, b"/metrics, /healthz, /readyz\n")

    do_HEAD = do_GET

    def _answer(self, code: int, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Who asks is not logged."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, address: tuple[str, int], serving: Serving) -> None:
        self.serving = serving
        self._open: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        """Without asking for the name of the host."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for one more."""
        with self._lock:
            if len(self._open) >= MOST:
                return False
            self._open[request] = time.monotonic()
        return True

    def service_actions(self) -> None:
        """End those that take too long; called every `LOOK` at least."""
        with self._lock:
            late = [one for one, since in self._open.items() if time.monotonic() - since > PATIENCE]
        for one in late:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Who has gone away is no error of ours."""


@contextmanager
def served(address: tuple[str, int], serving: Serving) -> Iterator[int]:
    """Serve at host and port (0: any); yields the port. `OSError` where it is taken, in one line."""
    host, port = address
    try:
        server = _Server(address, serving)
    except OSError as error:
        raise OSError(f"metrics cannot be served on {host}:{port}: {error.strerror or error}") from None
    thread = threading.Thread(target=server.serve_forever, args=(LOOK,), name="metrics", daemon=True)
    thread.start()
    port = int(server.server_address[1])
    log.info("metrics on http://%s:%d/metrics, beside /healthz and /readyz", f"[{host}]" if ":" in host else host, port)
    try:
        yield port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
