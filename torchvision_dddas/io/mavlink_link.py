"""MAVLink connections over UDP, TCP and serial lines: decode on a thread, serve several subscribers, send, sign."""

import hashlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, Self
from urllib.parse import parse_qsl

from torchvision_dddas.errors import InputError

Notify = Callable[[str, str], object]
"""Called with the kind and the text of an event, in any thread."""

Subscriber = Callable[[float, Any], object]
"""Called in the receiving thread with the time of reception, seconds since 1970, and a message. It must not block."""

PREFIX = "mavlink:"
WANTED = (
    "wanted mavlink:udp:HOST:PORT (listen), mavlink:udpout:HOST:PORT, mavlink:tcp:HOST:PORT or "
    "mavlink:serial:DEVICE:BAUD; ?key=FILE signs messages"
)

_KIND = "mavlink"  # of events
_V1, _V2, _SIGNED, _SIGNATURE = 0xFE, 0xFD, 0x01, 13
_RADIO_STATUS = 109  # the MAVLink specification accepts it unsigned, because radios have no key
_BAUD = 57600  # default of telemetry radios
_POLL_S, _CONNECT_S = 0.2, 5.0
_RETRY_S, _RETRY_MOST_S = 0.5, 10.0
_MOST_PEERS, _PEER_S = 16, 60.0
_SIGNING_EPOCH_S = 1_420_070_400  # signing times count 10 us steps from 2015-01-01


class Port(Protocol):
    """An open connection. All calls raise OSError once the connection is lost."""

    def read(self) -> tuple[Any, bytes]:
        """Return the sender's address and bytes; wait for a short time, then return no bytes."""
        ...

    def write(self, content: bytes) -> None:
        """Send bytes; wait for a short time at most."""
        ...

    def close(self) -> None:
        """Close the connection. Never raise."""
        ...


def is_mavlink(text: str) -> bool:
    """Return whether a text names a MAVLink connection."""
    return text.startswith(PREFIX)


