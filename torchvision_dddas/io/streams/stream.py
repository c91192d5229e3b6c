"""Streams of `--emit`, such as `json:-` or `cot:udp://239.2.3.1:6969`: they send results as messages, with retries."""

import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from torchvision_dddas.errors import InputError, without_secrets
from torchvision_dddas.io.streams.connections import open_connection
from torchvision_dddas.io.streams.messages import About, CotEvents, json_lines, mot_lines
from torchvision_dddas.io.streams.mqtt import open_mqtt
from torchvision_dddas.io.streams.outlets import LineOutlet, Outlet, open_datagrams
from torchvision_dddas.io.streams.video import VideoMessages, open_video
from torchvision_dddas.types import FrameResult, TrackedFrame

Notify = Callable[[str, str], object]
"""Called with the kind `sink` and a message for the user."""

Encoder = Callable[[FrameResult | None, TrackedFrame | None, float, int], Sequence[bytes]]
"""Returns the messages of a frame's targets and people. Third: its age, s. Fourth: longest message, 0: no limit."""

WANTED = (
    "wanted json, mot or cot, a colon, and - for standard output, a FILE, HOST:PORT after udp://, tcp:// or tls://, or "
    "HOST:PORT/TOPIC after mqtt://; or video:udp://HOST:PORT; as in json:-"
)

_BEGINS = {"json": b"{", "mot": b"0123456789", "cot": b"<", "video": b""}
_MOST_WAIT_S = 2.0  # longest wait for datagrams, which cost nothing to try
_NOTIFY_S, _SELDOM_S = 30.0, 3600.0  # time between messages on the same loss, initially and finally
_NUMBER = re.compile(r"\d+")


