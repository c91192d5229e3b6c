"""Histograms of oriented gradients, and scores of windows for people (appendix A, III-B)."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.errors import InputError


class HOGDescriptor(nn.Module):
    """Normalised histograms of all blocks of RGB or grey pictures in [0, 1], as cv2.HOGDescriptor computes them.

    >>> nn.HOGDescriptor()(torch.rand(1, 3, 128, 64)).shape
    torch.Size([1, 36, 15, 7])
    """

    def __init__(self, layout: F.Layout | None = None) -> None:
        """layout: layout of cells, blocks and window; by default OpenCV's."""
        super().__init__()
        self.layout = layout or F.Layout()

    def forward(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B F ny nx"]:
        """Return histograms, F = bins x cells down x cells across; ny, nx: blocks, every `layout.stride` pixels."""
        return F.hog(self.bordered(image), self.layout)

    def bordered(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H+2 W+2"]:
        """Return the input of `functional.hog`: levels 0 to 255 in OpenCV's colour order, with a mirrored border."""
        return F.pad_reflect(image.flip(1) * 255, 1, 1, 1, 1)


class PersonScorer(nn.Module):
    """Scores of all windows of a picture under a linear SVM of HOG; weights and bias are nn.Parameters.

    >>> nn.PersonScorer(torch.zeros(3780), 1.5)(torch.rand(1, 3, 136, 72)).tolist()
    [[[1.5, 1.5], [1.5, 1.5]]]
    """

    def __init__(
        self, weights: Float[Tensor, " D"], bias: float, *, layout: F.Layout | None = None, window_stride_px: int = 8
    ) -> None:
        """weights: `layout.features` numbers in OpenCV's order. window_stride_px: step from window to window.

        Raise InputError for another number of weights.
        """
        super().__init__()
        self.descriptor, self.window_stride_px = HOGDescriptor(layout), window_stride_px
        if tuple(weights.shape) != (self.descriptor.layout.features,):
            raise InputError(f"weights must be {self.descriptor.layout.features} numbers, got {tuple(weights.shape)}")
        arranged = F.arrange_weights(weights.detach(), self.descriptor.layout).contiguous()
        self.weights = nn.Parameter(arranged)
        self.bias = nn.Parameter(torch.tensor(bias, dtype=weights.dtype))

    def forward(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B ny nx"]:
        """Return the scores of the windows of RGB or grey pictures in [0, 1], from the top left corner on."""
        return self.score(self.descriptor.bordered(image))

    def score(self, bordered: Float[Tensor, "B C H+2 W+2"]) -> Float[Tensor, "B ny nx"]:
        """Return scores as `forward` does, of bordered levels.

        Blocks are computed at the common divisor of the strides of windows and blocks. Windows that share blocks are
        scored together, once for each phase of the block stride.
        """
        layout, stride = self.descriptor.layout, self.window_stride_px
        step = math.gcd(stride, layout.stride)
        hop, skip = layout.stride // step, stride // step
        blocks = F.hog(bordered, replace(layout, stride=step))
        if hop == 1:
            return F.svm_scores(blocks, self.weights, self.bias)[:, ::skip, ::skip]
        height, width = (side - 2 for side in bordered.shape[-2:])
        ny, nx = (height - layout.window[1]) // step + 1, (width - layout.window[0]) // step + 1
        dense = bordered.new_empty(len(bordered), ny, nx)
        for down in range(min(hop, ny)):
            for across in range(min(hop, nx)):
                phase = F.svm_scores(blocks[..., down::hop, across::hop], self.weights, self.bias)
                dense[:, down::hop, across::hop] = phase
        return dense[:, ::skip, ::skip]
