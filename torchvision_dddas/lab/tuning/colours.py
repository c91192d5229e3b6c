"""Ranges of landmark colours, learned from pictures in which the landmarks are labelled."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import FULL, TURN, bgr_to_hsv, within_ranges
from torchvision_dddas.io.colour_files import find_overlaps
from torchvision_dddas.types import Colours

SOFTNESS = (20.0, 2.0)
"""In levels, at the first and the last step."""

RATE = 1.5
"""Of Adam, in levels."""

MOST_PIXELS = 200_000
"""Of all pictures, that a step takes in; of more, some drawn once, labelled ones first."""


def fit_colours(
    pictures: Sequence[np.ndarray],
    labels: Sequence[np.ndarray],
    names: Sequence[str],
    steps: int = 120,
    seed: int = 0,
    start: Colours | None = None,
) -> Colours:
    """Ranges that hold what is labelled and little else.

    pictures: (H, W, 3) uint8 BGR. labels: (H, W) of each: 0 the ground and all that wears no colour, k the k-th of
    names. start: ranges to begin with; about the mean colours without. The best state is taken, by hard ranges.
    Raises InputError where a colour is labelled nowhere, pictures and labels differ in size, or ranges come out that
    overlap, so that one landmark would be taken for another.
    """
    bgr, worn = _pixels(pictures, labels, len(names), seed)
    soft = start_ranges(bgr, worn)
    if start is not None:
        if start.names != tuple(names):
            raise InputError(f"the ranges to begin with are of {', '.join(start.names)}; wanted {', '.join(names)}")
        soft = SoftColours(*(torch.as_tensor(np.array(end, float)) for end in (start.low, start.high)))
    adam = torch.optim.Adam(soft.parameters(), lr=RATE)
    best, least, hsv = soft.ranges(), float("inf"), bgr_to_hsv(bgr)
    for step in range(steps + 1):
        ranges = soft.ranges()
        wrong = float(confusion(within_ranges(hsv, ranges[0].to(bgr), ranges[1].to(bgr)), worn).sum())
        if wrong < least:
            best, least = ranges, wrong
        if step < steps:
            softness = SOFTNESS[0] * (SOFTNESS[1] / SOFTNESS[0]) ** (step / max(steps - 1, 1))
            adam.zero_grad()
            confusion(soft(bgr, softness), worn).sum().backward()
            adam.step()
    low, high = (end.numpy() for end in best)
    for a, b in find_overlaps(low, high):
        raise InputError(
            f"the colours of {names[a]} and {names[b]} come out overlapping: these pictures do not tell them apart; "
            "paint one of them differently, or label more pictures"
        )
    return Colours(tuple(names), low, high)


def _pixels(
    pictures: Sequence[np.ndarray], labels: Sequence[np.ndarray], count: int, seed: int
) -> tuple[Tensor, Tensor]:
    """All pixels as one picture (1, 3, 1, N) in [0, 1], and what they wear (1, K, 1, N)."""
    for number, (picture, label) in enumerate(zip(pictures, labels, strict=True), 1):
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.shape[:2] != label.shape:
            raise InputError(
                f"picture {number} is {' x '.join(map(str, picture.shape))}, its labels "
                f"{' x '.join(map(str, label.shape))}; wanted height x width x 3 (BGR), and labels of that size"
            )
    colour = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
    label = np.concatenate([one.ravel() for one in labels])
    if label.max(initial=0) > count or label.min(initial=0) < 0:
        raise InputError(f"labels go from {label.min()} to {label.max()}; wanted 0 to {count}, for the names given")
    if len(label) > MOST_PIXELS:
        chance = np.random.default_rng(seed).uniform(0, 1, len(label))
        kept = np.sort(np.argsort(np.where(label > 0, chance - 1, chance))[:MOST_PIXELS])
        colour, label = colour[kept], label[kept]
    worn = np.stack([label == k for k in range(1, count + 1)]).astype(np.float32)
    pixels = np.ascontiguousarray(colour.T, np.float32) / 255
    return torch.from_numpy(pixels)[None, :, None], torch.from_numpy(worn)[None, :, None]


LEAST_HALF = 1.0
"""No range is narrower than this either way, in levels: a range of nothing has no slope back."""

_START_HALF = (12.0, 60.0, 70.0)  # of hue, saturation, value, about the patch's own colour


class SoftColours(nn.Module):
    """K ranges of hue, saturation and value, as their middles and half widths; the hue goes round.

    Ends that come out beyond 0 or 255 of saturation and value are the ends of what there is.
    """

    def __init__(self, low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"]) -> None:
        """low, high: as `color.within_ranges` takes them; a lowest hue above the highest goes over 0."""
        super().__init__()
        low, high = low.double(), high.double()
        high = high + torch.where(low > high, TURN, 0.0) * torch.tensor([1.0, 0.0, 0.0])
        half = ((high - low) / 2 - LEAST_HALF).clamp(min=1e-3)
        self.middle = nn.Parameter((low + high) / 2)
        self.free = nn.Parameter(half + torch.log(-torch.expm1(-half)))  # softplus, undone

    def _ends(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest (K, 3), with gradients; a lowest hue below 0 or a highest above 180 goes over 0."""
        half = LEAST_HALF + functional.softplus(self.free)
        return self.middle - half, self.middle + half

    def forward(self, bgr: Float[Tensor, "B 3 H W"], softness: float) -> Float[Tensor, "B K H W"]:
        """How much each pixel of pictures in [0, 1] is of each colour; softness in levels, hard at 0."""
        low, high = self._ends()
        return within_ranges(bgr_to_hsv(bgr), low.to(bgr), high.to(bgr), softness)

    def ranges(self) -> tuple[Int[Tensor, "K 3"], Int[Tensor, "K 3"]]:
        """Lowest and highest in whole levels, as `Colours` has them: hues from 0 to 180."""
        low, high = (end.detach().round().long() for end in self._ends())
        whole = high[:, 0] - low[:, 0] >= int(TURN)
        low[:, 0], high[:, 0] = torch.remainder(low[:, 0], int(TURN)), torch.remainder(high[:, 0], int(TURN))
        low[whole, 0], high[whole, 0] = 0, int(TURN)
        low[:, 1:], high[:, 1:] = low[:, 1:].clamp(0, int(FULL)), high[:, 1:].clamp(0, int(FULL))
        return low, high


