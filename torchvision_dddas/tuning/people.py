"""The family of people: calibrated probabilities, boxes that fit, and a threshold that pays."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.boxes import SAME, areas, iou, judged
from torchvision_dddas.evaluation.metrics.ignored_regions import counted
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.functional.soft import step
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.detector import WindowScorer
from torchvision_dddas.people.suppression import body_sides, log_odds, people_from_windows
from torchvision_dddas.tuning.family import Example, Tick

MOST = 80
"""Pictures of a clip that are learned from, evenly over it: to score one takes about a second, and all clips' windows
together tell six numbers."""

BELOW = 1.0
"""How far below the threshold of the settings windows are kept, in units of the score."""

KNOBS = ("height_share", "width_share", "feet_share", "probability_slope", "probability_even", "threshold")


@dataclass(frozen=True)
class Scored:
    """The detections of a picture, best first. margin, right: (N,); right: 1.0 or 0.0. people: true ones.

    sure: how many score above the threshold of the settings: these alone have a probability. window_px, true_px: (R, 4)
    of those of them that are right, and the bodies' true boxes.
    """

    margin: Tensor
    right: Tensor
    sure: int
    window_px: Tensor
    true_px: Tensor
    people: int
    settings: PeopleParameters


@dataclass(frozen=True)
class Recognition:
    """The family `people`."""

    name: str = "people"
    task: Task = "people"
    measure: str = "people.boxes.f1"
    softness: tuple[float, float] = (0.3, 0.05)
    """In units of the score."""

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """The pictures whose people are labelled, each scored once. See `family.Family`."""
        from torchvision_dddas.people.detector import load_scorer

        parameters = settings.people
        if parameters.suppression != "nms":
            raise InputError(
                f"people.suppression = {parameters.suppression} cannot be tuned by gradient; set it to nms"
            )
        recognizer, found = load_scorer(parameters), list[Example]()
        for clip in clips:
            for example in _pictures(clip, parameters, recognizer):
                found.append(example)
                tick()
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,). See `family.Family`. A picture has too few numbers for another device than the CPU."""
        device = next(iter(parameters.values())).device if parameters else torch.device("cpu")
        here = {name: value.cpu() for name, value in parameters.items()}
        return torch.stack([_lost(example.content, here, softness) for example in batch]).to(device)


def family() -> Recognition:
    """See `family.family_of`."""
    return Recognition()


def scored(
    image: np.ndarray,
    truth_px: np.ndarray,
    parameters: PeopleParameters,
    recognizer: WindowScorer,
    counted: Callable[[np.ndarray], np.ndarray] = lambda box_px: np.ones(len(box_px), bool),
) -> Scored:
    """The detections of one picture, 8 bits grey or BGR, and which are right.

    truth_px: (M, 4). counted: which of boxes (N, 4) are right or wrong; the others are left out.
    """
    size = (image.shape[1], image.shape[0])
    parts = pyramid.everywhere(size, parameters)
    (maps,) = recognizer.scores([image], [parts])
    low = parameters.model_copy(update={"threshold": parameters.threshold - BELOW})
    window_px, margin = pyramid.windows(parts, maps, size, low)
    every = people_from_windows(window_px, margin, size, low)
    above = margin >= parameters.threshold
    # Boxes are means of windows, weighed by how far they are above the threshold: those of the settings' own.
    shown = people_from_windows(window_px[above], margin[above], size, parameters)
    box_px = np.concatenate([shown.box_px, every.box_px[len(shown) :]])
    kept = counted(box_px)
    sure = int(kept[: len(shown)].sum())
    box_px, margin = box_px[kept], every.margin[kept]
    right = judged(box_px, margin, truth_px)
    whose = _whose(box_px[:sure], right[:sure], truth_px)
    window_px = shown.window_px[kept[: len(shown)]][whose >= 0]
    columns = margin, right, window_px, truth_px[whose[whose >= 0]].reshape(-1, 4)
    margin_, right_, windows_, true_ = (torch.as_tensor(np.asarray(column, float)) for column in columns)
    return Scored(margin_, right_, sure, windows_, true_, len(truth_px), parameters)


