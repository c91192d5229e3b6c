"""A stream of messages: results in, messages out, with retries while they cannot be sent."""

import math
import os
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from torchvision_dddas.types import FrameResult, TrackedFrame

Notify = Callable[[str, str], object]
"""Called with the kind `sink` and a message for the user."""

_NOTIFY_S, _SELDOM_S = 30.0, 3600.0  # between two messages on the same loss, at first and at last
_NUMBER = re.compile(r"\d+")


@dataclass
class About:
    """What messages need to know of the run.

    start_utc_s: seconds since 1970 at time_s = 0, NaN while no clock is known. A live run sets it with its first
    picture, and again when the machine's clock is set. clock: whether it will be known. geographic: whether targets get
    longitudes and latitudes. landmarks: their names. source: what the run is called in Cursor-on-Target events.
    """

    start_utc_s: float = float("nan")
    geographic: bool = False
    landmarks: tuple[str, ...] = ()
    source: str = "dddas"
    clock: bool = True


class Outlet(Protocol):
    """Takes messages one after another and never waits long.

    most_bytes: of a message, 0 for any. lost: messages lost so far. reason: why the last of them was lost.
    """

    most_bytes: int
    lost: int
    reason: str

    def put(self, messages: Sequence[bytes]) -> None:
        """Keep messages until they can be sent; beyond a limit the oldest are lost."""

    def flush(self) -> None:
        """Send as much as is accepted now, each message whole or not at all. Raises OSError on trouble."""

    def mend(self) -> None:
        """Reopen after trouble. Raises OSError if that fails."""

    def handle(self) -> int | None:
        """A new descriptor of the file to be synced, which the caller closes; None if there is no file."""

    def close(self) -> None:
        """Send what can be sent soon and count the rest as lost. Never raises."""


class Encoder(Protocol):
    """Makes messages of a frame."""

    def __call__(
        self, result: FrameResult | None, people: TrackedFrame | None, age_s: float, most_bytes: int
    ) -> Sequence[bytes]:
        """Messages with line ends, of at most most_bytes where possible; 0: of any length."""


class Stream:
    """Sends results, given in order. Trouble of the outlet never ends the run: it is reported once and retried later.

    name: as the user wrote it. sent: number of messages given to the outlet. One thread writes and closes.
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
        """retry_s: a broken outlet is tried again after this, then twice that, up to retry_most_s."""
        self.name = name
        self.sent = 0
        self._encode, self._outlet, self._notify, self._clock = encode, outlet, notify, clock
        self._retry_s, self._retry_most_s = retry_s, retry_most_s
        self._lock = threading.Lock()
        self._trouble = ""
        self._wait_s = self._due_s = 0.0
        self._mended_s = -math.inf
        self._failed = self._reported_lost = 0
        self._reason = self._reported_reason = ""
        self._lost_wait_s, self._lost_due_s = 0.0, -math.inf

    @property
    def lost(self) -> int:
        """Messages lost for good."""
        return self._outlet.lost + self._failed

    @property
    def trouble(self) -> str:
        """Why nothing can be sent at the moment; empty if it can."""
        return self._trouble

    def write(self, result: FrameResult | None, people: TrackedFrame | None = None) -> None:
        """Send a frame: its targets and people, each None if it has none to send. Never raises."""
        followed = result.tracked if result is not None else people
        if followed is None:
            return
        age_s = float("nan") if followed.frame is None else self._clock() - followed.frame.taken_s
        messages: Sequence[bytes] = ()
        defect = ""
        try:
            messages = self._encode(result, people, age_s, self._outlet.most_bytes)
        except Exception as error:  # a defect of this package must not end a run
            defect = f"frame {followed.number} cannot be told, {type(error).__name__}: {error}"
        with self._lock:
            if defect:
                self._failed += 1
                self._reason = defect
            lost = self._outlet.lost
            self.sent += len(messages)
            self._outlet.put(messages)
            self._flush()
            if self._outlet.lost > lost:
                self._reason = self._outlet.reason
            if not self._trouble and self.lost > self._reported_lost:
                self._report_lost(self._reason)

    def sync(self) -> None:
        """Flush what was sent to the disk while `write` goes on. Never raises; another thread may call it."""
        file = None
        try:
            with self._lock:
                file = None if self._trouble else self._outlet.handle()
            if file is not None:
                os.fsync(file)
        except OSError as error:
            with self._lock:
                self._broke(error)
        finally:
            if file is not None:
                os.close(file)

    def close(self) -> None:
        """Send what can be sent soon, and report what was lost. Never raises."""
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
        except OSError as error:
            self._broke(error)
            return
        if self._trouble:
            self._trouble, self._mended_s = "", self._clock()
            self._notify("sink", f"{self.name} works again; {self._newly_lost()}")

    def _broke(self, error: OSError) -> None:
        trouble, now_s = error.strerror or str(error), self._clock()
        # An outlet that works for a moment only is not tried more often.
        steady = not self._trouble and now_s > self._mended_s + self._retry_most_s
        self._wait_s = self._retry_s if steady else min(2 * self._wait_s, self._retry_most_s)
        self._due_s = now_s + self._wait_s
        if trouble != self._trouble:
            self._notify("sink", f"{self.name}: {trouble}; trying again in {self._wait_s:g} s")
        self._trouble = trouble

    def _report_lost(self, reason: str) -> None:
        """Report losses, less and less often while the reason stays the same."""
        now_s, key = self._clock(), _NUMBER.sub("", reason)
        if key == self._reported_reason and now_s < self._lost_due_s:
            return
        again = key == self._reported_reason
        self._lost_wait_s = min(2 * self._lost_wait_s, _SELDOM_S) if again else _NOTIFY_S
        self._lost_due_s, self._reported_reason = now_s + self._lost_wait_s, key
        self._notify("sink", f"{self.name}: {reason}; {self._newly_lost()}")

    def _newly_lost(self) -> str:
        lost, self._reported_lost = self.lost - self._reported_lost, self.lost
        return f"{lost or 'no'} message{'' if lost == 1 else 's'} lost"