def start_ranges(bgr: Float[Tensor, "B 3 H W"], worn: Float[Tensor, "B K H W"]) -> SoftColours:
    """Ranges about the mean colour of what wears each. Raises InputError where nothing wears one."""
    hsv = bgr_to_hsv(bgr)
    angle = hsv[:, 0] * (2 * torch.pi / TURN)
    middles = []
    for k in range(worn.shape[1]):
        weight = worn[:, k]
        total = weight.sum()
        if not float(total):
            raise InputError(f"no pixel is labelled with colour {k + 1}; wanted a patch of each")
        hue = torch.atan2((weight * angle.sin()).sum(), (weight * angle.cos()).sum()) * (TURN / (2 * torch.pi))
        rest = [(weight * hsv[:, channel]).sum() / total for channel in (1, 2)]
        middles.append(torch.stack([torch.remainder(hue, TURN), *rest]))
    middle, half = torch.stack(middles).double(), torch.tensor(_START_HALF, dtype=torch.float64)
    found = SoftColours(torch.zeros_like(middle), torch.ones_like(middle))
    with torch.no_grad():
        found.middle.copy_(middle)
        found.free.copy_((half - LEAST_HALF).expand_as(middle))
    return found


def confusion(found: Float[Tensor, "B K H W"], worn: Float[Tensor, "B K H W"]) -> Float[Tensor, " K"]:
    """1 - F of each colour's pixels over all pictures, as soft as these: ground and others' paint are wrong."""
    axes = (0, 2, 3)
    return 1 - 2 * (found * worn).sum(axes) / (found.sum(axes) + worn.sum(axes)).clamp(min=1e-6)
