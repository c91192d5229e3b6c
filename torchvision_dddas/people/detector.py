"""Detect people by HOG and a linear SVM in pictures, in clips, and in the scenes of a live run."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol, overload

import numpy as np

from torchvision_dddas.config import PeopleParameters, Settings, check_settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import chain
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.classifiers import load_classifier
from torchvision_dddas.people.search_regions import Regions, Search, SearchPlan
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import (
    Detections,
    DetectionTable,
    Frame,
    LinearSvm,
    Part,
    People,
    PeopleFrame,
    Scene,
    TrackedFrame,
    Tracks,
    as_picture,
    is_sampled,
)

KIND = "person"
UNREAD = "the frame could not be read"
"""The cause that a frame without a picture has."""


class PersonDetector:
    """Detects people in single pictures.

    >>> people = td.PersonDetector()(np.full((240, 320, 3), 128, np.uint8))
    >>> len(people), people.box_px.shape
    (0, (0, 4))
    """

    def __init__(self, settings: Settings | None = None, *, backend: str = "auto") -> None:
        """Load the classifier.

        backend: onboard (OpenCV and ONNX Runtime), torch, or auto. auto is torch with a CUDA device, else onboard.
        Raises InputError for an unknown backend, and for a classifier or graphs that cannot be read or do not fit.
        """
        self.parameters = check_settings(settings).people
        self.scorer = load_scorer(self.parameters, backend)

    @overload
    def __call__(self, images: np.ndarray) -> People: ...
    @overload
    def __call__(self, images: Sequence[np.ndarray]) -> list[People]: ...
    def __call__(self, images: np.ndarray | Sequence[np.ndarray]) -> People | list[People]:
        """Detect the people of one picture, or of each picture of a sequence; the best score comes first.

        images: (H, W, 3) BGR or (H, W) grey uint8. Raises InputError for another shape or type, and for a picture that
        is smaller than the window.
        """
        several: Any = images
        if not isinstance(several, Iterable) or isinstance(several, str) or getattr(several, "ndim", 4) < 4:
            return detect_people([several], self.scorer, self.parameters)[0]
        return detect_people(list(images), self.scorer, self.parameters)


class WindowScorer(Protocol):
    """A backend's scorer of windows for one classifier and one descriptor layout."""

    name: str

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """Return for each image a list of score maps, one for each of its parts.

        A map is (ny, nx) float32; entry [j, i] is the score of the window at (x + i stride, y + j stride). images:
        uint8 (H, W) or (H, W, 3) BGR. They are resized like OpenCV's INTER_LINEAR_EXACT, and reflected (101) at the
        border. The edge of a part has no effect: scores equal those of a search of the whole picture. The map of a
        part that is smaller than the window is empty.
        """
        ...


def load_scorer(parameters: PeopleParameters, backend: str = "auto", svm: LinearSvm | None = None) -> WindowScorer:
    """Return the window scorer of a backend.

    svm: the classifier; None: the classifier in the settings. Raises InputError as `wants_torch` and `load_classifier`.
    """
    svm = load_classifier(parameters) if svm is None else svm
    if not wants_torch(backend):
        from torchvision_dddas.people.onnx_scorer import OnnxScorer

        return OnnxScorer(parameters, svm)
    from torchvision_dddas.people.torch_scorer import TorchScorer

    return TorchScorer(parameters, svm)


def detect_people(
    images: Sequence[np.ndarray],
    scorer: WindowScorer,
    parameters: PeopleParameters,
    regions: Sequence[Regions] | None = None,
) -> list[People]:
    """Detect the people of pictures, everywhere or in regions of each. Raises InputError as `detect_in_clip` does."""
    images = [as_picture(image, name=f"picture {i}") for i, image in enumerate(images, start=1)]
    parts = []
    for i, image in enumerate(images):
        size = image.shape[1], image.shape[0]
        try:
            whole = pyramid.everywhere(size, parameters)
        except InputError as error:
            raise InputError(f"picture {i + 1}: {error}") from None
        parts.append(whole if regions is None else pyramid.within(*regions[i], size, parameters))
    return _score_people(images, parts, scorer, parameters)


def _score_people(
    images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]], scorer: WindowScorer, parameters: PeopleParameters
) -> list[People]:
    found = []
    for image, wanted, maps in zip(images, parts, scorer.scores(images, parts), strict=True):
        size = image.shape[1], image.shape[0]
        found.append(people_from_windows(*pyramid.windows(wanted, maps, size, parameters), size, parameters))
    return found