def _pictures(clip: Clip, parameters: PeopleParameters, recognizer: WindowScorer) -> Iterator[Example]:
    from torchvision_dddas.evaluation.studies.stages import open_clip
    from torchvision_dddas.people.detector import check_image

    truth = clip.truth
    if truth is None or truth.kind != "boxes" or not truth.boxes:
        raise InputError(f"{clip.name} has no boxes of people; wanted pictures with labelled people")
    numbers = sorted(truth.boxes)
    some = {numbers[i * len(numbers) // MOST] for i in range(MOST)} if len(numbers) > MOST else set(numbers)
    for frame in open_clip(clip):
        if frame.number in some:
            image = check_image(frame.image, f"{clip.name}, frame {frame.number}")
            true_px = np.asarray(truth.boxes[frame.number], float).reshape(-1, 4)
            told = partial(_counted, truth, frame.number)
            yield Example(clip.name, frame.number, scored(image, true_px, parameters, recognizer, told))


def _counted(truth: Truth, number: int, box_px: np.ndarray) -> np.ndarray:
    return counted(truth, np.full(len(box_px), number), box_px)


def _whose(box_px: np.ndarray, right: np.ndarray, truth_px: np.ndarray) -> np.ndarray:
    """(N,) the true box of each that is right, best first, each once; -1 for the others."""
    whose, free = np.full(len(box_px), -1), iou(box_px, truth_px)
    for row in np.flatnonzero(right > 0).tolist():
        best = int(free[row].argmax())
        if free[row, best] >= SAME:
            whose[row], free[:, best] = best, -1
    return whose


def _lost(content: Scored, parameters: Mapping[str, Tensor], softness: float) -> Tensor:
    values = {f"people.{name}": torch.tensor(float(getattr(content.settings, name))) for name in KNOBS} | dict(
        parameters
    )
    total = 1 - soft_f(content.margin, content.right, content.people, values["people.threshold"], softness)
    if content.sure:
        total = total + doubt(content.margin[: content.sure], content.right[: content.sure], values).mean()
    if len(content.true_px):
        common, union = areas(bodies(content.window_px, values), content.true_px)
        total = total + (1 - common / union).mean()
    return total


Parameters = Mapping[str, Tensor]


def bodies(window_px: Float[Tensor, "N 4"], parameters: Parameters) -> Float[Tensor, "N 4"]:
    """The bodies' boxes in windows, x, y, width, height, by the parameters height_share, width_share and feet_share."""
    shares = (parameters[f"people.{name}_share"] for name in ("height", "width", "feet"))
    return torch.stack(body_sides(*window_px.unbind(1), *shares), 1)


def doubt(margin: Float[Tensor, " N"], right: Float[Tensor, " N"], parameters: Parameters) -> Float[Tensor, " N"]:
    """Negative log-likelihood, in nats, of detections of these scores being right (1) or wrong (0).

    By the parameters probability_slope and probability_even: least where probabilities are the shares that are right.
    """
    odds = log_odds(margin, parameters["people.probability_slope"], parameters["people.probability_even"])
    return functional.binary_cross_entropy_with_logits(odds, right, reduction="none")


def soft_f(
    margin: Float[Tensor, " N"], right: Float[Tensor, " N"], people: int, threshold: Tensor, softness: float
) -> Float[Tensor, ""]:
    """F1 of the detections of one picture that score above a threshold; 1 where nobody is there and none is found.

    people: how many there truly are. softness: in units of the score; 0: the hard figure.
    """
    counts = step(margin - threshold, softness)
    found = counts.sum()
    nobody = torch.zeros_like(found) + (people == 0)
    return (2 * (counts * right).sum() + nobody * _SPARE) / (found + people + nobody * _SPARE)


_SPARE = 1.0
"""Found in a picture without people: the more there are the worse, and none is right."""
