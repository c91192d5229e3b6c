"""A camera as a device: H.264 pictures with MISB ST 0601 metadata in an MPEG transport stream, over UDP or TCP."""

import socket
import time
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.video_packets import HZ, TransportStream, VideoEncoder, check_encoder

_DATAGRAM = 7 * 188  # bytes: the usual seven packets
_BURST = 24  # datagrams at once, because the buffers of receivers are small
_SEND_S = 0.5  # a TCP client that takes nothing for this time is disconnected


class StreamSender:
    """Sends a transport stream: as datagrams to an address, or to the clients that connect to it."""

    def __init__(self, url: str) -> None:
        """Open `udp://HOST:PORT` (send there) or `tcp://HOST:PORT` (listen there). Raise InputError."""
        self._clients: list[socket.socket] = []
        try:
            parts = urlsplit(url)
            host, port, self.is_udp = parts.hostname, parts.port, parts.scheme == "udp"
        except ValueError:
            host = port = None
        if not host or not port or parts.scheme not in ("udp", "tcp"):
            raise InputError(f"--serve {url}: wanted udp://HOST:PORT or tcp://HOST:PORT, such as udp://127.0.0.1:5600")
        try:
            if self.is_udp:
                family, kind, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
                self._socket = socket.socket(family, kind)
                self._socket.connect(place)
            else:
                self._socket = socket.create_server((host, port))
                self._socket.setblocking(False)
        except OSError as error:
            raise InputError(f"--serve {url} cannot be opened: {error.strerror or error}; check the address") from None

    def send(self, content: bytes) -> None:
        """Send a datagram, or the same bytes to all clients. Never raise OSError."""
        if self.is_udp:
            with suppress(OSError):  # nobody listens at present
                self._socket.send(content)
            return
        with suppress(BlockingIOError):
            self._clients.append(self._socket.accept()[0])
            self._clients[-1].settimeout(_SEND_S)
        for client in tuple(self._clients):
            try:
                client.sendall(content)
            except OSError:
                self._clients.remove(client)
                client.close()

    def close(self) -> None:
        """Disconnect the clients."""
        for each in (*self._clients, self._socket):
            each.close()


class CameraStream:
    """Encodes pictures and metadata as a transport stream. Time stamps are those of the moments of sending."""

    def __init__(self, size_px: tuple[int, int], rate_hz: float, send: Callable[[bytes], object]) -> None:
        """send: called with datagrams of whole packets. Raise InputError without PyAV, and for odd sizes."""
        check_encoder("--serve")
        if size_px[0] % 2 or size_px[1] % 2:
            raise InputError(f"--serve needs pictures of even width and height, got {size_px[0]}x{size_px[1]}")
        self._encoder, self._send = VideoEncoder(size_px, rate_hz, factor=18), send
        self._stream = TransportStream(self._encoder)
        self._begin_s, self._last = time.monotonic(), -1

    def show(self, image: np.ndarray | None, metadata: bytes | None) -> None:
        """Send a picture (H, W, 3) BGR and its metadata, either of which may be missing."""
        self._last = max(round(HZ * (time.monotonic() - self._begin_s)), self._last + 1)
        packets = [] if image is None else self._encoder.encode(np.ascontiguousarray(image), self._last / HZ)
        self._hand_on(self._stream.mux(packets, metadata or b"", self._last))

    def close(self) -> None:
        """End the stream."""
        self._hand_on(self._stream.close())

    def _hand_on(self, content: bytes) -> None:
        for number, place in enumerate(range(0, len(content), _DATAGRAM), 1):
            self._send(content[place : place + _DATAGRAM])
            if number % _BURST == 0:
                time.sleep(0.001)
