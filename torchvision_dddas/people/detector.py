"""People in the frames of a clip: which parts to look at, their scores, windows, people; and where to look next."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.people import pyramid as scan
from torchvision_dddas.people.boxes import people_of
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.scorer import WindowScorer, load_scorer
from torchvision_dddas.people.search_regions import Look, Regions, Search
from torchvision_dddas.types import DetectionTable, Frame, LinearSvm, Part, People, PeopleFrame

UNREAD = "the frame could not be read"


def recognizer_of(parameters: PeopleParameters, backend: str = "auto") -> WindowScorer:
    """The recognizer that the settings name, on a back end. Raises InputError as `engine.load` and `classifier_of`."""
    return load_scorer(backend, parameters, classifier_of(parameters))


def classifier_of(parameters: PeopleParameters) -> LinearSvm:
    """The classifier that the settings name. Raises InputError as `read_classifier`, for one that does not fit them."""
    return read_classifier(parameters.classifier, parameters.features, parameters.descriptor)


def recognize(
    source: Iterable[Frame],
    recognizer: WindowScorer,
    settings: Settings,
    moving: DetectionTable | None = None,
    batch: int | None = None,
) -> Iterator[PeopleFrame]:
    """The people of every frame number of the clip, in order. Frames that could not be read are black, with a cause.

    moving: boxes around which to search, by frame; see `targets.regions.Search` for what is searched where. batch:
    frames given to the back end at once; the result does not depend on it. None takes 8 for torch, else 1; with
    `people.search = regions` each frame waits for what was found in the one before.
    Raises InputError: a picture that is not 8 bits grey or BGR, or smaller than the window.
    """
    parameters = settings.people
    search = Search(parameters, None if moving is None else lambda number: moving.at(number).box_px)
    some = 1 if search.steered else batch or (8 if recognizer.name == "torch" else 1)
    waiting: list[tuple[Frame, Look, dict[str, float]]] = []
    number, rate_hz, shape = 1, float(getattr(source, "rate_hz", 10.0)), (1, 1)
    start = time.perf_counter()
    for frame in source:
        read = time.perf_counter()
        image = checked(frame.image, f"frame {frame.number}")
        frame = replace(frame, image=image)
        if frame.number > number:
            yield from _searched(waiting, recognizer, parameters, search)
            yield from (_unread(missing, rate_hz, image.shape) for missing in range(number, frame.number))
        number, shape = frame.number + 1, image.shape
        planned = time.perf_counter()
        look = search.look(frame.number, (image.shape[1], image.shape[0]))
        waiting.append((frame, look, {"read": read - start, "plan": time.perf_counter() - planned}))
        if len(waiting) >= some:
            yield from _searched(waiting, recognizer, parameters, search)
        start = time.perf_counter()
    yield from _searched(waiting, recognizer, parameters, search)
    yield from (_unread(missing, rate_hz, shape) for missing in range(number, getattr(source, "last", 0) + 1))


def people_in(
    images: Sequence[np.ndarray],
    recognizer: WindowScorer,
    parameters: PeopleParameters,
    regions: Sequence[Regions] | None = None,
) -> list[People]:
    """The people of pictures at hand, searched everywhere or in regions of each. Raises InputError as `recognize`."""
    images = [checked(image, f"picture {i}") for i, image in enumerate(images, start=1)]
    parts = [_everywhere(image, f"picture {i}", parameters) for i, image in enumerate(images, start=1)]
    if regions is not None:
        sizes = [(image.shape[1], image.shape[0]) for image in images]
        parts = [scan.within(*some, size, parameters) for some, size in zip(regions, sizes, strict=True)]
    return [
        _people(maps, wanted, image, parameters)
        for maps, wanted, image in zip(recognizer.scores(images, parts), parts, images, strict=True)
    ]


def checked(image: np.ndarray, name: str) -> np.ndarray:
    """A picture as the back ends want it: (H, W) or (H, W, 3) uint8. Raises InputError for anything else."""
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


def _everywhere(image: np.ndarray, name: str, parameters: PeopleParameters) -> list[Part]:
    """All parts of a picture. Raises InputError, which names it, where no window fits."""
    try:
        return scan.everywhere((image.shape[1], image.shape[0]), parameters)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _searched(
    waiting: list[tuple[Frame, Look, dict[str, float]]],
    recognizer: WindowScorer,
    parameters: PeopleParameters,
    search: Search,
) -> Iterator[PeopleFrame]:
    """The waiting frames, searched together, and none of them waiting any more."""
    if not waiting:
        return
    start = time.perf_counter()
    maps = recognizer.scores([frame.image for frame, _, _ in waiting], [look.parts for _, look, _ in waiting])
    spent = (time.perf_counter() - start) / len(waiting)
    for (frame, look, seconds), scored in zip(waiting, maps, strict=True):
        start = time.perf_counter()
        people = _people(scored, look.parts, frame.image, parameters)
        search.learn(frame.number, people, look)
        seconds = seconds | {"score": spent, "people": time.perf_counter() - start}
        yield PeopleFrame(frame, people, look.regions_px, look.share, "", look.adjustments, seconds)
    waiting.clear()


def _people(
    maps: Sequence[np.ndarray], parts: Sequence[Part], image: np.ndarray, parameters: PeopleParameters
) -> People:
    size = image.shape[1], image.shape[0]
    return people_of(*scan.windows(parts, maps, size, parameters), size, parameters)


def _unread(number: int, rate_hz: float, shape: tuple[int, ...]) -> PeopleFrame:
    frame = Frame(number, (number - 1) / rate_hz, np.zeros(shape, np.uint8))
    return PeopleFrame(frame, People(), np.zeros((0, 4)), 0.0, UNREAD)
