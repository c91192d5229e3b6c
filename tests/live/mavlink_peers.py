"""Programs on the other side of a MAVLink link: they follow the specification, with pymavlink's own encoder."""

import socket
import time
from contextlib import suppress
from typing import Any

import pytest

dialect: Any = pytest.importorskip("pymavlink.dialects.v20.all")

LONG_S = 20.0
FLYING = 0x80 | 0x08 | 0x01
GUIDED = 4  # custom mode of ArduPilot's copters


class Wire:
    """Stands in for a link in tests of logic: keeps sent messages, and hands on what peers say."""

    def __init__(self) -> None:
        self.dialect, self.name = dialect, "wire"
        self.sent = list[tuple[Any, int, int]]()
        self.subscribers: list[Any] = []

    def subscribe(self, subscriber: Any) -> None:
        self.subscribers.append(subscriber)

    def send(self, message: Any, system: int, component: int) -> bool:
        message.pack(dialect.MAVLink(None, srcSystem=system, srcComponent=component))  # a field out of range raises
        self.sent.append((message, system, component))
        return True

    def say(self, message: Any, system: int = 1, component: int = 1) -> None:
        """Let a peer send a message: it is encoded and decoded, so that it is as a link gives it."""
        content = message.pack(dialect.MAVLink(None, srcSystem=system, srcComponent=component))
        (decoded,) = dialect.MAVLink(None).parse_buffer(content)
        for subscriber in self.subscribers:
            subscriber(time.time(), decoded)

    def take(self, kind: str) -> list[Any]:
        """Return and forget the sent messages of a kind."""
        found = [message for message, *_ in self.sent if message.get_type() == kind]
        self.sent = [sent for sent in self.sent if sent[0].get_type() != kind]
        return found


def heartbeat(mode: int = GUIDED, base: int = FLYING, kind: int = 2, autopilot: int = 3) -> Any:
    return dialect.MAVLink_heartbeat_message(kind, autopilot, base, mode, 4, 3)


def station_heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def position(lonlat: tuple[float, float], above_home_m: float, time_ms: int, above_sea_m: float = 1350.0) -> Any:
    longitude, latitude = (round(1e7 * v) for v in lonlat)
    heights = round(1e3 * above_sea_m), round(1e3 * above_home_m)
    return dialect.MAVLink_global_position_int_message(time_ms, latitude, longitude, *heights, 0, 0, 0, 0)


def command(number: int, *params: float, system: int = 1, component: int = 100) -> Any:
    given = (*params, *[0.0] * (7 - len(params)))
    return dialect.MAVLink_command_long_message(system, component, number, 0, *given)


class UdpPeer:
    """A peer on a socket of this machine."""

    def __init__(self, port: int, system: int = 1, component: int = 1) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.reader = dialect.MAVLink(None)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.05)
        self.heard = list[Any]()

    def say(self, message: Any) -> None:
        with suppress(ConnectionError):  # nobody listens yet
            self.socket.send(message.pack(self.mav))

    def listen(self) -> list[Any]:
        """Return all messages so far, after a short wait for more."""
        with suppress(TimeoutError, ConnectionError):
            self.heard += self.reader.parse_buffer(self.socket.recv(4096)) or []
        return self.heard

    def close(self) -> None:
        self.socket.close()
