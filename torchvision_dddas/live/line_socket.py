"""The lines of JSON for browsers: /stream of the served page is a WebSocket, with the extra `links` (websockets)."""

import math
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from http.server import BaseHTTPRequestHandler

from torchvision_dddas.io.streams import About, json_lines
from torchvision_dddas.types import FrameResult, TrackedFrame

_MOST_CLIENTS = 8
_KEPT = 100  # lines that wait for a slow client, which misses the oldest then
_POLL_S = 0.02
_LAST_S = 2.0  # time for the last lines at the end of a run


class LineSocket:
    """Sends each client the lines of all results that come after its connection.

    The run calls `write` and `close`, and the server calls `serve` in a thread for each client.
    """

    def __init__(self, about: About) -> None:
        self._about, self._clients, self._is_ended = about, list[deque[bytes]](), False

    def write(self, result: FrameResult, people: TrackedFrame | None, start_utc_s: float) -> None:
        """Encode a result if a client is there. start_utc_s: as in `About`, for this result."""
        if not self._clients:
            return
        about = replace(self._about, start_utc_s=start_utc_s)  # another thread changes self._about
        age_s = math.nan if result.frame is None else time.monotonic() - result.frame.taken_s
        lines = json_lines(about, result, people, age_s)
        for client in tuple(self._clients):
            client.extend(lines)

    def close(self) -> None:
        """End the connections after their last lines. Wait two seconds at most for clients that read slowly."""
        self._is_ended, until_s = True, time.monotonic() + _LAST_S
        while self._clients and time.monotonic() < until_s:
            time.sleep(_POLL_S)

    def serve(self, handler: BaseHTTPRequestHandler, is_closing: Callable[[], bool]) -> str:
        """Answer a request and send lines until the client leaves. Return why it cannot be served, or ""."""
        try:
            from websockets.frames import CloseCode
            from websockets.http11 import Request
            from websockets.server import ServerProtocol
            from websockets.typing import Origin
        except ImportError:
            return "a WebSocket needs the extra links: pip install 'torchvision-dddas[links]'\n"
        if len(self._clients) >= _MOST_CLIENTS:
            return f"{_MOST_CLIENTS} clients read the lines already\n"
        # A browser lets any site open a WebSocket, so the site must be this page's; other programs name none.
        host = handler.headers.get("Host", "")
        protocol = ServerProtocol(origins=[Origin(f"http://{host}"), Origin(f"https://{host}"), None])
        # The server has read the request already; the protocol must see it before it can read frames.
        headers = "".join(f"{name}: {value}\r\n" for name, value in handler.headers.items())
        protocol.receive_data(f"GET {handler.path} HTTP/1.1\r\n{headers}\r\n".encode("latin-1"))
        request = next((event for event in protocol.events_received() if isinstance(event, Request)), None)
        if request is None:
            return "the request for the WebSocket cannot be read\n"
        protocol.send_response(protocol.accept(request))
        lines = deque[bytes](maxlen=_KEPT)
        self._clients.append(lines)
        try:
            while not is_closing():
                is_ended = self._is_ended  # read this first, so that no line comes after the last look at the lines
                while lines and protocol.state is protocol.state.OPEN:
                    protocol.send_text(lines.popleft().rstrip())
                if is_ended and protocol.state is protocol.state.OPEN:
                    protocol.send_close(CloseCode.NORMAL_CLOSURE, "the run has ended")
                for content in protocol.data_to_send():
                    if content:
                        handler.connection.sendall(content)
                    else:  # both sides have sent their close frames; the client now waits until the server disconnects
                        handler.connection.shutdown(socket.SHUT_WR)
                is_answer_due = is_ended and protocol.state is protocol.state.CLOSING and protocol.close_rcvd is None
                if protocol.state is not protocol.state.OPEN and not is_answer_due:
                    break
                if select.select([handler.connection], [], [], _POLL_S)[0]:
                    content = handler.connection.recv(1 << 16)
                    protocol.receive_data(content) if content else protocol.receive_eof()
                    protocol.events_received()  # messages of clients are discarded
        finally:
            self._clients.remove(lines)
        return ""
