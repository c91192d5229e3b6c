"""The family of registration: how far the background motion is off where masks say that nothing moves."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import torchvision_dddas.functional as F
from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection import (
    LAST_TOLERANCE,
    Engine,
    detect_keypoints,
    fit_motion,
    load_engine,
    match_exposure,
    track_both_ways,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.examples import check_masks, labels_at
from torchvision_dddas.tuning.family import Example, Family

RANSAC, CHECK = "registration.ransac_px", "registration.forward_backward_px"

REJECTED_PX = 2.0
"""The loss of a registration with too few inliers: nothing is detected in the frames about it."""

# A frame with fewer points on the background is no example.
_FEWEST = 8


@dataclass(frozen=True)
class TrackedPoints:
    """The points of one frame that were found in the next one, and again on the way back.

    earlier_px, later_px: u, v. missed_px: distance between the start and the end of the way back. still: points on the
    background, at least a search window away from what moves.
    """

    earlier_px: Float[Tensor, "N 2"]
    later_px: Float[Tensor, "N 2"]
    missed_px: Float[Tensor, " N"]
    still: Bool[Tensor, " N"]


@dataclass(frozen=True)
class RegistrationFamily(Family):
    """The family `registration`. softness: shares of the tolerances."""

    name: str = "registration"
    task: Task = "motion"
    measure: str = "motion.pixels.f"
    softness: tuple[float, float] = (0.3, 0.02)
    empty = "no two consecutive frames have background points that can be tracked"

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """See `Family.check`."""
        if settings.registration.halved:
            raise InputError("registration.halved = true cannot be tuned by gradient; set it to false")
        if CHECK in names and settings.registration.forward_backward_px == 0:
            raise InputError(f"{CHECK} = 0 leaves the check out, which cannot be tuned; set it above 0")

    def check_clips(self, clips: Sequence[Clip], settings: Settings) -> None:
        """See `Family.check_clips`."""
        check_masks(clips)

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, TrackedPoints]]:
        """The frames with masks that have a next one."""
        truth, engine = clip.truth, load_engine("onboard", settings)
        assert truth is not None
        for frame, later in pairwise(open_clip(clip)):
            if frame.number in truth.masks and later.number == frame.number + 1:
                labels = labels_at(truth, frame.number, frame.image.shape)
                points = track_points(engine, frame.image, later.image, labels)
                if int(points.still.sum()) >= _FEWEST:
                    yield frame.number, points

    def _losses(self, batch: Sequence[Example], values: dict[str, Tensor], softness: float) -> list[Tensor]:
        """Pixels by which each pair's motion misses the background."""
        return [_pair_loss(example.content, example.settings.registration, values, softness) for example in batch]


def track_points(engine: Engine, earlier: np.ndarray, later: np.ndarray, labels: np.ndarray) -> TrackedPoints:
    """The points of a picture, (H, W, 3) or (H, W) uint8, that are found in the next. labels: (H, W), 0 background."""
    parameters = engine.parameters.registration
    # All points, whatever their distance on the way back: its limit is tuned.
    unchecked = parameters.model_copy(update={"forward_backward_px": np.inf})
    views = engine.prepare(earlier), engine.prepare(later)
    start = detect_keypoints(views[0].grey, parameters, halved=parameters.halved_corners)
    end, found, missed_px = start, np.zeros(0, bool), np.zeros(0)
    if len(start):
        end, found, missed_px = track_both_ways(*match_exposure(*views), start, unchecked)
    # A point whose search window touches what moves is drawn along by it.
    near = cv2.dilate((labels != 0).astype(np.uint8), np.ones((parameters.window_px, parameters.window_px), np.uint8))
    column, row = start[found].astype(int).T
    numbers = [torch.from_numpy(values[found].astype(float)) for values in (start, end, missed_px)]
    return TrackedPoints(numbers[0], numbers[1], numbers[2], torch.from_numpy(near[row, column] == 0))


def _pair_loss(
    points: TrackedPoints, parameters: RegistrationParameters, values: dict[str, Tensor], softness: float
) -> Tensor:
    tolerance_px, check_px = (
        values.get(name, torch.tensor(value, dtype=torch.float64))
        for name, value in ((RANSAC, parameters.ransac_px), (CHECK, parameters.forward_backward_px))
    )
    has_check = parameters.forward_backward_px > 0
    kept = (points.missed_px <= check_px).numpy() if has_check else np.ones(len(points.still), bool)
    guess = np.eye(3)
    if kept.sum() >= 4:
        start, end = (side.numpy()[kept].astype(np.float32) for side in (points.earlier_px, points.later_px))
        guess = fit_motion(start, end, parameters.model_copy(update={"ransac_px": float(tolerance_px.detach())}))
    fit, limit_px = F.MODELS[parameters.model].fit, check_px if has_check else None
    found = refit_motion(points, torch.from_numpy(guess), tolerance_px, limit_px, fit, softness)
    least = max(parameters.min_inlier_share, 1e-3)
    return found.off_px + REJECTED_PX * F.step(1 - found.share / least, softness)


class Refit(NamedTuple):
    """later_from_earlier: (3, 3). off_px: mean error of the points on the background. share: of points that agree."""

    later_from_earlier: Float[Tensor, "3 3"]
    off_px: Float[Tensor, ""]
    share: Float[Tensor, ""]


def refit_motion(
    points: TrackedPoints,
    guess: Float[Tensor, "3 3"],
    tolerance_px: Tensor,
    check_px: Tensor | None,
    fit: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    softness: float = 0.0,
) -> Refit:
    """The motion of the points that agree with a guess and were tracked there and back.

    tolerance_px, check_px: the parameters ransac_px and forward_backward_px, the latter None without a check. fit: as
    `functional.find_homography`. softness: a share of each. The guess gets no gradient: a refit forgets it.
    """
    earlier, later = points.earlier_px[None], points.later_px[None]
    trusted = torch.ones_like(earlier[..., 0])
    if check_px is not None:
        trusted = F.step(1 - points.missed_px[None] / check_px, softness)
    error_px = F.oneway_transfer_error(earlier, later, guess[None].detach(), squared=False)
    matrix, solved = fit(earlier, later, F.step(1 - error_px / (LAST_TOLERANCE * tolerance_px), softness) * trusted)
    matrix = torch.where(solved[:, None, None], matrix, guess)
    error_px = F.oneway_transfer_error(earlier, later, matrix, squared=False)
    agreeing = F.step(1 - error_px / tolerance_px, softness) * trusted
    # Distances, not squares: a background point that was tracked wrongly counts no more than another.
    return Refit(matrix[0], error_px[0, points.still].mean(), agreeing.sum() / trusted.sum().clamp(min=1))