def detect_in_clip(
    source: Iterable[Frame],
    scorer: WindowScorer,
    settings: Settings,
    moving: DetectionTable | None = None,
    batch: int | None = None,
) -> Iterator[PeopleFrame]:
    """Yield the people of every frame number of a clip, in order. Unreadable frames are black and have a cause.

    moving: boxes around which to search, by frame; see `search_regions.Search`. batch: frames that the backend scores
    at once; it does not change the result. None means 8 for torch, else 1. With `people.search = regions` the batch is
    always 1, because the search of a frame needs the people of the frame before.
    Raises InputError for a picture that is not 8-bit grey or BGR, or is smaller than the window.
    """
    parameters = settings.people
    search = Search(parameters, None if moving is None else lambda number: moving.at(number).box_px)
    some = 1 if search.steered else batch or (8 if scorer.name == "torch" else 1)
    rate_hz = float(getattr(source, "rate_hz", 10.0))
    waiting: list[tuple[Frame, SearchPlan, dict[str, float]]] = []

    def search_waiting() -> Iterator[PeopleFrame]:
        """Search the waiting frames together, and empty the list."""
        if not waiting:
            return
        start = time.perf_counter()
        parts = [plan.parts for _, plan, _ in waiting]
        maps = scorer.scores([frame.image for frame, _, _ in waiting], parts)
        spent = (time.perf_counter() - start) / len(waiting)
        for (frame, plan, seconds), scored in zip(waiting, maps, strict=True):
            start, size = time.perf_counter(), (frame.image.shape[1], frame.image.shape[0])
            people = people_from_windows(*pyramid.windows(plan.parts, scored, size, parameters), size, parameters)
            search.update(frame.number, people, plan)
            seconds = seconds | {"score": spent, "people": time.perf_counter() - start}
            yield PeopleFrame(frame, people, plan.regions_px, plan.share, "", plan.adjustments, seconds)
        waiting.clear()

    def unread(numbers: range, shape: tuple[int, ...]) -> Iterator[PeopleFrame]:
        for number in numbers:
            frame = Frame(number, (number - 1) / rate_hz, np.zeros(shape, np.uint8))
            yield PeopleFrame(frame, People(), np.zeros((0, 4)), 0.0, UNREAD)

    number, shape = 1, (1, 1)
    start = time.perf_counter()
    for frame in source:
        read = time.perf_counter()
        image = as_picture(frame.image, name=f"frame {frame.number}")
        if frame.number > number:
            yield from search_waiting()
            yield from unread(range(number, frame.number), image.shape)
        number, shape = frame.number + 1, image.shape
        planned = time.perf_counter()
        plan = search.plan(frame.number, (image.shape[1], image.shape[0]))
        seconds = {"read": read - start, "plan": time.perf_counter() - planned}
        waiting.append((replace(frame, image=image), plan, seconds))
        if len(waiting) >= some:
            yield from search_waiting()
        start = time.perf_counter()
    yield from search_waiting()
    yield from unread(range(number, getattr(source, "last", 0) + 1), shape)


class AddsTracks(Protocol):
    """A tracker that adds tracks to frames, such as `tracking.FrameTracker`."""

    def update(self, given: TrackedFrame) -> Iterable[TrackedFrame]:
        """Add a frame, and return the frames whose tracks no later frame can change."""
        ...

    def flush(self) -> Iterable[TrackedFrame]:
        """Return the remaining frames at the end."""
        ...


class PersonTracker:
    """Detects people around the moving targets of a run's scenes, and tracks them with the run's registrations.

    Pass the scenes in order to `update`. A scene whose picture could not be read has no people. Identities of people
    start at 1 and are independent of those of moving targets.
    """

    def __init__(
        self, scorer: WindowScorer, settings: Settings, interval: int, size: tuple[int, int], tracker: AddsTracks
    ) -> None:
        """Start without people. size: (width, height) of the pictures. Raises InputError below the window's size."""
        self._scorer, self._interval, self._size, self._tracker = scorer, interval, size, tracker
        self._box_px = np.zeros((0, 4))
        self._search = Search(settings.people, lambda number: self._box_px)
        self._steps: list[np.ndarray] = []
        self._settled: dict[int, TrackedFrame] = {}
        pyramid.everywhere(size, settings.people)

    def retune(self, settings: Settings) -> None:
        """Use these settings for the search from the next scene on."""
        self._search.retune(settings.people)

    def update(self, scene: Scene) -> None:
        """Add the next scene."""
        if scene.step is not None and scene.step.reliable:
            self._steps.append(scene.step.later_from_earlier)
        number, image = scene.frame.number, scene.frame.image
        if not is_sampled(number, self._interval):
            return
        motion, self._steps = chain(self._steps) if self._steps else None, []
        given = TrackedFrame(number, scene.frame, Detections(kind=KIND), Tracks(number), motion, cause=scene.cause)
        given = replace(given, repeats=scene.repeats)
        if image.shape[1::-1] == self._size and scene.cause != UNREAD:
            start = time.perf_counter()
            self._box_px = scene.detections.box_px
            plan = self._search.plan(number, self._size)
            image = as_picture(image, name=f"frame {number}")
            (people,) = _score_people([image], [plan.parts], self._scorer, self._search.parameters)
            self._search.update(number, people, plan)
            unknown = np.full(len(people), np.nan)
            area_px = people.box_px[:, 2:].prod(axis=1)
            found = Detections(people.box_px, people.score, area_px, unknown, unknown, KIND)
            seconds = {"people": time.perf_counter() - start}
            given = replace(given, detections=found, adjustments=plan.adjustments, seconds=seconds)
        self._settled |= {settled.number: settled for settled in self._tracker.update(given)}

    def people_of(self, number: int, ended: bool) -> TrackedFrame | None:
        """Return the people of a frame, or None while later scenes may change them.

        This returns each frame once, and drops all earlier frames. ended: whether no scene follows.
        """
        if ended and number not in self._settled:
            self._settled |= {settled.number: settled for settled in self._tracker.flush()}
        self._settled = {other: settled for other, settled in self._settled.items() if other >= number}
        return self._settled.pop(number, None)
