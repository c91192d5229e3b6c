"""Examples and loss of people located from the ground.

`geo.ranging.range_people` is smooth in its three noise parameters and fast for a whole table, so that its gradient is
taken by differences of the hard function itself.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.scoring import whose_places
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.tuning.aerial_location import gaussian_nll
from torchvision_dddas.types import Camera, Poses

PARAMETERS = ("ground.body_height_sigma_m", "ground.height_sigma", "ground.feet_sigma")

_STEP = 1e-4
"""Of a difference, as a share of the parameter or of _LEAST."""

_LEAST = 1e-3


@dataclass(frozen=True)
class GroundView:
    """The people in a picture. box_px: (N, 4). cut: (N,). true_m: (N, 2) in the camera's metres. here_m: the camera."""

    camera: Camera
    box_px: np.ndarray
    cut: np.ndarray
    poses: Poses
    here_m: np.ndarray
    true_m: np.ndarray


def ground_examples(clip: Clip, settings: Settings) -> Iterator[tuple[int, tuple[GroundView, Settings]]]:
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
    places = truth.positions
    whose, _ = whose_places(truth, places, places.east_north_m, table.frame, table.box_px, view.sightings.east_north_m)
    whose = np.where(np.isfinite(view.sightings.east_north_m).all(axis=1), whose, -1)
    for frame in np.unique(table.frame).tolist():
        rows = np.flatnonzero((table.frame == frame) & (whose >= 0))
        if len(rows):
            true_m = places.east_north_m[whose[rows]]
            yield frame, (build_ground_view(camera, table.box_px[rows], view.cut[rows], true_m), settings)


def build_ground_view(camera: Camera, box_px: np.ndarray, cut: np.ndarray, true_m: np.ndarray) -> GroundView:
    """People in a picture of a fixed camera."""
    n = len(box_px)
    place = np.tile(camera.place, (n, 1))
    poses = Poses(place, np.full(n, camera.heading_rad), np.full(n, camera.pitch_rad))
    return GroundView(camera, box_px, cut, poses, place, true_m)


def ground_loss(seen: GroundView, settings: Settings, parameters: Mapping[str, Tensor], unplaced: float) -> Tensor:
    """() nats a person; those who get no position cost `unplaced`, without a gradient."""
    values = {name: parameters[name] for name in PARAMETERS if name in parameters}

    def hard(*given: float) -> np.ndarray:
        changed = dict(zip((name.partition(".")[2] for name in values), given, strict=True))
        found = range_people(
            seen.box_px, seen.cut, seen.camera, seen.poses, seen.here_m, settings.ground.model_copy(update=changed)
        )
        off = found.east_north_m - seen.true_m
        return np.concatenate([off, found.covariance_m2.reshape(-1, 4)], axis=1)

    rows: Tensor = _ByDifferences.apply(hard, *values.values())
    known = torch.isfinite(rows).all(dim=1)
    placed = rows[known]
    total = gaussian_nll(placed[:, :2], placed[:, 2:].reshape(-1, 2, 2)).sum() + unplaced * (~known).sum()
    return total / len(rows)


class _ByDifferences(torch.autograd.Function):
    """A NumPy function of numbers, with the gradient of its central differences."""

    @staticmethod
    def forward(ctx: Any, hard: Callable[..., np.ndarray], *values: Tensor) -> Tensor:
        at = [float(value) for value in values]
        slopes = []
        for k in range(len(values)):
            step = _STEP * max(abs(at[k]), _LEAST)
            if ctx.needs_input_grad[k + 1]:
                more, less = (hard(*at[:k], at[k] + side, *at[k + 1 :]) for side in (step, -step))
                slope = np.nan_to_num((more - less) / (2 * step), posinf=0.0, neginf=0.0)
            else:
                slope = np.zeros(0)
            slopes.append(torch.as_tensor(slope))
        ctx.slopes, ctx.kinds = slopes, [(value.dtype, value.device) for value in values]
        return torch.as_tensor(hard(*at))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        (grad,) = grads
        found: list[Any] = [None]
        for k, slope in enumerate(ctx.slopes):
            dtype, device = ctx.kinds[k]
            wanted = ctx.needs_input_grad[k + 1]
            found.append((grad * slope).sum().to(device=device, dtype=dtype) if wanted else None)
        return tuple(found)
