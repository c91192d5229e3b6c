"""Where keypoints went and the one motion they agree on: Lucas-Kanade, RANSAC, refits on the inliers; in tensors."""

from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.detection.torch_foreground import LEVEL
from torchvision_dddas.functional import affine, consensus, flow, homography

SCOUTS = 32


def follow(
    points: Tensor, valid: Tensor, earlier: list[Tensor], later: list[Tensor], parameters: RegistrationParameters
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the points are in the later frames, which were found, and the motion (B, 3, 3) that they agree on.

    A few scouts search the whole pyramid; the others start where the scouts' motion takes them, which is quicker by
    far. Where the scouts do not agree, all points search the whole pyramid.
    """
    if points.shape[1] < 2 * SCOUTS:
        return _from_nothing(points, valid, earlier, later, parameters)
    scouts = consensus.spread(valid, SCOUTS)
    start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
    # Scouts only lead: whoever is not there after a few steps does not count.
    ahead, found = flow.track(start, earlier, later, rounds=2, **_tracking(parameters, most_steps=8))
    found = found & valid.gather(1, scouts)
    motion = _ransac(start.double(), ahead.double(), found, parameters, parameters.hypotheses // 2, (1.5, 1.0)).float()
    near = found & (consensus.transfer_error(motion, start, ahead) < parameters.ransac_px)
    agreed = near.sum(1) >= (0.6 * valid.gather(1, scouts).sum(1)).clamp(min=12)
    end, kept, motion = torch.zeros_like(points), torch.zeros_like(valid), motion.double()
    for choice, search in ((agreed, _from_guess), (~agreed, _from_nothing)):
        chosen = choice.nonzero()[:, 0]
        if len(chosen) == len(points):
            return search(points, valid, earlier, later, parameters, motion)
        if len(chosen):
            pyramids = [level[chosen] for level in earlier], [level[chosen] for level in later]
            end[chosen], kept[chosen], motion[chosen] = search(
                points[chosen], valid[chosen], *pyramids, parameters, motion[chosen]
            )
    return end, kept, motion


def _from_nothing(
    points: Tensor,
    valid: Tensor,
    earlier: list[Tensor],
    later: list[Tensor],
    parameters: RegistrationParameters,
    _: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Lucas-Kanade through the whole pyramid, then RANSAC."""
    settings = _tracking(parameters) | {"rounds": 3}
    end, found = _there_and_back(points, earlier, later, None, parameters, settings)
    motion = _ransac(
        points.double(), end.double(), valid & found, parameters, parameters.hypotheses, (1.5, 1.0, 0.5, 0.5)
    )
    return end, found, motion


def _from_guess(
    points: Tensor,
    valid: Tensor,
    earlier: list[Tensor],
    later: list[Tensor],
    parameters: RegistrationParameters,
    motion: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Lucas-Kanade in the finest level alone, near where the motion takes the points; refits of that motion."""
    guess = consensus.transfer(motion.float(), points)
    settings = _tracking(parameters, most_steps=10) | {"reach_px": 3}
    end, found = _there_and_back(points, earlier[:1], later[:1], guess, parameters, settings)
    gates_px = tuple(share * parameters.ransac_px for share in (1.5, 1.0, 0.5, 0.5))
    model = _model(parameters)
    refits = consensus.refitted(
        points.double(), end.double(), valid & found, motion, gates_px, model.SAMPLE_SIZE, model.fit
    )
    return end, found, refits


def _there_and_back(
    points: Tensor,
    earlier: list[Tensor],
    later: list[Tensor],
    guess: Tensor | None,
    parameters: RegistrationParameters,
    settings: dict[str, Any],
) -> tuple[Tensor, Tensor]:
    if parameters.forward_backward_px > 0:
        return flow.forward_backward(points, earlier, later, guess, limit_px=parameters.forward_backward_px, **settings)
    return flow.track(points, earlier, later, guess, **settings)


def _tracking(parameters: RegistrationParameters, most_steps: int = 1000) -> dict[str, Any]:
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
    """RANSAC, then least squares on the inliers of a tightening tolerance, `shares` of RANSAC's own.

    The refits matter most for accuracy.
    """
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
