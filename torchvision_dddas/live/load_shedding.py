"""Load shedding: cheaper settings and fewer frames while the work on a frame takes too long."""

from collections import deque

import numpy as np

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.control import rules as control
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.frame_queue import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Adjustment, Frame

# The cost of a frame is the mean of the latest, without the longest of them: that one may wait for something else.
_MOST_FRAMES = 10
_FEWEST_FRAMES = 5


class LoadShedding:
    """Applies the rule `control.shed`. Call it before each frame; it returns the settings that keep up with the source.

    settings: those in force. people: whether people are searched for, so that their search can be narrowed.
    """

    def __init__(
        self,
        source: LiveSource,
        settings: Settings,
        health: Health | None = None,
        people: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.settings, self.load = settings, control.Load()
        self._source, self._base, self._people = source, settings, people
        self._health, self._clock = health or Health(), clock or Clock()
        self._costs: deque[float] = deque(maxlen=_MOST_FRAMES)
        self._has_begun = False
        self._show(control.rungs(settings, people)[0])

    def __call__(self, frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
        """The settings from this frame on, and the record of what changed."""
        if not self._has_begun:  # no frame was processed before the first
            self._has_begun = True
            return self.settings, ()
        self._costs.append(self._source.busy_s)
        if len(self._costs) < _FEWEST_FRAMES:
            return self.settings, ()
        cost_s = float(np.mean(sorted(self._costs)[:-1]))
        was = self.load.rung
        self.load, moved = control.shed(
            frame.number, self.load, cost_s, self._source.apart_s, self._clock.now(), self._base, self._people
        )
        if self.load.rung != was:
            self._change(moved, frame.number)
        return self.settings, moved

    def _change(self, moved: tuple[Adjustment, ...], number: int) -> None:
        rung = control.rungs(self._base, self._people)[self.load.rung]
        self.settings = with_parameters(
            self._base, {name: value for name, value in rung.items() if name != control.SAMPLING}
        )
        self._source.look_at(int(rung[control.SAMPLING]))
        self._costs.clear()  # measured with the settings before
        self._show(rung)
        words = ", ".join(f"{a.parameter} {a.old:g} -> {a.new:g}" for a in moved)
        self._health.event("load", f"{words}: {moved[0].cause}", number)

    def _show(self, rung: dict[str, float]) -> None:
        self._health.gauge("every", rung[control.SAMPLING])
        self._health.gauge("keypoints", rung["registration.keypoints"])
