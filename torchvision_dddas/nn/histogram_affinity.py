"""How alike targets of two or three frames look: affinities of colour histograms (appendix C, eq. 1 and 3 to 5)."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.errors import InputError

# Pixels of boxes that are read at once, at about 100 bytes each, and affinities that are computed at once.
_PIXELS, _AFFINITIES = 1 << 20, 1 << 21


class HistogramAffinity(nn.Module):
    """Histograms of the boxes of a clip, and the generalised Jaccard affinities of all its windows in batches.

    >>> clip, boxes = torch.rand(3, 3, 32, 32), torch.tensor([[[4.0, 4, 12, 12], [16, 16, 8, 8]]]).expand(3, 2, 4)
    >>> there, windows = torch.ones(3, 2, dtype=torch.bool), torch.tensor([[0, 1], [1, 2]])
    >>> nn.HistogramAffinity()(clip, boxes, there, windows).shape
    torch.Size([2, 2, 2])
    """

    def __init__(self, *, normalize: bool = True, softness: float = 0.0) -> None:
        """normalize: let the histogram of each colour add up to 1. softness: see `functional.rgb_histogram`."""
        super().__init__()
        self.normalize, self.softness = normalize, softness

    def forward(
        self,
        clip: Float[Tensor, "T 3 H W"],
        box_px: Float[Tensor, "T N 4"],
        valid: Bool[Tensor, "T N"],
        windows: Int64[Tensor, "W K"],
    ) -> Float[Tensor, "W N N *N"]:
        """Return affinities, (W, N, N) for windows of K = 2 frames, (W, N, N, N) for 3; 0 if a box is missing.

        clip: RGB in [0, 1]. box_px: x, y, width, height, padded to N boxes in each frame. valid: whether each box
        exists. windows: indices of the frames of each window, newest first.
        """
        return self.affinity(*self.histograms(clip, box_px, valid), windows)

    def histograms(
        self, clip: Float[Tensor, "T 3 H W"], box_px: Float[Tensor, "T N 4"], valid: Bool[Tensor, "T N"]
    ) -> tuple[Float[Tensor, "T N 768"], Bool[Tensor, "T N"]]:
        """Return 3 x 256 bins of every box, and which boxes lie in the picture."""
        (frames, boxes), largest = valid.shape, _largest(clip, box_px, valid)
        pixels = largest[0] * largest[1]
        boxes_at_once = max(1, min(boxes, _PIXELS // pixels))
        frames_at_once = max(1, min(frames, _PIXELS // (boxes_at_once * pixels)))
        made = []
        for first in range(0, frames, frames_at_once):
            some = slice(first, first + frames_at_once)
            columns = zip(box_px[some].split(boxes_at_once, 1), valid[some].split(boxes_at_once, 1), strict=True)
            found = [
                F.rgb_histogram(clip[some], *of, softness=self.softness, normalize=self.normalize, largest=largest)
                for of in columns
            ]
            made.append([torch.cat(parts, 1) for parts in zip(*found, strict=True)])
        histogram, inside = zip(*made, strict=True)
        return torch.cat(histogram), torch.cat(inside)

    def affinity(
        self, feature: Float[Tensor, "T N D"], valid: Bool[Tensor, "T N"], windows: Int64[Tensor, "W K"]
    ) -> Float[Tensor, "W N N *N"]:
        """Return affinities as `forward` does, of any non-negative features, such as the boxes' centres in pixels.

        Raise InputError for windows of other than two or three frames.
        """
        if windows.dim() != 2 or windows.shape[1] not in (2, 3):
            raise InputError(f"windows must be (W, 2) or (W, 3) indices of frames, got {tuple(windows.shape)}")
        count, size = feature.shape[1], windows.shape[1]
        of_frames = F.pair_affinity if size == 2 else F.triplet_affinity
        made = []
        for some in windows.split(max(1, _AFFINITIES // max(1, count**size))):
            frames = some.unbind(1)
            made.append(of_frames(*(feature[places] for places in frames), *(valid[places] for places in frames)))
        return torch.cat(made)


def _largest(clip: Tensor, box_px: Tensor, valid: Tensor) -> tuple[int, int]:
    """Return (height, width) that no box exceeds after rounding; in a graph, whose shapes are fixed, the clip's."""
    height, width = clip.shape[-2:]
    if torch.compiler.is_compiling() or not box_px.numel():
        return height, width
    side = torch.where(valid[..., None], box_px[..., 2:], 0.0).nan_to_num(0.0).flatten(0, 1).amax(0)
    wide, tall = (int(length) + 2 for length in side.clamp(0, max(height, width)).tolist())
    return min(height, tall), min(width, wide)
