"""People in pictures and clips by HOG and a linear SVM: parts of the pyramid, scores, windows, people."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol, overload

import numpy as np

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.classifiers import load_classifier
from torchvision_dddas.people.search_regions import Regions, Search, SearchPlan
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import DetectionTable, Frame, LinearSvm, Part, People, PeopleFrame

UNREAD = "the frame could not be read"
"""Cause of a frame without picture."""


class PersonDetector:
    """Detects people in single pictures."""

    def __init__(self, settings: Settings | None = None, backend: str = "auto") -> None:
        """backend: onboard (OpenCV and ONNX Runtime), torch, or auto for the former.

        Raises InputError for an unknown backend, and a classifier or graphs that cannot be read or do not fit.
        """
        self.parameters = (settings or Settings()).people
        self.scorer = load_scorer(self.parameters, backend)

    @overload
    def __call__(self, images: np.ndarray) -> People: ...
    @overload
    def __call__(self, images: Sequence[np.ndarray]) -> list[People]: ...
    def __call__(self, images: np.ndarray | Sequence[np.ndarray]) -> People | list[People]:
        """The people of a picture, (H, W, 3) BGR or (H, W) grey uint8, or of each of several; best first.

        Raises InputError for another shape or type, and a picture that is smaller than the window.
        """
        if isinstance(images, np.ndarray) and images.ndim < 4:
            return detect_people([images], self.scorer, self.parameters)[0]
        return detect_people(list(images), self.scorer, self.parameters)


class WindowScorer(Protocol):
    """A backend's scorer of windows, for one classifier and one layout of its descriptor."""

    name: str

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """For every image its parts' score maps: (ny, nx) float32, [j, i] the window at (x + i stride, y + j stride).

        images: uint8 (H, W) or (H, W, 3) BGR; resized as by OpenCV's INTER_LINEAR_EXACT, reflected (101) at the border.
        A part does not see its own edge: its scores are those of the same windows in a search everywhere.
        A part that is smaller than the window has an empty map.
        """
        ...


def load_scorer(parameters: PeopleParameters, backend: str = "auto", svm: LinearSvm | None = None) -> WindowScorer:
    """The scorer of windows of a backend, for a classifier; None: the one that the settings name.

    Raises InputError as `wants_torch` and `load_classifier`.
    """
    svm = load_classifier(parameters) if svm is None else svm
    if not wants_torch(backend):
        from torchvision_dddas.people.onnx_scorer import OnnxScorer

        return OnnxScorer(parameters, svm)
    from torchvision_dddas.people.torch_scorer import TorchScorer

    return TorchScorer(parameters, svm)


def detect_in_clip(
    source: Iterable[Frame],
    scorer: WindowScorer,
    settings: Settings,
    moving: DetectionTable | None = None,
    batch: int | None = None,
) -> Iterator[PeopleFrame]:
    """The people of every frame number of the clip, in order. Frames that could not be read are black, with a cause.

    moving: boxes around which to search, by frame; see `search_regions.Search`. batch:
    frames given to the backend at once, which does not change the result. None: 8 for torch, else 1; with
    `people.search = regions` each frame waits for what was found in the one before.
    Raises InputError: a picture that is not 8 bits grey or BGR, or smaller than the window.
    """
    parameters = settings.people
    search = Search(parameters, None if moving is None else lambda number: moving.at(number).box_px)
    some = 1 if search.steered else batch or (8 if scorer.name == "torch" else 1)
    waiting: list[tuple[Frame, SearchPlan, dict[str, float]]] = []
    number, rate_hz, shape = 1, float(getattr(source, "rate_hz", 10.0)), (1, 1)
    start = time.perf_counter()
    for frame in source:
        read = time.perf_counter()
        image = check_image(frame.image, f"frame {frame.number}")
        frame = replace(frame, image=image)
        if frame.number > number:
            yield from _search_waiting(waiting, scorer, parameters, search)
            yield from (_unread(missing, rate_hz, image.shape) for missing in range(number, frame.number))
        number, shape = frame.number + 1, image.shape
        planned = time.perf_counter()
        plan = search.plan(frame.number, (image.shape[1], image.shape[0]))
        waiting.append((frame, plan, {"read": read - start, "plan": time.perf_counter() - planned}))
        if len(waiting) >= some:
            yield from _search_waiting(waiting, scorer, parameters, search)
        start = time.perf_counter()
    yield from _search_waiting(waiting, scorer, parameters, search)
    yield from (_unread(missing, rate_hz, shape) for missing in range(number, getattr(source, "last", 0) + 1))


