"""What clips tell of places of people seen from the ground, and how surprising their errors are.

`targets.ranging.sight` weighs height and foot row by parameters, and settles where they disagree: it is smooth in its
three noise parameters, and so quick for a whole table that its slope is taken by differences of the hard function
itself.
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
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.soft_places import gaussian_nll
from torchvision_dddas.types import Camera, Poses

KNOBS = ("ground.body_height_sigma_m", "ground.height_sigma", "ground.feet_sigma")

_STEP = 1e-4
"""Of a difference, as a share of the parameter, or of the least that counts."""

_LEAST = 1e-3


@dataclass(frozen=True)
class Sighted:
    """People whom one camera saw in a picture. box_px: (N, 4). cut: (N,). true_m: (N, 2) in the camera's metres."""

    camera: Camera
    box_px: np.ndarray
    cut: np.ndarray
    poses: Poses
    here_m: np.ndarray
    true_m: np.ndarray


def sightings_of(clip: Clip, settings: Settings) -> Iterator[Example]:
    """Those of a clip with a camera on the ground and detections, frame by frame; metres alone.

    Raises InputError where the clip lacks them or true places, and for ground.mode = paper, which knows no errors.
    """
    from torchvision_dddas.geo.ground_locator import GroundLocator
    from torchvision_dddas.io.camera_files import read_camera
    from torchvision_dddas.io.detection_tables import read_detections

    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; ellipses cannot be tuned on it. Give clips with positions")
    if settings.ground.mode == "paper":
        raise InputError("ground.mode = paper knows no errors that could be tuned; take ground.mode = default")
    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    camera = read_camera(clip.camera)
    if camera.geographic:
        raise InputError(f"{clip.name}: the camera stands at degrees; wanted local metres, as the true places are")
    table = read_detections(clip.given)
    (view,) = GroundLocator(camera, settings, rate_hz=clip.rate_hz).place_tables([table])
    places = truth.positions
    whose, _ = whose_places(truth, places, places.east_north_m, table.frame, table.box_px, view.sightings.east_north_m)
    whose = np.where(np.isfinite(view.sightings.east_north_m).all(axis=1), whose, -1)
    for frame in np.unique(table.frame).tolist():
        rows = np.flatnonzero((table.frame == frame) & (whose >= 0))
        if len(rows):
            true_m = places.east_north_m[whose[rows]]
            yield Example(clip.name, frame, (sighted(camera, table.box_px[rows], view.cut[rows], true_m), settings))


def sighted(camera: Camera, box_px: np.ndarray, cut: np.ndarray, true_m: np.ndarray) -> Sighted:
    """People in a picture of a camera that stands still."""
    n = len(box_px)
    place = np.tile(camera.place, (n, 1))
    poses = Poses(place, np.full(n, camera.heading_rad), np.full(n, camera.pitch_rad))
    return Sighted(camera, box_px, cut, poses, place, true_m)


def person_lost(seen: Sighted, settings: Settings, parameters: Mapping[str, Tensor], unplaced: float) -> Tensor:
    """() nats a person; those whom the parameters leave without a place cost `unplaced`, without a slope."""
    values = {name: parameters[name] for name in KNOBS if name in parameters}

    def hard(*given: float) -> np.ndarray:
        changed = dict(zip((name.partition(".")[2] for name in values), given, strict=True))
        found = range_people(
            seen.box_px, seen.cut, seen.camera, seen.poses, seen.here_m, settings.ground.model_copy(update=changed)
        )
        off = found.east_north_m - seen.true_m
        return np.concatenate([off, found.covariance_m2.reshape(-1, 4)], axis=1)

    rows: Tensor = _ByDifferences.apply(hard, *values.values())
    known = torch.isfinite(rows).all(dim=1)
    told = rows[known]
    total = gaussian_nll(told[:, :2], told[:, 2:].reshape(-1, 2, 2)).sum() + unplaced * (~known).sum()
    return total / len(rows)


class _ByDifferences(torch.autograd.Function):
    """A function of numbers in NumPy, with the slope of its central differences."""

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
