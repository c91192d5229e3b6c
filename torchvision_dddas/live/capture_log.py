"""What the capture tells of itself: events that do not flood, the machine's clock, how many pictures really come."""

from collections.abc import Callable

import numpy as np

from torchvision_dddas.live.clock import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Problem

# What happens again and again is told so often; the counts tell the rest.
_QUIET_S = 10.0
# The machine's clock was set, not slowed or hurried, where it jumps by this against the one that only goes forward.
_CLOCK_SET_S = 0.5
# How long pictures are counted to know how many come a second.
_COUNTED_S = 2.0
_PROBLEMS = 64


class Diary:
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
