"""Outlets for messages that never wait for a slow reader: files, pipes, standard output, and UDP datagrams."""

import errno
import os
import select
import socket
import stat
import struct
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from torchvision_dddas.errors import InputError

KEPT_BYTES = 1 << 20
"""Bytes of lines that wait for a slow reader or for disk space; beyond this the oldest are lost."""

MOST_BYTES = 65_507
"""The longest content of an IPv4 datagram: 65535 minus the headers of IP and UDP."""

LEAST_BYTES = 512
"""The smallest limit of a datagram, which holds one target."""

LAST_S = 1.0
"""Longest wait for a reader when closing, seconds."""

WANTED = "wanted udp://HOST:PORT, or udp://[IPV6]:PORT, with ?ttl=1 to 255, bytes=512 to 65507 or interface=NAME, by &"

# By address family: level of the options, hops of unicast and of multicast datagrams, interface of multicast.
_OPTIONS = {
    socket.AF_INET: (socket.IPPROTO_IP, socket.IP_TTL, socket.IP_MULTICAST_TTL, socket.IP_MULTICAST_IF),
    socket.AF_INET6: (
        *(socket.IPPROTO_IPV6, socket.IPV6_UNICAST_HOPS),
        *(socket.IPV6_MULTICAST_HOPS, socket.IPV6_MULTICAST_IF),
    ),
}
_AT_ONCE = 4096  # Linux: a ready pipe accepts this many bytes in one piece without blocking


class Outlet(ABC):
    """Accept messages one after another.

    most_bytes: longest message, 0 for any. lost: messages lost so far. reason: why the last loss occurred.
    """

    most_bytes = 0

    def __init__(self) -> None:
        self.lost, self.reason = 0, ""
        self._kept: deque[bytes] = deque()

    @abstractmethod
    def put(self, messages: Sequence[bytes]) -> None:
        """Keep messages until they can be sent; beyond a limit the oldest are lost."""

    @abstractmethod
    def flush(self) -> None:
        """Send as much as is accepted now, each message whole or not at all. Raise OSError as `mend` does."""

    @abstractmethod
    def mend(self) -> None:
        """Reopen after trouble. Raise OSError if that fails, BlockingIOError while it is not decided."""

    def handle(self) -> int | None:
        """Return a new file descriptor for a sync, which the caller closes. Return None if there is no file."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Send what can be sent soon and count the rest as lost. Never raise."""

    def _lose(self, messages: int, reason: str) -> None:
        if messages:
            self.lost += messages
            self.reason = reason


class KeptOutlet(Outlet):
    """Keep up to KEPT_BYTES of messages for a slow reader."""

    def __init__(self) -> None:
        super().__init__()
        self._kept_bytes = 0
        self._begun = 0  # bytes of the first kept message that are already written
        self._is_held = False  # whether the first kept message must stay although no byte of it is written

    def put(self, messages: Sequence[bytes]) -> None:
        """Keep messages, up to KEPT_BYTES."""
        self._kept += messages
        self._kept_bytes += sum(map(len, messages))
        while self._kept_bytes > KEPT_BYTES and len(self._kept) > 1:
            # A partly written message stays, so that the next one does not begin in its middle.
            oldest = 1 if self._begun or self._is_held else 0
            self._kept_bytes -= len(self._kept[oldest])
            del self._kept[oldest]
            self._lose(1, "it is read too slowly")

    def _sent(self) -> None:
        """Remove the first message, which is written whole."""
        self._kept_bytes -= len(self._kept.popleft())
        self._begun, self._is_held = 0, False

    def _lose_all(self) -> None:
        self._lose(len(self._kept), "it was not taken in time")
        self._kept.clear()


