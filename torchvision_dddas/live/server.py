"""Serve a live run over HTTP: the operator's page, text for Prometheus, JSON for programs."""

import json
import select
import socket
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self
from urllib.parse import parse_qs

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import finite
from torchvision_dddas.io.report import render_page
from torchvision_dddas.io.streams import Stream
from torchvision_dddas.live.access import Access, cookie_name
from torchvision_dddas.live.health import Health, Snapshot, snapshot_facts
from torchvision_dddas.live.line_socket import LineSocket
from torchvision_dddas.live.metrics import metrics_page
from torchvision_dddas.live.operator_view import MOST_WATCHERS, PICTURES, OperatorView
from torchvision_dddas.live.watchdog import Watchdog

LOOPBACK = "127.0.0.1"

Body = str | Generator[bytes]
"""A text, or an endless stream of bytes, in which b"" means that there is nothing to send at the moment."""

Page = Callable[[], tuple[int, str, Body]]
"""Returns (status, type, body); called in a server thread."""

_CLIENT_TIMEOUT_S = 5.0
_MOST_CLIENTS = 8  # clients served at once; one more disconnects the oldest, so that slow clients cannot block the page
_SHOWN_EVENTS = 20
_ALARMS = ("zone", "crowd")  # kinds of events that an operator must not miss
# Allow own files alone, and no code inside a page, so that a stream's name cannot become code.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
_SENT_BYTES = 65_536  # buffer of a stream: a slow client gets few old pictures


class HealthServer:
    """Serves pages while the context is open. address: (host, port) in use. pages: by path; may be filled later."""

    def __init__(
        self, address: tuple[str, int], pages: Mapping[str, Page | LineSocket], access: Access | None = None
    ) -> None:
        """access: who may read the pages; None: no token is needed.

        Raise InputError if the port is in use, or if the host is not an address of this machine.
        """
        self.access = access or Access()
        try:
            self._server = _Server(address, pages, self.access)
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
        self._server.is_closing = True
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def url(self) -> str:
        """The address of the page, with the token if it was made here. A wildcard is replaced by an own address."""
        host, port = self.address
        host = _own_address() if host in ("0.0.0.0", "::") else host
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{port}/" + (f"?token={self.access.token}" if self.access.is_made else "")


