"""The lines of JSON for browsers: /stream of the served page is a WebSocket, with the extra `links` (websockets)."""

import math
import select
import time
from collections import deque
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler

from torchvision_dddas.io.streams import About, json_lines
from torchvision_dddas.types import FrameResult, TrackedFrame

_MOST_CLIENTS = 8
_KEPT = 100  # lines that wait for a slow client, which misses the oldest then
_POLL_S = 0.02


class LineSocket:
    """Gives each client the lines of all results from now on. `write` is called by the run, `serve` by the server."""

    def __init__(self, about: About) -> None:
        self._about, self._clients = about, list[deque[bytes]]()

    def write(self, result: FrameResult, people: TrackedFrame | None) -> None:
        """Encode a result if a client is there."""
        age_s = math.nan if result.frame is None else time.monotonic() - result.frame.taken_s
        lines: Sequence[bytes] = json_lines(self._about, result, people, age_s) if self._clients else ()
        for client in tuple(self._clients):
            client.extend(lines)

    def serve(self, handler: BaseHTTPRequestHandler, is_closing: Callable[[], bool]) -> str:
        """Answer a request and send lines until the client leaves. Return why it cannot be served, or ""."""
        try:
            from websockets.datastructures import Headers
            from websockets.http11 import Request
            from websockets.server import ServerProtocol
        except ImportError:
            return "a WebSocket needs the extra links: pip install 'torchvision-dddas[links]'\n"
        if len(self._clients) >= _MOST_CLIENTS:
            return f"{_MOST_CLIENTS} clients read the lines already\n"
        # A browser lets any site open a WebSocket, so the site must be this page's; other programs name none.
        host = handler.headers.get("Host", "")
        protocol = ServerProtocol(origins=[f"http://{host}", f"https://{host}", None])
        protocol.send_response(protocol.accept(Request(handler.path, Headers(handler.headers.items()))))
        lines = deque[bytes](maxlen=_KEPT)
        self._clients.append(lines)
        try:
            while not is_closing():
                for content in protocol.data_to_send():
                    handler.connection.sendall(content)
                if protocol.state is not protocol.state.OPEN:
                    break
                if select.select([handler.connection], [], [], _POLL_S)[0]:
                    content = handler.connection.recv(1 << 16)
                    protocol.receive_data(content) if content else protocol.receive_eof()
                while lines and protocol.state is protocol.state.OPEN:
                    protocol.send_text(lines.popleft().rstrip())
        finally:
            self._clients.remove(lines)
        return ""
