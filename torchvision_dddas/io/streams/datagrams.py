"""Sends messages as UDP datagrams to a host or a multicast address."""

import errno
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from torchvision_dddas.errors import InputError

MOST_BYTES = 65_507
"""The longest content of a datagram over IPv4: 65535 less the headers of IP and UDP."""

LEAST_BYTES = 512
"""The least limit of a datagram, which holds one target."""

WANTED = "wanted udp://HOST:PORT, or udp://[IPV6]:PORT, with ?ttl=1 to 255, bytes=512 to 65507 or interface=NAME, by &"

Place = tuple[Any, ...]
"""A host's address and a port, as a socket takes them."""


@dataclass(frozen=True)
class Address:
    """Where datagrams go.

    ttl: how many routers may pass them on; None: as the system has it, to a multicast address the own network only.
    most_bytes: of a datagram. interface: by which network a multicast goes out; empty: as the system has it.
    """

    host: str
    port: int
    ttl: int | None = None
    most_bytes: int = MOST_BYTES
    interface: str = ""


def parse_address(text: str, asked: str) -> Address:
    """Parse `udp://HOST:PORT?ttl=4`. asked: the whole option, for the message of an InputError."""
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
        given = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=True) if parts.query else []
        options = dict(given)
        ttl = int(options.pop("ttl")) if "ttl" in options else None
        most_bytes = int(options.pop("bytes", MOST_BYTES))
    except ValueError as error:
        raise InputError(f"{asked}: {error}; {WANTED}") from None
    interface = options.pop("interface", "")
    whole = parts.scheme == "udp" and host and port and not (parts.path or parts.fragment or parts.username or options)
    if not whole or not LEAST_BYTES <= most_bytes <= MOST_BYTES or not (ttl is None or 1 <= ttl <= 255):
        raise InputError(f"{asked} is no address; {WANTED}")
    assert host and port
    return Address(host, port, ttl, most_bytes, interface)


class DatagramOutlet:
    """An Outlet of datagrams, one per message. What cannot be sent at once is lost: old places are of no use later."""

    def __init__(self, to: Address) -> None:
        """Raises OSError if the host's name is not known or there is no way to it."""
        self.lost, self.reason = 0, ""
        self.most_bytes = to.most_bytes
        self._to = to
        self._kept: list[bytes] = []
        # IPv4 first, as most listeners know no other. The name is resolved once: that may take many seconds.
        found = socket.getaddrinfo(to.host, to.port, type=socket.SOCK_DGRAM)
        self._ways = sorted({(family, place) for family, _, _, _, place in found}, key=lambda w: w[0] != socket.AF_INET)
        self._socket: socket.socket | None = None
        self.mend()

    def put(self, messages: Sequence[bytes]) -> None:
        """As in Outlet."""
        if messages:
            self._lose(len(self._kept), self.reason)
            self._kept = list(messages)

    def flush(self) -> None:
        """As in Outlet."""
        while self._kept:
            try:
                self._send(self._kept[0])
            except BlockingIOError:
                self._lose(1, "the network takes it too slowly")
            except OSError as error:
                if error.errno != errno.EMSGSIZE:
                    raise
                self._lose(1, f"{len(self._kept[0])} bytes are too much for a datagram; give it ?bytes=")
            self._kept.pop(0)

    def mend(self) -> None:
        """As in Outlet."""
        self._shut()
        trouble = OSError(f"{self._to.host} has no address")
        for family, place in self._ways:
            opened = socket.socket(family, socket.SOCK_DGRAM)
            try:
                opened.setblocking(False)
                opened.connect(_prepared(opened, family, place, self._to))
            except OSError as error:
                opened.close()
                # A link-local address without the link.
                known = error.errno != errno.EINVAL or self._to.interface or family == socket.AF_INET
                trouble = error if known else OSError(error.errno, "give the network with ?interface=NAME")
            else:
                self._socket = opened
                return
        raise trouble

    def handle(self) -> None:
        """As in Outlet."""

    def close(self) -> None:
        """As in Outlet."""
        self._lose(len(self._kept), self.reason)
        self._kept = []
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
            self._lose(1, f"nobody listens at port {self._to.port} of {self._to.host}")
            with suppress(ConnectionRefusedError):
                self._socket.send(message)

    def _lose(self, messages: int, reason: str) -> None:
        if messages:
            self.lost += messages
            self.reason = reason


def _prepared(opened: socket.socket, family: int, place: Place, to: Address) -> Place:
    """Set the socket's options; return the place, with the interface if one is given."""
    four = family == socket.AF_INET
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    if to.ttl is not None and four:
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, to.ttl)
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, to.ttl)
    elif to.ttl is not None:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_UNICAST_HOPS, to.ttl)
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, to.ttl)
    if not to.interface:
        return place
    number = socket.if_nametoindex(to.interface)
    if four:
        request = struct.pack("4s4si", b"", b"", number)  # ip_mreqn of Linux: group, own address, interface
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, request)
        return place
    opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, number)
    return (*place[:3], number)  # a link-local address names its link
