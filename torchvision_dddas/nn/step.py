"""The steps that are exported as graphs: plane homographies, registration, difference, and the last two in one.

They do what the chain does with `difference.kind = "to_reference"` and one pair of neighbours, as configs/fast.toml has
it, but for the correction of exposures. What the controller moves is an input; sizes and budgets are baked in.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.config import DifferenceParameters, MorphologyParameters, RegistrationParameters, Settings

# Keypoints that search the whole pyramid; the others start where these say, in the full resolution alone. 200 of them
# all searching would take three times the nodes' work. With 64 scouts, or 3 steps, a motion in some dozens is lost.
SCOUTS, STEPS, REACH_PX = 96, 6, 3
REFITS = 1.0, 0.5  # of the tolerance of RANSAC
WHITE = 255.0


class PlaneHomography(nn.Module):
    """`functional.find_homography_dlt`."""

    def forward(self, ground: Tensor, image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Matrix (B, 3, 3), valid (B,) of ground and image (B, n, 2), weight (B, n)."""
        return F.find_homography_dlt(ground, image, weight)


class RawPlaneHomography(nn.Module):
    """`functional.find_homography_raw`, which solves four landmarks in another way than more."""

    def forward(self, ground: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """Matrix (B, 3, 3), valid (B,) of ground and image (B, n, 2). A trace has no branches: both ways are taken."""
        exact, exact_valid = F.find_homography_raw(ground[:, :4], image[:, :4])
        least, least_valid = F.find_homography_raw(ground, image)
        is_exact = torch.ones_like(ground[:1, :, 0]).sum(1) == 4
        matrix = torch.where(is_exact[:, None, None], exact, least)
        return matrix, (is_exact & exact_valid) | (~is_exact & least_valid)  # the runtime has no `where` of Booleans


class WarpDifference(nn.Module):
    """Where three pictures differ after two of them were brought onto the first."""

    def __init__(self, difference: DifferenceParameters, morphology: MorphologyParameters) -> None:
        super().__init__()
        self.difference, self.morphology = difference, morphology

    def forward(
        self, reference: Tensor, neighbours: Tensor, neighbour_from_reference: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Difference and mask (255 where something moves), both uint8 (H, W).

        reference: uint8 (H, W). neighbours: uint8 (2, H, W). neighbour_from_reference: float64 (2, 3, 3), px.
        threshold: uint8 (), grey levels; a larger difference is foreground.
        """
        height, width = reference.shape
        grey, levels = reference[None, None], neighbours[:, None].float()
        warped = F.warp_perspective(
            levels, neighbour_from_reference, (height, width), padding_mode="border", inverse_map=True, subpixels=32
        )
        warped = (warped + 0.5).floor().to(torch.uint8)
        first, last = F.seen_columns(
            neighbour_from_reference, (height, width), (height, width), self.difference.border_px
        )
        seen = F.seen_by_both((first[:1], last[:1]), (first[1:], last[1:]), width)
        least = torch.minimum(*(torch.maximum(grey, one) - torch.minimum(grey, one) for one in warped.split(1)))
        found = F.gaussian_blur2d(least, self.difference.blur_px) * seen
        core = (found > threshold).to(torch.uint8) * 255
        erode, close = (
            F.structuring_element("ellipse", side) for side in (self.morphology.erode_px, self.morphology.close_px)
        )
        return found[0, 0], F.closing(F.erosion(core, erode), close)[0, 0]


class Register(nn.Module):
    """The background's motion from a picture to each of its neighbours."""

    def __init__(self, size: tuple[int, int], parameters: RegistrationParameters, cell_px: int) -> None:
        """size: (width, height) in px. cell_px: side of the cells with one keypoint each."""
        super().__init__()
        self.settings, self.cell = parameters, cell_px
        self.count = (size[0] // cell_px) * (size[1] // cell_px)
        self.levels = 1
        while self.levels <= parameters.levels and min(size) / 2**self.levels > parameters.window_px:
            self.levels += 1
        self.model = F.MODELS[parameters.model]

    def forward(
        self, reference: Tensor, neighbours: Tensor, samples: Tensor, tolerance_px: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """neighbour_from_reference float64 (2, 3, 3), the inliers it has and the keypoints followed, int64 (2,).

        samples: int64 (S, 4), numbers of keypoints from which the hypotheses are drawn. tolerance_px: float64 ().
        Where nothing agrees: the identity, with 0 inliers.
        """
        parameters, pairs = self.settings, len(neighbours)
        levels = reference[None, None].float()
        points, _, valid = F.grid_features(
            levels, self.cell, parameters.quality, parameters.block_px, least=1e-7 * WHITE**2
        )
        points, valid = points.expand(pairs, -1, -1), valid.expand(pairs, -1)
        earlier = [level.expand(pairs, -1, -1, -1) for level in F.build_pyramid(levels, self.levels)]
        later = F.build_pyramid(neighbours[:, None].float(), self.levels)
        samples = samples.expand(pairs, -1, -1)

        scouts = F.spread_ranks(valid, SCOUTS)
        start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
        ahead, found = self._track(start, earlier, later, None)
        found = found & valid.gather(1, scouts)
        places = samples * SCOUTS // self.count
        motion = self._ransac(start, ahead, found, places, tolerance_px, (1.0,))[0]

        guess = F.transform_points(motion.float(), points)
        end, tracked = self._track(points, earlier[:1], later[:1], guess)
        tracked = tracked & valid
        matrix, inliers, agreed = self._ransac(points, end, tracked, samples, tolerance_px, REFITS)
        return matrix, (inliers & agreed[:, None]).sum(1), tracked.sum(1)

    def _track(
        self, points: Tensor, earlier: list[Tensor], later: list[Tensor], guess: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        parameters = self.settings
        settings = {
            "window_px": parameters.window_px,
            "iterations": min(parameters.iterations, STEPS),
            "epsilon_px": parameters.epsilon_px,
            "min_eigen": 1e-4 * WHITE**2,
        } | ({} if guess is None else {"reach_px": REACH_PX})
        return F.lucas_kanade(points, earlier, later, guess, **settings)  # type: ignore[arg-type]

    def _ransac(
        self, start: Tensor, end: Tensor, tracked: Tensor, samples: Tensor, gate_px: Tensor, shares: Sequence[float]
    ) -> tuple[Tensor, Tensor, Tensor]:
        gates, samples = tuple(share * gate_px for share in shares), samples[..., : self.model.size]
        return F.ransac(start.double(), end.double(), tracked, samples, self.model, gate_px, gates)


class Step(nn.Module):
    """Registration and difference in one."""

    def __init__(self, size: tuple[int, int], settings: Settings, cell_px: int) -> None:
        super().__init__()
        self.register = Register(size, settings.registration, cell_px)
        self.compare = WarpDifference(settings.difference, settings.morphology)

    def forward(
        self, reference: Tensor, neighbours: Tensor, samples: Tensor, tolerance_px: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What `Register` gives, then what `WarpDifference` does."""
        matrix, inliers, tracked = self.register(reference, neighbours, samples, tolerance_px)
        return matrix, inliers, tracked, *self.compare(reference, neighbours, matrix, threshold)
