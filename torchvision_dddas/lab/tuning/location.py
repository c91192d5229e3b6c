"""The family of locating: how likely the true positions are under their ellipses, which calibrates these.

The loss is the negative log-likelihood of the true positions, in nats a target: smaller ellipses gain until errors fall
outside of them too often. Frames are independent: what the georeferencer keeps from frame to frame
(aerial.correlation_s) makes its ellipses smaller than those tuned here, and is judged by the study's figures.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import GroundParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import GroundLocator, range_people
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.evaluation.studies.scoring import whose_places
from torchvision_dddas.lab.tuning.aerial_location import (
    AerialView,
    aerial_examples,
    aerial_losses,
    default_values,
    fit_view,
    gaussian_nll,
)
from torchvision_dddas.lab.tuning.family import Example, Family
from torchvision_dddas.types import Camera, Poses

UNPLACED = 25.0
"""The loss in nats, without a gradient, of a picture that no pose explains or whose rays miss the ground."""

GROUND = ("ground.body_height_sigma_m", "ground.height_sigma", "ground.feet_sigma")
"""The noise parameters of people located from the ground."""

# Of a difference, as a share of the parameter or of _LEAST.
_STEP, _LEAST = 1e-4, 1e-3


@dataclass(frozen=True)
class LocationFamily(Family):
    """The family `location`. softness has no effect, as nothing here is hard."""

    name: str = "location"
    task: Task = "location"
    measure: str = "location.metres.mean_m"
    softness: tuple[float, float] = (1.0, 1.0)
    empty = "no target was located whose true position is known; nothing to tune on"

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, Any]]:
        """Views from the air of a clip with landmarks; of one with a camera on the ground only, views from there."""
        if clip.truth is None or clip.truth.positions is None:
            raise InputError(f"{clip.name} has no true positions, which tuning of ellipses needs; leave it out")
        yield from ground_examples(clip, settings) if clip.landmarks is None else aerial_examples(clip, settings)

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) nats a target, on the CPU; views from the air of equal shapes are computed together."""
        device = next((value.device for value in parameters.values()), torch.device("cpu"))
        values = {name: value.cpu() for name, value in parameters.items()}
        losses: list[Tensor] = [torch.zeros(0)] * len(batch)
        groups = defaultdict(list)
        for row, example in enumerate(batch):
            view = example.content
            if isinstance(view, AerialView):
                known = {**default_values(example.settings), **values}
                if (fit := fit_view(view, known)) is not None:
                    groups[len(view.marks), len(view.true_m)].append((row, view, fit))
                else:
                    losses[row] = torch.full((), UNPLACED, dtype=torch.float64) + 0 * sum(values.values())
            else:
                losses[row] = ground_loss(view, example.settings.ground, values)
        for members in groups.values():
            rows, views, fits = zip(*members, strict=True)
            for row, loss in zip(rows, aerial_losses(views, known, fits), strict=True):
                losses[row] = loss
        return torch.stack(losses).to(device)


@dataclass(frozen=True)
class GroundView:
    """The people in a picture of a fixed camera. box_px: (N, 4). cut: (N,). true_m: (N, 2) in the camera's metres."""

    camera: Camera
    box_px: np.ndarray
    cut: np.ndarray
    true_m: np.ndarray


def ground_examples(clip: Clip, settings: Settings) -> Iterator[tuple[int, GroundView]]:
    """The frames of a clip with a camera on the ground and detections, in local metres.

    Raises InputError where the clip lacks these, and for ground.mode = paper, which has no error model.
    """
    truth = clip.truth
    assert truth is not None and truth.positions is not None
    if settings.ground.mode == "paper":
        raise InputError("ground.mode = paper has no error model to tune; set ground.mode = default")
    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    camera = read_camera(clip.camera)
    if camera.geographic:
        raise InputError(f"{clip.name}: the camera is given in degrees; wanted local metres, as the true positions are")
    table = read_detections(clip.given)
    (view,) = GroundLocator(camera, settings, rate_hz=clip.rate_hz).place_tables([table])
    places, found_m = truth.positions, view.sightings.east_north_m
    owner, _ = whose_places(truth, places, places.east_north_m, table.frame, table.box_px, found_m)
    known = (owner >= 0) & np.isfinite(found_m).all(axis=1)
    for frame in np.unique(table.frame[known]).tolist():
        rows = np.flatnonzero((table.frame == frame) & known)
        yield frame, GroundView(camera, table.box_px[rows], view.cut[rows], places.east_north_m[owner[rows]])


def ground_loss(seen: GroundView, parameters: GroundParameters, values: Mapping[str, Tensor]) -> Tensor:
    """() nats a person; those who get no position cost UNPLACED, without a gradient.

    `range_people` is smooth in its noise parameters and fast for a whole table, so that its gradient is taken by
    central differences of the hard function itself.
    """
    count, camera = len(seen.box_px), seen.camera
    place = np.tile(camera.place, (count, 1))
    poses = Poses(place, np.full(count, camera.heading_rad), np.full(count, camera.pitch_rad))
    tuned = {name.partition(".")[2]: values[name] for name in GROUND if name in values}
    at = {name: float(value.detach()) for name, value in tuned.items()}

    def locate(changed: Mapping[str, float]) -> np.ndarray:
        found = range_people(seen.box_px, seen.cut, camera, poses, place, parameters.model_copy(update=dict(changed)))
        return np.concatenate([found.east_north_m - seen.true_m, found.covariance_m2.reshape(-1, 4)], axis=1)

    rows = torch.as_tensor(locate(at))
    known = torch.isfinite(rows).all(dim=1)
    for name, value in tuned.items():
        if value.requires_grad:
            step = _STEP * max(abs(at[name]), _LEAST)
            more, less = (locate({**at, name: at[name] + side}) for side in (step, -step))
            slope = np.nan_to_num((more - less) / (2 * step), posinf=0.0, neginf=0.0)
            rows = rows + torch.as_tensor(slope) * (value - value.detach())
    placed = rows[known]
    total = gaussian_nll(placed[:, :2], placed[:, 2:].reshape(-1, 2, 2)).sum() + UNPLACED * (~known).sum()
    return total / len(rows)
