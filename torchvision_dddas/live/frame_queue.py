"""Where pictures wait between the camera's thread and the run: few, and of more the oldest is dropped."""

import threading
from collections import deque

from torchvision_dddas.live.clock import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Frame


class Inbox:
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
