"""Inputs of live telemetry: growing files, FIFOs, standard input, UDP, TCP, serial lines, gpsd, MAVLink, KLV."""

import os
import re
import select
import stat
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.mavlink_link import Port, is_mavlink, open_mavlink, port_opener, take_system
from torchvision_dddas.io.sources import names_file
from torchvision_dddas.io.telemetry import MAVLINK_NAMES, kind_of_report, split_reports

KLV = "klv"
"""The telemetry in the stream of the pictures."""
Report = tuple[float, bytes]
"""When a report came, seconds since 1970, and its content."""
Notify = Callable[[str], object]

_POLL_S, _RETRY_S, _RETRY_MOST_S = 0.2, 0.5, 10.0
_LONGEST_LINE = 1 << 16
_WATCH = b'?WATCH={"enable":true,"json":true};\n'
_FORM = re.compile(r"(udp|nmea:udp|nmea:tcp|nmea:serial|nmea:gpsd|gpsd):(.+)")
WANTED = (
    "wanted a file, a FIFO, -, klv, udp:HOST:PORT, nmea:udp:HOST:PORT, nmea:tcp:HOST:PORT, nmea:serial:DEVICE:BAUD, "
    "gpsd:HOST:PORT or mavlink:udp:HOST:PORT"
)


class ReportInput(Protocol):
    """An input that gives reports as they come. system: the MAVLink system that is asked for; 0: any."""

    system: int

    def receive(self) -> list[Report]:
        """Return the reports that came; wait for a short time for the first."""
        ...

    def close(self) -> None:
        """Close the input. Never raise."""
        ...


def is_live_input(text: str) -> bool:
    """Return whether a name stands for a live input: an address, `-`, `klv`, a FIFO or a device, but not a file."""
    if names_file(text):
        return not (Path(text).is_file() or Path(text).is_dir())
    return text in ("-", KLV) or is_mavlink(text) or re.match(r"(udp|nmea|gpsd|cot):", text) is not None


def open_input(text: str, notify: Notify, metadata: deque[Report] | None = None) -> ReportInput:
    """Open the input of --telemetry. notify: called for faults. metadata: KLV packets in the stream of the pictures.

    A file gives the lines that are added to it from now on. Raise InputError if the input is unknown or cannot be
    opened.
    """
    if names_file(text) or text == "-":
        return Lines(text, lambda: _FilePort(text), notify)
    if text == KLV:
        if metadata is None:
            raise InputError(f"--telemetry {KLV}: the stream announces no KLV beside its pictures")
        return _Packets(metadata)
    if is_mavlink(text):
        return _Mavlink(text, notify)
    if (found := _FORM.fullmatch(text)) is None:
        raise InputError(f"--telemetry {text} is unknown; {WANTED}")
    kind, place = found[1].removeprefix("nmea:"), found[2]
    if kind != "serial" and not re.fullmatch(r".+:\d{1,5}", place):
        raise InputError(f"--telemetry {text} lacks HOST:PORT; {WANTED}")
    opener = port_opener("tcp" if kind == "gpsd" else kind, place, f"--telemetry {text}")
    return Lines(text, opener, notify, is_datagram=kind == "udp", greeting=_WATCH if kind == "gpsd" else b"")


