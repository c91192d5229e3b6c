"""State shared by the capture thread and the run: a short queue of frames, the log of the capture, and the clock."""

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Frame, Problem

# An event that may happen often is reported once in this time; the counts include every occurrence.
_QUIET_S = 10.0
# A larger jump of the time of day against the monotonic clock shows that the clock was set.
_CLOCK_SET_S = 0.5
# The rate is measured over _COUNTED_S, starting _GATHERED_S after a stream was joined.
_COUNTED_S, _GATHERED_S = 2.0, 2.0
_PROBLEMS = 64


class Clock:
    """The clocks of this machine."""

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def utc(self) -> float:
        """Seconds since 1970."""
        return time.time()

    def wait(self, changed: threading.Condition, seconds: float | None = None) -> None:
        """Wait for the condition, which the caller holds, for at most `seconds`."""
        changed.wait(seconds)


class FrameQueue:
    """A queue with one thread on each side. A full queue drops its oldest frame.

    changed: condition that guards the queue and all state shared by the threads. begun: the run takes frames. ended:
    the source gives no more frames. closed: the run takes no more frames, and no thread waits. every: the run wants one
    of `every` frames.
    """

    def __init__(self, room: int, health: Health, clock: Clock) -> None:
        self.changed = threading.Condition()
        self.begun = self.ended = self.closed = False
        self.every = 1
        self._room, self._health, self._clock = room, health, clock
        self._waiting: deque[Frame] = deque()
        self._newest = 0  # number of the newest frame

    def wanted(self, number: int) -> bool:
        """Whether the run wants a frame."""
        return self.begun and (not self._newest or number - self._newest >= self.every)

    def put(self, frame: Frame) -> None:
        """Add a frame; drop the oldest if there is no room."""
        with self.changed:
            self._newest = frame.number
            while len(self._waiting) >= self._room:
                self._waiting.popleft()
                self._health.count("dropped")
            self._waiting.append(frame)
            self._notify()

    def take(self, until_s: float | None = None) -> Frame | None:
        """Wait for the oldest frame; None if the queue is ended or closed, or at the time until_s."""
        with self.changed:
            while not self._waiting and not self.ended and not self.closed:
                left = None if until_s is None else until_s - self._clock.now()
                if left is not None and left <= 0:
                    return None
                self._clock.wait(self.changed, left)
            if self.closed or not self._waiting:
                return None
            frame = self._waiting.popleft()
            self._notify()
            return frame

    @property
    def over(self) -> bool:
        """Whether no further frame can be taken."""
        return self.closed or (self.ended and not self._waiting)

    def make_room(self) -> None:
        """Wait until there is room, or the queue is closed."""
        with self.changed:
            while len(self._waiting) >= self._room and not self.closed:
                self._clock.wait(self.changed)

    def sleep(self, until_s: float) -> None:
        """Wait until the time until_s, or until the queue is closed."""
        with self.changed:
            while not self.closed and (left := until_s - self._clock.now()) > 0:
                self._clock.wait(self.changed, left)

    def note(self, begun: bool = False, ended: bool = False, closed: bool = False) -> None:
        """Set flags, and wake all waiting threads."""
        with self.changed:
            self.begun, self.ended, self.closed = self.begun or begun, self.ended or ended, self.closed or closed
            self.changed.notify_all()

    def _notify(self) -> None:
        self._health.gauge("queue", len(self._waiting))
        self.changed.notify_all()


class CaptureLog:
    """Records of the capture thread. number: number of the newest frame. start_utc_s, problems: as in LiveSource.

    sent_hz: the latest measured rate; None before the first measurement.
    """

    def __init__(self, health: Health, clock: Clock) -> None:
        self.number = 0
        self.start_utc_s = float("nan")
        self.sent_hz: float | None = None
        self.problems: list[Problem] = []
        self._health, self._clock = health, clock
        self._reported_s: dict[str, float] = {}
        self._ahead_s = float("nan")  # time of day minus monotonic time
        self._count, self._joined_s, self._since_s = 0, float("nan"), float("nan")

    def report(self, what: str, number: int | None = None, topic: str = "") -> None:
        """Record an event and a problem. topic: name for frequent events, of which one is kept every 10 s."""
        now_s, number = self._clock.now(), self.number if number is None else number
        if topic and now_s - self._reported_s.get(topic, -np.inf) < _QUIET_S:
            return
        if topic:
            self._reported_s[topic] = now_s
        self._health.event("stream", what, number)
        self.problems.append(Problem(number, what))
        del self.problems[:-_PROBLEMS]

    def damaged(self, what: str, number: int | None = None, topic: str = "damage") -> None:
        """Report damage to the pictures, as a trouble for the next 10 s."""
        self.report(what, number, topic)
        self._health.trouble("damage", what, _QUIET_S)

    def captured(self, taken_s: float, note: Callable[[float], object] = lambda sent_hz: None) -> None:
        """Count a picture taken at taken_s. note: called with each new measurement of the rate, Hz."""
        self._health.count("captured")
        ahead_s = self._clock.utc() - self._clock.now()
        if np.isnan(self.start_utc_s):
            self.start_utc_s, self._ahead_s = ahead_s + taken_s, ahead_s
        elif abs(jump_s := ahead_s - self._ahead_s) > _CLOCK_SET_S:
            self.start_utc_s += jump_s
            self._ahead_s = ahead_s
            which = "forward" if jump_s > 0 else "back"
            what = f"the machine's clock was set {which} by {abs(jump_s):.1f} s; times of day follow"
            self._health.count("clock_jumps")
            self.report(what, topic=f"clock {which}")
        if np.isnan(self._joined_s):
            self._joined_s = taken_s
        # Pictures that the driver gathered while it opened the stream arrive at once, so they are not counted.
        if taken_s - self._joined_s < _GATHERED_S:
            return
        if np.isnan(self._since_s):
            self._count, self._since_s = 0, taken_s
            return
        self._count += 1
        if (spent_s := taken_s - self._since_s) >= _COUNTED_S:
            self.sent_hz = self._count / spent_s
            self._health.gauge("sent_hz", self.sent_hz)
            note(self.sent_hz)
            self._count, self._since_s = 0, taken_s

    def restart(self) -> None:
        """Measure the rate again, because a stream is joined with the next picture."""
        self._joined_s = self._since_s = float("nan")