class MavlinkLink:
    """An open connection with a receiving thread. Create it with `open_mavlink`.

    garbage_bytes: received bytes that belong to no whole message. unknown: messages that the dialect does not know.
    refused: messages without a valid signature, if the link has a key. received, sent: messages.
    dialect: pymavlink's module, which has the classes of the messages. users: options that share the link.
    """

    def __init__(
        self, name: str, dialect: Any, open_port: Callable[[], Port], notify: Notify, key: bytes = b""
    ) -> None:
        """Open the port, and start to receive. Raise OSError if the port cannot be opened."""
        self.name, self.dialect = name, dialect
        self.received = self.sent = self.garbage_bytes = self.unknown = self.refused = 0
        self._open_port, self._notify, self.key, self.users = open_port, notify, key, 1
        self._told, self._closing = set[str](), threading.Event()
        self._subscribers: tuple[Subscriber, ...] = ()
        self._buffers: dict[Any, bytearray] = {}
        self._sending = threading.Lock()
        self._packer, self._sequences = dialect.MAVLink(None), dict[tuple[int, int], int]()
        self._decoder = _build_decoder(dialect, key)
        self._packer.signing.secret_key, self._packer.signing.sign_outgoing = key or None, bool(key)
        self._port: Port | None = open_port()
        self._thread = threading.Thread(target=self._receive, name="mavlink", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether the connection is open. It is always open for UDP."""
        return self._port is not None

    def subscribe(self, subscriber: Subscriber) -> None:
        """Call a function with each message from now on."""
        self._subscribers = (*self._subscribers, subscriber)

    def send(self, message: Any, system: int, component: int) -> bool:
        """Send a message of the dialect from a system and component. Return whether it was sent. Never raise OSError.

        Any thread may call this. An open TCP or serial line that takes nothing for a short time counts as lost.
        """
        with self._sending:
            if self._port is None:
                return False
            sequence = self._sequences.get((system, component), 0)
            self._packer.seq, self._packer.srcSystem, self._packer.srcComponent = sequence, system, component
            if self.key:
                times = self._packer.signing.timestamp, self._decoder.signing.timestamp, _signing_time()
                self._packer.signing.timestamp = max(times)
            try:
                self._port.write(message.pack(self._packer))
            except OSError as error:
                self._lose(error)
                return False
            self._sequences[system, component] = (sequence + 1) % 256
            self.sent += 1
            return True

    def close(self) -> None:
        """Close the connection and report the totals of faults, unless another option still uses it."""
        with _OPENING:
            self.users -= 1
            if self.users > 0 or self._closing.is_set():
                return
            self._closing.set()
            if _open.get(self.name) is self:
                del _open[self.name]
        self._thread.join()
        with self._sending:
            if self._port is not None:
                self._port.close()
            self._port = None
        totals = {"bytes of garbage": self.garbage_bytes, "unknown": self.unknown, "badly signed": self.refused}
        if any(totals.values()):
            words = ", ".join(f"{count} {name}" for name, count in totals.items() if count)
            self._notify(_KIND, f"{self.name} closed: {self.received} messages received; {words}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self) -> None:
        wait_s = _RETRY_S
        while not self._closing.is_set():
            port = self._port
            if port is None:
                if self._closing.wait(wait_s):
                    return
                wait_s = _RETRY_S if self._reopen() else min(2 * wait_s, _RETRY_MOST_S)
                continue
            try:
                sender, content = port.read()
            except OSError as error:
                content = b""
                with self._sending:
                    if self._port is port:
                        self._lose(error)
            if self._port is not port:  # only this thread closes a port, because a closed number may be used again
                port.close()
                self._buffers.clear()
            elif content:
                utc_s = time.time()
                for message in self._decode(sender, content):
                    self.received += 1
                    self._hand_on(utc_s, message)

    def _hand_on(self, utc_s: float, message: Any) -> None:
        for subscriber in self._subscribers:
            try:
                subscriber(utc_s, message)
            except Exception as error:  # a fault of one subscriber must not end the link
                self._tell_once("subscriber", f"{message.get_type()} failed: {type(error).__name__}: {error}")

    def _lose(self, error: OSError) -> None:
        """Give up the lost port; the receiving thread opens another. The caller holds the lock."""
        self._port = None
        if not self._closing.is_set():
            self._notify(_KIND, f"{self.name} lost: {error.strerror or error}; trying again")

    def _reopen(self) -> bool:
        try:
            port = self._open_port()
        except OSError:
            return False
        with self._sending:
            self._port = port
        self._notify(_KIND, f"{self.name} works again")
        return True

    def _decode(self, sender: Any, content: bytes) -> Iterator[Any]:
        """Yield the messages that are whole now. Bytes may be cut anywhere; keep the rest of each sender."""
        buffer = self._buffers.pop(sender, bytearray()) + content
        if len(self._buffers) >= _MOST_PEERS:
            self._buffers.pop(next(iter(self._buffers)))
        place, done, kept = 0, 0, len(buffer)  # bytes before `done` are counted; an unfinished message begins at `kept`
        while place < len(buffer):
            end = _end(buffer, place)
            if end is not None and end > len(buffer):
                kept = min(kept, place) if place >= done else kept
            elif end is not None and (message := self._message(buffer[place:end])) is not None:
                is_known = message is _REFUSED or not isinstance(message, self.dialect.MAVLink_unknown)
                # An unknown message has no checksum that can be checked. Another message behind it tells it from
                # garbage. Its inside is searched all the same.
                if is_known or (place >= done and kept > place and (end == len(buffer) or buffer[end] in (_V1, _V2))):
                    self.garbage_bytes += max(0, place - done)
                    done = end
                if is_known:
                    place, kept = end, len(buffer)
                    if message is not _REFUSED:
                        yield message
                    continue
                if done == end:
                    self.unknown += 1
                    first, last = (7, 10) if buffer[place] == _V2 else (5, 6)
                    number = int.from_bytes(buffer[place + first : place + last], "little")
                    self._tell_once("unknown", f"messages of unknown numbers are skipped and counted, first {number}")
            # Skip one byte only: a whole message may begin right after it.
            place += 1
        self.garbage_bytes += max(0, kept - done)
        if self.garbage_bytes:
            self._tell_once("garbage", "bytes that are no whole MAVLink messages are skipped and counted")
        self._buffers[sender] = buffer[kept:]

    def _message(self, frame: bytearray) -> Any:
        """Decode a frame. Return None if it is damaged, and _REFUSED if its signature is missing or wrong."""
        # In a row of 0xFE bytes each byte may start a frame. Check the stated length first: a checksum costs more.
        known = self.dialect.mavlink_map.get(frame[5]) if frame[0] == _V1 else None
        if known is not None and frame[1] > known.unpacker.size:
            return None
        signing = self._decoder.signing
        rejected, signing.timestamp = signing.reject_count, max(signing.timestamp, _signing_time())
        try:
            return self._decoder.decode(frame)
        except (self.dialect.MAVError, ValueError, TypeError):
            if signing.reject_count == rejected:
                return None
            self.refused += 1
            self._tell_once("signature", "messages without a valid signature are refused and counted")
            return _REFUSED

    def _tell_once(self, fault: str, words: str) -> None:
        if fault not in self._told:
            self._told.add(fault)
            self._notify(_KIND, f"{self.name}: {words}")


def open_mavlink(text: str, notify: Notify, option: str = "--telemetry") -> MavlinkLink:
    """Open `mavlink:udp:HOST:PORT`, `udpin:`, `udpout:`, `tcp:` or `serial:DEVICE[:BAUD]`, signed with `?key=FILE`.

    Options that name the same connection share it: close it once for each. notify: called for faults of the link, once
    for each kind. option: named in messages.
    Raise InputError: an unknown form, pymavlink is missing, a bad key, a port in use, or no connection.
    """
    name, _, query = text.partition("?")
    asked = f"{option} {name}"
    kind, _, place = name.removeprefix(PREFIX).partition(":")
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
    except ValueError:
        raise InputError(f"{asked}: {query!r} is no ?key=FILE; {WANTED}") from None
    key = options.pop("key", None)
    if not is_mavlink(text) or options or not place or kind not in ("udp", "udpin", "udpout", "tcp", "serial"):
        raise InputError(f"{asked} is no MAVLink connection; {WANTED}")
    try:
        from pymavlink.dialects.v20 import all as dialect
    except ImportError:
        raise InputError(f"{asked} needs pymavlink: pip install 'torchvision-dddas[telemetry]'") from None
    secret = b"" if key is None else read_key(key, asked)
    with _OPENING:
        if (link := _open.get(name)) is not None:
            if link.key != secret:
                raise InputError(f"{asked} is open with another key; give the same ?key=FILE in both options")
            link.users += 1
            return link
        open_port = port_opener(kind, place, asked)
        try:
            link = _open[name] = MavlinkLink(name, dialect, open_port, notify, secret)
        except OSError as error:
            raise InputError(f"{asked} cannot be opened: {error.strerror or error}; check the address") from None
        return link


def port_opener(kind: str, place: str, asked: str) -> Callable[[], Port]:
    """Return a function that opens a port of udp, udpin, udpout, tcp or serial. Raise InputError for a wrong place."""
    return _serial(place, asked) if kind == "serial" else _network(kind, place, asked)


def take_systems(text: str, option: str) -> tuple[str, dict[str, int]]:
    """Return the text of a connection without its `?NAME=N` of systems, and the systems. Raise InputError for a bad N.

    >>> take_systems("mavlink:tcp:localhost:5760?system=1&ugv1=11&key=fleet.key", "--command")
    ('mavlink:tcp:localhost:5760?key=fleet.key', {'system': 1, 'ugv1': 11})
    """
    name, _, query = text.partition("?")
    parts = [part for part in query.split("&") if part]
    rest = "&".join(part for part in parts if part.startswith("key="))
    systems = {}
    for part in parts:
        one, _, number = part.partition("=")
        if one == "key":
            continue
        if one in systems or not one or not number.isdecimal() or not 0 < int(number[:4]) <= 255:
            raise InputError(f"{option} {name}: {one[:40] or 'a system'} must be one number from 1 to 255")
        systems[one] = int(number)
    return name + f"?{rest}" * bool(rest), systems


def take_system(text: str, option: str) -> tuple[str, int]:
    """Return the text of a connection without `?system=N`, and N; 0 without it. Raise InputError for a bad N."""
    rest, systems = take_systems(text, option)
    system = systems.pop("system", 0)
    if systems:
        raise InputError(f"{option} {rest.partition('?')[0]}: {', '.join(systems)} is unknown; wanted system=N")
    return rest, system


def read_key(path: str, asked: str) -> bytes:
    """Read a signing key of 32 bytes, as 64 hexadecimal digits. Raise InputError without showing the content."""
    try:
        key = bytes.fromhex(Path(path).expanduser().read_text("ascii").strip())
    except (OSError, RuntimeError) as error:
        raise InputError(f"{asked}: the key file {path} cannot be read: {getattr(error, 'strerror', error)}") from None
    except ValueError:
        key = b""
    if len(key) != 32:
        raise InputError(f"{asked}: the key file {path} must hold 64 hexadecimal digits, which are 32 bytes")
    return key


_REFUSED = object()
_OPENING = threading.Lock()
_open: dict[str, MavlinkLink] = {}


def _signing_time() -> int:
    return max(0, int((time.time() - _SIGNING_EPOCH_S) * 1e5))


def _end(content: bytearray, place: int) -> int | None:
    """Return the end of the frame that begins here, beyond the content if unknown; None if no frame begins here."""
    magic, known = content[place], len(content) - place
    if magic not in (_V1, _V2):
        return None
    if known < 3:
        return len(content) + 1
    if magic == _V1:
        return place + 8 + content[place + 1]
    flags = content[place + 2]  # a receiver must not read messages with incompatible flags that it does not know
    return None if flags & ~_SIGNED else place + 12 + content[place + 1] + (_SIGNATURE if flags else 0)


def _build_decoder(dialect: Any, key: bytes) -> Any:
    class Decoder(dialect.MAVLink):
        def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
            # pymavlink stores a message's time before it compares the signature: a forged time would lock a sender out.
            digest = hashlib.sha256(key + msgbuf[:-6]).digest()[:6]
            return digest == bytes(msgbuf[-6:]) and super().check_signature(msgbuf, srcSystem, srcComponent)

    decoder = Decoder(None)
    decoder.signing.secret_key = key or None
    decoder.signing.allow_unsigned_callback = lambda _, number: number == _RADIO_STATUS
    return decoder


def _network(kind: str, place: str, asked: str) -> Callable[[], Port]:
    host, _, port = place.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 < int(port[:6]) <= 65535:
        raise InputError(f"{asked} lacks HOST:PORT; {WANTED}")
    try:
        host.encode("idna")
    except UnicodeError as error:
        raise InputError(f"{asked}: no host can have this name, {error}; {WANTED}") from None
    if kind == "tcp":
        return lambda: _TcpPort(host, int(port))
    return lambda: _UdpPort(host, int(port), listens=kind != "udpout")


class _UdpPort:
    """A socket that listens and answers those who sent within the last minute, or sends to one address."""

    def __init__(self, host: str, port: int, listens: bool) -> None:
        family, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._peers: dict[Any, float] = {} if listens else {place: float("inf")}
        self._listens = listens
        try:
            self._socket.settimeout(_POLL_S)
            if listens:
                group = socket.inet_aton(str(place[0])) if family == socket.AF_INET else b"\0"
                if 224 <= group[0] < 240:  # multicast
                    self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + bytes(4))
                self._socket.bind(place)
        except OSError:
            self._socket.close()
            raise

    def read(self) -> tuple[Any, bytes]:
        try:
            content, sender = self._socket.recvfrom(65535)
        except (TimeoutError, ConnectionError):  # the latter belongs to a datagram that nobody took
            return None, b""
        except OSError:
            if not self._listens and self._socket.fileno() >= 0:  # nothing was sent yet, so the socket has no address
                time.sleep(_POLL_S)
                return None, b""
            raise
        if self._listens:
            now_s = time.monotonic()
            kept = {peer: s for peer, s in self._peers.items() if now_s - s < _PEER_S and peer != sender}
            self._peers = dict([*kept.items(), (sender, now_s)][-_MOST_PEERS:])
        return sender, content

    def write(self, content: bytes) -> None:
        for peer in self._peers:
            with suppress(OSError):  # a datagram that cannot be sent is lost, and the others are still received
                self._socket.sendto(content, peer)

    def close(self) -> None:
        self._socket.close()


class _TcpPort:
    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_S)
        self._socket.settimeout(_POLL_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self) -> tuple[Any, bytes]:
        try:
            content = self._socket.recv(65535)
        except TimeoutError:
            return None, b""
        if not content:
            raise ConnectionResetError("the peer closed the connection")
        return None, content

    def write(self, content: bytes) -> None:
        self._socket.sendall(content)

    def close(self) -> None:
        self._socket.close()


def _serial(place: str, asked: str) -> Callable[[], Port]:
    device, _, baud = place.rpartition(":")
    if not device or not baud.isdecimal():
        device, baud = place, str(_BAUD)
    try:
        import serial
    except ImportError:
        raise InputError(f"{asked} needs pyserial: pip install 'torchvision-dddas[telemetry]'") from None
    return lambda: _SerialPort(serial, device, int(baud))


class _SerialPort:
    def __init__(self, serial: Any, device: str, baud: int) -> None:
        try:
            self._serial = serial.Serial(device, baud, timeout=_POLL_S, write_timeout=_POLL_S)
        except ValueError as error:  # such as a rate that the device does not have
            raise OSError(str(error)) from None

    def read(self) -> tuple[Any, bytes]:
        return None, self._serial.read(max(1, self._serial.in_waiting))

    def write(self, content: bytes) -> None:
        self._serial.write(content)

    def close(self) -> None:
        with suppress(OSError):
            self._serial.close()
