"""How alike targets of two or three frames look: affinities of colour histograms (appendix C, eq. 1 and 3 to 5)."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

import torchvision_dddas.functional as F

# Frames whose histograms, and windows whose affinities, are computed at once: their temporaries are large.
_FRAMES, _WINDOWS = 8, 64


class HistogramAffinity(nn.Module):
    """Histograms of the boxes of a clip, and the generalised Jaccard affinities of all its windows in batches."""

    def __init__(self, normalize: bool = True, softness: float = 0.0) -> None:
        """normalize: each colour's histogram adds up to 1. softness: see `functional.rgb_histogram`."""
        super().__init__()
        self.normalize, self.softness = normalize, softness

    def forward(
        self,
        clip: Float[Tensor, "T 3 H W"],
        box_px: Float[Tensor, "T N 4"],
        valid: Bool[Tensor, "T N"],
        windows: Int64[Tensor, "W K"],
    ) -> Float[Tensor, "W N N *N"]:
        """(W, N, N) for windows of K = 2 frames, (W, N, N, N) for 3; 0 where a box is missing.

        clip: RGB in [0, 1]. box_px: x, y, width, height, padded to N a frame; valid: which are there. windows: places
        of their frames in the clip, newest first.
        """
        return self.affinity(*self.histograms(clip, box_px, valid), windows)

    def histograms(
        self, clip: Float[Tensor, "T 3 H W"], box_px: Float[Tensor, "T N 4"], valid: Bool[Tensor, "T N"]
    ) -> tuple[Float[Tensor, "T N 768"], Bool[Tensor, "T N"]]:
        """3 x 256 bins of every box, and which boxes lie in the picture."""
        made = []
        for first in range(0, len(clip), _FRAMES):
            part = slice(first, first + _FRAMES)
            made.append(F.rgb_histogram(clip[part], box_px[part], valid[part], self.softness, self.normalize))
        histogram, inside = zip(*made, strict=True)
        return torch.cat(histogram), torch.cat(inside)

    def affinity(
        self, feature: Float[Tensor, "T N D"], valid: Bool[Tensor, "T N"], windows: Int64[Tensor, "W K"]
    ) -> Float[Tensor, "W N N *N"]:
        """As `forward`, of any non-negative features of the boxes: histograms, or their centres in pixels."""
        of_frames = F.pair_affinity if windows.shape[1] == 2 else F.triplet_affinity
        made = []
        for some in windows.split(_WINDOWS):
            frames = some.unbind(1)
            made.append(of_frames(*(feature[places] for places in frames), *(valid[places] for places in frames)))
        return torch.cat(made)
