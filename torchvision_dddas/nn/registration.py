"""The background's motion between frames (appendix B, steps S1 to S3), batched, for the torch engine and the graph.

A few points, the scouts, search the whole pyramid for the motion. The other points start where this motion takes them
and search only at full resolution, which is much faster. If the scouts do not agree, all points search the whole
pyramid. On a GPU and in a trace both searches are done for every pair, and the device selects the result.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

import torchvision_dddas.functional as F
from torchvision_dddas.config import RegistrationParameters

LEVEL = 255.0
# The scouts show the motion if this share of them, and at least this number, agree with it.
_AGREEING, _FEWEST = 0.6, 12
_SCOUT_REACH_PX, _NEAR_REACH_PX = 4, 3


@dataclass(frozen=True)
class Effort:
    """How thorough the search is.

    scouts: their number. rounds: largest number of tables that a scout makes at a level. scout_steps, near_steps:
    Lucas-Kanade steps of scouts, and of points that start near their place. scout_refits, refits: gates of the refits,
    as shares of RANSAC's tolerance; they matter most for accuracy. branches: False takes one path for all data, as a
    graph must: no point is tracked back, and RANSAC on all points follows the scouts.
    """

    scouts: int = 32
    rounds: int = 2
    scout_steps: int = 8
    near_steps: int = 10
    scout_refits: tuple[float, ...] = (1.5, 1.0)
    refits: tuple[float, ...] = (1.5, 1.0, 0.5, 0.5)
    branches: bool = True


# With 64 scouts, or 3 steps, one motion in some dozens is lost. 200 scouts would take three times as many operations.
GRAPH_EFFORT = Effort(96, 1, 6, 6, (1.0,), (1.0, 0.5), branches=False)


class Motion(NamedTuple):
    """The result of `FrameRegistration`.

    later_from_earlier: float64. start_px, end_px: keypoints, and the places where they were found if tracked. inliers:
    the tracked keypoints that agree with the matrix. If none agree, the matrix is the identity, without inliers.

    >>> picture = F.gaussian_blur2d(torch.rand(1, 1, 96, 96), 7)
    >>> motion = nn.FrameRegistration()(picture, picture)
    >>> motion.later_from_earlier.dtype, bool(motion.inliers.any())
    (torch.float64, True)
    """

    later_from_earlier: Float[Tensor, "B 3 3"]
    start_px: Float[Tensor, "B N 2"]
    end_px: Float[Tensor, "B N 2"]
    tracked: Bool[Tensor, "B N"]
    inliers: Bool[Tensor, "B N"]


class FrameRegistration(nn.Module):
    """Corners, pyramidal Lucas-Kanade, RANSAC and refits. The module learns nothing.

    >>> picture = F.gaussian_blur2d(torch.rand(1, 1, 96, 96), 7)
    >>> motion = nn.FrameRegistration()(picture, picture.roll(3, -1))
    >>> motion.later_from_earlier[0, 0, 2].round(decimals=1)
    tensor(3., dtype=torch.float64)
    """

    def __init__(self, parameters: RegistrationParameters | None = None, *, effort: Effort | None = None) -> None:
        super().__init__()
        self.settings, self.effort = parameters or RegistrationParameters(), effort or Effort()
        self.model = F.MODELS[self.settings.model]

    def forward(self, earlier: Float[Tensor, "B 1 H W"], later: Float[Tensor, "B 1 H W"]) -> Motion:
        """Return the motion from each earlier to its later picture, grey in [0, 1], whose exposures may differ."""
        earlier, later = (picture * LEVEL for picture in (earlier, later))
        points, valid = self.keypoints(earlier)
        matched = F.match_exposure(earlier, later)
        return self.match(points, valid, self.pyramid(matched[0]), self.pyramid(matched[1]))

    def keypoints(
        self, levels: Float[Tensor, "B 1 H W"], *, halved: bool | None = None
    ) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
        """Return the best corners of the cells or of the whole frame, and where there is one. levels: grey, 0 .. 255.

        halved: search at half the resolution, at a quarter of the cost; by default as the parameter says.
        """
        parameters, step = self.settings, 1
        height, width = levels.shape[-2:]
        cell, apart_px = parameters.cell_side(width, height), parameters.min_distance_px
        if (parameters.halved_corners if halved is None else halved) and min(height, width) > 1:
            # Points are half a pixel to the left of and above the corners, which does not matter for a search window.
            levels, cell, step = functional.avg_pool2d(levels, 2), max(cell // 2, 1), 2
            apart_px = max(apart_px // 2, 1)
        least = 1e-7 * LEVEL**2
        if parameters.corners == "frame":
            found = F.frame_features(
                levels,
                parameters.keypoints,
                quality=parameters.quality,
                min_distance_px=apart_px,
                block=parameters.block_px,
                least=least,
            )
            return step * found[0], found[1]
        points, _, valid = F.grid_features(
            levels, cell, quality=parameters.quality, block=parameters.block_px, least=least
        )
        return step * points, valid

    def pyramid(self, levels: Float[Tensor, "B 1 H W"]) -> list[Tensor]:
        """Return the pyramid by OpenCV's rule: levels that are smaller than the window of Lucas-Kanade are left out."""
        count, smaller_side = 1, min(levels.shape[-2:])
        while count <= self.settings.levels and smaller_side / 2**count > self.settings.window_px:
            count += 1
        return F.build_pyramid(levels, count)

    def match(
        self,
        points: Float[Tensor, "B N 2"],
        valid: Bool[Tensor, "B N"],
        earlier: list[Tensor],
        later: list[Tensor],
        *,
        samples: Int64[Tensor, "B S size"] | None = None,
        ransac_px: float | Tensor | None = None,
    ) -> Motion:
        """Return the motion of the keypoints between two pyramids.

        samples: numbers of the keypoints from which hypotheses are drawn. By default they are the same for every pair
        and call, so that pairs of a batch do not affect each other. ransac_px: replaces the parameter.
        """
        effort, parameters = self.effort, self.settings
        ransac_px = parameters.ransac_px if ransac_px is None else ransac_px
        frames = _FramePairs(points, valid, earlier, later, samples)
        if not points.shape[1]:
            return Motion(_identities(points), points, points, valid, valid)
        if effort.branches and points.shape[1] < 2 * effort.scouts:
            return self._search_everywhere(frames, _identities(points), ransac_px)
        scouts = F.spread_ranks(valid, effort.scouts)
        start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
        # A scout that has not arrived after a few steps does not count.
        search = self._search(effort.scout_steps, _SCOUT_REACH_PX)
        ahead, found = F.lucas_kanade(start, earlier, later, rounds=effort.rounds, **search)
        found = found & valid.gather(1, scouts)
        places = None if samples is None else samples * effort.scouts // points.shape[1]
        motion = self._ransac(start, ahead, found, places, ransac_px, effort.scout_refits, parameters.hypotheses // 2)
        if not effort.branches:
            return self._search_near(frames, motion, ransac_px)
        near = F.oneway_transfer_error(start, ahead, motion.float(), squared=False) < ransac_px
        agreed = (found & near).sum(1) >= (_AGREEING * valid.gather(1, scouts).sum(1)).clamp(min=_FEWEST)
        if not F.may_branch(agreed):
            ways = (search(frames, motion, ransac_px) for search in (self._search_near, self._search_everywhere))
            wide = [agreed[:, None], agreed[:, None, None]]
            return Motion(*(torch.where(wide[a.dim() - 2], a, b) for a, b in zip(*ways, strict=True)))
        made: dict[int, Motion] = {}
        for choice, search_from in ((agreed, self._search_near), (~agreed, self._search_everywhere)):
            chosen = choice.nonzero()[:, 0]
            if len(chosen) == len(points):
                return search_from(frames, motion, ransac_px)
            if len(chosen):
                part = search_from(frames.select(chosen), motion[chosen], ransac_px)
                made |= {place: Motion(*row) for place, *row in zip(chosen.tolist(), *part, strict=True)}
        return Motion(*(torch.stack(column) for column in zip(*(made[place] for place in sorted(made)), strict=True)))

    def _search_everywhere(self, frames: "_FramePairs", _: Tensor, ransac_px: float | Tensor) -> Motion:
        """Search by Lucas-Kanade through the whole pyramid, then RANSAC."""
        search = self._search(self.settings.iterations, _SCOUT_REACH_PX) | {"rounds": 3}
        end, tracked = self._track(frames, None, search)
        refits, count = self.effort.refits, self.settings.hypotheses
        matrix = self._ransac(frames.points, end, tracked, frames.samples, ransac_px, refits, count)
        return self._judged(matrix, frames.points, end, tracked, ransac_px)

    def _search_near(self, frames: "_FramePairs", motion: Tensor, ransac_px: float | Tensor) -> Motion:
        """Search by Lucas-Kanade only in the finest level, near the places that the motion predicts; then refit."""
        effort, points = self.effort, frames.points
        finest = frames._replace(earlier=frames.earlier[:1], later=frames.later[:1])
        # The exporter does not know the shape of Kornia's result.
        guess = F.transform_points(motion.float(), points).reshape([int(side) for side in points.shape])
        end, tracked = self._track(finest, guess, self._search(effort.near_steps, _NEAR_REACH_PX))
        if effort.branches:
            gates_px = [share * ransac_px for share in effort.refits]
            matrix = F.refit_map(points.double(), end.double(), tracked, motion, gates_px, self.model)
        else:
            count = self.settings.hypotheses
            matrix = self._ransac(points, end, tracked, frames.samples, ransac_px, effort.refits, count)
        return self._judged(matrix, points, end, tracked, ransac_px)

    def _track(self, frames: "_FramePairs", guess: Tensor | None, search: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the points' new places, and whether each was found there and, if requested, on the way back."""
        given, limit_px = (frames.points, frames.earlier, frames.later, guess), self.settings.forward_backward_px
        if limit_px > 0 and self.effort.branches:
            end, found = F.forward_backward(*given, limit_px=limit_px, **search)
        else:
            end, found = F.lucas_kanade(*given, **search)
        return end, found & frames.valid

    def _search(self, most_steps: int, reach_px: int) -> dict[str, Any]:
        """Return the settings of the search for points."""
        parameters = self.settings
        return {
            "window_px": parameters.window_px,
            "iterations": min(parameters.iterations, most_steps),
            "epsilon_px": parameters.epsilon_px,
            "min_eigen": 1e-4 * LEVEL**2,
            "reach_px": reach_px,
        }

    def _ransac(
        self,
        start: Tensor,
        end: Tensor,
        tracked: Tensor,
        samples: Tensor | None,
        ransac_px: float | Tensor,
        shares: tuple[float, ...],
        hypotheses: int,
    ) -> Tensor:
        """Run RANSAC, then least squares on inliers with tolerances that tighten by `shares` of RANSAC's own."""
        model, (batch, count) = self.model, tracked.shape
        if count < model.size:
            return _identities(start)
        if samples is None:
            samples = _drawn(hypotheses, count, model.size).to(start.device).expand(batch, -1, -1)
        gates_px = [share * ransac_px for share in shares]
        samples = samples[..., : model.size]
        return F.ransac(
            start.double(), end.double(), tracked, samples, model=model, tolerance_px=ransac_px, refits=gates_px
        )[0]

    def _judged(self, matrix: Tensor, start: Tensor, end: Tensor, tracked: Tensor, ransac_px: float | Tensor) -> Motion:
        miss = F.oneway_transfer_error(start.double(), end.double(), matrix, squared=False)
        inliers = tracked & (miss < ransac_px)
        return Motion(matrix, start, end, tracked, inliers & (inliers.sum(1, keepdim=True) >= self.model.size))


class _FramePairs(NamedTuple):
    """Pairs of frames. points: keypoints. valid: whether each keypoint exists. earlier, later: pyramids."""

    points: Tensor
    valid: Tensor
    earlier: list[Tensor]
    later: list[Tensor]
    samples: Tensor | None

    def select(self, chosen: Tensor) -> "_FramePairs":
        earlier, later = ([level[chosen] for level in pyramid] for pyramid in (self.earlier, self.later))
        samples = None if self.samples is None else self.samples[chosen]
        return _FramePairs(self.points[chosen], self.valid[chosen], earlier, later, samples)


def _drawn(hypotheses: int, count: int, size: int) -> Int64[Tensor, "1 S size"]:
    """Draw the keypoints of each hypothesis, by their numbers. Every call draws the same numbers."""
    if F.is_traced():  # a graph holds no generator, so the numbers are its constants
        numbers = np.random.default_rng(0).permuted(np.tile(np.arange(count), (hypotheses, 1)), axis=1)
        return torch.tensor(numbers[None, :, :size].tolist())
    return F.draw_samples(torch.Generator().manual_seed(0), 1, hypotheses, count, size=size)


def _identities(like: Tensor) -> Tensor:
    return torch.eye(3, dtype=torch.float64, device=like.device).expand(len(like), 3, 3)
