"""An outlet that sends messages through a TCP connection, with or without TLS, and never waits for the other side."""

import errno
import os
import select
import socket
import ssl
import struct
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from urllib.parse import SplitResult, parse_qsl, urlsplit

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams.outlets import LAST_S, KeptOutlet

with suppress(ImportError):  # without fcntl, messages lost with a connection are not counted
    import fcntl
    import termios

WANTED = "wanted tcp://HOST:PORT, or tls://HOST:PORT, which may have the options ca, cert, key and server"

_CONNECT_S = 10.0  # longest time until a connection is open
_SETTLE_S = 0.3  # a server that refuses a certificate, or a proxy without a server, closes within this time
_SILENT_MS = 20_000  # a connection whose bytes are not acknowledged for so long is closed by the system
_PIECE_BYTES = 1 << 16
_MOST_READS = 16  # pieces that are read and discarded before each sending
_WAITS = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)


class StreamOutlet(KeptOutlet):
    """Messages through one connection. Up to KEPT_BYTES of messages wait while it is not open.

    Data from the other side is read and discarded. Messages that the other machine has not acknowledged when the
    connection breaks are lost. Those that it acknowledged, but its program never read, cannot be counted.
    """

    def __init__(self, host: str, port: int, context: ssl.SSLContext | None = None, server: str = "") -> None:
        """Raise OSError if the host's name is not known. The connection is opened by the first `flush`.

        context: that of TLS, None without TLS. server: the name in the server's certificate; empty: the host.
        """
        super().__init__()
        self._host, self._context, self._server = host, context, server or host
        # IPv4 first, as most servers know no other. The name is resolved once: that may take many seconds.
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        ways = sorted({(family, place) for family, *_, place in found}, key=lambda way: way[0] != socket.AF_INET)
        self._ways = deque(ways)  # the next attempt takes the first
        self._socket: socket.socket | None = None
        self._is_open = False
        self._begun_s = self._settled_s = 0.0
        self._passed_bytes = 0  # bytes sent through this connection
        self._ends = deque[int]()  # of the messages that are not acknowledged yet, counted like _passed_bytes

    def flush(self) -> None:
        """Send while the other side accepts."""
        try:
            opened = self._opened()
            _discard_input(opened)
            self._forget_acknowledged(opened)
            while self._kept:
                try:
                    taken = opened.send(self._kept[0][self._begun : self._begun + _PIECE_BYTES])
                except _WAITS:
                    self._is_held = True  # TLS must be given the same bytes again
                    return
                self._begun += taken
                self._passed_bytes += taken
                if self._begun >= len(self._kept[0]):
                    self._ends.append(self._passed_bytes)
                    self._sent()
        except BlockingIOError:
            raise
        except OSError as error:
            self._shut()
            raise _explained(error) from error

    def mend(self) -> None:
        """Connect anew, or go on connecting."""
        try:
            self._opened()
        except BlockingIOError:
            raise
        except OSError as error:
            self._shut()
            raise _explained(error) from error

    def close(self) -> None:
        """Wait a little for a reader that is at work."""
        until_s = time.monotonic() + LAST_S
        with suppress(OSError):
            while self._kept or self._ends:
                with suppress(BlockingIOError):
                    self.flush()
                if not (self._kept or self._ends) or time.monotonic() > until_s:
                    break
                time.sleep(0.01)
        self._lose_all()
        if self._socket is not None:
            # Closing a connection with unread data would make the other side discard the last messages.
            with suppress(OSError, ValueError):
                _discard_input(self._socket)
                if isinstance(self._socket, ssl.SSLSocket):
                    self._socket.unwrap()
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_WR)
        self._shut()

    def _opened(self) -> socket.socket:
        """Return the open connection, or take the next step to it. Raise BlockingIOError while it is not open."""
        if self._socket is None:
            self._socket = self._begin()
        if self._is_open:
            return self._socket
        try:
            if not self._settled_s:
                self._finish(self._socket)
            _discard_input(self._socket)
            if time.monotonic() < self._settled_s:
                raise BlockingIOError
        except _WAITS:
            if time.monotonic() - self._begun_s > _CONNECT_S:
                raise TimeoutError(errno.ETIMEDOUT, f"no answer within {_CONNECT_S:g} s") from None
            raise BlockingIOError from None
        self._is_open = True
        return self._socket

    def _begin(self) -> socket.socket:
        family, place = self._ways[0]
        self._ways.rotate(-1)
        self._begun_s, self._settled_s = time.monotonic(), 0.0
        opened = socket.socket(family, socket.SOCK_STREAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
                opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _SILENT_MS)
            with suppress(BlockingIOError):
                opened.connect(place)
        except OSError:
            opened.close()
            raise
        return opened

    def _finish(self, opened: socket.socket) -> None:
        """Complete the connection, and the handshake of TLS. Raise one of _WAITS if that needs an answer."""
        if not isinstance(opened, ssl.SSLSocket):
            poll = select.poll()
            poll.register(opened, select.POLLOUT)
            if not poll.poll(0):
                raise BlockingIOError
            if number := opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(number, os.strerror(number))
            if self._context is not None:
                opened = self._context.wrap_socket(opened, do_handshake_on_connect=False, server_hostname=self._server)
                self._socket = opened
        if isinstance(opened, ssl.SSLSocket):
            opened.do_handshake()
        self._settled_s = time.monotonic() + _SETTLE_S

    def _forget_acknowledged(self, opened: socket.socket) -> None:
        arrived = self._passed_bytes - _unacknowledged_bytes(opened)
        while self._ends and self._ends[0] <= arrived:
            self._ends.popleft()

    def _shut(self) -> None:
        if self._socket is not None:
            self._forget_acknowledged(self._socket)
            self._lose(len(self._ends), "it was not taken in time")
            with suppress(OSError):
                self._socket.close()
        self._socket, self._is_open = None, False
        self._passed_bytes = 0
        self._ends.clear()
        self._begun, self._is_held = 0, False  # the next connection gets the first message whole


