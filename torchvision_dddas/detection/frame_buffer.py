"""Keep the frames of a clip that later windows may use, with their views, registrations and observations, by index."""

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from torchvision_dddas.chain import View
from torchvision_dddas.detection.interval import DistanceSettings
from torchvision_dddas.detection.observation import Observation
from torchvision_dddas.geometry import chain
from torchvision_dddas.types import Adjustment, Frame, Registration

# A picture is blank if its grey levels have a smaller standard deviation; pictures of fog have a larger deviation.
_BLANK_LEVELS = 1.0


@dataclass
class Slot:
    """A frame in process, with its intermediate results.

    look: the frame's number without the frames that were skipped on purpose or are repeats. passed: number of such
    frames since the previous slot. step: registration to the next slot; None until it is computed, and for the last
    slot. interval: detection interval, 0 until it is chosen. repeats: the frames that repeat this frame. cause: why
    detection is impossible in this frame, else "".
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
        """Whether the picture has too little contrast to be registered."""
        return float(self.view.grey[::4, ::4].std()) < _BLANK_LEVELS

    @property
    def next_from_this(self) -> np.ndarray | None:
        """The (3, 3) registration to the next frame; None if it is unknown or unreliable."""
        return self.step.later_from_earlier if self.step is not None and self.step.reliable else None


class FrameBuffer:
    """The slots of a clip by index, which counts frames read. first: the oldest index kept. total: frames read."""

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
        """Return the slots from `first` to below `end` that are still kept."""
        return [self[index] for index in range(max(first, self.first), end)]

    def step_before(self, index: int) -> Registration | None:
        """Return the registration from the frame before, or None."""
        return self[index - 1].step if index > self.first else None

    def this_from_last(self, index: int) -> np.ndarray | None:
        """Return the (3, 3) registration from the frame before; None if it is unknown or unreliable."""
        return self[index - 1].next_from_this if index > self.first else None

    def linked(self, index: int, least: int, most: int) -> tuple[int, int]:
        """Return the first and last frame, within least..most, that a chain of reliable steps links to this frame."""
        first = last = index
        while first > max(self.first, least) and self.this_from_last(first) is not None:
            first -= 1
        while last < most and self[last].next_from_this is not None:
            last += 1
        return first, last

    def motion(self, index: int, other: int) -> np.ndarray:
        """Return the homography (3, 3) of the background from a frame to another frame, chained over reliable steps."""
        steps = [slot.step for slot in self.span(min(index, other), max(index, other))]
        last_from_first = chain([step.later_from_earlier for step in steps if step is not None])
        return last_from_first if other > index else np.linalg.inv(last_from_first)

    def set_steps(self, first: int, steps: list[Registration], seconds: float) -> None:
        """Store the registrations of successive frames. seconds: computing time of each."""
        for index, step in enumerate(steps, first):
            # Tracking onto a blank picture seems to succeed: keypoints stay where the search began.
            is_blank = self[index].is_blank or self[index + 1].is_blank
            self[index].step = replace(step, reliable=False, cause="the picture is blank") if is_blank else step
            self[index].seconds["register"] = seconds

    def drop_colours(self, index: int) -> None:
        """Drop the colour picture of a frame that is still kept, because colour takes most of the memory."""
        if index >= self.first:
            self[index].view.image = self[index].view.grey

    def drop_before(self, index: int) -> None:
        """Drop the frames before an index."""
        while self.first < index:
            self._slots.popleft()
            self.first += 1
