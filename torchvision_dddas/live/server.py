"""Serve the state of a live run over HTTP: a page for people, text for Prometheus, JSON for programs."""

import json
import math
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import finite
from torchvision_dddas.io.report import render_page
from torchvision_dddas.io.streams import Stream
from torchvision_dddas.live.health import Health, Snapshot, snapshot_facts
from torchvision_dddas.live.watchdog import Watchdog

LOOPBACK = "127.0.0.1"

Page = Callable[[], tuple[int, str, str]]
"""Returns (status, type, text); called in a server thread."""

_CLIENT_TIMEOUT_S = 5.0
_MOST_CLIENTS = 8  # simultaneous clients; a further one disconnects the oldest, so that slow clients cannot block it
_SHOWN_EVENTS = 20


class HealthServer:
    """Serves pages while the context is open. address: (host, port) in use. pages: by path; may be filled later."""

    def __init__(self, address: tuple[str, int], pages: dict[str, Page]) -> None:
        """Raise InputError if the port is in use, or if the host is not an address of this machine."""
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
) -> dict[str, Page]:
    """Return the pages of a run. state_now: returns its state. patience_s: longest time without result that is fine."""

    def state() -> tuple[Snapshot, str]:
        now = health.snapshot()
        late = f"no result for {_span(now.idle_s)}" if now.idle_s > patience_s else ""
        return now, "; ".join(words for words in (watchdog.hung or late, *now.troubles) if words)

    def page() -> tuple[int, str, str]:
        now, trouble = state()
        return 200, "text/html", html_page(now, name, state_now(), trouble)

    def prometheus() -> tuple[int, str, str]:
        text = metrics(*state(), version, {stream.name: stream.lost for stream in streams})
        return 200, "text/plain; version=0.0.4", text

    def program() -> tuple[int, str, str]:
        now, trouble = state()
        facts = {"ok": not trouble, "trouble": trouble, "state": state_now(), "input": name, "version": version}
        text = json.dumps(finite(facts | snapshot_facts(now)), indent=2) + "\n"
        return (503 if trouble else 200), "application/json", text

    return {"/": page, "/metrics": prometheus, "/health.json": program}


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], pages: dict[str, Page]) -> None:
        self.pages = pages
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
            with self._lock, suppress(ValueError):
                self._clients.remove(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnected."""


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
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
        # Allow no external content and no script, so that a stream's name cannot become code.
        self.send_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

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
}
_HELP = {name: words for table in (_COUNTS, _GAUGES, _SECONDS) for name, (_, words) in table.items()}


def html_page(now: Snapshot, name: str, state: str, trouble: str, refresh_s: int = 2) -> str:
    """Return the page for people, without scripts or external content, reloaded every refresh_s."""

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
    return render_page(
        "live.html",
        title=f"{state} · {name}",
        name=name,
        trouble=trouble,
        figures=figures,
        events=[(_clock(e.utc_s), e.frame, e.text) for e in list(reversed(now.events))[:_SHOWN_EVENTS]],
        now=_clock(datetime.now(UTC).timestamp()),
        links=("/metrics", "/health.json"),
        refresh_s=refresh_s,
    )


def _span(seconds: float) -> str:
    whole = int(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    return f"{days} d {hours} h" if days else f"{hours} h {minutes} min" if hours else f"{minutes}:{whole % 60:02d}"


def _clock(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%H:%M:%S")


def metrics(now: Snapshot, trouble: str, version: str, lost: Mapping[str, int]) -> str:
    """Return Prometheus' text exposition format, version 0.0.4. lost: permanently lost messages, by stream."""
    lines: list[str] = []

    def add(name: str, kind: str, words: str, values: Mapping[str, float]) -> None:
        """Add a metric. values: by labels in braces, or by "" without labels."""
        lines.extend([f"# HELP dddas_{name} {words}", f"# TYPE dddas_{name} {kind}"])
        lines.extend(f"dddas_{name}{labels} {_value(value)}" for labels, value in values.items())

    add("info", "gauge", "What runs.", {_labels(version=version): 1})
    add("healthy", "gauge", "1 while all is well, as /health.json says.", {"": float(not trouble)})
    add("uptime_seconds", "gauge", "Since the start.", {"": now.since_s})
    add("idle_seconds", "gauge", "Since the last result.", {"": now.idle_s})
    events = {name.removeprefix("events_"): count for name, count in now.counts.items() if name.startswith("events_")}
    if events:
        add("events_total", "counter", "Events.", {_labels(kind=kind): count for kind, count in events.items()})
    for name, count in now.counts.items():
        if not name.startswith("events_"):
            add(f"{name}_total", "counter", _HELP.get(name, name), {"": count})
    for name, value in now.gauges.items():
        add(name, "gauge", _HELP.get(name, name), {"": value})
    for name, values in now.seconds.items():
        shares = zip(("0.5", "0.95", "0.99"), values, strict=True)
        add(f"{name}_seconds", "gauge", _HELP.get(name, name), {_labels(quantile=q): v for q, v in shares})
    if lost:
        words = "Messages that were lost for good."
        add("lost_messages_total", "counter", words, {_labels(stream=s): n for s, n in lost.items()})
    return "\n".join(lines) + "\n"


def _labels(**labels: str) -> str:
    def quote(text: str) -> str:
        return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

    return "{" + ",".join(f'{name}="{quote(value)}"' for name, value in labels.items()) + "}"


def _value(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    return ("+Inf" if value > 0 else "-Inf") if math.isinf(value) else f"{value:.12g}"