class Lines:
    """Lines or datagrams from a port, which is opened again when it is lost."""

    system = 0

    def __init__(
        self,
        name: str,
        open_port: Callable[[], Port],
        notify: Notify,
        is_datagram: bool = False,
        greeting: bytes = b"",
        option: str = "--telemetry",
    ) -> None:
        """option: for the message of an InputError."""
        self._name, self._open_port, self._notify = name, open_port, notify
        self._is_datagram, self._greeting = is_datagram, greeting
        self._rest, self._retry_s, self._due_s = b"", _RETRY_S, 0.0
        self._port: Port | None = None
        try:
            self._open()
        except OSError as error:
            raise InputError(f"{option} {name} cannot be opened: {error.strerror or error}; is it there?") from None

    def _open(self) -> None:
        self._port, self._rest = self._open_port(), b""
        if self._greeting:
            self._port.write(self._greeting)

    def receive(self) -> list[Report]:
        """Return the reports that came; wait for a short time for the first, or until the port is tried again."""
        try:
            if self._port is None:
                time.sleep(_POLL_S)
                if time.monotonic() < self._due_s:
                    return []
                self._open()
                self._notify(f"{self._name} is there again")
                self._retry_s = _RETRY_S
            assert self._port is not None
            content = self._port.read()[1]
        except OSError as error:
            if self._port is not None:
                self._notify(f"{self._name} is lost: {error.strerror or error}; it is opened again")
                self.close()
            self._due_s, self._retry_s = time.monotonic() + self._retry_s, min(2 * self._retry_s, _RETRY_MOST_S)
            return []
        now_s = time.time()
        return [(now_s, report) for report in self._reports(content)]

    def _reports(self, content: bytes) -> Iterator[bytes]:
        if self._is_datagram:
            yield from split_reports(content)
            return
        *lines, self._rest = (self._rest + content).split(b"\n")
        yield from (line.rstrip(b"\r") for line in lines if line.strip())
        if len(self._rest) > _LONGEST_LINE:  # no text ends its lines so late; the window reports it as no report
            yield self._rest[:_LONGEST_LINE]
            self._rest = b""

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None


class _FilePort:
    """A file that grows, a FIFO or standard input. A growing file gives its first line, then what is added to it."""

    def __init__(self, name: str) -> None:
        # A FIFO must be opened without waiting for its writer.
        self._file = os.dup(0) if name == "-" else os.open(name, os.O_RDONLY | os.O_NONBLOCK)
        self._grows = stat.S_ISREG(os.fstat(self._file).st_mode) and name != "-"
        self._first = b""
        if self._grows:
            # The names of the columns stand in the first line. Rows that are there already came at an unknown time.
            line, end, _ = os.pread(self._file, _LONGEST_LINE, 0).partition(b"\n")
            self._first = line + end if end and kind_of_report(line) == "csv" else b""
            begin = max(0, os.fstat(self._file).st_size - _LONGEST_LINE)
            tail = os.pread(self._file, _LONGEST_LINE, begin)
            os.lseek(self._file, begin + tail.rfind(b"\n") + 1, os.SEEK_SET)

    def read(self) -> tuple[Any, bytes]:
        if self._first:
            content, self._first = self._first, b""
            return None, content
        if not self._grows and not select.select([self._file], [], [], _POLL_S)[0]:
            return None, b""
        try:
            content = os.read(self._file, _LONGEST_LINE)
        except BlockingIOError:
            content = b""
        if not content:  # nothing was added, or no program writes to the FIFO at present
            time.sleep(_POLL_S / 2)
            if self._grows and os.fstat(self._file).st_size < os.lseek(self._file, 0, os.SEEK_CUR):
                os.lseek(self._file, 0, os.SEEK_SET)  # the file was begun anew
        return None, content

    def write(self, content: bytes) -> None:
        """Do nothing: a file is only read."""

    def close(self) -> None:
        with suppress(OSError):
            os.close(self._file)


class _Packets:
    """Packets that another thread, or the receiver of the pictures, puts into a queue."""

    system = 0

    def __init__(self, queue: deque[Report]) -> None:
        self._queue = queue

    def receive(self) -> list[Report]:
        if not self._queue:
            time.sleep(_POLL_S / 4)
        return [self._queue.popleft() for _ in range(len(self._queue))]

    def close(self) -> None:
        """Do nothing: the queue belongs to its writer."""


class _Mavlink(_Packets):
    """The messages of a MAVLink connection that give a place or an attitude, and heartbeats."""

    def __init__(self, text: str, notify: Notify) -> None:
        super().__init__(deque(maxlen=1000))
        text, self.system = take_system(text, "--telemetry")
        self._link = open_mavlink(text, lambda _, words: notify(words), "--telemetry")
        self._link.subscribe(self._take)

    def _take(self, utc_s: float, message: Any) -> None:
        if message.get_type() in (*MAVLINK_NAMES, "HEARTBEAT"):
            self._queue.append((utc_s, bytes(message.get_msgbuf())))

    def close(self) -> None:
        self._link.close()