class LineOutlet(KeptOutlet):
    """Write lines into a file, a pipe, or standard output, which is never closed."""

    def __init__(self, path: Path | None) -> None:
        """Open for appending. path: None for standard output. Raise OSError if it cannot be opened."""
        super().__init__()
        self._path = path
        self._file = 1
        if path is not None:
            self._file = -1
            self.mend()
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)

    def flush(self) -> None:
        """Write lines while the reader accepts them; reopen the file if it was renamed, as log rotation does."""
        if self._path is not None and self._regular and not self._begun and not self._is_at(self._path):
            self.mend()
        while self._kept and self._is_ready():
            line = self._kept[0]
            # A file accepts a whole line; a pipe gets at most what it certainly has room for.
            end = len(line) if self._regular else self._begun + _AT_ONCE
            try:
                self._begun += os.write(self._file, line[self._begun : end])
            except BlockingIOError:
                return
            except OSError as error:
                self._take_back()
                raise _explained(error) from error
            if self._begun >= len(line):
                self._sent()

    def mend(self) -> None:
        """Reopen a file, and end an unfinished line of an earlier writer."""
        if self._path is None:
            return
        self._shut()
        # Without O_NONBLOCK, opening a named pipe without a reader would block.
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            self._file = os.open(self._path, flags, 0o666)
            self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
            self._begun = 0
            if self._regular and _ends_within_a_line(self._path):
                os.write(self._file, b"\n")
        except OSError as error:
            self._shut()
            raise _explained(error) from error

    def handle(self) -> int | None:
        """A new descriptor of a file; None for a pipe."""
        return os.dup(self._file) if self._regular and self._file >= 0 else None

    def close(self) -> None:
        """Wait a little for a reader that is at work."""
        until = time.monotonic() + LAST_S
        with suppress(OSError):
            if self._file < 0:
                self.mend()
            self.flush()
            while self._kept and time.monotonic() < until:
                self._is_ready(until - time.monotonic())
                self.flush()
            if self._regular:
                os.fsync(self._file)
        self._lose_all()
        self._shut()

    def _is_ready(self, wait_s: float = 0.0) -> bool:
        """Whether something can be written without waiting, or would fail at once."""
        if self._regular:
            return True
        poll = select.poll()
        poll.register(self._file, select.POLLOUT)
        return bool(poll.poll(max(wait_s, 0.0) * 1000))

    def _is_at(self, path: Path) -> bool:
        try:
            return os.path.samestat(path.stat(), os.fstat(self._file))
        except FileNotFoundError:
            return False

    def _take_back(self) -> None:
        """Truncate the beginning of a line that a full disk cut off, if it is at the file's end."""
        if not (self._regular and self._begun):
            return
        with suppress(OSError):
            end = os.lseek(self._file, 0, os.SEEK_CUR)
            if end == os.fstat(self._file).st_size:
                os.ftruncate(self._file, end - self._begun)
                os.lseek(self._file, end - self._begun, os.SEEK_SET)
                self._begun = 0

    def _shut(self) -> None:
        if self._path is not None and self._file >= 0:
            with suppress(OSError):
                os.close(self._file)
        self._file = -1


def _ends_within_a_line(path: Path) -> bool:
    """Whether what wrote the file before was killed in the middle of a line."""
    try:
        with path.open("rb") as file:
            if file.seek(0, os.SEEK_END) == 0:
                return False
            file.seek(-1, os.SEEK_END)
            return file.read(1) != b"\n"
    except PermissionError:  # the file may be writable but not readable
        return False


def _explained(error: OSError) -> OSError:
    unread = error.errno in (errno.EPIPE, errno.ENXIO)
    return OSError(error.errno, "nobody reads it" if unread else error.strerror or str(error))


# --------------------------------------------------------------------------------------------------------------------
# Datagrams.


