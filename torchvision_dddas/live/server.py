"""A small page, Prometheus text and JSON about a live run, for whoever looks after the vehicle."""

import threading
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Protocol, Self

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.pages import find_trouble, health_json, html_page, metrics
from torchvision_dddas.live.status import snapshot_facts
from torchvision_dddas.live.watchdog import Watchdog

LOOPBACK = "127.0.0.1"
_LINKS = ("/metrics", "/health.json")

Page = Callable[[], tuple[int, str, str]]
"""Gives (status, type, text); called in a thread of its own."""

_PATIENCE_S = 5.0  # with a client that is slow
_AT_ONCE = 8  # clients; more are turned away, so that they cannot take the run's time


def address_of(spec: str) -> tuple[str, int]:
    """PORT or HOST:PORT; a port alone is this machine's own. Raises InputError for anything else."""
    host, _, port = spec.rpartition(":")
    if not port.isdecimal() or len(port) > 5 or int(port) > 65535:
        raise InputError(f"--serve {spec} is no address; wanted PORT or HOST:PORT, such as 8080 or 0.0.0.0:8080")
    return host.strip("[]") or LOOPBACK, int(port)


class Losing(Protocol):
    """A stream that counts what nobody will get, as io.streams.Stream."""

    @property
    def name(self) -> str:
        """As the user wrote it."""
        ...

    @property
    def lost(self) -> int:
        """Messages that nobody will get."""
        ...


class Going(Protocol):
    """What tells how far the run is, as StatusWriter: running, complete, stopped or failed."""

    @property
    def state(self) -> str:
        """One word."""
        ...


class HealthServer:
    """A context in which the pages are there. address: (host, port), where.

    pages: by their paths; may be filled until it begins.
    """

    def __init__(self, address: tuple[str, int], pages: dict[str, Page]) -> None:
        """Raises InputError where the port is in use, or the host is none of this machine's."""
        try:
            self._server = _Server(address, pages)
        except OSError as error:
            raise InputError(
                f"cannot serve at {address[0]}:{address[1]}: {(error.strerror or str(error)).lower()}; "
                "choose another --serve PORT"
            ) from None
        self.address: tuple[str, int] = self._server.server_address[:2]  # type: ignore[assignment]
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.2}, name="serving", daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def health_pages(
    health: Health,
    watchdog: Watchdog,
    streams: Sequence[Losing],
    run: Going,
    name: str,
    version: str,
    patience_s: float,
) -> dict[str, Page]:
    """The pages. patience_s: no result for longer is trouble."""

    def human() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = find_trouble(now, patience_s, watchdog.hung)
        return 200, "text/html", html_page(now, name, run.state, trouble, _LINKS)

    def prometheus() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble, lost = find_trouble(now, patience_s, watchdog.hung), {stream.name: stream.lost for stream in streams}
        return 200, "text/plain; version=0.0.4", metrics(now, version, trouble, lost)

    def program() -> tuple[int, str, str]:
        now = health.snapshot()
        trouble = find_trouble(now, patience_s, watchdog.hung)
        facts = {"state": run.state, "input": name, "version": version, **snapshot_facts(now)}
        return (503 if trouble else 200), "application/json", health_json(facts, trouble)

    return {"/": human, "/metrics": prometheus, "/health.json": program}


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], pages: dict[str, Page]) -> None:
        self.pages = pages
        self._free = threading.BoundedSemaphore(_AT_ONCE)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is nobody's trouble."""


class _Handler(BaseHTTPRequestHandler):
    timeout = _PATIENCE_S
    server: _Server
    server_version, sys_version = "dddas", ""

    def do_GET(self) -> None:
        page = self.server.pages.get(self.path.partition("?")[0])
        status, kind, text = page() if page else (404, "text/plain", f"there are {', '.join(self.server.pages)}\n")
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        # Nothing from elsewhere, no script: what a stream says of itself stays text.
        self.send_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Who asks is not the run's business."""