class Stream:
    """Send results, given in order. Trouble of the outlet never ends the run: it is reported once and retried later.

    name: as the user wrote it, without passwords. video: the encoder of a stream of pictures, which the recording
    writes; None for other streams. One thread writes and closes.
    """

    def __init__(
        self,
        name: str,
        encode: Encoder,
        outlet: Outlet,
        notify: Notify,
        retry_s: float = 0.5,
        retry_most_s: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """retry_s: wait before a broken outlet is tried again; it doubles at each try, up to retry_most_s."""
        self.name, self.video = without_secrets(name), encode if isinstance(encode, VideoMessages) else None
        self._encode, self._outlet, self._notify, self._clock = encode, outlet, notify, clock
        self._retry_s, self._retry_most_s = retry_s, retry_most_s
        self._lock = threading.Lock()
        self._trouble = ""  # why nothing can be sent at the moment
        self._wait_s = self._due_s = 0.0
        self._mended_s = -math.inf
        self._failed = self._reported_lost = 0
        self._reason = self._reported_reason = ""
        self._lost_wait_s, self._lost_due_s = 0.0, -math.inf
        self._lost_s = -math.inf  # time of the last loss

    @property
    def lost(self) -> int:
        """Number of permanently lost messages."""
        return self._outlet.lost + self._failed

    def trouble(self) -> str:
        """Return why messages cannot be sent, or were lost in the last 30 s; empty if all is well. Thread-safe."""
        if self._trouble or self._clock() - self._lost_s < _NOTIFY_S:
            return f"{self.name}: {self._trouble or f'{self._reason}; messages are lost'}"
        return ""

    def write(self, result: FrameResult | None, people: TrackedFrame | None = None) -> None:
        """Send a frame: its targets and people, each None if there are none to send. Never raise."""
        tracked = result.tracked if result is not None else people
        if tracked is None:
            return
        age_s = math.nan if tracked.frame is None else self._clock() - tracked.frame.taken_s
        messages: Sequence[bytes] = ()
        defect = ""
        try:
            messages = self._encode(result, people, age_s, self._outlet.most_bytes)
        except Exception as error:  # a defect of this package must not end a run
            defect = f"frame {tracked.number} cannot be encoded, {type(error).__name__}: {error}"
        with self._lock:
            if defect:
                self._failed += 1
                self._reason = defect
            lost = self._outlet.lost
            self._outlet.put(messages)
            self._flush()
            if self._outlet.lost > lost:
                self._reason = self._outlet.reason
            if defect or self._outlet.lost > lost:
                self._lost_s = self._clock()
            if not self._trouble and self.lost > self._reported_lost:
                self._report_lost()

    def sync(self) -> None:
        """Flush sent messages to the disk while `write` continues. Never raise; another thread may call it."""
        file = None
        try:
            with self._lock:
                file = None if self._trouble else self._outlet.handle()
            if file is not None:
                os.fsync(file)
        except OSError as error:
            with self._lock:
                self._retry_later(error)
        finally:
            if file is not None:
                os.close(file)

    def close(self) -> None:
        """Send what can be sent soon, and report losses. Never raise."""
        with self._lock:
            self._outlet.close()
            if self.lost > self._reported_lost:
                self._notify("sink", f"{self.name} closed; {self._newly_lost()}")

    def _flush(self) -> None:
        if self._trouble and self._clock() < self._due_s:
            return
        try:
            if self._trouble:
                self._outlet.mend()
            self._outlet.flush()
        except BlockingIOError:  # a connection is being opened; the next frame goes on with it
            return
        except OSError as error:
            self._retry_later(error)
            return
        if self._trouble:
            self._trouble, self._mended_s = "", self._clock()
            self._notify("sink", f"{self.name} works again; {self._newly_lost()}")

    def _retry_later(self, error: OSError) -> None:
        trouble, now_s = error.strerror or str(error), self._clock()
        # An outlet that works only for a moment is not tried more often.
        steady = not self._trouble and now_s > self._mended_s + self._retry_most_s
        self._wait_s = self._retry_s if steady else min(2 * self._wait_s, self._retry_most_s)
        self._due_s = now_s + self._wait_s
        if trouble != self._trouble:
            self._notify("sink", f"{self.name}: {trouble}; trying again in {self._wait_s:g} s")
        self._trouble = trouble

    def _report_lost(self) -> None:
        """Report losses, less often as long as the reason stays the same."""
        now_s, key = self._clock(), _NUMBER.sub("", self._reason)
        again = key == self._reported_reason
        if again and now_s < self._lost_due_s:
            return
        self._lost_wait_s = min(2 * self._lost_wait_s, _SELDOM_S) if again else _NOTIFY_S
        self._lost_due_s, self._reported_reason = now_s + self._lost_wait_s, key
        self._notify("sink", f"{self.name}: {self._reason}; {self._newly_lost()}")

    def _newly_lost(self) -> str:
        lost, self._reported_lost = self.lost - self._reported_lost, self.lost
        return f"{lost or 'no'} message{'' if lost == 1 else 's'} lost"


def open_streams(
    texts: Sequence[str],
    about: About,
    notify: Notify,
    retry_s: float = 0.5,
    retry_most_s: float = 30.0,
    option: str = "--emit",
) -> list[Stream]:
    """Open all streams or none. Raise InputError as open_stream does, and if two would write to one file."""
    places: dict[str, str] = {}
    for text in texts:
        place = text.partition(":")[2]
        if _is_address(place):
            continue
        real = place if place == "-" else os.path.realpath(_path(place, f"{option} {text}"))
        if real in places:
            raise InputError(
                f"{option} {places[real]} and {option} {text} go to the same place; choose another for one"
            )
        places[real] = text
    with ExitStack() as opened:
        streams = []
        for text in texts:
            streams.append(open_stream(text, about, notify, retry_s, retry_most_s, option))
            opened.callback(streams[-1].close)
        opened.pop_all()
    return streams


def open_stream(
    text: str, about: About, notify: Notify, retry_s: float = 0.5, retry_most_s: float = 30.0, option: str = "--emit"
) -> Stream:
    """Open a stream. notify: called when it breaks and when it works again. retry_s, retry_most_s: as in Stream.

    Raise InputError: an unknown kind, a file that cannot be written or holds something else, an unknown host, or
    events without places.
    """
    kind, colon, place = text.partition(":")
    is_address, scheme = _is_address(place), place.partition(":")[0].lower()
    is_datagram = scheme == "udp"
    # The query of a connection names the files of its keys.
    asked = f"{option} {without_secrets(text).partition('?')[0] if is_address and not is_datagram else text}"
    if kind not in _BEGINS or not colon or not place or ("://" in place and not is_address):
        raise InputError(f"{option} {text!r} is no stream; {WANTED}")
    encode: Encoder
    if kind == "json":
        encode = partial(json_lines, about)
    elif kind == "mot":
        encode = mot_lines
    elif kind == "video":
        encode = VideoMessages(about)
    elif about.geographic:
        encode = CotEvents(about)
    else:
        raise InputError(
            f"{asked}: such events need longitudes and latitudes; give --landmarks or --telemetry in degrees, or "
            "emit json instead"
        )
    try:
        outlet: Outlet
        if kind == "video":
            outlet = open_video(place, asked)
        elif is_datagram:
            outlet = open_datagrams(place, asked)
        elif scheme.startswith("mqtt") and is_address:
            outlet = open_mqtt(place, asked)
        else:
            outlet = open_connection(place, asked) if is_address else _open_lines(place, kind, asked)
    except (OSError, UnicodeError) as error:  # the latter for a name that no host can have
        raise InputError(f"{asked}: {getattr(error, 'strerror', '') or error}; choose another place") from None
    return Stream(
        text, encode, outlet, notify, retry_s, min(retry_most_s, _MOST_WAIT_S) if is_datagram else retry_most_s
    )


def _is_address(place: str) -> bool:
    return place.lower().startswith(("udp:", "tcp:", "tls:", "mqtt:", "mqtts:"))


def _path(place: str, asked: str) -> Path:
    try:
        if "\0" in place:
            raise ValueError("a zero byte is in no file's name")
        return Path(place).expanduser()
    except (RuntimeError, ValueError) as error:  # ~nobody
        raise InputError(f"{asked!r}: {error}; choose another place") from None


def _open_lines(place: str, kind: str, asked: str) -> LineOutlet:
    if place == "-":
        if sys.__stdout__ is None:
            raise OSError("standard output is closed")
        return LineOutlet(None)
    path = _path(place, asked)
    if path.is_file() and os.access(path, os.R_OK):
        with path.open("rb") as file:
            first = file.read(1)
        if first not in _BEGINS[kind]:  # true for an empty file
            raise InputError(f"{asked}: the file holds something else than {kind}; choose another file")
    return LineOutlet(path)