class DatagramOutlet(Outlet):
    """Datagrams, one per message. What cannot be sent at once is lost: old places are of no use later."""

    def __init__(
        self, host: str, port: int, ttl: int | None = None, most_bytes: int = MOST_BYTES, interface: str = ""
    ) -> None:
        """Raise OSError if the host's name is not known or there is no way to it.

        ttl: how many routers may pass them on; None: as the system has it, to a multicast address the own network only.
        most_bytes: of a datagram. interface: by which network a multicast goes out; empty: as the system has it.
        """
        super().__init__()
        self.most_bytes = most_bytes
        self._host, self._port, self._ttl, self._interface = host, port, ttl, interface
        # IPv4 first, as most listeners know no other. The name is resolved once: that may take many seconds.
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        self._ways = sorted({(family, place) for family, *_, place in found}, key=lambda w: w[0] != socket.AF_INET)
        self._socket: socket.socket | None = None
        self.mend()

    def put(self, messages: Sequence[bytes]) -> None:
        """Keep the newest messages alone."""
        if messages:
            self._lose(len(self._kept), self.reason)
            self._kept = deque(messages)

    def flush(self) -> None:
        """Send each message, or lose it."""
        while self._kept:
            try:
                self._send(self._kept[0])
            except BlockingIOError:
                self._lose(1, "the network takes it too slowly")
            except OSError as error:
                if error.errno != errno.EMSGSIZE:
                    raise
                self._lose(1, f"{len(self._kept[0])} bytes are too much for a datagram; give it ?bytes=")
            self._kept.popleft()

    def mend(self) -> None:
        """Connect by the first way that there is."""
        self._shut()
        trouble = OSError(f"{self._host} has no address")
        for family, place in self._ways:
            opened = socket.socket(family, socket.SOCK_DGRAM)
            try:
                opened.setblocking(False)
                opened.connect(self._prepare(opened, family, place))
            except OSError as error:
                opened.close()
                # A link-local address without the link.
                known = error.errno != errno.EINVAL or self._interface or family == socket.AF_INET
                trouble = error if known else OSError(error.errno, "give the network with ?interface=NAME")
            else:
                self._socket = opened
                return
        raise trouble

    def close(self) -> None:
        """Send nothing more."""
        self._lose(len(self._kept), self.reason)
        self._kept.clear()
        self._shut()

    def _shut(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
        self._socket = None

    def _send(self, message: bytes) -> None:
        if self._socket is None:
            raise OSError(errno.ENOTCONN, "not connected")
        try:
            self._socket.send(message)
        except ConnectionRefusedError:
            # The error belongs to an earlier datagram; this one was not sent yet.
            self._lose(1, f"nobody listens at port {self._port} of {self._host}")
            with suppress(ConnectionRefusedError):
                self._socket.send(message)

    def _prepare(self, opened: socket.socket, family: socket.AddressFamily, place: tuple[Any, ...]) -> tuple[Any, ...]:
        """Set the socket's options; return the place, with the interface if one is given."""
        level, unicast, multicast, way_out = _OPTIONS[family]
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        if self._ttl is not None:
            opened.setsockopt(level, unicast, self._ttl)
            opened.setsockopt(level, multicast, self._ttl)
        if not self._interface:
            return place
        number = socket.if_nametoindex(self._interface)
        if family == socket.AF_INET:
            # ip_mreqn of Linux: group, own address, interface
            opened.setsockopt(level, way_out, struct.pack("4s4si", b"", b"", number))
            return place
        opened.setsockopt(level, way_out, number)
        return (*place[:3], number)  # a link-local address names its link


def open_datagrams(text: str, asked: str, kind: type[DatagramOutlet] = DatagramOutlet) -> DatagramOutlet:
    """Open `udp://HOST:PORT?ttl=4`. asked: the whole option, for the message of an InputError. Raise OSError too."""
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
        options = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
        ttl = int(options.pop("ttl")) if "ttl" in options else None
        most_bytes = int(options.pop("bytes", MOST_BYTES))
    except ValueError as error:
        raise InputError(f"{asked}: {error}; {WANTED}") from None
    interface = options.pop("interface", "")
    is_odd = parts.scheme != "udp" or parts.path or parts.fragment or parts.username or options
    is_beyond = not LEAST_BYTES <= most_bytes <= MOST_BYTES or not (ttl is None or 1 <= ttl <= 255)
    if not host or not port or is_odd or is_beyond:
        raise InputError(f"{asked} is no address; {WANTED}")
    return kind(host, port, ttl, most_bytes, interface)
