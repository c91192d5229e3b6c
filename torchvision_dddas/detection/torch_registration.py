"""The registration of frame pairs in tensors, all at once: keypoints, point tracking, RANSAC, refits."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.detection.engine import View
from torchvision_dddas.detection.registration import cell_side, judge_points, match_exposure
from torchvision_dddas.functional import affine, consensus, flow, homography, keypoints
from torchvision_dddas.types import Registration

LEVEL = 255.0
POINTS_AT_ONCE = {"cpu": 1000, "cuda": 100_000}
# So many points search for the motion first; the others start where it takes them.
SCOUTS = 32
# Gates of the refits, in RANSAC's tolerance; they matter most for accuracy.
REFITS = (1.5, 1.0, 0.5, 0.5)


def register(
    pairs: list[tuple[View, View]], parameters: RegistrationParameters, device: torch.device
) -> list[Registration]:
    """The background's motion from the first to the second frame of each pair, all of one size.

    Pyramids, and the keypoints of the earlier frames, are left in `kept` for other pairs.
    """
    for earlier, _ in pairs:
        _detect(earlier, parameters, device)
    matched = [_match_exposures(earlier, later) for earlier, later in pairs]
    _build_pyramids([view for pair in matched for view in pair], parameters, device)
    count = max(pairs[0][0].kept["points"].shape[1], 1)
    step = max(1, POINTS_AT_ONCE.get(device.type, 1000) // count)
    found: list[Registration] = []
    for first in range(0, len(pairs), step):
        part = np.s_[first : first + step]
        found += _register_at_once([earlier for earlier, _ in pairs[part]], matched[part], parameters)
    return found


def _register_at_once(
    detected: list[View], pairs: list[tuple[View, View]], parameters: RegistrationParameters
) -> list[Registration]:
    """detected: the frames that hold the keypoints. pairs: the same frames and the later ones, in equal exposure."""
    points, valid = (join_batch([view.kept[name] for view in detected]) for name in ("points", "valid"))
    earlier, later = (
        [join_batch(level) for level in zip(*(pair[i].kept["pyramid"] for pair in pairs), strict=True)] for i in (0, 1)
    )
    if points.shape[1]:
        end, found, matrices = _track_points(_Batch(points, valid, earlier, later), parameters)
        tracked = valid & found
    else:
        end, tracked, matrices = points, valid, torch.eye(3).expand(len(detected), 3, 3)
    arrays = (array.cpu().numpy() for array in (points, end, tracked, matrices.double()))
    size = detected[0].size
    return [
        judge_points(matrix, start[kept], end[kept], size, parameters)[0]
        for start, end, kept, matrix in zip(*arrays, strict=True)
    ]


def _match_exposures(earlier: View, later: View) -> tuple[View, View]:
    """The pair in equal exposure: where exposures differ, one of the two is a view of its own."""
    greys = match_exposure(earlier, later)
    first, second = (
        view if grey is view.grey else View(view.image, grey)
        for view, grey in zip((earlier, later), greys, strict=True)
    )
    return first, second


def _build_pyramids(views: list[View], parameters: RegistrationParameters, device: torch.device) -> None:
    """Build the missing pyramids in one batch."""
    missing = list({id(view): view for view in views if "pyramid" not in view.kept}.values())
    if not missing:
        return
    levels, smaller_side = 1, min(missing[0].size)
    # OpenCV's rule: a level that Lucas-Kanade's window does not fit into is left out.
    while levels <= parameters.levels and smaller_side / 2**levels > parameters.window_px:
        levels += 1
    pictures = flow.pyramid(join_batch([levels_of(view, device) for view in missing]), levels)
    for number, view in enumerate(missing):
        view.kept["pyramid"] = [level[number : number + 1] for level in pictures]


def _detect(view: View, parameters: RegistrationParameters, device: torch.device) -> None:
    """Detect keypoints, at half the resolution where the onboard engine does so, at a quarter of the cost."""
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


def levels_of(view: View, device: torch.device) -> Tensor:
    """(1, 1, H, W) float32 grey levels, computed once."""
    if "levels" not in view.kept:
        view.kept["levels"] = torch.from_numpy(view.grey)[None, None].to(device).float()
    levels: Tensor = view.kept["levels"]
    return levels


def join_batch(pictures: Sequence[Tensor]) -> Tensor:
    """One batch; a single picture is not copied."""
    return pictures[0] if len(pictures) == 1 else torch.cat(list(pictures))


class _Batch(NamedTuple):
    """points: (B, N, 2) keypoints, valid (B, N) which are there. earlier, later: pyramids."""

    points: Tensor
    valid: Tensor
    earlier: list[Tensor]
    later: list[Tensor]

    def select(self, chosen: Tensor) -> "_Batch":
        earlier, later = ([level[chosen] for level in pyramid] for pyramid in (self.earlier, self.later))
        return _Batch(self.points[chosen], self.valid[chosen], earlier, later)


Tracked = tuple[Tensor, Tensor, Tensor]
"""Where the points are in the later frames, which were found, and the motion (B, 3, 3) that they agree on."""


def _track_points(batch: _Batch, parameters: RegistrationParameters) -> Tracked:
    """Lucas-Kanade and RANSAC.

    A few scouts search the whole pyramid; the others start where the scouts' motion takes them, which is much faster.
    Where the scouts do not agree, all points search the whole pyramid.
    """
    points, valid = batch.points, batch.valid
    if points.shape[1] < 2 * SCOUTS:
        return _search_everywhere(batch, parameters)
    scouts = consensus.spread(valid, SCOUTS)
    start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
    # A scout that has not arrived after a few steps does not count.
    ahead, found = flow.track(start, batch.earlier, batch.later, rounds=2, **_settings(parameters, most_steps=8))
    found = found & valid.gather(1, scouts)
    motion = _ransac(start.double(), ahead.double(), found, parameters, parameters.hypotheses // 2, (1.5, 1.0)).float()
    near = found & (consensus.transfer_error(motion, start, ahead) < parameters.ransac_px)
    agreed = near.sum(1) >= (0.6 * valid.gather(1, scouts).sum(1)).clamp(min=12)
    end, kept, motion = torch.zeros_like(points), torch.zeros_like(valid), motion.double()
    for choice, search in ((agreed, _search_near), (~agreed, _search_everywhere)):
        chosen = choice.nonzero()[:, 0]
        if len(chosen) == len(points):
            return search(batch, parameters, motion)
        if len(chosen):
            end[chosen], kept[chosen], motion[chosen] = search(batch.select(chosen), parameters, motion[chosen])
    return end, kept, motion


def _search_everywhere(batch: _Batch, parameters: RegistrationParameters, _: Tensor | None = None) -> Tracked:
    """Lucas-Kanade through the whole pyramid, then RANSAC."""
    end, found = _track(batch, None, parameters, _settings(parameters) | {"rounds": 3})
    start, valid = batch.points.double(), batch.valid & found
    return end, found, _ransac(start, end.double(), valid, parameters, parameters.hypotheses, REFITS)


def _search_near(batch: _Batch, parameters: RegistrationParameters, motion: Tensor) -> Tracked:
    """Lucas-Kanade in the finest level alone, near where the motion takes the points; refits of that motion."""
    finest = batch._replace(earlier=batch.earlier[:1], later=batch.later[:1])
    guess = consensus.transfer(motion.float(), batch.points)
    end, found = _track(finest, guess, parameters, _settings(parameters, most_steps=10) | {"reach_px": 3})
    gates_px = tuple(share * parameters.ransac_px for share in REFITS)
    model, start = _model(parameters), batch.points.double()
    valid = batch.valid & found
    return end, found, consensus.refit(start, end.double(), valid, motion, gates_px, model.SAMPLE_SIZE, model.fit)


def _track(
    batch: _Batch, guess: Tensor | None, parameters: RegistrationParameters, settings: dict[str, Any]
) -> tuple[Tensor, Tensor]:
    pictures, limit_px = (batch.points, batch.earlier, batch.later), parameters.forward_backward_px
    if limit_px > 0:
        return flow.forward_backward(*pictures, guess, limit_px=limit_px, **settings)
    return flow.track(*pictures, guess, **settings)


def _settings(parameters: RegistrationParameters, most_steps: int = 1000) -> dict[str, Any]:
    return {
        "window_px": parameters.window_px,
        "iterations": min(parameters.iterations, most_steps),
        "epsilon_px": parameters.epsilon_px,
        "min_eigen": 1e-4 * LEVEL**2,
    }


def _model(parameters: RegistrationParameters) -> ModuleType:
    return affine if parameters.model == "affine" else homography


def _ransac(
    start: Tensor,
    end: Tensor,
    tracked: Tensor,
    parameters: RegistrationParameters,
    hypotheses: int,
    shares: tuple[float, ...],
) -> Tensor:
    """RANSAC, then least squares on the inliers of a tightening tolerance, `shares` of RANSAC's own."""
    model = _model(parameters)
    batch, count = tracked.shape
    if count < model.SAMPLE_SIZE:
        return torch.eye(3, dtype=start.dtype, device=start.device).expand(batch, 3, 3)
    # The same numbers for every pair and call: what one pair gives does not depend on its company.
    generator = torch.Generator().manual_seed(0)
    samples = consensus.draw_samples(generator, 1, hypotheses, count, model.SAMPLE_SIZE)
    samples = samples.to(start.device).expand(batch, -1, -1)
    refits = tuple(share * parameters.ransac_px for share in shares)
    matrix: Tensor = model.ransac(start, end, tracked, samples, parameters.ransac_px, refits)[0]
    return matrix
