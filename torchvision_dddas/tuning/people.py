"""The family of people: calibrated probabilities, fitting boxes, and the best threshold by F1."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.boxes import SAME, areas, iou, judged
from torchvision_dddas.evaluation.metrics.matching import counted
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.functional.soft import step
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.detector import WindowScorer, check_image, load_scorer
from torchvision_dddas.people.suppression import body_sides, log_odds, people_from_windows
from torchvision_dddas.tuning.family import Family

MOST = 80
"""Pictures of a clip at most, evenly over it: scoring takes about a second each, and only six numbers are tuned."""

BELOW = 1.0
"""Windows are kept down to this far below the threshold of the settings, in units of the score."""

PARAMETERS = ("height_share", "width_share", "feet_share", "probability_slope", "probability_even", "threshold")


@dataclass(frozen=True)
class ScoredPicture:
    """The detections of a picture, best first. margin, right: (N,); right: 1.0 or 0.0. people: number of true ones.

    shown: how many score above the threshold of the settings; only these have a probability. window_px, true_px:
    (R, 4) windows of the right ones among them, and the true boxes of their bodies.
    """

    margin: Tensor
    right: Tensor
    shown: int
    window_px: Tensor
    true_px: Tensor
    people: int
    settings: PeopleParameters


@dataclass(frozen=True)
class PeopleFamily(Family):
    """The family `people`. softness: in units of the score."""

    name: str = "people"
    task: Task = "people"
    measure: str = "people.boxes.f1"
    softness: tuple[float, float] = (0.3, 0.05)

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """See `Family.check`."""
        if settings.people.suppression != "nms":
            raise InputError(
                f"people.suppression = {settings.people.suppression} cannot be tuned by gradient; set it to nms"
            )

    def check_clips(self, clips: Sequence[Clip], settings: Settings) -> None:
        """See `Family.check_clips`."""
        self.check((), settings)

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, ScoredPicture]]:
        """The pictures whose people are labelled, each scored once."""
        truth = clip.truth
        if truth is None or truth.kind != "boxes" or not truth.boxes:
            raise InputError(f"{clip.name} has no boxes of people; give pictures with labelled people")
        parameters = settings.people
        scorer = load_scorer(parameters)
        numbers = sorted(truth.boxes)
        wanted = {numbers[i * len(numbers) // MOST] for i in range(MOST)} if len(numbers) > MOST else set(numbers)
        for frame in open_clip(clip):
            if frame.number in wanted:
                image = check_image(frame.image, f"{clip.name}, frame {frame.number}")
                true_px = np.asarray(truth.boxes[frame.number], float).reshape(-1, 4)
                counts = partial(_counted_boxes, truth, frame.number)
                yield frame.number, score_picture(image, true_px, parameters, scorer, counts)

    def _losses(self, contents: Sequence[Any], values: dict[str, Tensor], softness: float) -> list[Tensor]:
        return [_picture_loss(content, values, softness) for content in contents]


def score_picture(
    image: np.ndarray,
    truth_px: np.ndarray,
    parameters: PeopleParameters,
    scorer: WindowScorer,
    counted: Callable[[np.ndarray], np.ndarray] = lambda box_px: np.ones(len(box_px), bool),
) -> ScoredPicture:
    """Detect people in one picture, 8 bits grey or BGR, and compare them with the truth.

    truth_px: (M, 4). counted: which of boxes (N, 4) are right or wrong; the others are left out.
    """
    size = (image.shape[1], image.shape[0])
    parts = pyramid.everywhere(size, parameters)
    (maps,) = scorer.scores([image], [parts])
    low = parameters.model_copy(update={"threshold": parameters.threshold - BELOW})
    window_px, margin = pyramid.windows(parts, maps, size, low)
    every = people_from_windows(window_px, margin, size, low)
    above = margin >= parameters.threshold
    # Boxes are means of windows, weighed by how far they are above the threshold: those of the settings' own.
    shown = people_from_windows(window_px[above], margin[above], size, parameters)
    box_px = np.concatenate([shown.box_px, every.box_px[len(shown) :]])
    kept = counted(box_px)
    count = int(kept[: len(shown)].sum())
    box_px, margin = box_px[kept], every.margin[kept]
    right = judged(box_px, margin, truth_px)
    whose = _match_true_boxes(box_px[:count], right[:count], truth_px)
    window_px = shown.window_px[kept[: len(shown)]][whose >= 0]
    columns = margin, right, window_px, truth_px[whose[whose >= 0]].reshape(-1, 4)
    margin_, right_, windows_, true_ = (torch.as_tensor(np.asarray(column, float)) for column in columns)
    return ScoredPicture(margin_, right_, count, windows_, true_, len(truth_px), parameters)


def _counted_boxes(truth: Truth, number: int, box_px: np.ndarray) -> np.ndarray:
    return counted(truth, np.full(len(box_px), number), box_px)


def _match_true_boxes(box_px: np.ndarray, right: np.ndarray, truth_px: np.ndarray) -> np.ndarray:
    """(N,) the true box of each right detection, best first, each once; -1 for the others."""
    whose, free = np.full(len(box_px), -1), iou(box_px, truth_px)
    for row in np.flatnonzero(right > 0).tolist():
        best = int(free[row].argmax())
        if free[row, best] >= SAME:
            whose[row], free[:, best] = best, -1
    return whose


def _picture_loss(content: ScoredPicture, parameters: Mapping[str, Tensor], softness: float) -> Tensor:
    values = {f"people.{name}": torch.tensor(float(getattr(content.settings, name))) for name in PARAMETERS} | dict(
        parameters
    )
    total = 1 - soft_f1(content.margin, content.right, content.people, values["people.threshold"], softness)
    if content.shown:
        total = total + right_nll(content.margin[: content.shown], content.right[: content.shown], values).mean()
    if len(content.true_px):
        common, union = areas(body_boxes(content.window_px, values), content.true_px)
        total = total + (1 - common / union).mean()
    return total


def body_boxes(window_px: Float[Tensor, "N 4"], parameters: Mapping[str, Tensor]) -> Float[Tensor, "N 4"]:
    """The boxes of the bodies in windows, x, y, width, height, by the shares of height, width and feet."""
    shares = (parameters[f"people.{name}_share"] for name in ("height", "width", "feet"))
    return torch.stack(body_sides(*window_px.unbind(1), *shares), 1)


def right_nll(
    margin: Float[Tensor, " N"], right: Float[Tensor, " N"], parameters: Mapping[str, Tensor]
) -> Float[Tensor, " N"]:
    """Negative log-likelihood, in nats, of detections with these scores being right (1) or wrong (0).

    It is least where the probabilities by probability_slope and probability_even are the shares that are right.
    """
    odds = log_odds(margin, parameters["people.probability_slope"], parameters["people.probability_even"])
    return functional.binary_cross_entropy_with_logits(odds, right, reduction="none")


def soft_f1(
    margin: Float[Tensor, " N"], right: Float[Tensor, " N"], people: int, threshold: Tensor, softness: float
) -> Float[Tensor, ""]:
    """F1 of the detections of one picture that score above a threshold; 1 where there are no people and none is found.

    people: how many there are. softness: in units of the score; at 0 the result is the hard F1.
    """
    counts = step(margin - threshold, softness)
    found = counts.sum()
    # In a picture without people every detection lowers the F1 of 1.
    nobody = torch.zeros_like(found) + (people == 0)
    return (2 * (counts * right).sum() + nobody) / (found + people + nobody)
