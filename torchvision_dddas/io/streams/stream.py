"""A stream of messages: frames in, messages out, and retries while nobody takes them."""

import math
import os
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from torchvision_dddas.types import FrameResult, TrackedFrame

Tell = Callable[[str, str], object]
"""Called with a kind, `sink`, and words for a person."""

_TELL_S, _SELDOM_S = 30.0, 3600.0  # between two words on the same loss, at first and at last
_NUMBER = re.compile(r"\d+")


@dataclass
class About:
    """What hardly changes from frame to frame.

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
    """A place that takes messages, one after another, without ever waiting long.

    most_bytes: of a message; 0: any. lost: messages that nobody got so far; reason: why the last of them, in words.
    """

    most_bytes: int
    lost: int
    reason: str

    def put(self, messages: Sequence[bytes]) -> None:
        """Keep messages until they can be sent. What is kept is bounded: then the oldest are lost."""

    def flush(self) -> None:
        """Send what is kept as far as it is taken now, each message whole or not at all. Raises OSError on trouble."""

    def mend(self) -> None:
        """After trouble: make ready to send again. Raises OSError if it cannot."""

    def handle(self) -> int | None:
        """A new descriptor of the file that was written, for whoever puts it on the disk; None where there is none."""

    def close(self) -> None:
        """Send what can be sent soon and count the rest as lost. Never raises."""


class Encoder(Protocol):
    """What makes messages of a frame."""

    def __call__(
        self, surveyed: FrameResult | None, people: TrackedFrame | None, age_s: float, most_bytes: int
    ) -> Sequence[bytes]:
        """Messages with their line ends, of most_bytes at most where that can be; 0: of any length."""


class Stream:
    """Feed it frames in order. No trouble of the outlet ends the run: it is told once, and tried again with back-off.

    name: as the user wrote it. sent: messages that there were to send. One thread writes and closes.
    """

    def __init__(
        self,
        name: str,
        encode: Encoder,
        outlet: Outlet,
        tell: Tell,
        retry_s: float = 0.5,
        retry_most_s: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """retry_s: a broken outlet is tried again after this, then twice that, up to retry_most_s."""
        self.name = name
        self.sent = 0
        self._encode, self._outlet, self._tell, self._clock = encode, outlet, tell, clock
        self._retry_s, self._retry_most_s = retry_s, retry_most_s
        self._lock = threading.Lock()
        self._trouble = ""
        self._wait_s = self._due_s = 0.0
        self._mended_s = -math.inf
        self._untold = self._told_lost = 0
        self._reason = self._told_reason = ""
        self._lost_wait_s, self._lost_due_s = 0.0, -math.inf

    @property
    def lost(self) -> int:
        """Messages that nobody will get."""
        return self._outlet.lost + self._untold

    @property
    def trouble(self) -> str:
        """Why nothing goes out at the moment; empty where all is well."""
        return self._trouble

    def write(self, surveyed: FrameResult | None, people: TrackedFrame | None = None) -> None:
        """Send a frame: its targets, and the people seen in it; None: not told, or not searched for. Never raises."""
        followed = surveyed.tracked if surveyed is not None else people
        if followed is None:
            return
        age_s = float("nan") if followed.frame is None else self._clock() - followed.frame.taken_s
        messages: Sequence[bytes] = ()
        defect = ""
        try:
            messages = self._encode(surveyed, people, age_s, self._outlet.most_bytes)
        except Exception as error:  # a defect of ours: still no reason to end a run
            defect = f"frame {followed.number} cannot be told, {type(error).__name__}: {error}"
        with self._lock:
            if defect:
                self._untold += 1
                self._reason = defect
            lost = self._outlet.lost
            self.sent += len(messages)
            self._outlet.put(messages)
            self._flush()
            if self._outlet.lost > lost:
                self._reason = self._outlet.reason
            if not self._trouble and self.lost > self._told_lost:
                self._tell_lost(self._reason)

    def sync(self) -> None:
        """Put what was sent where a loss of power leaves it. Never raises; another thread may call it: nobody waits."""
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
        """Send what can be sent soon, and say what was lost. Never raises."""
        with self._lock:
            self._outlet.close()
            if self.lost > self._told_lost:
                self._tell("sink", f"{self.name} closed; {self._newly_lost()}")

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
            self._tell("sink", f"{self.name} works again; {self._newly_lost()}")

    def _broke(self, error: OSError) -> None:
        trouble, now_s = error.strerror or str(error), self._clock()
        # What works for a moment only is tried no oftener for that.
        steady = not self._trouble and now_s > self._mended_s + self._retry_most_s
        self._wait_s = self._retry_s if steady else min(2 * self._wait_s, self._retry_most_s)
        self._due_s = now_s + self._wait_s
        if trouble != self._trouble:
            self._tell("sink", f"{self.name}: {trouble}; trying again in {self._wait_s:g} s")
        self._trouble = trouble

    def _tell_lost(self, reason: str) -> None:
        """Now and then, less and less often while the reason stays the same."""
        now_s, key = self._clock(), _NUMBER.sub("", reason)
        if key == self._told_reason and now_s < self._lost_due_s:
            return
        again = key == self._told_reason
        self._lost_wait_s = min(2 * self._lost_wait_s, _SELDOM_S) if again else _TELL_S
        self._lost_due_s, self._told_reason = now_s + self._lost_wait_s, key
        self._tell("sink", f"{self.name}: {reason}; {self._newly_lost()}")

    def _newly_lost(self) -> str:
        """In words, what was lost since it was last told."""
        lost, self._told_lost = self.lost - self._told_lost, self.lost
        return f"{lost or 'no'} message{'' if lost == 1 else 's'} lost"
