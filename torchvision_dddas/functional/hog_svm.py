"""Dense histograms of oriented gradients under a linear SVM: the scores of all windows of a picture at once.

Scores equal those of OpenCV's `HOGDescriptor` to 1e-4, because all details are OpenCV's: square-root gamma, the
polynomial for the arc tangent, circular bins, Gaussian and bilinear weights in a block, L2-Hys with its constants. Only
the order of sums differs.
Source: N. Dalal and B. Triggs, Histograms of oriented gradients for human detection, CVPR 2005.
"""

import math
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from torchvision_dddas.errors import InputError

# OpenCV's odd polynomial for the arc tangent of 0 .. 1, in degrees (modules/core, mathfuncs_core: fastAtan).
ARC = tuple(
    p * 180 / math.pi for p in (0.9997878412794807, -0.3258083974640975, 0.1555786518463281, -0.04432655554792128)
)
TINY = 2.220446049250313e-16  # OpenCV adds this to the divisor

# OpenCV's L2-Hys (modules/objdetect, hog.cpp) adds SOFT_FIRST for each number of a block to the norm before it clips
# the numbers, and SOFT_SECOND to the norm after that.
SOFT_FIRST, SOFT_SECOND = 0.1, 1e-3


@dataclass(frozen=True)
class Layout:
    """The layout of a descriptor; lengths in pixels.

    window: (width, height). cell, block: side of a square. stride: step from block to block. bins: number of directions
    in half a turn, or in a whole turn if signed. clip: limit of the values in L2-Hys. gamma: take roots of the levels.
    Raise InputError if cells do not fill the block, or blocks do not fill the window.

    >>> F.Layout().window, F.Layout(window=(32, 64)).window
    ((64, 128), (32, 64))
    """

    window: tuple[int, int] = (64, 128)
    cell: int = 8
    block: int = 16
    stride: int = 8
    bins: int = 9
    signed: bool = False
    clip: float = 0.2
    gamma: bool = True

    def __post_init__(self) -> None:
        if self.block % self.cell:
            raise InputError(f"a block of {self.block} px is not a multiple of a cell of {self.cell} px")
        for name, length in zip(("width", "height"), self.window, strict=True):
            if length < self.block or (length - self.block) % self.stride:
                raise InputError(
                    f"blocks of {self.block} px every {self.stride} px do not fill a window {name} of {length} px; "
                    f"wanted {self.block} + a multiple of {self.stride}"
                )

    @property
    def cells(self) -> int:
        """The number of cells along a block's side."""
        return self.block // self.cell

    @property
    def blocks(self) -> tuple[int, int]:
        """The numbers of blocks of a window, (across, down)."""
        width, height = ((length - self.block) // self.stride + 1 for length in self.window)
        return width, height

    @property
    def features(self) -> int:
        """The number of values of a descriptor."""
        return self.blocks[0] * self.blocks[1] * self.cells**2 * self.bins


def gradient(bordered: Tensor, gamma: bool = True) -> tuple[Tensor, Tensor]:
    """Return differences of neighbours across and down, (B, 1, H, W) each, of the channel with the largest gradient.

    bordered: (B, C, H + 2, W + 2) levels 0 .. 255 with a border of one pixel, reflected (101) at the picture's edge. Of
    equal channels the first counts, as in OpenCV's BGR order.
    """
    levels = bordered
    if gamma:
        # The slope of the root is infinite at black, and would turn the gradient of all black pixels into NaN.
        levels = (bordered.clamp(min=1e-30) if bordered.requires_grad else bordered).sqrt()
    across = levels[..., 1:-1, 2:] - levels[..., 1:-1, :-2]
    down = levels[..., 2:, 1:-1] - levels[..., :-2, 1:-1]
    square = across * across + down * down
    dx, dy, largest = across[:, :1], down[:, :1], square[:, :1]
    for channel in range(1, bordered.shape[1]):
        here = slice(channel, channel + 1)
        wins = square[:, here] > largest
        dx, dy = torch.where(wins, across[:, here], dx), torch.where(wins, down[:, here], dy)
        largest = torch.maximum(largest, square[:, here])
    return dx, dy


def angle(dx: Tensor, dy: Tensor, layout: Layout) -> Tensor:
    """Return the direction in bins, from -0.5 to bins - 0.5; 0 is the centre of the first bin.

    OpenCV's polynomial is up to 0.01 degrees off the true angle. The trained weights fit the polynomial.
    """
    x, y = dx.abs(), dy.abs()
    ratio = torch.minimum(x, y) / (torch.maximum(x, y) + TINY).clamp(min=TINY)
    square = ratio * ratio
    degrees = (((ARC[3] * square + ARC[2]) * square + ARC[1]) * square + ARC[0]) * ratio
    degrees = torch.where(x < y, 90 - degrees, degrees)
    if layout.signed:
        degrees = torch.where(dx < 0, 180 - degrees, degrees)
        degrees = torch.where(dy < 0, 360 - degrees, degrees)
    else:
        degrees = torch.where((dx < 0) ^ (dy < 0), 180 - degrees, degrees)
    return degrees * (layout.bins / (360 if layout.signed else 180)) - 0.5


def knots(bins: int) -> list[int]:
    """Return the whole numbers between which `angle` lies. Knot k is the centre of bin k modulo bins."""
    return list(range(-1, bins + 1))


def hats(dx: Tensor, dy: Tensor, layout: Layout) -> Tensor:
    """Return the share of each pixel's magnitude m at each knot k, relu(m - |m (angle - k)|), (B, K, H, W).

    Knots of the same bin are added after the pooling, when there are 64 times fewer numbers: see `bins_of_knots`.
    """
    magnitude = torch.sqrt((dx * dx + dy * dy).clamp(min=1e-30))
    turn = magnitude * angle(dx, dy, layout)
    at = torch.tensor(knots(layout.bins), dtype=dx.dtype, device=dx.device).view(1, -1, 1, 1)
    return (magnitude - (turn - magnitude * at).abs()).relu()


def bins_of_knots(bins: int) -> Tensor:
    """Return (bins, K) float64, 1 where a knot is the centre of a bin."""
    return torch.eye(bins, dtype=torch.float64)[:, [knot % bins for knot in knots(bins)]]


def cell_weights(layout: Layout) -> Tensor:
    """Return the weight of each row or column of a block's pixels in each of its cells, (cells, block) float64.

    The weight is a Gaussian with a sigma of a quarter of the block, half a pixel off like OpenCV's, times a hat.
    """
    place = torch.arange(layout.block, dtype=torch.float64)
    sigma = layout.block / 4
    gauss = torch.exp(-((place - layout.block / 2) ** 2) / (2 * sigma**2))
    cell = torch.arange(layout.cells, dtype=torch.float64)[:, None]
    hat = (1 - ((place + 0.5) / layout.cell - 0.5 - cell).abs()).clamp(min=0)
    return gauss * hat


def _pooled(maps: Tensor, layout: Layout) -> Tensor:
    """Return weighted sums over the rows of each block: (..., rows, N) -> (..., cells, blocks, N)."""
    step = math.gcd(layout.block, layout.stride)
    parts, hop = layout.block // step, layout.stride // step
    strips = maps.shape[-2] // step
    blocks = (strips - parts) // hop + 1
    cut = maps[..., : strips * step, :].unflatten(-2, (strips, step))
    weights = cell_weights(layout).to(maps).view(layout.cells, parts, step)
    rows = torch.matmul(weights.flatten(0, 1), cut).unflatten(-2, (layout.cells, parts))  # (..., strips, c, parts, N)
    shifted = [rows[..., part : part + (blocks - 1) * hop + 1 : hop, :, part, :] for part in range(parts)]
    return reduce(torch.add, shifted).transpose(-3, -2)


def hog(bordered: Tensor, layout: Layout, *, clip: Tensor | None = None) -> Tensor:
    """Return normalised histograms of every block, (B, F, ny, nx), F = bins x cells down x cells across.

    bordered: as in `gradient`; its inside must hold a block. clip: replaces the layout's clip.

    >>> F.hog(torch.rand(1, 1, 130, 66) * 255, F.Layout()).shape
    torch.Size([1, 36, 15, 7])
    """
    maps = hats(*gradient(bordered, layout.gamma), layout)  # (B, K, H, W)
    down = _pooled(maps, layout)  # (B, K, cy, ny, W)
    both = _pooled(down.transpose(-1, -2), layout)  # (B, K, cy, W, ny) -> (B, K, cy, cx, nx, ny)
    histogram = torch.matmul(bins_of_knots(layout.bins).to(maps), both.flatten(2)).unflatten(
        2, both.shape[2:]
    )  # (B, bins, cy, cx, nx, ny)
    histogram = histogram.transpose(-1, -2).flatten(1, 3)
    size = layout.bins * layout.cells**2
    norm = torch.sqrt((histogram * histogram).sum(1, keepdim=True).clamp(min=1e-30)) + size * SOFT_FIRST
    share = histogram / norm
    clipped = share.clamp(max=layout.clip) if clip is None else torch.minimum(share, clip)
    return clipped / (torch.sqrt((clipped * clipped).sum(1, keepdim=True).clamp(min=1e-30)) + SOFT_SECOND)


def arrange_weights(weights: Tensor, layout: Layout) -> Tensor:
    """Rearrange a linear SVM's weights from OpenCV's order, (down x across x F,), to (down, across, F).

    OpenCV stores the blocks of a window, and the cells of a block, by columns; bins vary fastest. `svm_scores` takes
    the result.

    >>> F.arrange_weights(torch.zeros(3780), F.Layout()).shape
    torch.Size([15, 7, 36])
    """
    across, down = layout.blocks
    cells = layout.cells
    return weights.view(across, down, cells, cells, layout.bins).permute(1, 0, 4, 3, 2).reshape(down, across, -1)


def svm_scores(block_map: Tensor, weights: Tensor, bias: Tensor) -> Tensor:
    """Return the SVM's score of the window at each block, (B, ny - down + 1, nx - across + 1).

    block_map: (B, F, ny, nx). weights: (down, across, F). bias: a number that is added.

    >>> F.svm_scores(torch.ones(1, 2, 4, 3), torch.ones(3, 2, 2), torch.tensor(-1.0))
    tensor([[[11., 11.],
             [11., 11.]]])
    """
    batch, _, ny, nx = block_map.shape
    down, across, _ = weights.shape
    part = torch.matmul(weights.flatten(0, 1), block_map.flatten(2))  # (B, down x across, ny nx)
    # Sum over the blocks of a window: the block in row i, column j of a window has part (i, j) of the weights. Padding
    # shifts part (i, j) by i rows and j columns, so that one sum over the parts adds the blocks of each window.
    places = ny * nx
    part = (
        torch.nn.functional.pad(part.reshape(batch, down, -1), (0, across)).unflatten(-1, (across, places + 1)).sum(2)
    )
    part = (
        torch.nn.functional.pad(part.reshape(batch, -1), (0, down * nx)).unflatten(-1, (down, places + 1 + nx)).sum(1)
    )
    total = part[:, :places].unflatten(-1, (ny, nx))
    return total[:, : ny - down + 1, : nx - across + 1] + bias
