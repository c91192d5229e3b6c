"""The family of people: calibrated probabilities, fitting boxes, and the best threshold by F1."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
from torchvision_dddas.functional import step
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.detector import WindowScorer, load_scorer
from torchvision_dddas.people.suppression import body_sides, log_odds, people_from_windows
from torchvision_dddas.tuning.family import Example, Family
from torchvision_dddas.tuning.parameters import with_tensors
from torchvision_dddas.types import as_picture

MOST = 80
"""Pictures of a clip at most, evenly over it: scoring takes about a second each, and only six numbers are tuned."""

BELOW = 1.0
"""Windows are kept down to this far below the threshold of the settings, in units of the score."""


@dataclass(frozen=True)
class ScoredPicture:
    """The detections of a picture, best first. margin, right: (N,); right: 1.0 or 0.0. people: number of true ones.

    shown: how many score above the threshold of the settings; only these have a probability. window_px, true_px:
    (R, 4) windows of the right ones among them, and the true boxes of their bodies.
    """

    margin: Float[Tensor, " N"]
    right: Float[Tensor, " N"]
    shown: int
    window_px: Float[Tensor, "R 4"]
    true_px: Float[Tensor, "R 4"]
    people: int


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
        scorer, numbers = load_scorer(settings.people), sorted(truth.boxes)
        count = min(len(numbers), MOST)
        wanted = {numbers[i * len(numbers) // count] for i in range(count)}
        for frame in open_clip(clip):
            if frame.number in wanted:
                image = as_picture(frame.image, f"{clip.name}, frame {frame.number}")
                yield frame.number, score_picture(image, truth, frame.number, settings.people, scorer)

    def _losses(self, batch: Sequence[Example], values: dict[str, Tensor], softness: float) -> list[Tensor]:
        return [
            picture_loss(example.content, with_tensors(example.settings.people, "people", values), softness)
            for example in batch
        ]


def score_picture(
    image: np.ndarray, truth: Truth, number: int, parameters: PeopleParameters, scorer: WindowScorer
) -> ScoredPicture:
    """Detect people in one picture, 8 bits grey or BGR, and compare them with the truth of a frame."""
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
    kept = counted(truth, np.full(len(box_px), number), box_px)
    count = int(kept[: len(shown)].sum())
    box_px, margin = box_px[kept], every.margin[kept]
    true_px = np.asarray(truth.boxes[number], float).reshape(-1, 4)
    right = judged(box_px, margin, true_px)
    # The true box of each right detection, best first, each once.
    rows, owners, free = [], [], iou(box_px[:count], true_px)
    for row in np.flatnonzero(right[:count] > 0).tolist():
        best = int(free[row].argmax())
        if free[row, best] >= SAME:
            rows.append(row)
            owners.append(best)
            free[:, best] = -1
    found_px = shown.window_px[kept[: len(shown)]][rows], true_px[owners].reshape(-1, 4)
    tensors = [torch.as_tensor(np.asarray(column, float)) for column in (margin, right, *found_px)]
    return ScoredPicture(tensors[0], tensors[1], count, tensors[2], tensors[3], len(true_px))


def picture_loss(content: ScoredPicture, parameters: PeopleParameters, softness: float) -> Float[Tensor, ""]:
    """1 - F1, the doubt about what is shown, and how much bodies and true boxes do not have in common.

    parameters: numbers or tensors. The doubt is the mean negative log-likelihood of detections being right or wrong, in
    nats: least where the probabilities are the shares that are right.
    """
    total = 1 - soft_f1(content.margin, content.right, content.people, parameters.threshold, softness)
    if content.shown:
        odds = log_odds(content.margin[: content.shown], parameters.probability_slope, parameters.probability_even)
        total = total + functional.binary_cross_entropy_with_logits(odds, content.right[: content.shown])
    if len(content.true_px):
        x, y, width, height = content.window_px.unbind(1)
        shares = parameters.height_share, parameters.width_share, parameters.feet_share
        common, union = areas(torch.stack(body_sides(x, y, width, height, *shares), 1), content.true_px)
        total = total + (1 - common / union).mean()
    return total


def soft_f1(
    margin: Float[Tensor, " N"], right: Float[Tensor, " N"], people: int, threshold: float | Tensor, softness: float
) -> Float[Tensor, ""]:
    """F1 of the detections of one picture that score above a threshold; 1 where there are no people and none is found.

    people: how many there are. softness: in units of the score; at 0 the result is the hard F1.
    """
    counts = step(margin - threshold, softness)
    found = counts.sum()
    # In a picture without people every detection lowers the F1 of 1.
    nobody = torch.zeros_like(found) + (people == 0)
    return (2 * (counts * right).sum() + nobody) / (found + people + nobody)