def _own_address() -> str:
    """Return the address of this machine towards other machines; its name if it has none."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; the address is reserved for documentation
        return str(probe.getsockname()[0])
    return socket.gethostname()


def parse_address(spec: str) -> tuple[str, int]:
    """Parse PORT or HOST:PORT as (host, port); a port alone is local to this machine. Raise InputError otherwise."""
    host, _, port = spec.rpartition(":")
    if not port.isdecimal() or len(port) > 5 or int(port) > 65535:
        raise InputError(f"--serve {spec} is no address; give PORT or HOST:PORT, such as 8080 or 0.0.0.0:8080")
    return host.strip("[]") or LOOPBACK, int(port)


def health_pages(
    health: Health,
    watchdog: Watchdog,
    streams: Sequence[Stream],
    state_now: Callable[[], str],
    name: str,
    version: str,
    patience_s: float,
    view: OperatorView | None = None,
) -> dict[str, Page]:
    """Return the pages of a run. state_now: returns its state. patience_s: longest time without result that is fine.

    view: the source of pictures and targets; None leaves them out.
    """
    view = view or OperatorView()

    def state() -> tuple[Snapshot, str]:
        now = health.snapshot()
        late = f"no result for {_span(now.idle_s)}" if now.idle_s > patience_s else ""
        return now, "; ".join(words for words in (watchdog.hung or late, *now.troubles) if words)

    def page() -> tuple[int, str, str]:
        now, trouble = state()
        return 200, "text/html", html_page(now, name, state_now(), trouble)

    def prometheus() -> tuple[int, str, str]:
        return metrics_page(*state(), version, {stream.name: stream.lost for stream in streams}, _HELP)

    def program() -> tuple[int, str, str]:
        now, trouble = state()
        facts = {"ok": not trouble, "trouble": trouble, "state": state_now(), "input": name, "version": version}
        text = json.dumps(finite(facts | snapshot_facts(now)), indent=2) + "\n"
        return (503 if trouble else 200), "application/json", text

    def operator() -> tuple[int, str, str]:
        now, trouble = state()
        facts = shown_facts(now, name, state_now(), trouble)
        facts |= {"session": view.session, "idle_s": now.idle_s, **view.facts()}
        return 200, "application/json", json.dumps(finite(facts))

    def pictures() -> tuple[int, str, Body]:
        if view.is_full:
            return 503, "text/plain", f"{MOST_WATCHERS} clients watch the pictures already\n"
        return 200, PICTURES, view.pictures()

    return {
        "/": page,
        "/metrics": prometheus,
        "/health.json": program,
        "/state.json": operator,
        "/zones.json": lambda: (200, "application/json", json.dumps(view.zones())),
        "/picture.mjpg": pictures,
        "/live.js": lambda: (200, "text/javascript", render_page("live.js")),
        "/live.css": lambda: (200, "text/css", render_page("live.css")),
        "/favicon.ico": lambda: (204, "image/x-icon", ""),
    }


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], pages: Mapping[str, Page | LineSocket], access: Access) -> None:
        self.pages, self.access, self.is_closing = pages, access, False
        self._clients: list[socket.socket] = []
        self._lock = threading.Lock()
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._clients.append(request)
            oldest = self._clients.pop(0) if len(self._clients) > _MOST_CLIENTS else None
        if oldest is not None:
            with suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.release(request)

    def release(self, request: Any) -> None:
        """Do not disconnect this client for others any more."""
        with self._lock, suppress(ValueError):
            self._clients.remove(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnected."""


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: _Server
    server_version, sys_version = "dddas", ""

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        access, port = self.server.access, self.server.server_address[1]
        if not access.allows(self.headers, query, port):
            self._refuse(path)
        elif path == "/" and access.token and "token" in parse_qs(query):
            # The cookie takes the token out of the address, which histories and logs keep.
            cookie = f"{cookie_name(port)}={access.token}; HttpOnly; SameSite=Lax; Max-Age=31536000"
            self._send(303, "text/plain", "", {"Location": "./", "Set-Cookie": cookie})
        elif isinstance(page := self.server.pages.get(path), LineSocket):
            self.server.release(
                self.request
            )  # it stays connected: the oldest client would be disconnected for a new one
            if why := page.serve(self, lambda: self.server.is_closing):
                self._send(503, "text/plain", why)
        elif page is not None:
            self._send(*page())
        else:
            self._send(404, "text/plain", f"there are {', '.join(self.server.pages)}\n")

    def _refuse(self, path: str) -> None:
        if not self.server.access.token:
            words = "this run is served to localhost and addresses alone; give it a token with --serve-token\n"
            self._send(403, "text/plain", words)
        elif path == "/":
            self._send(401, "text/html", render_page("token.html"), {"WWW-Authenticate": "Bearer"})
        else:
            words = "a token is needed: send Authorization: Bearer TOKEN, or open /?token=TOKEN in a browser\n"
            self._send(401, "text/plain", words, {"WWW-Authenticate": "Bearer"})

    def _send(self, status: int, kind: str, body: Body, headers: Mapping[str, str] | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8" if isinstance(body, str) else kind)
        if isinstance(body, str):
            self.send_header("Content-Length", str(len(body.encode())))
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        if self.command == "HEAD":
            return
        if isinstance(body, str):
            self.wfile.write(body.encode())
        else:
            self._stream(body)

    def _stream(self, parts: Generator[bytes]) -> None:
        """Send parts until the client disconnects, reads too slowly, or the server closes."""
        self.server.release(self.request)  # it lasts, so it is the oldest client soon
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SENT_BYTES)
        with closing(parts):
            for part in parts:
                if self.server.is_closing or select.select([self.request], [], [], 0)[0]:  # it sends only its end
                    return
                self.wfile.write(part)

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Do not log requests."""


# Quantities of the health by name: title of the tile on the page, "" for none, and the help text for Prometheus.
_COUNTS = {
    "captured": ("pictures captured", "Pictures that the source gave."),
    "dropped": ("dropped", "Pictures that came too late to be processed."),
    "late": ("late", "Results later than the deadline."),
    "undecoded": ("not decoded", "Pictures that could not be decoded."),
    "concealed": ("with concealed errors", "Pictures in which the decoder concealed errors."),
    "unreliable": ("without a conclusion", "Frames from which nothing could be concluded."),
    "reconnects": ("reconnected", "Times that the stream was opened again."),
    "clock_jumps": ("clock set", "Times that the machine's clock was set."),
    "begun_anew": ("begun anew", "Times that the work failed, or the pictures changed size, and it was restarted."),
    "wrong_size": ("of another size", "Pictures of another size than the run's."),
    "looked_at": ("", "Pictures that were looked at."),
    "results": ("", "Frames whose results were handed on."),
}
_GAUGES = {
    "sent_hz": ("pictures a second", "Pictures a second that the source sends."),
    "rate_hz": ("results a second", "Results a second."),
    "connected": ("camera", "1 while the camera sends pictures."),
    "targets": ("targets now", "Targets in the latest frame."),
    "people": ("people now", "People in the latest frame."),
    "every": ("pictures for each one looked at", "One of so many pictures is looked at."),
    "keypoints": ("keypoints at most", "Keypoints that a registration may take."),
    "queue": ("pictures waiting", "Pictures that wait."),
    "resident_bytes": ("memory", "Memory of the process."),
}
_SECONDS = {
    "latency": ("latency", "From the capture of the newest picture to the results that it settles."),
    "age": ("age of a result", "From the capture of a picture to its own results."),
    "step": ("work on a picture", "Work on a picture."),
    "provisional": ("age of provisional tracks", "From the capture of a picture to its provisional tracks."),
}
_HELP = {name: words for table in (_COUNTS, _GAUGES, _SECONDS) for name, (_, words) in table.items()}


def html_page(now: Snapshot, name: str, state: str, trouble: str, refresh_s: int = 2) -> str:
    """Return the page for people. Its script updates it; without scripts it reloads itself every refresh_s."""
    return render_page("live.html", refresh_s=refresh_s, **shown_facts(now, name, state, trouble))


def shown_facts(now: Snapshot, name: str, state: str, trouble: str) -> dict[str, Any]:
    """Return what the page shows of the health: figures, and the latest events first."""

    def count(name: str) -> str:
        return f"{now.counts.get(name, 0):,}".replace(",", " ")

    figures = [("running for", _span(now.since_s)), ("results", count("results"))]
    for key, (title, _) in _GAUGES.items():
        if key == "connected" and key in now.gauges:
            figures.append((title, "sends pictures" if now.gauges[key] else "lost"))
        elif key in now.gauges:
            is_bytes = key == "resident_bytes"
            shown = now.gauges[key] / (1e6 if is_bytes else 1)
            digits = 1 if key in ("sent_hz", "rate_hz") else 0
            figures.append((title, f"{shown:,.{digits}f}".replace(",", " ") + (" MB" if is_bytes else "")))
    for key, (title, _) in _SECONDS.items():
        if key in now.seconds:
            median, _, most = now.seconds[key]
            figures += [(f"{title}, median", f"{1000 * median:.0f} ms"), (f"{title}, 99 %", f"{1000 * most:.0f} ms")]
    figures += [(title, count(key)) for key, (title, _) in _COUNTS.items() if title and key in now.counts]
    figures += [(platform, facts["state"]) for platform, facts in now.platforms.items()]
    # Other events must not push alarms off the page.
    newest = [e for k, e in enumerate(reversed(now.events)) if k < _SHOWN_EVENTS or e.kind in _ALARMS]
    return {
        "title": f"{state} · {name}",
        "name": name,
        "trouble": trouble,
        "figures": figures,
        "events": [(_clock(e.utc_s), e.frame, e.text, e.kind in _ALARMS, round(e.utc_s, 3)) for e in newest],
        "now": _clock(datetime.now(UTC).timestamp()),
    }


def _span(seconds: float) -> str:
    whole = int(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    return f"{days} d {hours} h" if days else f"{hours} h {minutes} min" if hours else f"{minutes}:{whole % 60:02d}"


def _clock(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%H:%M:%S")
