"""The frames of a clip that windows may still use: their views, registrations and observations, by index."""

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from torchvision_dddas.chain import View
from torchvision_dddas.detection.interval import DistanceSettings
from torchvision_dddas.detection.observation import Observation
from torchvision_dddas.geometry import chain
from torchvision_dddas.types import Adjustment, Frame, Registration

# A picture whose grey levels have a smaller standard deviation is blank: even fog shows more.
_BLANK_LEVELS = 1.0


@dataclass
class Slot:
    """One frame in flight. look: its number if frames that are skipped on purpose, or repeated, did not count.

    passed: those frames since the slot before. step: registration to the next slot; None while unknown and at the end.
    interval: 0 until it is chosen. repeats: the frames that repeat this one. cause: why nothing can be found in it.
    """

    frame: Frame
    view: View
    look: int
    passed: int
    distance: DistanceSettings
    adjustments: tuple[Adjustment, ...]
    seconds: dict[str, float]
    step: Registration | None = None
    interval: int = 0
    repeats: list[Frame] = field(default_factory=list)
    observation: Observation = field(default_factory=Observation)
    cause: str = ""

    @cached_property
    def is_blank(self) -> bool:
        """Whether the picture shows nothing that could be registered."""
        return float(self.view.grey[::4, ::4].std()) < _BLANK_LEVELS

    @property
    def next_from_this(self) -> np.ndarray | None:
        """(3, 3) registration to the next frame; None if it is unknown or unreliable."""
        return self.step.later_from_earlier if self.step is not None and self.step.reliable else None


class FrameBuffer:
    """Slots by index; indices count the frames that were read. first, total: the first that is kept, and the end."""

    def __init__(self) -> None:
        self.first = self.total = 0
        self._slots: deque[Slot] = deque()

    def __getitem__(self, index: int) -> Slot:
        return self._slots[index - self.first]

    def append(self, slot: Slot) -> None:
        """Add the next frame."""
        self._slots.append(slot)
        self.total += 1

    def span(self, first: int, end: int) -> list[Slot]:
        """The slots from `first` on, as far as they are kept, below `end`."""
        return [self[index] for index in range(max(first, self.first), end)]

    def step_before(self, index: int) -> Registration | None:
        """The registration from the frame before."""
        return self[index - 1].step if index > self.first else None

    def this_from_last(self, index: int) -> np.ndarray | None:
        """(3, 3) the registration from the frame before; None if it is unknown or unreliable."""
        return self[index - 1].next_from_this if index > self.first else None

    def linked(self, index: int, least: int, most: int) -> tuple[int, int]:
        """The first and last frame, within least..most, that reliable steps link to this one."""
        first = last = index
        while first > max(self.first, least) and self.this_from_last(first) is not None:
            first -= 1
        while last < most and self[last].next_from_this is not None:
            last += 1
        return first, last

    def motion(self, index: int, other: int) -> np.ndarray:
        """Return the homography (3, 3) of the background from a frame to another one, chained over reliable steps."""
        steps = [slot.step for slot in self.span(min(index, other), max(index, other))]
        last_from_first = chain([step.later_from_earlier for step in steps if step is not None])
        return last_from_first if other > index else np.linalg.inv(last_from_first)

    def set_steps(self, first: int, steps: list[Registration], seconds: float) -> None:
        """Keep the registrations of successive frames, which took so many seconds each."""
        for index, step in enumerate(steps, first):
            # Tracking onto a blank picture seems to succeed: keypoints stay where the search began.
            is_blank = self[index].is_blank or self[index + 1].is_blank
            self[index].step = replace(step, reliable=False, cause="the picture is blank") if is_blank else step
            self[index].seconds["register"] = seconds

    def drop_colours(self, index: int) -> None:
        """Keep the grey picture of a frame alone, if the frame is kept: colour is most of the memory."""
        if index >= self.first:
            self[index].view.image = self[index].view.grey

    def drop_before(self, index: int) -> None:
        """Let go of the frames before an index."""
        while self.first < index:
            self._slots.popleft()
            self.first += 1
