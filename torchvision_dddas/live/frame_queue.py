"""What the capture thread and the run share: few waiting frames, the log of the capture, and the clock."""

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Frame, Problem

# What happens again and again is told so often; the counts tell the rest.
_QUIET_S = 10.0
# The machine's clock was set, not slowed or hurried, where it jumps by this against the one that only goes forward.
_CLOCK_SET_S = 0.5
# How long pictures are counted to know how many come a second.
_COUNTED_S = 2.0
_PROBLEMS = 64


class Clock:
    """The clocks of this machine."""

    def now(self) -> float:
        """Seconds that only go forward."""
        return time.monotonic()

    def utc(self) -> float:
        """Seconds since 1970, as far as the machine knows."""
        return time.time()

    def wait(self, changed: threading.Condition, seconds: float | None = None) -> None:
        """Until someone notifies the condition, which the caller holds, or so many seconds are over."""
        changed.wait(seconds)


class FrameQueue:
    """Filled by one thread, emptied by another. changed: guards it and all that these two share.

    begun: somebody takes pictures. ended: no more come. closed: none is wanted any more.
    """

    def __init__(self, room: int, health: Health, clock: Clock) -> None:
        self.changed = threading.Condition()
        self.begun = self.ended = self.closed = False
        self.every = 1
        self._room, self._health, self._clock = room, health, clock
        self._waiting: deque[Frame] = deque()
        self._newest = 0  # number of the frame that was put in last

    def wanted(self, number: int) -> bool:
        """Whether a frame is one of those to look at."""
        return self.begun and (not self._newest or number - self._newest >= self.every)

    def put(self, frame: Frame) -> None:
        """Put a frame in the place of the oldest, where there is no room."""
        with self.changed:
            self._newest = frame.number
            while len(self._waiting) >= self._room:
                self._waiting.popleft()
                self._health.count("dropped")
            self._waiting.append(frame)
            self._told()

    def take(self, until_s: float | None = None) -> Frame | None:
        """The oldest frame; None when no more come or none is wanted, or when it is until_s."""
        with self.changed:
            while not self._waiting and not self.ended and not self.closed:
                left = None if until_s is None else until_s - self._clock.now()
                if left is not None and left <= 0:
                    return None
                self._clock.wait(self.changed, left)
            if self.closed or not self._waiting:
                return None
            frame = self._waiting.popleft()
            self._told()
            return frame

    @property
    def over(self) -> bool:
        """Whether nothing will be taken any more."""
        return self.closed or (self.ended and not self._waiting)

    def make_room(self) -> None:
        """Wait until there is room, or none is wanted."""
        with self.changed:
            while len(self._waiting) >= self._room and not self.closed:
                self._clock.wait(self.changed)

    def sleep(self, until_s: float) -> None:
        """Until it is until_s, or none is wanted."""
        with self.changed:
            while not self.closed and (left := until_s - self._clock.now()) > 0:
                self._clock.wait(self.changed, left)

    def begin(self) -> bool:
        """Somebody takes pictures from now on; returns whether nobody did before."""
        with self.changed:
            first, self.begun = not self.begun, True
            self.changed.notify_all()
            return first

    def end(self) -> None:
        """No more frames come."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()

    def close(self) -> None:
        """No frame is wanted any more: whoever waits, on either side, goes on."""
        with self.changed:
            self.closed = True
            self.changed.notify_all()

    def _told(self) -> None:
        self._health.gauge("queue", len(self._waiting))
        self.changed.notify_all()


class CaptureLog:
    """Kept by the camera's thread. number: of the newest frame captured. start_utc_s: see LiveSource.

    sent_hz: pictures that came a second, lately; None while that is not known.
    """

    def __init__(self, health: Health, clock: Clock) -> None:
        self.number = 0
        self.start_utc_s = float("nan")
        self.sent_hz: float | None = None
        self.problems: list[Problem] = []
        self._health, self._clock = health, clock
        self._told_s: dict[str, float] = {}
        self._ahead_s = float("nan")  # of the machine's clock before the one that only goes forward
        self._count, self._since_s = 0, float("nan")

    def tell(self, what: str, number: int | None = None, topic: str = "") -> None:
        """An event. topic: what may happen often is told once in a while."""
        now_s, number = self._clock.now(), self.number if number is None else number
        if topic and now_s - self._told_s.get(topic, -np.inf) < _QUIET_S:
            return
        if topic:
            self._told_s[topic] = now_s
        self._health.event("stream", what, number)
        self.problems.append(Problem(number, what))
        del self.problems[:-_PROBLEMS]

    def captured(self, taken_s: float, note: Callable[[float], object] = lambda sent_hz: None) -> None:
        """A picture came. note: called with how many come a second, whenever that is known anew."""
        self._health.count("captured")
        ahead_s = self._clock.utc() - self._clock.now()
        if np.isnan(self.start_utc_s):
            self.start_utc_s, self._ahead_s = ahead_s + taken_s, ahead_s
        elif abs(jump_s := ahead_s - self._ahead_s) > _CLOCK_SET_S:
            self.start_utc_s += jump_s
            self._ahead_s = ahead_s
            which = "forward" if jump_s > 0 else "back"
            self.tell(f"the machine's clock was set {which} by {abs(jump_s):.1f} s; times of day follow", topic="clock")
        if np.isnan(self._since_s):
            self.restart(taken_s)
            return
        self._count += 1
        if (spent_s := taken_s - self._since_s) >= _COUNTED_S:
            self.sent_hz = self._count / spent_s
            self._health.gauge("rate_hz", self.sent_hz)
            note(self.sent_hz)
            self.restart(taken_s)

    def restart(self, since_s: float = float("nan")) -> None:
        """Count pictures from now on, or from the next one: what was before is no measure."""
        self._count, self._since_s = 0, since_s
