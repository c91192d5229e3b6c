"""People in the scenes of a run: recognized around what moves, and followed by the run's own registrations."""

import time

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geometry import chain
from torchvision_dddas.people import pyramid as scan
from torchvision_dddas.people.boxes import people_of
from torchvision_dddas.people.detector import UNREAD, checked
from torchvision_dddas.people.scorer import WindowScorer
from torchvision_dddas.people.search_regions import Search
from torchvision_dddas.tracking import FrameTracker
from torchvision_dddas.types import Adjustment, Detections, Scene, TrackedFrame, Tracks, is_sampled

KIND = "person"


class Spotter:
    """Give it the scenes of a run in order; its people are settled when the run's own targets are.

    A scene whose picture could not be read has no people. Identities are from 1, apart from those of what moves.
    """

    def __init__(self, recognizer: WindowScorer, settings: Settings, interval: int, size: tuple[int, int]) -> None:
        """size: (width, height) of the pictures. Raises InputError where they are smaller than the window."""
        self._recognizer, self._interval, self._size = recognizer, interval, size
        self._box_px = np.zeros((0, 4))
        self._search = Search(settings.people, lambda number: self._box_px)
        self._follower = FrameTracker(settings, interval, size, pictures=False)
        self._steps: list[np.ndarray] = []
        self._settled: dict[int, TrackedFrame] = {}
        scan.everywhere(size, settings.people)

    def retune(self, settings: Settings) -> None:
        """From now on search as these say."""
        self._search.retune(settings.people)

    def see(self, scene: Scene) -> None:
        """The next scene."""
        if scene.step is not None and scene.step.reliable:
            self._steps.append(scene.step.later_from_earlier)
        if not is_sampled(scene.frame.number, self._interval):
            return
        found, adjustments, seconds = self._found(scene)
        followed = TrackedFrame(
            scene.frame.number,
            scene.frame,
            found,
            Tracks(scene.frame.number),
            chain(self._steps) if self._steps else None,
            cause=scene.cause,
            adjustments=adjustments,
            seconds=seconds,
        )
        self._steps = []
        for settled in self._follower.update(followed):
            self._settled[settled.number] = settled

    def of(self, number: int, ended: bool) -> TrackedFrame | None:
        """The people of a frame, once; None where they are not settled. Those of frames before it are forgotten.

        ended: whether no scene follows.
        """
        if ended and number not in self._settled:
            self._settled |= {settled.number: settled for settled in self._follower.flush()}
        self._settled = {other: settled for other, settled in self._settled.items() if other >= number}
        return self._settled.pop(number, None)

    def _found(self, scene: Scene) -> tuple[Detections, tuple[Adjustment, ...], dict[str, float]]:
        image, parameters = scene.frame.image, self._search.parameters
        if image.shape[1::-1] != self._size or scene.cause == UNREAD:
            return Detections(kind=KIND), (), {}
        start = time.perf_counter()
        self._box_px = scene.detections.box_px
        look = self._search.look(scene.frame.number, self._size)
        maps = self._recognizer.scores([checked(image, f"frame {scene.frame.number}")], [look.parts])[0]
        people = people_of(*scan.windows(look.parts, maps, self._size, parameters), self._size, parameters)
        self._search.learn(scene.frame.number, people, look)
        unknown = np.full(len(people), np.nan)
        found = Detections(people.box_px, people.score, people.box_px[:, 2:].prod(axis=1), unknown, unknown, KIND)
        return found, look.adjustments, {"people": time.perf_counter() - start}
