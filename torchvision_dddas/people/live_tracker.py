"""People in the scenes of a run: detected around what moves, and tracked by the run's own registrations."""

import time
from collections.abc import Iterable
from typing import Protocol

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geometry import chain
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.detector import UNREAD, WindowScorer, check_image
from torchvision_dddas.people.search_regions import Search
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.types import Adjustment, Detections, Scene, TrackedFrame, Tracks, is_sampled

KIND = "person"


class FrameTracker(Protocol):
    """What gives frames their tracks, such as `tracking.FrameTracker`."""

    def update(self, given: TrackedFrame) -> Iterable[TrackedFrame]:
        """Add a frame; returns the frames that are settled by it."""
        ...

    def flush(self) -> Iterable[TrackedFrame]:
        """The frames that were still waiting."""
        ...


class PersonTracker:
    """Detects and tracks people in the scenes of a run. Give it the scenes in order.

    A scene whose picture could not be read has no people. Identities are from 1, apart from those of what moves.
    """

    def __init__(
        self, scorer: WindowScorer, settings: Settings, interval: int, size: tuple[int, int], tracker: FrameTracker
    ) -> None:
        """size: (width, height) of the pictures. Raises InputError where they are smaller than the window."""
        self._scorer, self._interval, self._size, self._tracker = scorer, interval, size, tracker
        self._box_px = np.zeros((0, 4))
        self._search = Search(settings.people, lambda number: self._box_px)
        self._steps: list[np.ndarray] = []
        self._settled: dict[int, TrackedFrame] = {}
        pyramid.everywhere(size, settings.people)

    def retune(self, settings: Settings) -> None:
        """Search as these settings say from now on."""
        self._search.retune(settings.people)

    def update(self, scene: Scene) -> None:
        """Add the next scene."""
        if scene.step is not None and scene.step.reliable:
            self._steps.append(scene.step.later_from_earlier)
        number = scene.frame.number
        if not is_sampled(number, self._interval):
            return
        found, adjustments, seconds = self._detect(scene)
        motion, self._steps = chain(self._steps) if self._steps else None, []
        given = TrackedFrame(
            number,
            scene.frame,
            found,
            Tracks(number),
            motion,
            cause=scene.cause,
            adjustments=adjustments,
            seconds=seconds,
        )
        self._settled |= {settled.number: settled for settled in self._tracker.update(given)}

    def people_of(self, number: int, ended: bool) -> TrackedFrame | None:
        """The people of a frame, once; None while they are not settled. Those of earlier frames are forgotten.

        ended: whether no scene follows.
        """
        if ended and number not in self._settled:
            self._settled |= {settled.number: settled for settled in self._tracker.flush()}
        self._settled = {other: settled for other, settled in self._settled.items() if other >= number}
        return self._settled.pop(number, None)

    def _detect(self, scene: Scene) -> tuple[Detections, tuple[Adjustment, ...], dict[str, float]]:
        image, parameters = scene.frame.image, self._search.parameters
        if image.shape[1::-1] != self._size or scene.cause == UNREAD:
            return Detections(kind=KIND), (), {}
        start = time.perf_counter()
        self._box_px = scene.detections.box_px
        plan = self._search.plan(scene.frame.number, self._size)
        maps = self._scorer.scores([check_image(image, f"frame {scene.frame.number}")], [plan.parts])[0]
        people = people_from_windows(*pyramid.windows(plan.parts, maps, self._size, parameters), self._size, parameters)
        self._search.update(scene.frame.number, people, plan)
        unknown = np.full(len(people), np.nan)
        found = Detections(people.box_px, people.score, people.box_px[:, 2:].prod(axis=1), unknown, unknown, KIND)
        return found, plan.adjustments, {"people": time.perf_counter() - start}