def _unacknowledged_bytes(opened: socket.socket) -> int:
    """Return how many bytes the system has accepted that the other machine has not acknowledged; 0 if unknown."""
    try:
        return int(struct.unpack("i", fcntl.ioctl(opened, termios.TIOCOUTQ, bytes(4)))[0])
    except (NameError, OSError, ValueError):  # the last for a closed socket
        return 0


def _discard_input(opened: socket.socket) -> None:
    """Discard received data. Raise OSError if the other side closed the connection."""
    for _ in range(_MOST_READS):
        try:
            if not opened.recv(_PIECE_BYTES):
                raise ConnectionResetError(errno.ECONNRESET, "the other side closed the connection")
        except _WAITS:
            return


def _explained(error: OSError) -> OSError:
    words = error.strerror or str(error)
    if isinstance(error, ssl.SSLCertVerificationError):
        words = f"the server's certificate is not accepted: {error.verify_message}"
    elif isinstance(error, ssl.SSLError):
        words = f"TLS failed: {(error.reason or words).lower().replace('_', ' ')}"
    return OSError(error.errno, words)


def open_connection(text: str, asked: str) -> StreamOutlet:
    """Open `tcp://HOST:PORT` or `tls://HOST:PORT?ca=FILE`. asked: the option, for the message of an InputError.

    Raise OSError too.
    """
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
        options = options_of(parts)
    except ValueError:  # its words may quote a password
        raise InputError(f"{asked} is no address; {WANTED}") from None
    is_odd = parts.scheme not in ("tcp", "tls") or parts.path or parts.fragment or parts.username is not None
    unknown = [name for name in options if parts.scheme == "tcp" or name not in ("ca", "cert", "key", "server")]
    if not host or not port or is_odd or unknown or not all(options.values()):
        raise InputError(f"{asked} is no address{f' with {unknown[0]}' if unknown else ''}; {WANTED}")
    context = None if parts.scheme == "tcp" else tls_context(options, asked)
    return StreamOutlet(host, port, context, options.get("server", ""))


def options_of(parts: SplitResult) -> dict[str, str]:
    """Return the options of an address. Raise ValueError if its query has another form."""
    return dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))


def tls_context(options: dict[str, str], asked: str) -> ssl.SSLContext:
    """Return what TLS needs from the files. Raise InputError if one cannot be used."""
    files = {name: str(Path(options[name]).expanduser()) for name in ("ca", "cert", "key") if name in options}
    if "key" in files and "cert" not in files:
        raise InputError(f"{asked}: key= is the key of a certificate; give the certificate with cert=FILE too")
    what = f"ca={files.get('ca')} cannot be used"
    try:
        context = ssl.create_default_context(cafile=files.get("ca"))
        if "cert" in files:
            what = f"cert={files['cert']} cannot be used" + (f" with key={files['key']}" if "key" in files else "")
            # The function replaces the question for a password, which would stop the run at the terminal.
            context.load_cert_chain(files["cert"], files.get("key"), password=lambda: "")
    except OSError as error:
        words = error.strerror or "" if not isinstance(error, ssl.SSLError) else (error.reason or "no PEM file").lower()
        wanted = "give PEM files, the key without a password, as `openssl pkcs12 -nodes` writes them"
        raise InputError(f"{asked}: {what}: {words.replace('_', ' ')}; {wanted}") from None
    return context
