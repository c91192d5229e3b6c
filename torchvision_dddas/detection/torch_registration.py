"""The step from a frame to the next in tensors: grid keypoints, where they went, what to trust; all pairs at once."""

import numpy as np
import torch
from torch.nn import functional

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.detection.engine import View
from torchvision_dddas.detection.exposure import in_one_light
from torchvision_dddas.detection.keypoint_grid import cell_side
from torchvision_dddas.detection.registration_check import judged
from torchvision_dddas.detection.torch_foreground import LEVEL, joined, levels_of
from torchvision_dddas.detection.torch_point_tracking import follow
from torchvision_dddas.functional import flow, keypoints
from torchvision_dddas.geometry import transfer
from torchvision_dddas.types import Registration

POINTS_AT_ONCE = {"cpu": 1000, "cuda": 100_000}


def register(
    pairs: list[tuple[View, View]], parameters: RegistrationParameters, device: torch.device
) -> list[Registration]:
    """The background's motion from the first to the second frame of each pair, all of one size.

    Pyramids, and the keypoints of the earlier frames, are left in `kept` for other pairs.
    """
    for earlier, _ in pairs:
        _detect(earlier, parameters, device)
    followed = [_in_one_light(earlier, later) for earlier, later in pairs]
    _build_pyramids([view for pair in followed for view in pair], parameters, device)
    count = max(pairs[0][0].kept["points"].shape[1], 1)
    step = max(1, POINTS_AT_ONCE.get(device.type, 1000) // count)
    found: list[Registration] = []
    for first in range(0, len(pairs), step):
        part = np.s_[first : first + step]
        found += _register_at_once([earlier for earlier, _ in pairs[part]], followed[part], parameters)
    return found


def _register_at_once(
    detected: list[View], followed: list[tuple[View, View]], parameters: RegistrationParameters
) -> list[Registration]:
    """detected: the frames that hold the keypoints. followed: the same frames and the later ones, in one light."""
    points, valid = (joined([view.kept[name] for view in detected]) for name in ("points", "valid"))
    earlier, later = (
        [joined(level) for level in zip(*(pair[i].kept["pyramid"] for pair in followed), strict=True)] for i in (0, 1)
    )
    if points.shape[1]:
        end, found, matrices = follow(points, valid, earlier, later, parameters)
        tracked = valid & found
    else:
        end, tracked, matrices = points, valid, torch.eye(3).expand(len(detected), 3, 3)
    arrays = (array.cpu().numpy() for array in (points, end, valid, tracked, matrices))
    return [_judged(one, detected[0].size, parameters) for one in zip(*arrays, strict=True)]


def _in_one_light(earlier: View, later: View) -> tuple[View, View]:
    """The pair as it is followed: where exposures differ, one of the two is a view of its own."""
    greys = in_one_light(earlier, later)
    first, second = (
        view if grey is view.grey else View(view.image, grey)
        for view, grey in zip((earlier, later), greys, strict=True)
    )
    return first, second


def _build_pyramids(views: list[View], parameters: RegistrationParameters, device: torch.device) -> None:
    """Those that are not there yet, in one batch."""
    missing = list({id(view): view for view in views if "pyramid" not in view.kept}.values())
    if not missing:
        return
    levels, smaller_side = 1, min(missing[0].size)
    # OpenCV's rule: a level that Lucas-Kanade's window does not fit into is left out.
    while levels <= parameters.levels and smaller_side / 2**levels > parameters.window_px:
        levels += 1
    pictures = flow.pyramid(joined([levels_of(view, device) for view in missing]), levels)
    for number, view in enumerate(missing):
        view.kept["pyramid"] = [level[number : number + 1] for level in pictures]


def _detect(view: View, parameters: RegistrationParameters, device: torch.device) -> None:
    """Keypoints, at half the resolution where the onboard engine looks for them so, at a quarter of the cost."""
    if "points" in view.kept:
        return
    levels, cell, step = levels_of(view, device), cell_side(*view.size, parameters), 1
    if parameters.redetect_frames > 1 and min(view.size) > 1:
        # Half a pixel to the left and top of where the corner stands: a search window does not mind.
        levels, cell, step = functional.avg_pool2d(levels, 2), max(cell // 2, 1), 2
    points, _, valid = keypoints.grid_features(
        levels, cell, parameters.quality, parameters.block_px, least=1e-7 * LEVEL**2
    )
    view.kept["points"], view.kept["valid"] = step * points, valid


def _judged(found: tuple[np.ndarray, ...], size: tuple[int, int], parameters: RegistrationParameters) -> Registration:
    start, end, valid, tracked, later_from_earlier = found
    start, end = start[tracked], end[tracked]
    if valid.sum() < 4 or len(start) < 4:
        return judged(np.eye(3), len(start) if valid.sum() >= 4 else 0, 0, np.inf, size, parameters)
    miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
    inliers = miss < parameters.ransac_px
    error = float(np.median(miss[inliers])) if inliers.any() else np.inf
    return judged(later_from_earlier.astype(np.float64), len(start), int(inliers.sum()), error, size, parameters)
