"""The family of registration: how far the background motion is off where masks say that nothing moves."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection import Engine, load_engine, match_exposure
from torchvision_dddas.detection.opencv_registration import (
    LAST_TOLERANCE,
    detect_keypoints,
    fit_motion,
    track_both_ways,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.functional import affine, homography
from torchvision_dddas.functional.consensus import Fit, fit_to_inliers, inlier_weights, transfer_error
from torchvision_dddas.functional.soft import step
from torchvision_dddas.tuning.examples import check_masks, labels_at
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.types import Frame

RANSAC, CHECK = "registration.ransac_px", "registration.forward_backward_px"

LOST_PX = 2.0
"""What a registration costs that is not believed: the frames about it show nothing."""

_FEWEST = 8
"""Points on background from which on a frame says something."""


@dataclass(frozen=True)
class TrackedFrame:
    """The points of one frame that were found in the next one, and again on the way back.

    earlier_px, later_px: u, v. missed_px: by how much the way back missed its start. still: which lie on background,
    out of reach of what moves.
    """

    earlier_px: Float[Tensor, "N 2"]
    later_px: Float[Tensor, "N 2"]
    missed_px: Float[Tensor, " N"]
    still: Bool[Tensor, " N"]


@dataclass(frozen=True)
class Step:
    """A pair of frames: its points, and the parameters of what is not tuned."""

    points: TrackedFrame
    parameters: RegistrationParameters


class Registering:
    """Implements `Family` for the parameters of registration."""

    name = "registration"
    task: Task = "motion"
    measure = "motion.pixels.f"
    softness = (0.3, 0.02)
    """Shares of the tolerances."""

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """Raises InputError for settings that cannot be tuned. See `family.Particular`."""
        if settings.registration.halved:
            raise InputError("registration.halved = true cannot be tuned by gradient; set it to false")
        if CHECK in names and settings.registration.forward_backward_px == 0:
            raise InputError(f"{CHECK} = 0 leaves the check out, which cannot be tuned; set it above 0")

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """The frames with masks that have a next one. Raises InputError for a clip without any."""
        check_masks(clips)
        found: list[Example] = []
        for clip in clips:
            before = len(found)
            for example in _examples(clip, settings):
                found.append(example)
                tick()
            if len(found) == before:
                raise InputError(f"{clip.name}: no two frames after each other have background that can be followed")
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) px by which each pair's motion misses the background. On the CPU, where points are few."""
        device = next(iter(parameters.values())).device if parameters else torch.device("cpu")
        here = {name: value.cpu() for name, value in parameters.items()}
        return torch.stack([_lost(example.content, here, softness) for example in batch]).to(device)


def family() -> Registering:
    """See `family.family_of`."""
    return Registering()


def followed(engine: Engine, earlier: np.ndarray, later: np.ndarray, labels: np.ndarray) -> TrackedFrame:
    """The points of a picture, (H, W, 3) or (H, W) uint8, that are found in the next. labels: (H, W), 0 background."""
    parameters = engine.parameters.registration
    # Whatever the way back misses by: how much it may is tuned.
    freely = parameters.model_copy(update={"forward_backward_px": np.inf})
    views = engine.prepare(earlier), engine.prepare(later)
    start = detect_keypoints(views[0].grey, parameters, halved=parameters.redetect_frames > 1)
    if not len(start):
        end, found, missed_px = start, np.zeros(0, bool), np.zeros(0)
    else:
        end, found, missed_px = track_both_ways(*match_exposure(*views), start, freely)
    # A point whose search window meets what moves is drawn along by it.
    near = cv2.dilate((labels != 0).astype(np.uint8), np.ones((parameters.window_px, parameters.window_px), np.uint8))
    column, row = start[found].astype(int).T
    still = near[row, column] == 0
    return TrackedFrame(
        torch.from_numpy(start[found].astype(float)),
        torch.from_numpy(end[found].astype(float)),
        torch.from_numpy(missed_px[found].astype(float)),
        torch.from_numpy(still),
    )


def _examples(clip: Clip, settings: Settings) -> Iterator[Example]:
    truth, engine = clip.truth, load_engine("onboard", settings)
    assert truth is not None, "asked for clips with masks alone"
    frames: Iterator[tuple[Frame, Frame]] = pairwise(open_clip(clip))
    for frame, later in frames:
        if frame.number not in truth.masks or later.number != frame.number + 1:
            continue
        labels = labels_at(truth, frame.number, frame.image.shape)
        points = followed(engine, frame.image, later.image, labels)
        if int(points.still.sum()) >= _FEWEST:
            yield Example(clip.name, frame.number, Step(points, settings.registration))


def _lost(pair: Step, parameters: Mapping[str, Tensor], softness: float) -> Tensor:
    fixed, points = pair.parameters, pair.points
    tolerance_px = parameters.get(RANSAC, torch.tensor(fixed.ransac_px, dtype=torch.float64))
    check_px = parameters.get(CHECK, torch.tensor(fixed.forward_backward_px, dtype=torch.float64))
    kept = (points.missed_px <= check_px).numpy() if fixed.forward_backward_px else np.ones(len(points.still), bool)
    guess = np.eye(3)
    if kept.sum() >= 4:
        start, end = (side.numpy()[kept].astype(np.float32) for side in (points.earlier_px, points.later_px))
        guess = fit_motion(start, end, fixed.model_copy(update={"ransac_px": float(tolerance_px.detach())}))
    found = refitted(
        points,
        torch.from_numpy(guess),
        tolerance_px,
        check_px if fixed.forward_backward_px else None,
        LAST_TOLERANCE,
        affine.fit if fixed.model == "affine" else homography.fit,
        softness,
    )
    least = max(fixed.min_inlier_share, 1e-3)
    return found.off_px + LOST_PX * step(1 - found.share / least, softness)


class Refitted(NamedTuple):
    """later_from_earlier: (3, 3). off_px: mean miss of the points on background. share: of the points that agree."""

    later_from_earlier: Float[Tensor, "3 3"]
    off_px: Float[Tensor, ""]
    share: Float[Tensor, ""]


def refitted(
    points: TrackedFrame,
    guess: Float[Tensor, "3 3"],
    tolerance_px: Tensor,
    check_px: Tensor | None,
    last_share: float,
    fit: Fit,
    softness: float = 0.0,
) -> Refitted:
    """The motion of the points that agree with a guess and were followed there and back.

    tolerance_px, check_px: the parameters ransac_px and forward_backward_px, the latter None where there is no check.
    last_share: of the tolerance, which the refit keeps to. fit: as `ops.homography.fit`. softness: a share of each.
    """
    earlier, later = points.earlier_px[None], points.later_px[None]
    trusted = torch.ones_like(earlier[..., 0])
    if check_px is not None:
        trusted = inlier_weights(points.missed_px[None], check_px, softness)
    matrix, _ = fit_to_inliers(earlier, later, trusted, guess[None], last_share * tolerance_px, fit, softness)
    error_px = transfer_error(matrix, earlier, later)
    agreeing = inlier_weights(error_px, tolerance_px, softness) * trusted
    # Distances, not their squares: a point on background that was lost on the way has no more say than another.
    return Refitted(
        matrix[0],
        error_px[0, points.still].mean(),
        agreeing.sum() / trusted.sum().clamp(min=1),
    )