def detect_people(
    images: Sequence[np.ndarray],
    scorer: WindowScorer,
    parameters: PeopleParameters,
    regions: Sequence[Regions] | None = None,
) -> list[People]:
    """The people of pictures, searched everywhere or in regions of each. Raises InputError as `detect_in_clip`."""
    images = [check_image(image, f"picture {i}") for i, image in enumerate(images, start=1)]
    parts = [_whole_pyramid(image, f"picture {i}", parameters) for i, image in enumerate(images, start=1)]
    if regions is not None:
        sizes = [(image.shape[1], image.shape[0]) for image in images]
        parts = [pyramid.within(*some, size, parameters) for some, size in zip(regions, sizes, strict=True)]
    return [
        _people(maps, wanted, image, parameters)
        for maps, wanted, image in zip(scorer.scores(images, parts), parts, images, strict=True)
    ]


def check_image(image: np.ndarray, name: str) -> np.ndarray:
    """A picture as the backends take it: (H, W) or (H, W, 3) uint8. Raises InputError for anything else."""
    if image is None:  # what OpenCV gives for a file that it cannot read
        raise InputError(f"{name} is None; could its file be read? Wanted an array of height x width pixels")
    image = np.asarray(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)) or 0 in image.shape:
        what = (
            "an array of " + " x ".join(map(str, image.shape))
            if image.ndim
            else f"a single {image.dtype.type.__name__}"
        )
        raise InputError(f"{name} is {what}; wanted height x width, or these x 1 or 3 channels (BGR)")
    if image.dtype != np.uint8:
        nan = image.dtype.kind == "f" and bool(np.isnan(image).any())
        raise InputError(
            f"{name} holds {image.dtype} pixels{', NaN among them' if nan else ''}; wanted 8 bits (uint8), 0 to 255"
        )
    return image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image


def _whole_pyramid(image: np.ndarray, name: str, parameters: PeopleParameters) -> list[Part]:
    """All parts of a picture. Raises InputError, which names it, where no window fits."""
    try:
        return pyramid.everywhere((image.shape[1], image.shape[0]), parameters)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _search_waiting(
    waiting: list[tuple[Frame, SearchPlan, dict[str, float]]],
    scorer: WindowScorer,
    parameters: PeopleParameters,
    search: Search,
) -> Iterator[PeopleFrame]:
    """Search the waiting frames together, and empty the list."""
    if not waiting:
        return
    start = time.perf_counter()
    maps = scorer.scores([frame.image for frame, _, _ in waiting], [plan.parts for _, plan, _ in waiting])
    spent = (time.perf_counter() - start) / len(waiting)
    for (frame, plan, seconds), scored in zip(waiting, maps, strict=True):
        start = time.perf_counter()
        people = _people(scored, plan.parts, frame.image, parameters)
        search.update(frame.number, people, plan)
        seconds = seconds | {"score": spent, "people": time.perf_counter() - start}
        yield PeopleFrame(frame, people, plan.regions_px, plan.share, "", plan.adjustments, seconds)
    waiting.clear()


def _people(
    maps: Sequence[np.ndarray], parts: Sequence[Part], image: np.ndarray, parameters: PeopleParameters
) -> People:
    size = image.shape[1], image.shape[0]
    return people_from_windows(*pyramid.windows(parts, maps, size, parameters), size, parameters)


def _unread(number: int, rate_hz: float, shape: tuple[int, ...]) -> PeopleFrame:
    frame = Frame(number, (number - 1) / rate_hz, np.zeros(shape, np.uint8))
    return PeopleFrame(frame, People(), np.zeros((0, 4)), 0.0, UNREAD)
