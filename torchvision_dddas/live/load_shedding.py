"""Less is looked at where it takes too long: the rule of `control.shed`, fed with what looks take."""

from collections import deque
from typing import Protocol

import numpy as np

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.control import rules as control
from torchvision_dddas.live.frame_queue import Clock
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Adjustment, Frame

# The mean of so many looks, but for the longest of them, is what a look takes: a step of anything else is none of ours.
_LOOKS = 10
_FEWEST = 5


class Paced(Protocol):
    """What is needed of a live source."""

    @property
    def apart_s(self) -> float:
        """Seconds from picture to picture; 0 where they wait for the run."""
        ...

    @property
    def busy_s(self) -> float:
        """What the last look took."""
        ...

    def look_at(self, every: int) -> None:
        """Of so many pictures one is handed on."""


class LoadShedding:
    """Asked before each frame, as `run.run` does: the settings that keep up with the source, and what changed.

    settings: those in force. people: whether people are searched for, so that their search can be narrowed.
    """

    def __init__(
        self,
        source: Paced,
        settings: Settings,
        health: Health | None = None,
        people: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.settings, self.load = settings, control.Load()
        self._source, self._base, self._people = source, settings, people
        self._health, self._clock = health or Health(), clock or Clock()
        self._costs: deque[float] = deque(maxlen=_LOOKS)
        self._asked = False
        self._show(control.rungs(settings, people)[0])

    def __call__(self, frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
        """The settings from this frame on, and the record of what changed."""
        if not self._asked:  # nothing has been looked at
            self._asked = True
            return self.settings, ()
        self._costs.append(self._source.busy_s)
        if len(self._costs) < _FEWEST:
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
        self._costs.clear()  # what was measured is no longer so
        self._show(rung)
        words = ", ".join(f"{a.parameter} {a.old:g} -> {a.new:g}" for a in moved)
        self._health.event("load", f"{words}: {moved[0].cause}", number)

    def _show(self, rung: dict[str, float]) -> None:
        self._health.gauge("every", rung[control.SAMPLING])
        self._health.gauge("keypoints", rung["registration.keypoints"])
